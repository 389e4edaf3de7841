"""Models of radial distortion with focal lengths in px, perspective or wide-angle, as in COLMAP.

The coordinates of a ray (a, b) = (u, -v), y down, are mapped to s(r2) (a, b) with r2 = a^2 + b^2. One or two
focal lengths (frame[4]) convert them to pixels. All models are smooth on the axis because s is a function of
r2. With tangents, (a, b) = (x/z, y/z) and r = tan(theta). With stereographic coordinates r = 2 tan(theta/2),
and the ray is the direction (a, b, 1 - r2/4).

The outputs are described in `sfm.model.distortion.models`.
"""

from __future__ import annotations

import math

from sfm.model.conventions import FloatArray
from sfm.runtime.compiling import inlined

SERIES = 0.01  # r2 below which a series is more precise than the closed form
SMALL_OMEGA2 = 1e-3  # the same for omega^2


@inlined
def radial(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Perspective with s = 1 + k1 r2 + k2 r4 + ..., with frame[5] coefficients.

    Source: COLMAP, camera models SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL and RADIAL.
    """
    a, b, first = u, -v, int(frame[4]) + 2
    r2 = a * a + b * b
    s, ds, power = 1.0, 0.0, 1.0
    for j in range(int(frame[5])):
        k = p[first + j]
        ds += (j + 1) * k * power
        power *= r2
        s += k * power
        fill_derivative(frame, p, first + j, a * power, b * power, Jp)
    _fill_radial(frame, p, x, y, a, b, s, ds, residual, Ju, Jp)


@inlined
def fisheye(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Equidistant: r s = theta (1 + k1 theta^2 + k2 theta^4 + ...), r = 2 tan(theta/2).

    Source: Kannala and Brandt (2006), IEEE Trans. PAMI 28(8), eq. 6; COLMAP, camera models SIMPLE_FISHEYE,
    FISHEYE, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE and OPENCV_FISHEYE.
    """
    a, b, first = u, -v, int(frame[4]) + 2
    r2 = a * a + b * b
    q, dq, dtheta2 = equidistant(r2)
    theta2 = q * q * r2
    P, dP, power = 1.0, 0.0, 1.0
    for j in range(int(frame[5])):
        k = p[first + j]
        dP += (j + 1) * k * power
        power *= theta2
        P += k * power
        fill_derivative(frame, p, first + j, a * q * power, b * q * power, Jp)
    _fill_radial(frame, p, x, y, a, b, q * P, dq * P + q * dP * dtheta2, residual, Ju, Jp)


@inlined
def fov(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Field of view: r s = atan(2 r tan(omega / 2)) / omega, r = tan(theta).

    Source: Devernay and Faugeras (2001), Machine Vision and Applications 13, eq. 13; COLMAP, model FOV.
    """
    a, b, first = u, -v, int(frame[4]) + 2
    r2 = a * a + b * b
    omega = p[first]
    w = 2.0 * math.tan(omega / 2.0)
    dw = 1.0 + w * w / 4.0
    ratio, dratio = _ratio_of_tangent(omega, w, dw)  # w / omega
    q, dq = arctangent(w * w * r2)
    by_omega = dratio * q + ratio * dq * 2.0 * w * dw * r2
    fill_derivative(frame, p, first, a * by_omega, b * by_omega, Jp)
    _fill_radial(frame, p, x, y, a, b, ratio * q, ratio * dq * w * w, residual, Ju, Jp)


@inlined
def division(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Division: the ray is (ad, bd, 1 + k rd^2), so that s = 2 / (z + sqrt(z^2 - 4 k r2)), z = 1 - r2/4.

    Source: Fitzgibbon (2001), CVPR; COLMAP, camera models SIMPLE_DIVISION and DIVISION.
    """
    a, b, first = u, -v, int(frame[4]) + 2
    r2 = a * a + b * b
    k = p[first]
    z = 1.0 - r2 / 4.0
    root = math.sqrt(z * z - 4.0 * k * r2)  # NaN where the distortion folds over
    s = 2.0 / (z + root)
    ds = s * s * (k + (z + root) / 8.0) / root
    by_k = s * s * r2 / root
    fill_derivative(frame, p, first, a * by_k, b * by_k, Jp)
    _fill_radial(frame, p, x, y, a, b, s, ds, residual, Ju, Jp)


@inlined
def eucm(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Enhanced unified camera model: s = 1 / (alpha d + (1 - alpha) z) with d = sqrt(beta r2 + z^2).

    The ray is (a, b, z) with z = 1 - r2/4.

    Source: Khomutenko et al. (2016), IEEE Robotics and Automation Letters 1(1), eq. 8; COLMAP, model EUCM.
    """
    a, b, first = u, -v, int(frame[4]) + 2
    r2 = a * a + b * b
    alpha, beta = p[first], p[first + 1]
    z = 1.0 - r2 / 4.0
    d = math.sqrt(beta * r2 + z * z)
    s = 1.0 / (alpha * d + (1.0 - alpha) * z)
    by_alpha, by_beta = s * s * (z - d), -s * s * alpha * r2 / (2.0 * d)
    ds = -s * s * (alpha * (beta - z / 2.0) / (2.0 * d) - (1.0 - alpha) / 4.0)
    fill_derivative(frame, p, first, a * by_alpha, b * by_alpha, Jp)
    fill_derivative(frame, p, first + 1, a * by_beta, b * by_beta, Jp)
    _fill_radial(frame, p, x, y, a, b, s, ds, residual, Ju, Jp)


@inlined
def equidistant(r2: float) -> tuple[float, float, float]:
    """Return q = theta / r, dq / d(r2) and d(theta^2) / d(r2) of stereographic r = 2 tan(theta/2)."""
    q, dq = arctangent(r2 / 4.0)
    return q, dq / 4.0, q / (1.0 + r2 / 4.0)


@inlined
def arctangent(r2: float) -> tuple[float, float]:
    """Return q = atan(r) / r and dq / d(r2), by their series near the axis."""
    if r2 < SERIES:
        q, dq = 0.0, 0.0
        for n in range(9, 0, -1):  # q = sum (-r2)^n / (2 n + 1)
            q = -r2 * (q + 1.0 / (2 * n + 1))
            dq = -r2 * dq - n / (2 * n + 1.0)
        return 1.0 + q, dq
    r = math.sqrt(r2)
    q = math.atan(r) / r
    return q, (1.0 / (1.0 + r2) - q) / (2.0 * r2)


@inlined
def _ratio_of_tangent(omega: float, w: float, dw: float) -> tuple[float, float]:
    """Return w / omega with w = 2 tan(omega / 2), and its derivative; by series if omega is small."""
    o2 = omega * omega
    if o2 < SMALL_OMEGA2:
        ratio = 1.0 + o2 * (1.0 / 12.0 + o2 * (1.0 / 120.0 + o2 * (17.0 / 20160.0 + o2 * 31.0 / 362880.0)))
        slope = 2.0 / 12.0 + o2 * (4.0 / 120.0 + o2 * (6.0 * 17.0 / 20160.0 + o2 * 8.0 * 31.0 / 362880.0))
        return ratio, omega * slope
    return w / omega, (dw * omega - w) / o2


@inlined
def _fill_radial(
    frame: FloatArray, p: FloatArray, x: float, y: float, a: float, b: float, s: float, ds: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Fill all outputs from s and ds = d s / d(r2) of a radial distortion."""
    ab = 2.0 * a * b * ds
    fill_residual(
        frame, p, x, y, s * a, s * b, s + 2.0 * a * a * ds, ab, ab, s + 2.0 * b * b * ds, residual, Ju, Jp
    )


@inlined
def fill_residual(
    frame: FloatArray, p: FloatArray, x: float, y: float, ad: float, bd: float,
    aa: float, ab: float, ba: float, bb: float, residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Fill the residual of a distorted point, and its derivatives by u, v, focal lengths and principal point.

    Args:
        frame: frame[4] is the number of focal lengths; they and cx, cy are the first parameters.
        p: parameters.
        x: measured pixel.
        y: measured pixel.
        ad: distorted point in units of the focal lengths, y down.
        bd: the same along y.
        aa: d ad / d a, of the ideal point (a, b) = (u, -v).
        ab: d ad / d b.
        ba: d bd / d a.
        bb: d bd / d b.
        residual: filled.
        Ju: filled.
        Jp: filled in the first columns.
    """
    focal = int(frame[4])
    fx, fy = p[0], p[focal - 1]
    residual[0] = fx * ad + p[focal] - x
    residual[1] = fy * bd + p[focal + 1] - y
    Ju[0, 0], Ju[0, 1] = fx * aa, -fx * ab
    Ju[1, 0], Ju[1, 1] = fy * ba, -fy * bb
    Jp[1, 0] = Jp[0, focal - 1] = 0.0  # with two focal lengths; one alone has both derivatives
    Jp[0, 0], Jp[1, focal - 1] = ad, bd
    Jp[0, focal], Jp[1, focal] = 1.0, 0.0
    Jp[0, focal + 1], Jp[1, focal + 1] = 0.0, 1.0


@inlined
def fill_derivative(
    frame: FloatArray, p: FloatArray, column: int, da: float, db: float, Jp: FloatArray
) -> None:
    """Fill the derivatives by a parameter that moves the distorted point by (da, db)."""
    Jp[0, column] = p[0] * da
    Jp[1, column] = p[int(frame[4]) - 1] * db
