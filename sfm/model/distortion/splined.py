"""Distortion as a surface of cubic B-splines over the stereographic plane of rays.

It describes a lens that no polynomial does. The ray (a, b) = (u, -v) is mapped to the distorted point

    ad = a + sum_ij N_i(a) N_j(b) A_ij,   bd = b + sum_ij N_i(a) N_j(b) B_ij

with the uniform cubic B-splines N of a grid of n x n coefficients, n in KNOTS, whose range is |a| <= a_max
and |b| <= b_max. Beyond it the distortion is that of its border. A change of a coefficient acts on four cells
of the grid in each direction, so that image points determine the surface only where they are.

The outputs are described in `sfm.model.distortion.models`.

Source: Kogan (2021), mrcal documentation, "Splined stereographic lens model"; de Boor (2001), A Practical
Guide to Splines, ch. IX (B-splines).
"""

from __future__ import annotations

import math

from sfm.model.conventions import FloatArray
from sfm.model.distortion.radial import fill_derivative, fill_residual
from sfm.runtime.compiling import inlined

KNOTS = (7, 10, 14, 20)  # coefficients along each axis: 4 to 17 cells over the format
FIRST = 6  # place of A_00 among the parameters: fx, fy, cx, cy, a_max, b_max, A, B


@inlined
def splined(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Splined stereographic: fx, fy, cx, cy, a_max, b_max, A of n x n, B of n x n.

    Source: Kogan (2021), mrcal documentation, "Splined stereographic lens model".
    """
    a, b = u, -v
    surface = (int(frame[5]) - 2) // 2  # coefficients of A, and of B
    n = int(math.sqrt(surface))
    i, N, dN = basis(a, p[4], n - 3)
    j, M, dM = basis(b, p[5], n - 3)
    for s in range(FIRST - 2, FIRST + 2 * surface):
        Jp[0, s] = Jp[1, s] = 0.0
    ad, bd = a, b
    aa, ab, ba, bb = 1.0, 0.0, 0.0, 1.0
    for k in range(4):
        for m in range(4):
            column = FIRST + n * (j + m) + i + k
            A, B = p[column], p[column + surface]
            weight = N[k] * M[m]
            by_a, by_b = dN[k] * M[m], N[k] * dM[m]
            ad += weight * A
            bd += weight * B
            aa += by_a * A
            ab += by_b * A
            ba += by_a * B
            bb += by_b * B
            fill_derivative(frame, p, column, weight, 0.0, Jp)
            fill_derivative(frame, p, column + surface, 0.0, weight, Jp)
    # the splines depend on a / a_max and b / b_max
    of_a = -a / p[4] if p[4] > 0.0 else 0.0
    of_b = -b / p[5] if p[5] > 0.0 else 0.0
    fill_derivative(frame, p, 4, (aa - 1.0) * of_a, ba * of_a, Jp)
    fill_derivative(frame, p, 5, ab * of_b, (bb - 1.0) * of_b, Jp)
    fill_residual(frame, p, x, y, ad, bd, aa, ab, ba, bb, residual, Ju, Jp)


@inlined
def basis(
    a: float, reach: float, cells: int
) -> tuple[int, tuple[float, float, float, float], tuple[float, float, float, float]]:
    """Return the first of the four B-splines that are not 0 at a, their values and their derivatives."""
    per_unit = cells / (2.0 * reach) if reach > 0.0 else 0.0
    t = (a + reach) * per_unit
    slope = per_unit
    if not t > 0.0:  # or NaN
        t, slope = 0.0, 0.0
    elif t > cells:
        t, slope = float(cells), 0.0
    i = min(int(t), cells - 1)
    f = t - i
    g = 1.0 - f
    N = (
        g * g * g / 6.0,
        (f * f * (3.0 * f - 6.0) + 4.0) / 6.0,
        (g * g * (3.0 * g - 6.0) + 4.0) / 6.0,
        f * f * f / 6.0,
    )
    dN = (
        -slope * g * g / 2.0,
        slope * f * (3.0 * f - 4.0) / 2.0,
        -slope * g * (3.0 * g - 4.0) / 2.0,
        slope * f * f / 2.0,
    )
    return i, N, dN
