"""Brown's corrections of the measured point, and the balanced form with R0.

If frame[4] is 1, residuals lie in the plane of measurement. The point is found whose correction meets the
ray, and the residual is its difference from the measured point. The standard deviations of the measurement
are then the right weights. Otherwise residuals lie in the corrected plane, as in DBAT (Boerlin and
Grussenmeyer, 2013, Photogrammetric Record 28(144)): the difference between the ray and the corrected point.
Affinity and distortion that shrink this plane also shrink v'Pv, which biases them and everything correlated
with them (`tests/adjustment/test_plane_of_residuals.py`).

Signs are those of PhotoModeler and DBAT. The outputs are described in `sfm.model.distortion.models`.

The balanced radial distortion is AICON's form of `brown_forward` with a second zero crossing R0:

    x = x0 + X (1 + R) + B1 (r2 + 2 X^2) + 2 B2 X Y + C1 X + C2 Y
    y = y0 + Y (1 + R) + B2 (r2 + 2 Y^2) + 2 B1 X Y
    R = A1 (r2 - R0^2) + A2 (r4 - R0^4) + A3 (r6 - R0^6)

with X = c u, Y = c v. At the radius R0 the radial distortion is 0, because part of the scale is assigned to
c. With s = 1 - A1 R0^2 - A2 R0^4 - A3 R0^6 it is exactly `brown_forward` with these parameters: s c,
A1 / s^3, A2 / s^5, A3 / s^7, B1 / s^2, B2 / s^2, C1 / s, C2 / s.

Source: Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2020), sec. 3.3.3 (balanced distortion).
"""

from __future__ import annotations

import numpy as np

from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError
from sfm.runtime.compiling import inlined

BALANCED_MODEL = "brown_forward"  # the model to which the balanced form is equivalent
BALANCED = ("c", "x0", "y0", "A1", "A2", "A3", "R0", "B1", "B2", "C1", "C2")
BALANCED_UNITS = ("mm", "mm", "mm", "mm^-2", "mm^-4", "mm^-6", "mm", "mm^-1", "mm^-1", "1", "1")
BALANCED_STEPS = 50  # largest number of steps of Newton's method
CONVERGED = 1e-15  # last step of s, which is near 1
Values = tuple[tuple[str, float], ...]
# Step of Newton's method after which one more is exact: its error is the curvature times the squared step.
LOCATED_PX = 0.25
STEPS = 20  # largest number of steps of Newton's method
# Determinant of d(corrected)/d(measured), 1 without distortion, below which the corrections fold over.
FOLDED = 0.01


