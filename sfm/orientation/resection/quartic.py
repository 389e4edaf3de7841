"""Real positive roots of a quartic, found between its turning points so that no root is missed.

Closed formulas (Ferrari) lose the near-double roots that occur when the camera is near the danger
cylinder of three points. Here every interval between turning points is searched by bracketed Newton
steps, and a turning point that touches zero within rounding counts as a double root.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sfm.conventions import FloatArray

MAX_ROOTS = 8  # four roots, each of which may be reported once more as a touching turning point
TOUCH = 1e-9  # |f| at a turning point over sum |coefficient| below which it counts as a double root
STEPS = 60
CONVERGED = 1e-9  # relative step; the error after it is its square, or what rounding allows


def positive_roots(coefficients: FloatArray) -> FloatArray:
    """Return the positive real roots of G4 x^4 + G3 x^3 + G2 x^2 + G1 x + G0.

    Args:
        coefficients: G4, G3, G2, G1, G0, shape (5,).

    Returns:
        Roots in ascending order; near-double roots may appear as two close values, shape (r,).
    """
    roots = np.empty(MAX_ROOTS)
    n = find_positive_roots(np.ascontiguousarray(coefficients[::-1], dtype=float), roots)
    return np.sort(roots[:n])


@njit(cache=True)
def find_positive_roots(g, roots):  # type: ignore[no-untyped-def]
    """Fill the positive roots of g[0] + g[1] x + ... + g[4] x^4 and return their number.

    Roots up to 1 are found in x and those above 1 in 1/x, so that every search is in (0, 1].
    """
    n = _roots_in_unit_interval(g[0], g[1], g[2], g[3], g[4], roots, 0)
    m = _roots_in_unit_interval(g[4], g[3], g[2], g[1], g[0], roots, n)
    for i in range(n, m):
        roots[i] = 1.0 / roots[i]
    return m


@njit(cache=True)
def _roots_in_unit_interval(g0, g1, g2, g3, g4, roots, n):  # type: ignore[no-untyped-def]
    """Append the roots of the quartic in (0, 1] behind the first n and return the new number."""
    # turning points of the quartic are the roots of its derivative, whose turning points are those of
    # a quadratic
    e0, e1, e2 = 2.0 * g2, 6.0 * g3, 12.0 * g4
    b0 = b1 = 1.0
    disc = e1 * e1 - 4.0 * e0 * e2
    if disc > 0.0:
        q = -0.5 * (e1 + (np.sqrt(disc) if e1 >= 0.0 else -np.sqrt(disc)))
        r0 = q / e2 if abs(q) < abs(e2) else 1.0
        r1 = e0 / q if abs(e0) < abs(q) else 1.0
        b0, b1 = min(r0, r1), max(r0, r1)
    d0, d1, d2, d3 = g1, 2.0 * g2, 3.0 * g3, 4.0 * g4
    # intervals on which the derivative is monotonic: 0 .. b0 .. b1 .. 1
    t0 = t1 = t2 = 1.0
    count = 0
    low, f_low = 0.0, d0
    for k in range(3):
        high = b0 if k == 0 else (b1 if k == 1 else 1.0)
        if high <= low:
            continue
        f_high = ((d3 * high + d2) * high + d1) * high + d0
        if (f_low < 0.0) != (f_high < 0.0):
            t = _bracketed(d0, d1, d2, d3, 0.0, low, high, f_low)
            if count == 0:
                t0 = t
            elif count == 1:
                t1 = t
            else:
                t2 = t
            count += 1
        low, f_low = high, f_high
    touch = TOUCH * (abs(g0) + abs(g1) + abs(g2) + abs(g3) + abs(g4))
    low, f_low = 0.0, g0
    for k in range(count + 1):
        high = 1.0
        if k < count:
            high = t0 if k == 0 else (t1 if k == 1 else t2)
        f_high = (((g4 * high + g3) * high + g2) * high + g1) * high + g0
        if (f_low < 0.0) != (f_high < 0.0):
            roots[n] = _bracketed(g0, g1, g2, g3, g4, low, high, f_low)
            n += 1
        elif k < count and abs(f_high) < touch and n < MAX_ROOTS:
            roots[n] = high
            n += 1
        low, f_low = high, f_high
    return n


@njit(cache=True)
def _bracketed(g0, g1, g2, g3, g4, low, high, f_low):  # type: ignore[no-untyped-def]
    """Newton's method kept inside a bracket by bisection."""
    x = 0.5 * (low + high)
    rising = f_low < 0.0
    for _ in range(STEPS):
        f = (((g4 * x + g3) * x + g2) * x + g1) * x + g0
        slope = ((4.0 * g4 * x + 3.0 * g3) * x + 2.0 * g2) * x + g1
        if (f < 0.0) == rising:
            low = x
        else:
            high = x
        step = f / slope if slope != 0.0 else 0.0
        new = x - step
        if slope == 0.0 or new <= low or new >= high:
            new = 0.5 * (low + high)
        if abs(new - x) <= CONVERGED * abs(x):
            return new
        x = new
    return x
