"""Normal equations of a patch: gradients of the template, their products, and the solution.

Observations are the intensities of the window; unknowns are 2, 6 or 8 geometric parameters, offset and gain.
The template is in single precision, the sums are in double.
"""

from __future__ import annotations

import numpy as np
from numba import njit

MODELS = {"shift": 2, "affine": 6, "projective": 8}  # geometric parameters
RADIOMETRIC = 2  # offset and gain
MARGIN = 3  # pixels around the template that its gradients need
# Symmetric difference of sixth order, taps 1, 2, 3; a gradient has the variance of a pixel times SLOPE_NOISE.
# Source: Abramowitz and Stegun (1964), table 25.2 (seven-point formula).
SLOPE = (3.0 / 4.0, -3.0 / 20.0, 1.0 / 60.0)
SLOPE_NOISE = 2.0 * (SLOPE[0] ** 2 + SLOPE[1] ** 2 + SLOPE[2] ** 2)


@njit(cache=True, nogil=True)
def gradients(grid, half, geometric, J):  # type: ignore[no-untyped-def]
    """Fill J: d (patch) / d (geometric, offset, gain), window coordinates counted in half windows.

    Order of the geometric parameters: shift x, y; xx, xy, yx, yy; and the two of perspective.
    """
    a, b, c = np.float32(half * SLOPE[0]), np.float32(half * SLOPE[1]), np.float32(half * SLOPE[2])
    side = 2 * half + 1
    for i in range(side):
        y = i + MARGIN
        v = np.float32((i - half) / half)
        for j in range(side):
            x = j + MARGIN
            u = np.float32((j - half) / half)
            p = i * side + j
            gx = a * (grid[y, x + 1] - grid[y, x - 1]) + b * (grid[y, x + 2] - grid[y, x - 2])
            gx += c * (grid[y, x + 3] - grid[y, x - 3])
            gy = a * (grid[y + 1, x] - grid[y - 1, x]) + b * (grid[y + 2, x] - grid[y - 2, x])
            gy += c * (grid[y + 3, x] - grid[y - 3, x])
            J[0, p], J[1, p] = gx, gy
            if geometric > 2:
                J[2, p], J[3, p], J[4, p], J[5, p] = gx * u, gx * v, gy * u, gy * v
            if geometric > 6:
                along = gx * u + gy * v
                J[6, p], J[7, p] = -along * u, -along * v
            J[geometric, p] = np.float32(1.0)
            J[geometric + 1, p] = grid[y, x]


@njit(cache=True, nogil=True, fastmath=True)
def fill_normals(J, N):  # type: ignore[no-untyped-def]
    for a in range(len(J)):
        for b in range(a + 1):
            N[a, b] = N[b, a] = dot(J[a], J[b])


@njit(cache=True, nogil=True, fastmath=True)
def dot(a, b):  # type: ignore[no-untyped-def]
    total = 0.0
    for p in range(len(a)):
        total += np.float64(a[p]) * np.float64(b[p])
    return total


@njit(cache=True, nogil=True)
def factorise(N, L):  # type: ignore[no-untyped-def]
    """Cholesky factor of N in the lower triangle of L; False where a parameter is not determined."""
    n = len(N)
    for a in range(n):
        for b in range(a + 1):
            s = N[a, b]
            for c in range(b):
                s -= L[a, c] * L[b, c]
            if a == b:
                if not s > 1e-9 * N[a, a]:  # what rounding of float32 intensities leaves of nothing
                    return False
                L[a, a] = np.sqrt(s)
            else:
                L[a, b] = s / L[b, b]
    return True


@njit(cache=True, nogil=True)
def solve(L, q):  # type: ignore[no-untyped-def]
    n = len(L)
    for a in range(n):
        for c in range(a):
            q[a] -= L[a, c] * q[c]
        q[a] /= L[a, a]
    for a in range(n - 1, -1, -1):
        for c in range(a + 1, n):
            q[a] -= L[c, a] * q[c]
        q[a] /= L[a, a]
