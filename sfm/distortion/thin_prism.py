"""Equidistant wide-angle models with decentring and thin prism distortion, as COLMAP has them.

The ideal point (a, b) goes to e = s(r2) (a, b), as in `radial`, and from there to the distorted point.

Its outputs are described in `sfm.distortion.models`.
"""

from __future__ import annotations

from sfm.conventions import FloatArray
from sfm.distortion.radial import along, equidistant, seen
from sfm.kernels.compiling import inlined


@inlined
def thin_prism_fisheye(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """As OPENCV with (a, b) theta / r for (a, b): fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1.

    With t2 = theta^2, ad = ea (1 + k1 t2 + ... + k4 t8) + 2 p1 ea eb + p2 (t2 + 2 ea^2) + sx1 t2,
    bd = eb (1 + ...) + 2 p2 ea eb + p1 (t2 + 2 eb^2) + sy1 t2.

    Source: Weng et al. (1992), IEEE Trans. PAMI 14(10); COLMAP, camera model THIN_PRISM_FISHEYE.
    """
    a, b = u, -v
    r2 = a * a + b * b
    s, ds = equidistant(r2)
    ea, eb = s * a, s * b
    t2 = s * s * r2
    k1, k2, p1, p2, k3, k4, sx1, sy1 = p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11]
    P = 1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
    slope = 2.0 * (k1 + t2 * (2.0 * k2 + t2 * (3.0 * k3 + t2 * 4.0 * k4)))
    aa2, ab2, bb2 = t2 + 2.0 * ea * ea, 2.0 * ea * eb, t2 + 2.0 * eb * eb
    cross = slope * ea * eb + 2.0 * p1 * ea + 2.0 * p2 * eb
    _through(
        frame, p, x, y, a, b, s, ds,
        ea * P + p1 * ab2 + p2 * aa2 + sx1 * t2, eb * P + p2 * ab2 + p1 * bb2 + sy1 * t2,
        P + slope * ea * ea + 2.0 * p1 * eb + 6.0 * p2 * ea + 2.0 * sx1 * ea, cross + 2.0 * sx1 * eb,
        cross + 2.0 * sy1 * ea, P + slope * eb * eb + 2.0 * p2 * ea + 6.0 * p1 * eb + 2.0 * sy1 * eb,
        residual, Ju, Jp,
    )  # fmt: skip
    power = t2
    for j in range(4):
        along(frame, p, 4 + j if j < 2 else 6 + j, ea * power, eb * power, Jp)
        power *= t2
    along(frame, p, 6, ab2, bb2, Jp)
    along(frame, p, 7, aa2, ab2, Jp)
    along(frame, p, 10, t2, 0.0, Jp)
    along(frame, p, 11, 0.0, t2, Jp)


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
    q, dq = equidistant(r2)
    t2 = q * q * r2
    P, dP, power = 1.0, 0.0, 1.0
    for j in range(6):
        dP += (j + 1) * p[4 + j] * power
        power *= t2
        P += p[4 + j] * power
    s, ds = q * P, dq * P + q * dP * q / (1.0 + r2)
    ea, eb = s * a, s * b
    e2 = s * s * r2
    p0, p1, s0, s1, s2, s3 = p[10], p[11], p[12], p[13], p[14], p[15]
    sa, sb = 2.0 * (s0 + 2.0 * s1 * e2), 2.0 * (s2 + 2.0 * s3 * e2)
    aa2, ab2, bb2 = e2 + 2.0 * ea * ea, 2.0 * ea * eb, e2 + 2.0 * eb * eb
    cross = 2.0 * p0 * eb + 2.0 * p1 * ea
    aa, ab = 1.0 + 6.0 * p0 * ea + 2.0 * p1 * eb + sa * ea, cross + sa * eb
    ba, bb = cross + sb * ea, 1.0 + 6.0 * p1 * eb + 2.0 * p0 * ea + sb * eb
    _through(
        frame, p, x, y, a, b, s, ds,
        ea + p0 * aa2 + p1 * ab2 + e2 * (s0 + s1 * e2), eb + p1 * bb2 + p0 * ab2 + e2 * (s2 + s3 * e2),
        aa, ab, ba, bb, residual, Ju, Jp,
    )  # fmt: skip
    power = q
    for j in range(6):
        power *= t2
        along(frame, p, 4 + j, (aa * a + ab * b) * power, (ba * a + bb * b) * power, Jp)
    along(frame, p, 10, aa2, ab2, Jp)
    along(frame, p, 11, ab2, bb2, Jp)
    along(frame, p, 12, e2, 0.0, Jp)
    along(frame, p, 13, e2 * e2, 0.0, Jp)
    along(frame, p, 14, 0.0, e2, Jp)
    along(frame, p, 15, 0.0, e2 * e2, Jp)


@inlined
def _through(
    frame: FloatArray, p: FloatArray, x: float, y: float, a: float, b: float, s: float, ds: float,
    ad: float, bd: float, aa: float, ab: float, ba: float, bb: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Fill what follows from the distorted point and its derivatives aa, ab, ba, bb by e = s(r2) (a, b)."""
    xx, xy, yy = s + 2.0 * a * a * ds, 2.0 * a * b * ds, s + 2.0 * b * b * ds  # d e / d (a, b)
    seen(
        frame, p, x, y, ad, bd,
        aa * xx + ab * xy, aa * xy + ab * yy, ba * xx + bb * xy, ba * xy + bb * yy,
        residual, Ju, Jp,
    )  # fmt: skip