@inlined
def brown(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Corrections of the measured point: c, x0, y0, K1-K3, P1, P2, affinity b1, shear b2.

    Source: Brown (1971), Photogramm. Eng. 37(8); affinity before the distortion as DBAT's model 3:
    xb = (1 + b1)(x - x0) + b2 (y - y0), yb = y - y0; (xc, yc) = Brown(xb, yb) = c (u, v).
    """
    c, a1, b2 = p[0], 1.0 + p[8], p[9]
    K1, K2, K3, P1, P2 = p[3], p[4], p[5], p[6], p[7]
    xm = (x - frame[0]) * frame[2] - p[1]
    ym = -(y - frame[1]) * frame[3] - p[2]
    carried = frame[4] > 0.0
    xb, yb = a1 * xm + b2 * ym, ym
    xh, yh = xm, ym
    if carried:
        xb, yb = _measured(xb, yb, c * u, c * v, LOCATED_PX * frame[2], K1, K2, K3, P1, P2)
        xh, yh = (xb - b2 * yb) / a1, yb
    xc, yc, xx, xy, yy, r2 = _corrected(xb, yb, K1, K2, K3, P1, P2)
    # d(corrected)/d(measured), and its inverse in px: x right, y down
    dxx, dxy, dyx, dyy = xx * a1, xx * b2 + xy, xy * a1, xy * b2 + yy
    fxx, fxy, fyx, fyy = _inverse(carried, frame, dxx, dxy, dyx, dyy)
    ex, ey = c * u - xc, c * v - yc
    residual[0] = (xh - xm) / frame[2] + fxx * ex + fxy * ey
    residual[1] = (ym - yh) / frame[3] + fyx * ex + fyy * ey
    _pinhole(c, u, v, dxx, dxy, dyx, dyy, fxx, fxy, fyx, fyy, Ju, Jp)
    _radial(xb, yb, r2, fxx, fxy, fyx, fyy, Jp)
    _decentring(r2 + 2.0 * xb * xb, 2.0 * xb * yb, r2 + 2.0 * yb * yb, fxx, fxy, fyx, fyy, Jp)
    gx, gy = fxx * xx + fxy * xy, fyx * xx + fyy * xy
    Jp[0, 8], Jp[1, 8] = -gx * xh, -gy * xh
    Jp[0, 9], Jp[1, 9] = -gx * yh, -gy * yh


@inlined
def brown_affine(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Like `brown`, with affinity and shear after the corrections instead of before them.

    Source: DBAT's model 4: (xd, yd) = Brown(x - x0, y - y0), (1 + b1) xd + b2 yd = c u, yd = c v.
    """
    c, a1, b2 = p[0], 1.0 + p[8], p[9]
    K1, K2, K3, P1, P2 = p[3], p[4], p[5], p[6], p[7]
    xm = (x - frame[0]) * frame[2] - p[1]
    ym = -(y - frame[1]) * frame[3] - p[2]
    carried = frame[4] > 0.0
    xh, yh = xm, ym
    if carried:
        x_lens, y_lens = c * (u - b2 * v) / a1, c * v
        xh, yh = _measured(xm, ym, x_lens, y_lens, LOCATED_PX * frame[2], K1, K2, K3, P1, P2)
    xd, yd, xx, xy, yy, r2 = _corrected(xh, yh, K1, K2, K3, P1, P2)
    dxx, dxy, dyx, dyy = a1 * xx + b2 * xy, a1 * xy + b2 * yy, xy, yy
    fxx, fxy, fyx, fyy = _inverse(carried, frame, dxx, dxy, dyx, dyy)
    ex, ey = c * u - a1 * xd - b2 * yd, c * v - yd
    residual[0] = (xh - xm) / frame[2] + fxx * ex + fxy * ey
    residual[1] = (ym - yh) / frame[3] + fyx * ex + fyy * ey
    _pinhole(c, u, v, dxx, dxy, dyx, dyy, fxx, fxy, fyx, fyy, Ju, Jp)
    # affinity and shear act on the corrections: (1 + b1) dx + b2 dy
    gxx, gxy, gyx, gyy = fxx * a1, fxx * b2 + fxy, fyx * a1, fyx * b2 + fyy
    _radial(xh, yh, r2, gxx, gxy, gyx, gyy, Jp)
    _decentring(r2 + 2.0 * xh * xh, 2.0 * xh * yh, r2 + 2.0 * yh * yh, gxx, gxy, gyx, gyy, Jp)
    Jp[0, 8], Jp[1, 8] = -fxx * xd, -fyx * xd
    Jp[0, 9], Jp[1, 9] = -fxx * yd, -fyx * yd


@inlined
def _pinhole(
    c: float, u: float, v: float, dxx: float, dxy: float, dyx: float, dyy: float,
    fxx: float, fxy: float, fyx: float, fyy: float, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Fill the derivatives by u and v, c, and x0 and y0, which move the corrected point by D."""
    Ju[0, 0], Ju[1, 0] = fxx * c, fyx * c
    Ju[0, 1], Ju[1, 1] = fxy * c, fyy * c
    Jp[0, 0], Jp[1, 0] = fxx * u + fxy * v, fyx * u + fyy * v
    Jp[0, 1], Jp[1, 1] = fxx * dxx + fxy * dyx, fyx * dxx + fyy * dyx
    Jp[0, 2], Jp[1, 2] = fxx * dxy + fxy * dyy, fyx * dxy + fyy * dyy


@inlined
def _inverse(
    carried: bool, frame: FloatArray, dxx: float, dxy: float, dyx: float, dyy: float
) -> tuple[float, float, float, float]:
    """Return the matrix from differences in the corrected plane, mm, y up, to px, y down.

    It is D^-1 with D = d(corrected)/d(measured). If e remains in the corrected plane, the point that should
    have been measured is D^-1 e away, and it moves with the unknowns by D^-1 J. If D folds over, or if
    residuals stay in the corrected plane, only the unit changes.
    """
    fx, fy = 1.0 / frame[2], -1.0 / frame[3]
    det = dxx * dyy - dxy * dyx
    if carried and det > FOLDED:
        inverse = 1.0 / det
        return fx * dyy * inverse, -fx * dxy * inverse, -fy * dyx * inverse, fy * dxx * inverse
    return fx, 0.0, 0.0, fy


@inlined
def _radial(
    x: float, y: float, r2: float, fxx: float, fxy: float, fyx: float, fyy: float, Jp: FloatArray
) -> None:
    """Fill the derivatives by K1, K2, K3."""
    kx, ky = -(fxx * x + fxy * y) * r2, -(fyx * x + fyy * y) * r2
    Jp[0, 3], Jp[1, 3] = kx, ky
    Jp[0, 4], Jp[1, 4] = kx * r2, ky * r2
    Jp[0, 5], Jp[1, 5] = kx * r2 * r2, ky * r2 * r2


@inlined
def _decentring(
    xx: float, xy: float, yy: float, fxx: float, fxy: float, fyx: float, fyy: float, Jp: FloatArray
) -> None:
    """Fill the derivatives by P1 and P2 from r2 + 2 x^2, 2 x y and r2 + 2 y^2."""
    Jp[0, 6], Jp[1, 6] = -(fxx * xx + fxy * xy), -(fyx * xx + fyy * xy)
    Jp[0, 7], Jp[1, 7] = -(fxx * xy + fxy * yy), -(fyx * xy + fyy * yy)


@inlined
def _corrected(
    x: float, y: float, K1: float, K2: float, K3: float, P1: float, P2: float
) -> tuple[float, float, float, float, float, float]:
    """Return Brown's corrected point, its derivatives by the point (xx, xy = yx, yy) and r2.

    r2 = x^2 + y^2, xc = x (1 + K1 r2 + K2 r4 + K3 r6) + P1 (r2 + 2 x^2) + 2 P2 x y, yc likewise.
    """
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
def _measured(
    x: float, y: float, xc: float, yc: float, located: float,
    K1: float, K2: float, K3: float, P1: float, P2: float,
) -> tuple[float, float]:  # fmt: skip
    """Return the point that Brown's corrections move to (xc, yc), by Newton's method, mm.

    One more step would be exact; the caller has the derivatives for it. The iteration starts at the measured
    point (x, y), which is near, and ends at a step shorter than `located`. With bad approximate values the
    corrections may fold over on the way. In that case the start is returned, and that one step is the whole
    residual.
    """
    xh, yh = x, y
    for _ in range(STEPS):
        x_now, y_now, xx, xy, yy, _r2 = _corrected(xh, yh, K1, K2, K3, P1, P2)
        det = xx * yy - xy * xy
        if not (det > FOLDED and xx + yy > 0.0):
            break
        inverse, ex, ey = 1.0 / det, xc - x_now, yc - y_now
        dx, dy = (yy * ex - xy * ey) * inverse, (xx * ey - xy * ex) * inverse
        xh += dx
        yh += dy
        if abs(dx) + abs(dy) < located:
            return xh, yh
    return x, y


def from_balanced(values: Values) -> Values:
    """Return the `brown_forward` parameters of a camera in the balanced form.

    Args:
        values: (name, value) of `BALANCED`, omitted ones are 0; c may be negative, as AICON writes it.

    Raises:
        GeometryError: R0 is so large that the scale is not positive.
    """
    p = dict.fromkeys(BALANCED, 0.0) | dict(values)
    A, R0 = (p["A1"], p["A2"], p["A3"]), p["R0"]
    s = 1.0 - sum(a * R0 ** (2 * i) for i, a in enumerate(A, 1))
    if not s > 0:
        raise GeometryError(f"A1, A2, A3 and R0 = {R0:g} mm give a scale of {s:g}, expected one near 1")
    radial = tuple((f"K{i}", a / s ** (2 * i + 1)) for i, a in enumerate(A, 1))
    plane = (("P1", p["B1"] / s**2), ("P2", p["B2"] / s**2), ("b1", p["C1"] / s), ("b2", p["C2"] / s))
    return (("c", s * abs(p["c"])), ("x0", p["x0"]), ("y0", p["y0"]), *radial, *plane)


def to_balanced(values: Values, R0: float) -> Values:
    """Return a camera of model `brown_forward` in the balanced form.

    Args:
        values: (name, value) of its parameters; K4 must be 0, since the balanced form does not have it.
        R0: radius at which the radial distortion shall be 0, mm.

    Raises:
        GeometryError: K4 is not 0, or no scale balances the distortion at R0.
    """
    p = dict(values)
    if p.get("K4"):
        raise GeometryError(f"K4 = {p['K4']:g}, the balanced form has A1, A2 and A3 only")
    K = [p[f"K{i}"] * R0 ** (2 * i) for i in (1, 2, 3)]
    s = 1.0
    for _ in range(BALANCED_STEPS):
        f = s - 1.0 + sum(k * s ** (2 * i + 1) for i, k in enumerate(K, 1))
        slope = 1.0 + sum((2 * i + 1) * k * s ** (2 * i) for i, k in enumerate(K, 1))
        if not slope > 0:
            break
        s -= f / slope
        if abs(f / slope) < CONVERGED:
            break
    else:
        slope = 0.0
    if not (slope > 0 and s > 0):
        raise GeometryError(f"the radial distortion cannot be balanced at R0 = {R0:g} mm")
    A = [p[f"K{i}"] * s ** (2 * i + 1) for i in (1, 2, 3)]
    balanced = (
        p["c"] / s,
        p["x0"],
        p["y0"],
        *A,
        R0,
        p["P1"] * s**2,
        p["P2"] * s**2,
        p["b1"] * s,
        p["b2"] * s,
    )
    return tuple(zip(BALANCED, balanced, strict=True))


def brown_by_balanced(values: Values) -> FloatArray:
    """Return the derivatives of `brown_forward` by the balanced form, with R0 fixed, (10, 10).

    Rows are c, x0, y0, K1, K2, K3, P1, P2, b1, b2, columns are `BALANCED` without R0; c is positive.

    Args:
        values: (name, value) of `BALANCED`.

    Source: derivatives of the formulas above.
    """
    p = dict(values)
    A, R0 = np.array([p["A1"], p["A2"], p["A3"]]), p["R0"]
    ds = -(R0 ** (2.0 * np.arange(1, 4)))  # derivatives of s by A1, A2, A3
    s = 1.0 + float(ds @ A)
    J = np.zeros((10, 10))
    scaled = (("c", 0, 1), *((f"A{i}", 2 + i, -2 * i - 1) for i in (1, 2, 3)))
    scaled += (("B1", 6, -2), ("B2", 7, -2), ("C1", 8, -1), ("C2", 9, -1))
    J[1, 1] = J[2, 2] = 1.0
    for name, row, power in scaled:
        J[row, row] = s**power
        J[row, 3:6] += power * p[name] * s ** (power - 1) * ds
    return J
