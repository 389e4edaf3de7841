"""Small algebra for compiled loops: vectors, 6 x 6 blocks, Cholesky, roots of quartics.

Symmetric systems of equations are solved by Cholesky's factorisation. Only the lower triangle of a matrix is
read, and all work is done in arrays of the caller.

Two products of 6 x 6 and 3 x 6 numbers, the inner work of sums over pairs of rays, are written with vectors
of six numbers. The compiler vectorises loops over long arrays, but not six numbers at a time: as loops the
products take 21 ns, as vectors 5 ns.

The positive real roots of a quartic are found without missing any. Ferrari's two quadratic factors give the
roots if their product is the quartic again and no two roots are close together. Closed formulas lose the
near-double roots that occur when the camera is near the danger cylinder of three points. In that case
bracketed Newton steps search every interval between turning points. A turning point that touches zero within
rounding counts as a double root.

Source: vector types and `contract` (fused multiply-add): LLVM Language Reference; Golub and Van Loan (2013),
Matrix Computations, sec. 4.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import types

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import FloatArray
from sfm.runtime.compiling import compiled, compiled_fused

MAX_ROOTS = 8  # four roots, each of which may be reported once more as a touching turning point
TOUCH = 1e-9  # |f| at a turning point over sum |coefficient| below which it counts as a double root
STEPS = 60
FACTORED = 1e-11  # largest misfit of the product of the factors over sum |coefficient|
APART = 1e-5  # discriminant of a factor over p^2 + 4 |q| above which its roots are certainly real or complex
MAX_LAST_STEP = 1e-9  # relative step; the error after it is its square, or rounding
SIX = ir.VectorType(ir.DoubleType(), 6)
FUSED = ("contract",)
_intrinsic: Any = extending.intrinsic  # its types are those of the generated code
ALIGNED = 8  # bytes; six numbers may start at any multiple of this
MIN_PIVOT = 1e-14  # remainder of a diagonal of 1 after elimination, below which scaled equations are singular
# Determinant over the product of the diagonal below which three equations are singular.
SINGULAR_THREE = 1e-13


@compiled
def cross(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Fill the cross product a x b, (3,)."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@compiled
def turn(R: FloatArray, wx: float, wy: float, wz: float, out: FloatArray) -> None:
    """Fill out = R exp([w]x), a rotation (3, 3) followed by a small one about its axes (Rodrigues)."""
    t2 = wx * wx + wy * wy + wz * wz
    t = np.sqrt(t2)
    if t < 1e-4:
        a, b = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0
    else:
        a, b = np.sin(t) / t, (1.0 - np.cos(t)) / t2
    e00, e01, e02 = 1.0 - b * (wy * wy + wz * wz), b * wx * wy - a * wz, b * wx * wz + a * wy
    e10, e11, e12 = b * wx * wy + a * wz, 1.0 - b * (wx * wx + wz * wz), b * wy * wz - a * wx
    e20, e21, e22 = b * wx * wz - a * wy, b * wy * wz + a * wx, 1.0 - b * (wx * wx + wy * wy)
    for i in range(3):
        r0, r1, r2 = R[i, 0], R[i, 1], R[i, 2]
        out[i, 0] = r0 * e00 + r1 * e10 + r2 * e20
        out[i, 1] = r0 * e01 + r1 * e11 + r2 * e21
        out[i, 2] = r0 * e02 + r1 * e12 + r2 * e22


@compiled
def solve_scaled(N: FloatArray, n_vector: FloatArray, dx: FloatArray) -> bool:
    """Solve normal equations N dx = n after scaling N to unit diagonal.

    Args:
        N: normal matrix, (m, m); unchanged.
        n_vector: right-hand side, (m,); unchanged.
        dx: receives the solution, (m,).

    Returns:
        False if the unknowns are not determined.
    """
    m = len(n_vector)
    L = np.empty((m, m))
    scale = np.empty(m)
    for a in range(m):
        if not N[a, a] > 0.0:
            return False
        scale[a] = 1.0 / np.sqrt(N[a, a])
    for a in range(m):
        for b in range(a + 1):
            L[a, b] = N[a, b] * scale[a] * scale[b]
        dx[a] = n_vector[a] * scale[a]
    if not factorise(L, L, MIN_PIVOT):
        return False
    solve_factorised(L, dx)
    for a in range(m):
        dx[a] *= scale[a]
    return True


@compiled
def solve_three(N: FloatArray, h: FloatArray, x: FloatArray) -> bool:
    """Solve N x = h, 3 by 3, by Cramer's rule; False if N is singular to double precision."""
    c0 = N[1, 1] * N[2, 2] - N[1, 2] * N[2, 1]
    c1 = N[1, 2] * N[2, 0] - N[1, 0] * N[2, 2]
    c2 = N[1, 0] * N[2, 1] - N[1, 1] * N[2, 0]
    det = N[0, 0] * c0 + N[0, 1] * c1 + N[0, 2] * c2
    if not det > SINGULAR_THREE * N[0, 0] * N[1, 1] * N[2, 2]:
        return False
    x[0] = (
        c0 * h[0]
        + (N[0, 2] * N[2, 1] - N[0, 1] * N[2, 2]) * h[1]
        + (N[0, 1] * N[1, 2] - N[0, 2] * N[1, 1]) * h[2]
    ) / det
    x[1] = (
        c1 * h[0]
        + (N[0, 0] * N[2, 2] - N[0, 2] * N[2, 0]) * h[1]
        + (N[0, 2] * N[1, 0] - N[0, 0] * N[1, 2]) * h[2]
    ) / det
    x[2] = (
        c2 * h[0]
        + (N[0, 1] * N[2, 0] - N[0, 0] * N[2, 1]) * h[1]
        + (N[0, 0] * N[1, 1] - N[0, 1] * N[1, 0]) * h[2]
    ) / det
    return True


