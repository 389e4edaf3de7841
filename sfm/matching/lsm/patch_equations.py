"""Normal equations of a patch: gradients of the template, their products, and the solution.

Observations are the intensities of the window; unknowns are 2, 6 or 8 geometric parameters, offset and gain,
and, where the photographs may be blurred differently, three of the difference of their blur.
The template is in single precision, the sums are in double.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfm.conventions import AnyArray, FloatArray
from sfm.kernels.cholesky import factorise
from sfm.kernels.options import compiled, compiled_fast
from sfm.kernels.sampling import TAPS
from sfm.matching.lsm.window import resample_window
from sfm.matching.match_flags import FLAT_TEXTURE, MATCHED, OUTSIDE

MODELS = {"shift": 2, "affine": 6, "projective": 8}  # geometric parameters
RADIOMETRIC = 2  # offset and gain
# Differences of the second moments of blur, px^2: xx, xy, yy. A blur changes intensities by half the products
# of its second moments and the second derivatives, up to moments of higher order.
BLUR = 3
MARGIN = 3  # pixels around the template that its gradients need
UNDETERMINED = 1e-9  # part of a diagonal that rounding of float32 intensities leaves of nothing
# Symmetric difference of sixth order, taps 1, 2, 3; a gradient has the variance of a pixel times SLOPE_NOISE.
# Source: Abramowitz and Stegun (1964), table 25.2 (seven-point formula).
SLOPE = (3.0 / 4.0, -3.0 / 20.0, 1.0 / 60.0)
SLOPE_NOISE = 2.0 * (SLOPE[0] ** 2 + SLOPE[1] ** 2 + SLOPE[2] ** 2)
# Contributions of noise of variance 1 to products of blur's rows: (1 -2 1) across (1 2 1) / 4, halved, and
# its mixed difference: of xx or yy with itself, of xx with yy, of xy with itself, and of xx or yy with
# intensities.
BLUR_NOISE = (9.0 / 16.0, 1.0 / 16.0, 1.0 / 4.0, -1.0 / 2.0)


class Workspace(NamedTuple):
    """Settings of all patches, and the arrays in which each is worked on in turn."""

    half: int  # half the side of the window, px
    kind: int  # kernel of resampling
    geometric: int  # geometric parameters
    blurred: int  # parameters of blur: 0 or BLUR
    grid: AnyArray  # template with its margin, float32
    J: AnyArray  # d (patch) / d (unknowns), a row each, float32, (u, side^2)
    N: FloatArray  # normal matrix, (u, u)
    L: FloatArray  # its factor, (u, u)
    q: FloatArray  # solution, (u,)
    rhs: FloatArray  # right-hand side, (u,)
    patch: AnyArray  # resampled intensities, later residuals, float32, (side^2,)
    wx: AnyArray  # weights of the kernel along a row, float32
    wy: AnyArray  # and along a column, float32


@compiled
def new_workspace(half: int, kind: int, geometric: int, blurred: int) -> Workspace:
    """Return arrays for windows of a size and a model."""
    side, size = 2 * half + 1, geometric + RADIOMETRIC + blurred
    wide = side + 2 * MARGIN
    return Workspace(
        half,
        kind,
        geometric,
        blurred,
        np.empty((wide, wide), np.float32),
        np.empty((size, side * side), np.float32),
        np.empty((size, size)),
        np.empty((size, size)),
        np.empty(size),
        np.empty(size),
        np.empty(side * side, np.float32),
        np.zeros(TAPS, np.float32),
        np.zeros(TAPS, np.float32),
    )


@compiled
def prepare_template(left: AnyArray, x: float, y: float, work: Workspace) -> int:
    """Fill gradients, normal matrix and factor of the template around a point; return the flag."""
    if not resample_window(left, x, y, work.half + MARGIN, work.kind, work.wx, work.wy, work.grid):
        return OUTSIDE
    gradients(work.grid, work.half, work.geometric, work.J)
    if work.blurred:
        blur_changes(work.grid, work.half, work.J[work.geometric + RADIOMETRIC :])
    fill_normals(work.J, work.N)
    return MATCHED if factorise(work.N, work.L, UNDETERMINED) else FLAT_TEXTURE


@compiled
def gradients(grid: AnyArray, half: int, geometric: int, J: AnyArray) -> None:
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


@compiled
def blur_changes(grid: AnyArray, half: int, J: AnyArray) -> None:
    """Fill J: d (patch) / d (second moments of blur xx, xy, yy), (3, side^2).

    Second differences are taken over three rows and columns, which keeps them free from most of the noise.
    """
    side, quarter, eighth = 2 * half + 1, np.float32(0.25), np.float32(0.125)
    for i in range(side):
        y = i + MARGIN
        for j in range(side):
            x = j + MARGIN
            p = i * side + j
            corners = grid[y - 1, x - 1] + grid[y - 1, x + 1] + grid[y + 1, x - 1] + grid[y + 1, x + 1]
            beside, above = grid[y, x - 1] + grid[y, x + 1], grid[y - 1, x] + grid[y + 1, x]
            middle = np.float32(4.0) * grid[y, x]
            J[0, p] = eighth * (corners + np.float32(2.0) * (beside - above) - middle)
            J[1, p] = quarter * (corners - np.float32(2.0) * (grid[y - 1, x + 1] + grid[y + 1, x - 1]))
            J[2, p] = eighth * (corners + np.float32(2.0) * (above - beside) - middle)


@compiled_fast
def fill_normals(J: AnyArray, N: FloatArray) -> None:
    """Fill N = J J^T, the rows of J being the unknowns."""
    for a in range(len(J)):
        for b in range(a + 1):
            N[a, b] = N[b, a] = dot(J[a], J[b])


@compiled_fast
def dot(a: AnyArray, b: AnyArray) -> float:
    """Return the sum of products of two rows of float32 in double precision."""
    total = 0.0
    for p in range(len(a)):
        total += np.float64(a[p]) * np.float64(b[p])
    return total
