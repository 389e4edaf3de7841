"""OpenCV's models, and equidistant models with decentring and thin prism distortion.

All are in units of the focal lengths, as in COLMAP. The coordinates of a ray (a, b) are mapped to
e = s(r2) (a, b), as in `radial`, and from there to the distorted point. Those of equidistant models are
stereographic. The outputs are described in `sfm.model.distortion.models`.
"""

from __future__ import annotations

from sfm.model.conventions import FloatArray
from sfm.model.distortion.radial import equidistant, fill_derivative, fill_residual
from sfm.runtime.compiling import inlined


@inlined
def thin_prism_fisheye(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Like OPENCV, with (a, b) theta / r for (x/z, y/z): fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1.

    With t2 = theta^2, ad = ea (1 + k1 t2 + ... + k4 t8) + 2 p1 ea eb + p2 (t2 + 2 ea^2) + sx1 t2,
    bd = eb (1 + ...) + 2 p2 ea eb + p1 (t2 + 2 eb^2) + sy1 t2.

    Source: Weng et al. (1992), IEEE Trans. PAMI 14(10); COLMAP, camera model THIN_PRISM_FISHEYE.
    """
    a, b = u, -v
    r2 = a * a + b * b
    s, ds, _ = equidistant(r2)
    ea, eb = s * a, s * b
    t2 = s * s * r2
    k1, k2, p1, p2, k3, k4, sx1, sy1 = p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11]
    P = 1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
    slope = 2.0 * (k1 + t2 * (2.0 * k2 + t2 * (3.0 * k3 + t2 * 4.0 * k4)))
    aa2, ab2, bb2 = t2 + 2.0 * ea * ea, 2.0 * ea * eb, t2 + 2.0 * eb * eb
    cross = slope * ea * eb + 2.0 * p1 * ea + 2.0 * p2 * eb
    _fill_distorted(
        frame, p, x, y, a, b, s, ds,
        ea * P + p1 * ab2 + p2 * aa2 + sx1 * t2, eb * P + p2 * ab2 + p1 * bb2 + sy1 * t2,
        P + slope * ea * ea + 2.0 * p1 * eb + 6.0 * p2 * ea + 2.0 * sx1 * ea, cross + 2.0 * sx1 * eb,
        cross + 2.0 * sy1 * ea, P + slope * eb * eb + 2.0 * p2 * ea + 6.0 * p1 * eb + 2.0 * sy1 * eb,
        residual, Ju, Jp,
    )  # fmt: skip
    power = t2
    for j in range(4):
        fill_derivative(frame, p, 4 + j if j < 2 else 6 + j, ea * power, eb * power, Jp)
        power *= t2
    fill_derivative(frame, p, 6, ab2, bb2, Jp)
    fill_derivative(frame, p, 7, aa2, ab2, Jp)
    fill_derivative(frame, p, 10, t2, 0.0, Jp)
    fill_derivative(frame, p, 11, 0.0, t2, Jp)


@inlined
def rad_tan_thin_prism_fisheye(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Decentring and thin prism of the radially distorted point: fx, fy, cx, cy, k0-k5, p0, p1, s0-s3.

    With e of length theta (1 + k0 theta^2 + ... + k5 theta^12) and e2 its square,
    ad = ea + p0 (e2 + 2 ea^2) + 2 p1 ea eb + s0 e2 + s1 e4, bd = eb + p1 (e2 + 2 eb^2) + 2 p0 ea eb + s2 e2
    + s3 e4.

    Source: Project Aria, "Camera intrinsic models", Fisheye624; COLMAP, RAD_TAN_THIN_PRISM_FISHEYE.
    """
    a, b = u, -v
    r2 = a * a + b * b
    q, dq, dt2 = equidistant(r2)
    t2 = q * q * r2
    P, dP, power = 1.0, 0.0, 1.0
    for j in range(6):
        dP += (j + 1) * p[4 + j] * power
        power *= t2
        P += p[4 + j] * power
    s, ds = q * P, dq * P + q * dP * dt2
    ea, eb = s * a, s * b
    e2 = s * s * r2
    p0, p1, s0, s1, s2, s3 = p[10], p[11], p[12], p[13], p[14], p[15]
    sa, sb = 2.0 * (s0 + 2.0 * s1 * e2), 2.0 * (s2 + 2.0 * s3 * e2)
    aa2, ab2, bb2 = e2 + 2.0 * ea * ea, 2.0 * ea * eb, e2 + 2.0 * eb * eb
    cross = 2.0 * p0 * eb + 2.0 * p1 * ea
    aa, ab = 1.0 + 6.0 * p0 * ea + 2.0 * p1 * eb + sa * ea, cross + sa * eb
    ba, bb = cross + sb * ea, 1.0 + 6.0 * p1 * eb + 2.0 * p0 * ea + sb * eb
    _fill_distorted(
        frame, p, x, y, a, b, s, ds,
        ea + p0 * aa2 + p1 * ab2 + e2 * (s0 + s1 * e2), eb + p1 * bb2 + p0 * ab2 + e2 * (s2 + s3 * e2),
        aa, ab, ba, bb, residual, Ju, Jp,
    )  # fmt: skip
    power = q
    for j in range(6):
        power *= t2
        fill_derivative(frame, p, 4 + j, (aa * a + ab * b) * power, (ba * a + bb * b) * power, Jp)
    fill_derivative(frame, p, 10, aa2, ab2, Jp)
    fill_derivative(frame, p, 11, ab2, bb2, Jp)
    fill_derivative(frame, p, 12, e2, 0.0, Jp)
    fill_derivative(frame, p, 13, e2 * e2, 0.0, Jp)
    fill_derivative(frame, p, 14, 0.0, e2, Jp)
    fill_derivative(frame, p, 15, 0.0, e2 * e2, Jp)


@inlined
def _fill_distorted(
    frame: FloatArray, p: FloatArray, x: float, y: float, a: float, b: float, s: float, ds: float,
    ad: float, bd: float, aa: float, ab: float, ba: float, bb: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Fill all outputs from the distorted point and its derivatives aa, ab, ba, bb by e = s(r2) (a, b)."""
    xx, xy, yy = s + 2.0 * a * a * ds, 2.0 * a * b * ds, s + 2.0 * b * b * ds  # d e / d (a, b)
    fill_residual(
        frame, p, x, y, ad, bd,
        aa * xx + ab * xy, aa * xy + ab * yy, ba * xx + bb * xy, ba * xy + bb * yy,
        residual, Ju, Jp,
    )  # fmt: skip


@inlined
def opencv(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Distortion of the ideal point in units of the focal length: fx, fy, cx, cy, k1, k2, p1, p2.

    Source: OpenCV calib3d and COLMAP, camera model OPENCV; there y is down, so a = u, b = -v.
    Here cx, cy count from the centre of the top-left pixel, in COLMAP from its corner.
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
    """Like `opencv`, with the rational radial term (1 + k1 r2 + k2 r4 + k3 r6)/(1 + k4 r2 + k5 r4 + k6 r6).

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
    """Fill the outputs common to both OpenCV models: residual, derivatives by u, v and by fx, fy, cx, cy."""
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
