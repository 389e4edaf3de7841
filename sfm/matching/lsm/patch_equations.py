"""Least squares matching of a patch: window, warp, gradients and normal equations.

Observations are the intensities of the window. Unknowns are 2, 6 or 8 geometric parameters, gain and
offset, and three parameters for a difference of blur if the photographs may be blurred differently. The
template is in single precision, the sums are in double precision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfm.matching.correlation import FLAT_TEXTURE, MATCHED, OUTSIDE
from sfm.model.conventions import AnyArray, FloatArray
from sfm.runtime.compiling import compiled, compiled_fast
from sfm.runtime.sampling import AFTER, BEFORE, BILINEAR, TAPS, kernel_weights, sample
from sfm.runtime.small_algebra import factorise

MAX_STRETCH = 3.0  # ratio of lengths of a patch in both photographs above which it is not a match
SHIFT, LINEAR = 2, 4  # geometric parameters of the shift, and of the linear part of a warp
MODELS = {"shift": SHIFT, "affine": SHIFT + LINEAR, "projective": 8}
RADIOMETRIC = 2  # offset and gain
# Differences of the second moments of blur, px^2: xx, xy, yy. A blur changes intensities by half the products
# of its second moments and the second derivatives, up to moments of higher order.
BLUR = 3
MARGIN = 3  # pixels around the template that its gradients need
UNDETERMINED = 1e-9  # fraction of a diagonal element that is left by rounding of float32 intensities
# Symmetric difference of sixth order, taps 1, 2, 3; a gradient has the variance of a pixel times SLOPE_NOISE.
# Source: Abramowitz and Stegun (1964), table 25.2 (seven-point formula).
SLOPE = (3.0 / 4.0, -3.0 / 20.0, 1.0 / 60.0)
SLOPE_NOISE = 2.0 * (SLOPE[0] ** 2 + SLOPE[1] ** 2 + SLOPE[2] ** 2)
# Contributions of noise of variance 1 to products of the blur rows: (1 -2 1) across (1 2 1) / 4, halved, and
# its mixed difference. In order: xx or yy with itself, xx with yy, xy with itself, and xx or yy with
# intensities.
BLUR_NOISE = (9.0 / 16.0, 1.0 / 16.0, 1.0 / 4.0, -1.0 / 2.0)


class Workspace(NamedTuple):
    """Settings for all patches, and the arrays in which they are processed one after the other."""

    half: int  # half the side of the window, px
    kind: int  # kernel of resampling
    geometric: int  # geometric parameters
    blurred: int  # parameters of blur: 0 or BLUR
    grid: AnyArray  # template with its margin, float32
    J: AnyArray  # d (patch) / d (unknowns), one row each, float32, (u, side^2)
    N: FloatArray  # normal matrix, (u, u)
    L: FloatArray  # its factor, (u, u)
    q: FloatArray  # solution, (u,)
    rhs: FloatArray  # right-hand side, (u,)
    patch: AnyArray  # resampled intensities, later residuals, float32, (side^2,)
    wx: AnyArray  # weights of the kernel along a row, float32
    wy: AnyArray  # and along a column, float32


@compiled
def new_workspace(half: int, kind: int, geometric: int, blurred: int) -> Workspace:
    """Return arrays for windows of one size and one model."""
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
    """Compute gradients, normal matrix and factor of the template around a point; return the flag."""
    if not resample_window(left, x, y, work.half + MARGIN, work.kind, work.wx, work.wy, work.grid):
        return OUTSIDE
    gradients(work.grid, work.half, work.geometric, work.J)
    if work.blurred:
        blur_changes(work.grid, work.half, work.J[work.geometric + RADIOMETRIC :])
    fill_normals(work.J, work.N)
    return MATCHED if factorise(work.N, work.L, UNDETERMINED) else FLAT_TEXTURE


@compiled
def gradients(grid: AnyArray, half: int, geometric: int, J: AnyArray) -> None:
    """Fill J: d (patch) / d (geometric, offset, gain), with window coordinates in half windows.

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
            if geometric > SHIFT:
                J[2, p], J[3, p], J[4, p], J[5, p] = gx * u, gx * v, gy * u, gy * v
            if geometric > 6:
                outwards = gx * u + gy * v
                J[6, p], J[7, p] = -outwards * u, -outwards * v
            J[geometric, p] = np.float32(1.0)
            J[geometric + 1, p] = grid[y, x]


