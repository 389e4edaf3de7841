"""Algebra of three and six numbers inside compiled loops: products of vectors, small rotations, systems."""

from __future__ import annotations

import numpy as np

from sfm.conventions import FloatArray
from sfm.kernels.cholesky import factorise, solve_factorised
from sfm.kernels.options import compiled

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
