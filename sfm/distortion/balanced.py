"""Balanced radial distortion, AICON's form with a second zero crossing R0, from and to `brown_forward`.

    x = x0 + X (1 + R) + B1 (r2 + 2 X^2) + 2 B2 X Y + C1 X + C2 Y
    y = y0 + Y (1 + R) + B2 (r2 + 2 Y^2) + 2 B1 X Y
    R = A1 (r2 - R0^2) + A2 (r4 - R0^4) + A3 (r6 - R0^6)

with X = c u, Y = c v. At the radius R0 the radial distortion is 0, by a share of the scale that goes over
into c: with s = 1 - A1 R0^2 - A2 R0^4 - A3 R0^6 it is `brown_forward` with s c, A1 / s^3, A2 / s^5, A3 / s^7,
B1 / s^2, B2 / s^2, C1 / s, C2 / s, to the last digit.

Source: Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2020), sec. 3.3.3 (balanced distortion).
"""

from __future__ import annotations

import numpy as np

from sfm.conventions import FloatArray
from sfm.errors import GeometryError

MODEL = "brown_forward"  # the model of this form
BALANCED = ("c", "x0", "y0", "A1", "A2", "A3", "R0", "B1", "B2", "C1", "C2")
UNITS = ("mm", "mm", "mm", "mm^-2", "mm^-4", "mm^-6", "mm", "mm^-1", "mm^-1", "1", "1")
STEPS = 50  # of Newton's method at most
CONVERGED = 1e-15  # last step of s, which is near 1
Values = tuple[tuple[str, float], ...]


def from_balanced(values: Values) -> Values:
    """Return the parameters of `brown_forward` of a camera in the balanced form.

    Args:
        values: (name, value) of `BALANCED`, those left out are 0; c may be negative, as AICON writes it.

    Raises:
        GeometryError: R0 is so large that nothing is left of the scale.
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
        values: (name, value) of its parameters; K4 must be 0, which the balanced form has not.
        R0: radius at which the radial distortion is to be 0, mm.

    Raises:
        GeometryError: K4 is not 0, or there is no scale that balances the distortion at R0.
    """
    p = dict(values)
    if p.get("K4"):
        raise GeometryError(f"K4 = {p['K4']:g}, the balanced form has A1, A2 and A3 only")
    K = [p[f"K{i}"] * R0 ** (2 * i) for i in (1, 2, 3)]
    s = 1.0
    for _ in range(STEPS):
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
    found = (p["c"] / s, p["x0"], p["y0"], *A, R0, p["P1"] * s**2, p["P2"] * s**2, p["b1"] * s, p["b2"] * s)
    return tuple(zip(BALANCED, found, strict=True))


def brown_by_balanced(values: Values) -> FloatArray:
    """Return the derivatives of `brown_forward` by the balanced form, R0 held, (10, 10).

    Rows are c, x0, y0, K1, K2, K3, P1, P2, b1, b2, columns `BALANCED` without R0; c is positive.

    Args:
        values: (name, value) of `BALANCED`.

    Source: derivatives of the formulas above.
    """
    p = dict(values)
    A, R0 = np.array([p["A1"], p["A2"], p["A3"]]), p["R0"]
    ds = -(R0 ** (2.0 * np.arange(1, 4)))  # of s by A1, A2, A3
    s = 1.0 + float(ds @ A)
    J = np.zeros((10, 10))
    scaled = (("c", 0, 1), *((f"A{i}", 2 + i, -2 * i - 1) for i in (1, 2, 3)))
    scaled += (("B1", 6, -2), ("B2", 7, -2), ("C1", 8, -1), ("C2", 9, -1))
    J[1, 1] = J[2, 2] = 1.0
    for name, row, power in scaled:
        J[row, row] = s**power
        J[row, 3:6] += power * p[name] * s ** (power - 1) * ds
    return J