@compiled
def blur_changes(grid: AnyArray, half: int, J: AnyArray) -> None:
    """Fill J: d (patch) / d (second moments of blur xx, xy, yy), (3, side^2).

    Second differences are averaged over three rows and columns, which removes most of the noise.
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
    """Fill N = J J^T; the rows of J are the unknowns."""
    for a in range(len(J)):
        for b in range(a + 1):
            N[a, b] = N[b, a] = dot(J[a], J[b])


@compiled_fast
def dot(a: AnyArray, b: AnyArray) -> float:
    """Return the sum of products of two rows of float32, in double precision."""
    total = 0.0
    for p in range(len(a)):
        total += np.float64(a[p]) * np.float64(b[p])
    return total


@compiled
def resample_window(
    grey: AnyArray, x: float, y: float, reach: int, kind: int, wx: AnyArray, wy: AnyArray, grid: AnyArray
) -> bool:
    """Fill `grid` with the intensities at (x + j, y + i), |i|, |j| <= reach; False outside the photograph."""
    height, width = grey.shape
    if not (x >= reach and y >= reach and x <= width - 1.0 - reach and y <= height - 1.0 - reach):
        return False
    col, row = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - col, y - row
    if fx == 0.0 and fy == 0.0:
        for i in range(-reach, reach + 1):
            for j in range(-reach, reach + 1):
                grid[reach + i, reach + j] = grey[row + i, col + j]
        return True
    before, after = reach + BEFORE, reach + AFTER
    if col < before or row < before or col + after > width - 1 or row + after > height - 1:
        return False
    kernel_weights(kind, np.float32(fx), wx)
    kernel_weights(kind, np.float32(fy), wy)
    flat, step = grey.reshape(-1), np.uintp(width)
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            at = np.uintp((row + i - BEFORE) * width + col + j - BEFORE)
            grid[reach + i, reach + j] = sample(flat, at, step, wx, wy)
    return True


@compiled_fast
def resample_patch(
    grey: AnyArray, H: FloatArray, half: int, kind: int, wx: AnyArray, wy: AnyArray, patch: AnyArray
) -> bool:
    """Fill `patch` with S(H x) for x in the window; False where it reaches beyond the photograph."""
    height, width = grey.shape
    for b in (-half, half):
        for a in (-half, half):
            w = H[2, 0] * a + H[2, 1] * b + H[2, 2]
            if not w > 0.0:
                return False
            x = (H[0, 0] * a + H[0, 1] * b + H[0, 2]) / w
            y = (H[1, 0] * a + H[1, 1] * b + H[1, 2]) / w
            if not (x >= BEFORE and y >= BEFORE and x < width - AFTER and y < height - AFTER):
                return False
    flat, step = grey.reshape(-1), np.uintp(width)
    perspective = H[2, 0] != 0.0 or H[2, 1] != 0.0
    p = 0
    for b in range(-half, half + 1):
        x0, y0, w0 = H[0, 1] * b + H[0, 2], H[1, 1] * b + H[1, 2], H[2, 1] * b + H[2, 2]
        for a in range(-half, half + 1):
            x, y = x0 + H[0, 0] * a, y0 + H[1, 0] * a
            if perspective:
                w = w0 + H[2, 0] * a
                x, y = x / w, y / w
            col, row = int(x), int(y)
            fx, fy = np.float32(x - col), np.float32(y - row)
            if kind == BILINEAR:
                q = row * width + col
                top, low = flat[q], flat[q + width]
                top += fx * (flat[q + 1] - top)
                low += fx * (flat[q + width + 1] - low)
                patch[p] = top + fy * (low - top)
            else:
                kernel_weights(kind, fx, wx)
                kernel_weights(kind, fy, wy)
                at = np.uintp((row - BEFORE) * width + col - BEFORE)
                patch[p] = sample(flat, at, step, wx, wy)
            p += 1
    return True


@compiled
def put_step(H: FloatArray, q: FloatArray, half: int, geometric: int) -> float:
    """Apply the step q, H <- H dH^-1; return the shift in px, inf if gain or warp become degenerate."""
    beta = q[geometric + 1]
    if not beta > 0.0:
        return np.inf
    x, y = H[0, 2], H[1, 2]
    d00, d01, d02 = 1.0, 0.0, half * q[0] / beta
    d10, d11, d12 = 0.0, 1.0, half * q[1] / beta
    d20, d21 = 0.0, 0.0
    if geometric > SHIFT:
        d00 += q[2] / beta
        d01 += q[3] / beta
        d10 += q[4] / beta
        d11 += q[5] / beta
    if geometric > 6:
        d20, d21 = q[6] / (beta * half), q[7] / (beta * half)
    # adjugate of dH; its determinant is only a scale, which the normalisation H[2, 2] = 1 removes
    a00, a01, a02 = d11 - d12 * d21, d02 * d21 - d01, d01 * d12 - d02 * d11
    a10, a11, a12 = d12 * d20 - d10, d00 - d02 * d20, d02 * d10 - d00 * d12
    a20, a21, a22 = d10 * d21 - d11 * d20, d01 * d20 - d00 * d21, d00 * d11 - d01 * d10
    if not d00 * a00 + d10 * a01 + d20 * a02 > 1e-3:
        return np.inf
    for i in range(3):
        h0, h1, h2 = H[i, 0], H[i, 1], H[i, 2]
        H[i, 0] = h0 * a00 + h1 * a10 + h2 * a20
        H[i, 1] = h0 * a01 + h1 * a11 + h2 * a21
        H[i, 2] = h0 * a02 + h1 * a12 + h2 * a22
    if not H[2, 2] > 0.0:
        return np.inf
    scale = 1.0 / H[2, 2]
    for i in range(3):
        for j in range(3):
            H[i, j] *= scale
    det = area_ratio(H)
    if not (det > MAX_STRETCH**-2 and det < MAX_STRETCH**2):
        return np.inf
    return float(np.hypot(H[0, 2] - x, H[1, 2] - y))


@compiled
def area_ratio(H: FloatArray) -> float:
    """Return the right area of a unit area at the point: the determinant of d(H x)/dx at x = 0."""
    xx, xy = H[0, 0] - H[0, 2] * H[2, 0], H[0, 1] - H[0, 2] * H[2, 1]
    yx, yy = H[1, 0] - H[1, 2] * H[2, 0], H[1, 1] - H[1, 2] * H[2, 1]
    ratio: float = xx * yy - xy * yx
    return ratio


def linear_part(warp: FloatArray) -> FloatArray:
    """Return d(H x)/dx at x = 0 of homographies (k, 3, 3) whose H[2, 2] is 1, (k, 2, 2)."""
    return np.asarray(warp[:, :2, :2] - warp[:, :2, 2:] * warp[:, 2:, :2])
