"""Real positive roots of a quartic, none of which is missed.

Ferrari's two quadratic factors give the roots where they multiply back to the quartic and no two roots
are near each other. Closed formulas lose the near-double roots that occur when the camera is near the
danger cylinder of three points; there every interval between turning points is searched by bracketed
Newton steps, and a turning point that touches zero within rounding counts as a double root.
"""

from __future__ import annotations

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import FloatArray
from sfm.kernels.compiling import compiled_fused

MAX_ROOTS = 8  # four roots, each of which may be reported once more as a touching turning point
TOUCH = 1e-9  # |f| at a turning point over sum |coefficient| below which it counts as a double root
STEPS = 60
FACTORED = 1e-11  # misfit of the product of the factors over sum |coefficient| that is accepted
APART = 1e-5  # discriminant of a factor over p^2 + 4 |q| above which its roots are real or complex for sure
MAX_LAST_STEP = 1e-9  # relative step; the error after it is its square, or what rounding allows


@checked_arguments(coefficients="5")
def positive_roots(coefficients: FloatArray) -> FloatArray:
    """Return the positive real roots of G4 x^4 + G3 x^3 + G2 x^2 + G1 x + G0.

    Args:
        coefficients: G4, G3, G2, G1, G0, shape (5,).

    Returns:
        Roots in ascending order; near-double roots may appear as two close values, shape (r,).

    Source: Ferrari, in Abramowitz and Stegun (1964), sec. 3.8.3; bracketed Newton steps, Press et al. (2007),
    Numerical Recipes, sec. 9.4.
    """
    roots = np.empty(MAX_ROOTS)
    G4, G3, G2, G1, G0 = np.asarray(coefficients, dtype=float)
    n = find_positive_roots(G0, G1, G2, G3, G4, roots)
    return np.sort(roots[:n])


@compiled_fused
def find_positive_roots(g0: float, g1: float, g2: float, g3: float, g4: float, roots: FloatArray) -> int:
    """Fill the positive roots of g0 + g1 x + ... + g4 x^4 and return their number."""
    n = _roots_by_factors(g0, g1, g2, g3, g4, roots)
    if n >= 0:
        return n
    # up to 1 in x, above 1 in 1/x, so that every search is in (0, 1]
    n = _roots_in_unit_interval(g0, g1, g2, g3, g4, roots, 0)
    m = _roots_in_unit_interval(g4, g3, g2, g1, g0, roots, n)
    for i in range(n, m):
        roots[i] = 1.0 / roots[i]
    return m


@compiled_fused
def _roots_by_factors(g0: float, g1: float, g2: float, g3: float, g4: float, roots: FloatArray) -> int:
    """Ferrari: x^4 + a x^3 + b x^2 + c x + d = (x^2 + p x + q)(x^2 + r x + s); -1 if it is not safe."""
    reverse = abs(g0) > abs(g4)
    if reverse:
        g0, g1, g3, g4 = g4, g3, g1, g0
    if g4 == 0.0:
        return -1
    a, b, c, d = g3 / g4, g2 / g4, g1 / g4, g0 / g4
    y = _largest_cubic_root(-b, a * c - 4.0 * d, d * (4.0 * b - a * a) - c * c)
    under_p, under_q = 0.25 * a * a - b + y, 0.25 * y * y - d
    if under_p < 0.0 or under_q < 0.0:
        return -1
    half_p, half_q = np.sqrt(under_p), np.sqrt(under_q)
    # p s + r q = a y / 2 - 2 half_p half_q must be c; the larger of the two roots gives the smaller
    if under_p * d * d > under_q * b * b:
        half_q = 0.25 * (a * y - 2.0 * c) / half_p
    elif half_q > 0.0:
        half_p = 0.25 * (a * y - 2.0 * c) / half_q
    p, r = 0.5 * a + half_p, 0.5 * a - half_p
    q, s = 0.5 * y + half_q, 0.5 * y - half_q
    misfit = abs(p + r - a) + abs(q + s + p * r - b) + abs(p * s + q * r - c) + abs(q * s - d)
    if not misfit < FACTORED * (1.0 + abs(a) + abs(b) + abs(c) + abs(d)):
        return -1
    n = 0
    for factor in range(2):
        e, f = (p, q) if factor == 0 else (r, s)
        disc = e * e - 4.0 * f
        if abs(disc) < APART * (e * e + 4.0 * abs(f)):
            return -1
        if disc < 0.0:
            continue
        far = -0.5 * (e + (np.sqrt(disc) if e >= 0.0 else -np.sqrt(disc)))
        near = f / far
        for x in (far, near):
            if not x > 0.0:
                continue
            # a root shared by both factors is a double root of the quartic
            t = x * x + (r * x + s if factor == 0 else p * x + q)
            if abs(t) < APART * (x * x + abs(r * x) + abs(s) if factor == 0 else x * x + abs(p * x) + abs(q)):
                return -1
            slope = ((4.0 * x + 3.0 * a) * x + 2.0 * b) * x + c
            x -= ((((x + a) * x + b) * x + c) * x + d) / slope
            roots[n] = 1.0 / x if reverse else x
            n += 1
    return n


@compiled_fused
def _largest_cubic_root(b: float, c: float, d: float) -> float:
    """Largest real root of y^3 + b y^2 + c y + d (Cardano, Vieta), polished by one Newton step."""
    shift = b / 3.0
    p = c / 3.0 - shift * shift
    q = shift * (shift * shift - 0.5 * c) + 0.5 * d
    square = q * q + p * p * p
    if square >= 0.0:
        w = np.cbrt(abs(q) + np.sqrt(square))
        t = (w - p / w if w > 0.0 else 0.0) * (-1.0 if q > 0.0 else 1.0)
    else:
        root = np.sqrt(-p)
        t = 2.0 * root * np.cos(np.arccos(max(-1.0, min(1.0, -q / (root * root * root)))) / 3.0)
    y = t - shift
    slope = (3.0 * y + 2.0 * b) * y + c
    if slope != 0.0:
        y -= (((y + b) * y + c) * y + d) / slope
    return y


@compiled_fused
def _roots_in_unit_interval(
    g0: float, g1: float, g2: float, g3: float, g4: float, roots: FloatArray, n: int
) -> int:
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


@compiled_fused
def _bracketed(
    g0: float, g1: float, g2: float, g3: float, g4: float, low: float, high: float, f_low: float
) -> float:
    """Return the root in a bracket by Newton's method, kept inside by bisection."""
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
        if abs(new - x) <= MAX_LAST_STEP * abs(x):
            return new
        x = new
    return x
