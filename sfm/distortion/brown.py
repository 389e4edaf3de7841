"""The models of photogrammetry, in mm: corrections of the measured point, or distortion of the ideal one.

Signs as PhotoModeler and DBAT. What a model fills is said in `sfm.distortion.models`.
"""

from __future__ import annotations

from sfm.conventions import FloatArray
from sfm.kernels.options import inlined


@inlined
def brown(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Corrections of the measured point: c, x0, y0, K1-K3, P1, P2, affinity b1, shear b2.

    Source: Brown (1971), Photogramm. Eng. 37(8); affinity before the distortion as DBAT's model 3:
    xb = (1 + b1)(x - x0) + b2 (y - y0), yb = y - y0; (xc, yc) = Brown(xb, yb) = c (u, v).
    """
    sx, sy = frame[2], frame[3]
    c, x0, y0, b1, b2 = p[0], p[1], p[2], p[8], p[9]
    xm = (x - frame[0]) * sx - x0
    yb = -(y - frame[1]) * sy - y0
    xb = (1.0 + b1) * xm + b2 * yb
    xc, yc, xx, xy, yy, r2 = _corrected(xb, yb, p)
    fx, fy = 1.0 / sx, -1.0 / sy  # mm, y up -> px, y down
    residual[0] = fx * (c * u - xc)
    residual[1] = fy * (c * v - yc)
    _pinhole_mm(fx, fy, c, u, v, Ju, Jp)
    Jp[0, 1] = fx * xx * (1.0 + b1)
    Jp[1, 1] = fy * xy * (1.0 + b1)
    Jp[0, 2] = fx * (xx * b2 + xy)
    Jp[1, 2] = fy * (xy * b2 + yy)
    r4 = r2 * r2
    Jp[0, 3] = -fx * xb * r2
    Jp[1, 3] = -fy * yb * r2
    Jp[0, 4] = -fx * xb * r4
    Jp[1, 4] = -fy * yb * r4
    Jp[0, 5] = -fx * xb * r4 * r2
    Jp[1, 5] = -fy * yb * r4 * r2
    Jp[0, 6] = -fx * (r2 + 2.0 * xb * xb)
    Jp[1, 6] = -fy * 2.0 * xb * yb
    Jp[0, 7] = -fx * 2.0 * xb * yb
    Jp[1, 7] = -fy * (r2 + 2.0 * yb * yb)
    Jp[0, 8] = -fx * xx * xm
    Jp[1, 8] = -fy * xy * xm
    Jp[0, 9] = -fx * xx * yb
    Jp[1, 9] = -fy * xy * yb


@inlined
def brown_affine(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """As `brown` with affinity and shear behind the corrections instead of before them.

    Source: DBAT's model 4: (xd, yd) = Brown(x - x0, y - y0), (1 + b1) xd + b2 yd = c u, yd = c v.
    """
    sx, sy = frame[2], frame[3]
    c, x0, y0, a1, b2 = p[0], p[1], p[2], 1.0 + p[8], p[9]
    xm = (x - frame[0]) * sx - x0
    ym = -(y - frame[1]) * sy - y0
    xd, yd, xx, xy, yy, r2 = _corrected(xm, ym, p)
    fx, fy = 1.0 / sx, -1.0 / sy
    residual[0] = fx * (c * u - a1 * xd - b2 * yd)
    residual[1] = fy * (c * v - yd)
    _pinhole_mm(fx, fy, c, u, v, Ju, Jp)
    Jp[0, 1] = fx * (a1 * xx + b2 * xy)
    Jp[1, 1] = fy * xy
    Jp[0, 2] = fx * (a1 * xy + b2 * yy)
    Jp[1, 2] = fy * yy
    power = r2
    for s in range(3, 6):
        Jp[0, s] = -fx * (a1 * xm + b2 * ym) * power
        Jp[1, s] = -fy * ym * power
        power *= r2
    Jp[0, 6] = -fx * (a1 * (r2 + 2.0 * xm * xm) + b2 * 2.0 * xm * ym)
    Jp[1, 6] = -fy * 2.0 * xm * ym
    Jp[0, 7] = -fx * (a1 * 2.0 * xm * ym + b2 * (r2 + 2.0 * ym * ym))
    Jp[1, 7] = -fy * (r2 + 2.0 * ym * ym)
    Jp[0, 8] = -fx * xd
    Jp[1, 8] = 0.0
    Jp[0, 9] = -fx * yd
    Jp[1, 9] = 0.0


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


@inlined
def _corrected(x: float, y: float, p: FloatArray) -> tuple[float, float, float, float, float, float]:
    """Return Brown's corrected point, its derivatives by the point (xx, xy = yx, yy) and r2.

    r2 = x^2 + y^2, xc = x (1 + K1 r2 + K2 r4 + K3 r6) + P1 (r2 + 2 x^2) + 2 P2 x y, yc likewise.
    """
    K1, K2, K3, P1, P2 = p[3], p[4], p[5], p[6], p[7]
    r2 = x * x + y * y
    r4 = r2 * r2
    radial = 1.0 + K1 * r2 + K2 * r4 + K3 * (r4 * r2)
    slope = 2.0 * (K1 + 2.0 * K2 * r2 + 3.0 * K3 * r4)  # d radial = slope (x dx + y dy)
    xc = x * radial + P1 * (r2 + 2.0 * x * x) + 2.0 * P2 * x * y
    yc = y * radial + P2 * (r2 + 2.0 * y * y) + 2.0 * P1 * x * y
    xx = radial + slope * x * x + 6.0 * P1 * x + 2.0 * P2 * y
    xy = slope * x * y + 2.0 * P1 * y + 2.0 * P2 * x
    yy = radial + slope * y * y + 6.0 * P2 * y + 2.0 * P1 * x
    return xc, yc, xx, xy, yy, r2


@inlined
def _pinhole_mm(fx: float, fy: float, c: float, u: float, v: float, Ju: FloatArray, Jp: FloatArray) -> None:
    """Fill the derivatives of (fx c u, fy c v) by u, v and by c."""
    Ju[0, 0] = fx * c
    Ju[0, 1] = 0.0
    Ju[1, 0] = 0.0
    Ju[1, 1] = fy * c
    Jp[0, 0] = fx * u
    Jp[1, 0] = fy * v
