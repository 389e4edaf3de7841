"""Algebra of three and six numbers inside compiled loops: products of vectors, small rotations, systems.

Two products of 6 x 6 and 3 x 6 numbers for compiled loops, written in vectors of six.

Both are the inner work of sums over pairs of rays. The compiler makes vectors of loops over long arrays, but
not of six numbers at a time: as loops they take 21 ns, as vectors 5 ns.

Source: vector types and `contract` (fused multiply-add): LLVM Language Reference.

Small symmetric systems of equations by Cholesky's factorisation, for use inside compiled loops.

Only the lower triangle of a matrix is read. All work is done in arrays of the caller.

Source: Golub and Van Loan (2013), Matrix Computations, sec. 4.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import types

from sfm.conventions import FloatArray
from sfm.kernels.compiling import compiled

SIX = ir.VectorType(ir.DoubleType(), 6)
FUSED = ("contract",)
_intrinsic: Any = extending.intrinsic  # whose types are those of the code that is generated
ALIGNED = 8  # bytes; no more is known of where six numbers lie
MIN_PIVOT = 1e-14  # what elimination leaves of a diagonal of 1 below which scaled equations are singular
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
        False where the unknowns are not determined.
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
    """Take Y_s Y_t' off 6 x 6 numbers: flat[at + q stride + p] -= sum_r Y[s, r, q] Y[t, r, p].

    Args:
        flat: contiguous numbers, (any,).
        at: place of the first of them.
        stride: from one row to the next.
        Y: rows Y' of image points, contiguous, (k, 3, 6).
        s: one of them.
        t: another.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        flat, at, stride, Y, s, t = arguments
        numbers = _data(context, builder, signature.args[0], flat)
        rows = _data(context, builder, signature.args[3], Y)
        first, second = (builder.mul(k, _integer(18)) for k in (s, t))
        others = [_six(builder, _place(builder, rows, second, 6 * r)) for r in range(3)]
        for q in range(6):
            place = builder.bitcast(
                builder.gep(numbers, [builder.add(at, builder.mul(stride, _integer(q)))]), SIX.as_pointer()
            )
            value = builder.load(place, align=ALIGNED)
            for r in range(3):
                one = _repeated(builder, builder.load(_place(builder, rows, first, 6 * r + q)))
                value = builder.fsub(value, builder.fmul(one, others[r], flags=FUSED), flags=FUSED)
            builder.store(value, place, align=ALIGNED)
        return context.get_dummy_value()

    return types.void(flat, types.intp, types.intp, Y, types.intp, types.intp), generate


def _add_product(_: Any, YQ: Any, s: Any, Y: Any, t: Any, flat: Any, at: Any, stride: Any) -> Any:
    """Add Y_t' Q to YQ_s: YQ[s, r, p] += sum_q Y[t, r, q] flat[at + q stride + p].

    Args:
        YQ: what is added to, rows of image points, contiguous, (k, 3, 6).
        s: image point of YQ.
        Y: rows of image points, contiguous, (k, 3, 6).
        t: image point of Y.
        flat: contiguous numbers, (any,).
        at: place of the first of 6 x 6 numbers Q.
        stride: from one row to the next.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        YQ, s, Y, t, flat, at, stride = arguments
        sums = _data(context, builder, signature.args[0], YQ)
        rows = _data(context, builder, signature.args[2], Y)
        numbers = _data(context, builder, signature.args[4], flat)
        first, second = (builder.mul(k, _integer(18)) for k in (s, t))
        places = [builder.bitcast(_place(builder, sums, first, 6 * r), SIX.as_pointer()) for r in range(3)]
        values = [builder.load(place, align=ALIGNED) for place in places]
        for q in range(6):
            row = _six(builder, builder.gep(numbers, [builder.add(at, builder.mul(stride, _integer(q)))]))
            for r in range(3):
                one = _repeated(builder, builder.load(_place(builder, rows, second, 6 * r + q)))
                values[r] = builder.fadd(values[r], builder.fmul(one, row, flags=FUSED), flags=FUSED)
        for place, value in zip(places, values, strict=True):
            builder.store(value, place, align=ALIGNED)
        return context.get_dummy_value()

    return types.void(YQ, types.intp, Y, types.intp, flat, types.intp, types.intp), generate


subtract_pair: Callable[[FloatArray, int, int, FloatArray, int, int], None] = _intrinsic(_subtract_pair)
add_product: Callable[[FloatArray, int, FloatArray, int, FloatArray, int, int], None] = _intrinsic(
    _add_product
)


def _data(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """Return the pointer to the numbers of an array."""
    return context.make_array(kind)(context, builder, array).data


def _integer(value: int) -> ir.Constant:
    return ir.Constant(ir.IntType(64), value)


def _place(builder: Any, numbers: Any, start: Any, offset: int) -> Any:
    return builder.gep(numbers, [builder.add(start, _integer(offset))])


def _six(builder: Any, place: Any) -> Any:
    """Return the six numbers from a place on."""
    return builder.load(builder.bitcast(place, SIX.as_pointer()), align=ALIGNED)


def _repeated(builder: Any, number: Any) -> Any:
    """Return one number six times."""
    nothing, lane = ir.Constant(SIX, ir.Undefined), ir.IntType(32)
    one = builder.insert_element(nothing, number, ir.Constant(lane, 0))
    return builder.shuffle_vector(one, nothing, ir.Constant(ir.VectorType(lane, 6), [0] * 6))


@compiled
def solve_symmetric(N: FloatArray, g: FloatArray) -> bool:
    """Solve N x = g; the factor replaces N and x replaces g.

    Args:
        N: symmetric matrix, shape (n, n).
        g: right-hand side, shape (n,).

    Returns:
        False, with N and g spoilt, where N is not positive definite.
    """
    if not factorise(N, N, 0.0):
        return False
    solve_factorised(N, g)
    return True


@compiled
def invert_symmetric(N: FloatArray) -> bool:
    """Replace a symmetric matrix, shape (n, n), by its inverse; False where it is not positive definite."""
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
        least: smallest part of a diagonal element of N that must be left after elimination.

    Returns:
        False where no more is left: an unknown is not determined, or N is not positive definite.
    """
    for i in range(len(N)):
        for j in range(i + 1):
            total = N[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > least * N[i, i]:  # nan is not above either
                    return False
                L[i, i] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return True


@compiled
def solve_factorised(L: FloatArray, x: FloatArray) -> None:
    """Solve L L' x = g in place: x is g, shape (n,), and receives the solution."""
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