def _subtract_pair(_: Any, flat: Any, at: Any, stride: Any, Y: Any, s: Any, t: Any) -> Any:
    """Subtract Y_s Y_t' from 6 x 6 numbers: flat[at + q stride + p] -= sum_r Y[s, r, q] Y[t, r, p].

    Args:
        flat: contiguous numbers, (any,).
        at: index of the first of them.
        stride: distance from one row to the next.
        Y: rows Y' of image points, contiguous, (k, 3, 6).
        s: first image point.
        t: second image point.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        flat, at, stride, Y, s, t = arguments
        numbers = _data(context, builder, signature.args[0], flat)
        rows = _data(context, builder, signature.args[3], Y)
        first, second = (builder.mul(k, _integer(18)) for k in (s, t))
        others = [_load_six(builder, _pointer(builder, rows, second, 6 * r)) for r in range(3)]
        for q in range(6):
            pointer = builder.bitcast(
                builder.gep(numbers, [builder.add(at, builder.mul(stride, _integer(q)))]), SIX.as_pointer()
            )
            value = builder.load(pointer, align=ALIGNED)
            for r in range(3):
                factor = _repeated(builder, builder.load(_pointer(builder, rows, first, 6 * r + q)))
                value = builder.fsub(value, builder.fmul(factor, others[r], flags=FUSED), flags=FUSED)
            builder.store(value, pointer, align=ALIGNED)
        return context.get_dummy_value()

    return types.void(flat, types.intp, types.intp, Y, types.intp, types.intp), generate


def _add_product(_: Any, YQ: Any, s: Any, Y: Any, t: Any, flat: Any, at: Any, stride: Any) -> Any:
    """Add Y_t' Q to YQ_s: YQ[s, r, p] += sum_q Y[t, r, q] flat[at + q stride + p].

    Args:
        YQ: sums, rows of image points, contiguous, (k, 3, 6).
        s: image point of YQ.
        Y: rows of image points, contiguous, (k, 3, 6).
        t: image point of Y.
        flat: contiguous numbers, (any,).
        at: index of the first of the 6 x 6 numbers Q.
        stride: distance from one row to the next.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        YQ, s, Y, t, flat, at, stride = arguments
        sums = _data(context, builder, signature.args[0], YQ)
        rows = _data(context, builder, signature.args[2], Y)
        numbers = _data(context, builder, signature.args[4], flat)
        first, second = (builder.mul(k, _integer(18)) for k in (s, t))
        pointers = [
            builder.bitcast(_pointer(builder, sums, first, 6 * r), SIX.as_pointer()) for r in range(3)
        ]
        values = [builder.load(pointer, align=ALIGNED) for pointer in pointers]
        for q in range(6):
            row = _load_six(
                builder, builder.gep(numbers, [builder.add(at, builder.mul(stride, _integer(q)))])
            )
            for r in range(3):
                factor = _repeated(builder, builder.load(_pointer(builder, rows, second, 6 * r + q)))
                values[r] = builder.fadd(values[r], builder.fmul(factor, row, flags=FUSED), flags=FUSED)
        for pointer, value in zip(pointers, values, strict=True):
            builder.store(value, pointer, align=ALIGNED)
        return context.get_dummy_value()

    return types.void(YQ, types.intp, Y, types.intp, flat, types.intp, types.intp), generate


