"""The models of computer vision, in units of the focal lengths: OpenCV's, as COLMAP has them.

They distort the ideal point. Its outputs are described in `sfm.distortion.models`.
"""

from __future__ import annotations

from sfm.conventions import FloatArray
from sfm.kernels.compiling import inlined


@inlined
def opencv(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Distortion of the ideal point in units of the focal length: fx, fy, cx, cy, k1, k2, p1, p2.

    Source: OpenCV calib3d and COLMAP, camera model OPENCV; there y is down, so a = u, b = -v.
    cx, cy count from the centre of the top-left pixel here, from its corner in COLMAP.
    """
    a, b = u, -v
    fx, fy, k1, k2, p1, p2 = p[0], p[1], p[4], p[5], p[6], p[7]
    r2 = a * a + b * b
    radial = 1.0 + k1 * r2 + k2 * r2 * r2
    slope = 2.0 * (k1 + 2.0 * k2 * r2)
    ad = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
    bd = b * radial + 2.0 * p2 * a * b + p1 * (r2 + 2.0 * b * b)
    _pinhole(p, x, y, a, b, ad, bd, radial, slope, p1, p2, residual, Ju, Jp)
    Jp[0, 4] = fx * a * r2
    Jp[1, 4] = fy * b * r2
    Jp[0, 5] = fx * a * r2 * r2
    Jp[1, 5] = fy * b * r2 * r2
    _tangential(fx, fy, a, b, r2, Jp)


@inlined
def full_opencv(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """As `opencv` with the rational radial term (1 + k1 r2 + k2 r4 + k3 r6)/(1 + k4 r2 + k5 r4 + k6 r6).

    Source: OpenCV calib3d and COLMAP, camera model FULL_OPENCV (parameters in the same order).
    """
    a, b = u, -v
    fx, fy, p1, p2 = p[0], p[1], p[6], p[7]
    r2 = a * a + b * b
    r4 = r2 * r2
    r6 = r4 * r2
    top = 1.0 + p[4] * r2 + p[5] * r4 + p[8] * r6
    below = 1.0 / (1.0 + p[9] * r2 + p[10] * r4 + p[11] * r6)
    radial = top * below
    dtop = p[4] + 2.0 * p[5] * r2 + 3.0 * p[8] * r4
    dbottom = p[9] + 2.0 * p[10] * r2 + 3.0 * p[11] * r4
    slope = 2.0 * below * (dtop - radial * dbottom)
    ad = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
    bd = b * radial + 2.0 * p2 * a * b + p1 * (r2 + 2.0 * b * b)
    _pinhole(p, x, y, a, b, ad, bd, radial, slope, p1, p2, residual, Ju, Jp)
    power = r2 * below
    for j in range(3):
        numerator = 4 + j if j < 2 else 8
        Jp[0, numerator] = fx * a * power
        Jp[1, numerator] = fy * b * power
        Jp[0, 9 + j] = -fx * a * power * radial
        Jp[1, 9 + j] = -fy * b * power * radial
        power *= r2
    _tangential(fx, fy, a, b, r2, Jp)


@inlined
def _pinhole(
    p: FloatArray, x: float, y: float, a: float, b: float, ad: float, bd: float,
    radial: float, slope: float, p1: float, p2: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Fill what is common to both OpenCV models: residual, derivatives by u, v and by fx, fy, cx, cy."""
    fx, fy = p[0], p[1]
    residual[0] = fx * ad + p[2] - x
    residual[1] = fy * bd + p[3] - y
    cross = slope * a * b + 2.0 * p1 * a + 2.0 * p2 * b
    Ju[0, 0] = fx * (radial + slope * a * a + 2.0 * p1 * b + 6.0 * p2 * a)
    Ju[0, 1] = -fx * cross
    Ju[1, 0] = fy * cross
    Ju[1, 1] = -fy * (radial + slope * b * b + 2.0 * p2 * a + 6.0 * p1 * b)
    Jp[0, 0] = ad
    Jp[1, 0] = 0.0
    Jp[0, 1] = 0.0
    Jp[1, 1] = bd
    Jp[0, 2] = 1.0
    Jp[1, 2] = 0.0
    Jp[0, 3] = 0.0
    Jp[1, 3] = 1.0


@inlined
def _tangential(fx: float, fy: float, a: float, b: float, r2: float, Jp: FloatArray) -> None:
    """Fill the derivatives by p1 and p2, common to both OpenCV models."""
    Jp[0, 6] = fx * 2.0 * a * b
    Jp[1, 6] = fy * (r2 + 2.0 * b * b)
    Jp[0, 7] = fx * (r2 + 2.0 * a * a)
    Jp[1, 7] = fy * 2.0 * a * b
