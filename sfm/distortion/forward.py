"""Distortion of the ideal point in mm, with affinity and shear of the ideal or of the distorted point.

Signs as PhotoModeler and DBAT. Its outputs are described in `sfm.distortion.models`.
"""

from __future__ import annotations

from sfm.conventions import FloatArray
from sfm.kernels.options import inlined


@inlined
def brown_forward(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Distortion of the ideal point in mm: c, x0, y0, K1-K4, P1, P2, affinity b1, shear b2.

    X = c u, Y = c v, r2 = X^2 + Y^2, xd = X (1 + K1 r2 + ... + K4 r8) + P1 (r2 + 2 X^2) + 2 P2 X Y,
    yd = Y (1 + ...) + P2 (r2 + 2 Y^2) + 2 P1 X Y, y = y0 + yd, and x = x0 + xd + b1 X + b2 Y or, where
    frame[5] is 1, x = x0 + xd + b1 xd + b2 yd.

    Source: AICON 3D Studio, and Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2020), sec. 3.3,
    for affinity and shear of the ideal point; Zhang (2000), IEEE Trans. PAMI 22(11), whose skew is c b2, and
    the Agisoft Metashape manual, app. D, frame camera (there in units of c), for those of the distorted one.
    """
    sx, sy, on = frame[2], frame[3], frame[5]
    c, x0, y0, K1, K2, K3, K4 = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
    P1, P2, b1, b2 = p[7], p[8], p[9], p[10]
    X, Y = c * u, c * v
    r2 = X * X + Y * Y
    r4 = r2 * r2
    r6 = r4 * r2
    r8 = r4 * r4
    radial = 1.0 + K1 * r2 + K2 * r4 + K3 * r6 + K4 * r8
    slope = 2.0 * (K1 + 2.0 * K2 * r2 + 3.0 * K3 * r4 + 4.0 * K4 * r6)
    P1x, P1y, P2y = r2 + 2.0 * X * X, 2.0 * X * Y, r2 + 2.0 * Y * Y  # P2x = P1y
    xd = X * radial + P1 * P1x + P2 * P1y
    yd = Y * radial + P2 * P2y + P1 * P1y
    dxx = radial + slope * X * X + 6.0 * P1 * X + 2.0 * P2 * Y
    dxy = slope * X * Y + 2.0 * P1 * Y + 2.0 * P2 * X  # = dyx
    dyy = radial + slope * Y * Y + 6.0 * P2 * Y + 2.0 * P1 * X
    # what affinity and shear act on, X and Y or xd and yd
    off = 1.0 - on
    xa, ya = off * X + on * xd, off * Y + on * yd
    a, s = 1.0 + on * b1, on * b2  # of distortion
    fx, fy = 1.0 / sx, -1.0 / sy
    xX = a * dxx + s * dxy + off * b1
    xY = a * dxy + s * dyy + off * b2
    residual[0] = fx * (x0 + xd + b1 * xa + b2 * ya) + frame[0] - x
    residual[1] = fy * (y0 + yd) + frame[1] - y
    Ju[0, 0] = fx * xX * c
    Ju[0, 1] = fx * xY * c
    Ju[1, 0] = fy * dxy * c
    Ju[1, 1] = fy * dyy * c
    Jp[0, 0] = fx * (xX * u + xY * v)
    Jp[1, 0] = fy * (dxy * u + dyy * v)
    Jp[0, 1] = fx
    Jp[1, 1] = 0.0
    Jp[0, 2] = 0.0
    Jp[1, 2] = fy
    Kx, Ky = fx * (a * X + s * Y), fy * Y
    Jp[0, 3] = Kx * r2
    Jp[1, 3] = Ky * r2
    Jp[0, 4] = Kx * r4
    Jp[1, 4] = Ky * r4
    Jp[0, 5] = Kx * r6
    Jp[1, 5] = Ky * r6
    Jp[0, 6] = Kx * r8
    Jp[1, 6] = Ky * r8
    Jp[0, 7] = fx * (a * P1x + s * P1y)
    Jp[1, 7] = fy * P1y
    Jp[0, 8] = fx * (a * P1y + s * P2y)
    Jp[1, 8] = fy * P2y
    Jp[0, 9] = fx * xa
    Jp[1, 9] = 0.0
    Jp[0, 10] = fx * ya
    Jp[1, 10] = 0.0
