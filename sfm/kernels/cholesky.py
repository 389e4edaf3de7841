"""Small symmetric systems of equations by Cholesky's factorisation, for use inside compiled loops.

Only the lower triangle of a matrix is read. All work is done in arrays of the caller.

Source: Golub and Van Loan (2013), Matrix Computations, sec. 4.2.
"""

from __future__ import annotations

import math

from sfm.conventions import FloatArray
from sfm.kernels.options import compiled


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