subtract_pair: Callable[[FloatArray, int, int, FloatArray, int, int], None] = _intrinsic(_subtract_pair)
add_product: Callable[[FloatArray, int, FloatArray, int, FloatArray, int, int], None] = _intrinsic(
    _add_product
)


def _data(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """Return the pointer to the data of an array."""
    return context.make_array(kind)(context, builder, array).data


def _integer(value: int) -> ir.Constant:
    return ir.Constant(ir.IntType(64), value)


def _pointer(builder: Any, numbers: Any, start: Any, offset: int) -> Any:
    return builder.gep(numbers, [builder.add(start, _integer(offset))])


def _load_six(builder: Any, pointer: Any) -> Any:
    """Return the six numbers that begin at a pointer."""
    return builder.load(builder.bitcast(pointer, SIX.as_pointer()), align=ALIGNED)


def _repeated(builder: Any, number: Any) -> Any:
    """Return a vector that repeats one number six times."""
    nothing, lane = ir.Constant(SIX, ir.Undefined), ir.IntType(32)
    first = builder.insert_element(nothing, number, ir.Constant(lane, 0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(lane, 6), [0] * 6))


@compiled
def solve_symmetric(N: FloatArray, g: FloatArray) -> bool:
    """Solve N x = g; the factor replaces N and x replaces g.

    Args:
        N: symmetric matrix, shape (n, n).
        g: right-hand side, shape (n,).

    Returns:
        False if N is not positive definite; N and g are then invalid.
    """
    if not factorise(N, N, 0.0):
        return False
    solve_factorised(N, g)
    return True


@compiled
def invert_symmetric(N: FloatArray) -> bool:
    """Replace a symmetric matrix, shape (n, n), by its inverse; False if it is not positive definite."""
    n = len(N)
    if not factorise(N, N, 0.0):
        return False
    for j in range(n):  # L becomes its inverse
        N[j, j] = 1 / N[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total -= N[i, k] * N[k, j]
            N[i, j] = total / N[i, i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += N[k, i] * N[k, j]
            N[j, i] = total  # rows above are no longer read
    for i in range(n):
        for j in range(i):
            N[i, j] = N[j, i]
    return True


@compiled
def factorise(N: FloatArray, L: FloatArray, least: float) -> bool:
    """Write the lower triangular factor of N = L L'.

    Args:
        N: symmetric matrix, shape (n, n).
        L: receives the factor, shape (n, n); may be N itself.
        least: smallest fraction of a diagonal element of N that must remain after elimination.

    Returns:
        False if less remains: an unknown is not determined, or N is not positive definite.
    """
    for i in range(len(N)):
        for j in range(i + 1):
            total = N[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > least * N[i, i]:  # False for NaN as well
                    return False
                L[i, i] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return True


@compiled
def solve_factorised(L: FloatArray, x: FloatArray) -> None:
    """Solve L L' x = g in place: x contains g, shape (n,), and receives the solution."""
    n = len(L)
    for i in range(n):
        total = x[i]
        for k in range(i):
            total -= L[i, k] * x[k]
        x[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= L[k, i] * x[k]
        x[i] = total / L[i, i]


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
    # x up to 1, and 1/x for x above 1, so that every search is in (0, 1]
    n = _roots_in_unit_interval(g0, g1, g2, g3, g4, roots, 0)
    m = _roots_in_unit_interval(g4, g3, g2, g1, g0, roots, n)
    for i in range(n, m):
        roots[i] = 1.0 / roots[i]
    return m


@compiled_fused
def _roots_by_factors(g0: float, g1: float, g2: float, g3: float, g4: float, roots: FloatArray) -> int:
    """Ferrari: x^4 + a x^3 + b x^2 + c x + d = (x^2 + p x + q)(x^2 + r x + s); -1 if this is not safe."""
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
    # p s + r q = a y / 2 - 2 half_p half_q must equal c; the larger of the two roots gives the smaller
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
    """Return the largest real root of y^3 + b y^2 + c y + d (Cardano, Vieta), refined by one Newton step."""
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
    """Append the roots of the quartic in (0, 1] after the first n and return the new number."""
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
    """Return the root in a bracket by Newton's method; bisection keeps it inside."""
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
