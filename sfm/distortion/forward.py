"""Distortion of the ideal point in mm, as AICON and Metashape have it.

Signs as PhotoModeler and DBAT. What a model fills is said in `sfm.distortion.models`.
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

    Source: Agisoft Metashape manual, app. D, frame camera (there in units of c), and AICON; in mm
    X = c u, Y = c v, r2 = X^2 + Y^2, x = x0 + X (1 + K1 r2 + ... + K4 r8) + P1 (r2 + 2 X^2)
    + 2 P2 X Y + b1 X + b2 Y, y = y0 + Y (1 + ...) + P2 (r2 + 2 Y^2) + 2 P1 X Y.
    """
    sx, sy = frame[2], frame[3]
    c, x0, y0, K1, K2, K3, K4 = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
    P1, P2, b1, b2 = p[7], p[8], p[9], p[10]
    X, Y = c * u, c * v
    r2 = X * X + Y * Y
    r4 = r2 * r2
    r6 = r4 * r2
    r8 = r4 * r4
    radial = 1.0 + K1 * r2 + K2 * r4 + K3 * r6 + K4 * r8
    slope = 2.0 * (K1 + 2.0 * K2 * r2 + 3.0 * K3 * r4 + 4.0 * K4 * r6)
    xd = x0 + X * radial + P1 * (r2 + 2.0 * X * X) + 2.0 * P2 * X * Y + b1 * X + b2 * Y
    yd = y0 + Y * radial + P2 * (r2 + 2.0 * Y * Y) + 2.0 * P1 * X * Y
    xX = radial + slope * X * X + 6.0 * P1 * X + 2.0 * P2 * Y + b1
    xY = slope * X * Y + 2.0 * P1 * Y + 2.0 * P2 * X + b2
    yX = slope * X * Y + 2.0 * P1 * Y + 2.0 * P2 * X
    yY = radial + slope * Y * Y + 6.0 * P2 * Y + 2.0 * P1 * X
    fx, fy = 1.0 / sx, -1.0 / sy
    residual[0] = fx * xd + frame[0] - x
    residual[1] = fy * yd + frame[1] - y
    Ju[0, 0] = fx * xX * c
    Ju[0, 1] = fx * xY * c
    Ju[1, 0] = fy * yX * c
    Ju[1, 1] = fy * yY * c
    Jp[0, 0] = fx * (xX * u + xY * v)
    Jp[1, 0] = fy * (yX * u + yY * v)
    Jp[0, 1] = fx
    Jp[1, 1] = 0.0
    Jp[0, 2] = 0.0
    Jp[1, 2] = fy
    Jp[0, 3] = fx * X * r2
    Jp[1, 3] = fy * Y * r2
    Jp[0, 4] = fx * X * r4
    Jp[1, 4] = fy * Y * r4
    Jp[0, 5] = fx * X * r6
    Jp[1, 5] = fy * Y * r6
    Jp[0, 6] = fx * X * r8
    Jp[1, 6] = fy * Y * r8
    Jp[0, 7] = fx * (r2 + 2.0 * X * X)
    Jp[1, 7] = fy * 2.0 * X * Y
    Jp[0, 8] = fx * 2.0 * X * Y
    Jp[1, 8] = fy * (r2 + 2.0 * Y * Y)
    Jp[0, 9] = fx * X
    Jp[1, 9] = 0.0
    Jp[0, 10] = fx * Y
    Jp[1, 10] = 0.0
