"""Least squares matching: where the patch of one photograph is in another, to a hundredth of a pixel.

The patch T around a point of the left photograph and the right photograph S are tied by

    S(H x) = alpha + beta T(x) + noise

with x in the window, a geometric model H (shift, affine or projective) and the two radiometric parameters.
Gauss-Newton is written the inverse way: the change dH of a step is applied to the template, whose gradients
and normal equations then stay the same from step to step, and is put on H as H <- H dH^-1. The right
photograph is resampled in every step, the gradients are symmetric differences of the resampled template.
At convergence it is the least squares solution of the forward equations, up to the noise of the gradients.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numba import njit

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.matching.interpolation import (
    AFTER,
    BEFORE,
    BILINEAR,
    TAPS,
    interpolation_index,
    kernel_weights,
    sample,
)
from sfm.matching.radiometry import grey_of, odd_window

MODELS = {"shift": 2, "affine": 6, "projective": 8}  # geometric parameters
RADIOMETRIC = 2  # offset and gain
MARGIN = 3  # pixels around the template that its gradients need
# Symmetric difference of sixth order, taps 1, 2, 3; a gradient has the variance of a pixel times SLOPE_NOISE.
# Source: Abramowitz and Stegun (1964), table 25.2 (seven-point formula).
SLOPE = (3.0 / 4.0, -3.0 / 20.0, 1.0 / 60.0)
SLOPE_NOISE = 2.0 * (SLOPE[0] ** 2 + SLOPE[1] ** 2 + SLOPE[2] ** 2)
# Texture is flat in a direction in which its gradients have less than this many times the energy of noise.
LEAST_TEXTURE = 3.0
COARSE_STEP = 0.5  # bilinear interpolation is good enough while steps are longer than this, px
CONTRACTION = 0.04  # a step is at most this part of the one before; 0.01 to 0.03 on texture with noise
MAX_STRETCH = 3.0  # ratio of lengths, of a patch in both photographs, that is a match no more
CHUNK = 256  # patches that a thread takes at a time


class LsmFlag(IntFlag):
    """Why least squares matching gives no position, one bit each."""

    NONE = 0
    FLAT_TEXTURE = 1 << 0  # in some direction no more texture than noise
    DIVERGED = 1 << 1  # no solution within the steps allowed, or a patch turned inside out
    OUTSIDE = 1 << 2  # the window, or the margin of its kernel, reaches beyond a photograph
    TOO_FAR = 1 << 3  # farther from the start than allowed
    LOW_CORRELATION = 1 << 4  # converged on something that is not alike


MATCHED, FLAT_TEXTURE, DIVERGED, OUTSIDE, TOO_FAR, LOW_CORRELATION = (int(f) for f in (0, 1, 2, 4, 8, 16))


@dataclass(frozen=True)
class LsmMatches:
    """Positions in the right photograph found by least squares matching; NaN where the flag says why."""

    xy: FloatArray  # place of the left point in the right photograph, px, (k, 2)
    covariance: FloatArray  # of xy, px^2, (k, 2, 2)
    warp: FloatArray  # H: right px from left px relative to the left point, homogeneous, (k, 3, 3)
    gain: FloatArray  # beta: right intensities per left one, (k,)
    offset: FloatArray  # alpha, right intensity units, (k,)
    correlation: FloatArray  # r of template and resampled patch, (k,)
    sigma0: FloatArray  # standard deviation of an intensity difference, right units, (k,)
    steps: IntArray  # Gauss-Newton steps, (k,)
    flag: IntArray  # see LsmFlag, 0 = matched, (k,)

    def __len__(self) -> int:
        return len(self.xy)

    @property
    def good(self) -> BoolArray:
        """Which points were matched, (k,)."""
        return np.asarray(self.flag == 0)


def match_lsm(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    xy_right: FloatArray,
    *,
    model: str = "affine",
    window_px: int = 21,
    interpolation: str = "six_tap",
    stop_px: float = 0.002,
    max_steps: int = 30,
    max_shift_px: float = 5.0,
    min_correlation: float = 0.5,
    start: FloatArray | None = None,
    threads: int = 1,
) -> LsmMatches:
    """Match points of the left photograph in the right one, from places known to a pixel or two.

    Args:
        left, right: photographs, (H, W), 8 or 16 bit or float, grey or colour.
        xy_left: points in the left photograph, px, any fraction, (k, 2).
        xy_right: where they are in the right photograph, approximately, px, (k, 2).
        model: shift (2), affine (6) or projective (8 parameters), each with gain and offset.
        window_px: odd side of the template.
        interpolation: kernel for the right photograph; bilinear costs 1.28 times and bicubic 1.15 times the
            standard deviation of six_tap on fine texture.
        stop_px: the shift of the step that would come next is shorter than this.
        max_steps: after so many a patch counts as diverged.
        max_shift_px: farther from the start is too far.
        min_correlation: below it the places are not alike.
        start: linear part of the warp, right px per left px, (k, 2, 2); the unit matrix if not given.
        threads: patches are shared among so many.

    Returns:
        One match for each point; the covariance assumes the same noise in both photographs, after the gain.

    Raises:
        GeometryError: an unknown model or kernel, an even window, or points that do not go in pairs.

    Source: Gruen (1985), S. Afr. J. Photogrammetry 14(3), and Foerstner (1993) in Haralick and Shapiro,
    Computer and Robot Vision II, ch. 16; the inverse way is Baker and Matthews (2004), IJCV 56(3).
    """
    if model not in MODELS:
        raise GeometryError(f"LSM: model '{model}' is none of {', '.join(MODELS)}")
    kind = interpolation_index(interpolation)
    half = odd_window("LSM", window_px) // 2
    a = np.ascontiguousarray(xy_left, dtype=float).reshape(-1, 2)
    b = np.ascontiguousarray(xy_right, dtype=float).reshape(-1, 2)
    k = len(a)
    if len(b) != k:
        raise GeometryError(f"LSM: {k} points in the left photograph, {len(b)} in the right, needed in pairs")
    linear = np.broadcast_to(np.eye(2), (k, 2, 2)) if start is None else start
    if linear.shape != (k, 2, 2):
        raise GeometryError(f"LSM: start has shape {linear.shape}, needed ({k}, 2, 2)")
    warp = np.zeros((k, 3, 3))
    warp[:, :2, :2], warp[:, :2, 2], warp[:, 2, 2] = linear, b, 1.0
    out = np.zeros((k, OUTPUTS))
    fixed = (grey_of(left), grey_of(right), half, kind, MODELS[model])
    limits = (float(stop_px), int(max_steps), float(max_shift_px), float(min_correlation))

    def work(part: slice) -> None:
        _match_all(*fixed, *limits, a[part], warp[part], out[part])

    if threads > 1:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(work, _chunks(k)))
    else:
        work(slice(0, k))
    flag = out[:, 0].astype(np.int64)
    values = np.where((flag & ~int(LsmFlag.LOW_CORRELATION))[:, None] == 0, out[:, 1:9], np.nan)
    xy = np.where((flag == 0)[:, None], values[:, :2], np.nan)
    covariance = np.stack([values[:, 2], values[:, 3], values[:, 3], values[:, 4]], axis=1).reshape(k, 2, 2)
    covariance[flag != 0] = np.nan
    gain, offset, r = values[:, 5], values[:, 6], values[:, 7]
    return LsmMatches(xy, covariance, warp, gain, offset, r, out[:, 9], out[:, 10].astype(np.int64), flag)


OUTPUTS = 11  # flag; x, y, their three covariances; gain, offset, correlation; sigma0; steps


def _chunks(k: int) -> Iterator[slice]:
    return (slice(first, first + CHUNK) for first in range(0, k, CHUNK))


@njit(cache=True, nogil=True)
def _match_all(left, right, half, kind, geometric, stop, max_steps, max_shift, min_r, xy, warp, out):  # type: ignore[no-untyped-def]
    """Match patch after patch; `warp` goes from start to solution, `out` as in OUTPUTS."""
    side = 2 * half + 1
    wide = side + 2 * MARGIN
    grid = np.empty((wide, wide), np.float32)
    size = geometric + RADIOMETRIC
    J = np.empty((size, side * side), np.float32)
    patch = np.empty(side * side, np.float32)
    N, L = np.empty((size, size)), np.empty((size, size))
    q, rhs = np.empty(size), np.empty(size)
    wx, wy = np.zeros(TAPS, np.float32), np.zeros(TAPS, np.float32)
    for i in range(len(xy)):
        if not resample_window(left, xy[i, 0], xy[i, 1], half + MARGIN, kind, wx, wy, grid):
            out[i, 0] = OUTSIDE
            continue
        gradients(grid, half, geometric, J)
        fill_normals(J, N)
        if not factorise(N, L):
            out[i, 0] = FLAT_TEXTURE
            continue
        out[i, 0] = _iterate(
            right,
            half,
            kind,
            geometric,
            stop,
            max_steps,
            max_shift,
            J,
            L,
            q,
            rhs,
            patch,
            wx,
            wy,
            warp[i],
            out[i],
        )
        if out[i, 0] == MATCHED:
            out[i, 0] = judge(half, kind, geometric, min_r, J, N, L, q, rhs, patch, wx, wy, warp[i], out[i])


@njit(cache=True, nogil=True)
def resample_window(grey, x, y, reach, kind, wx, wy, grid):  # type: ignore[no-untyped-def]
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


@njit(cache=True, nogil=True)
def _iterate(right, half, kind, geometric, stop, max_steps, max_shift, J, L, q, rhs, patch, wx, wy, H, out):  # type: ignore[no-untyped-def]
    """Gauss-Newton steps on H, from its start; returns the flag and leaves J^T S and the solution q."""
    x0, y0 = H[0, 2], H[1, 2]
    coarse = kind > BILINEAR
    previous = np.inf
    for step in range(1, max_steps + 1):
        out[10] = step
        if not resample_patch(right, H, half, BILINEAR if coarse else kind, wx, wy, patch):
            return OUTSIDE
        for a in range(len(q)):
            rhs[a] = q[a] = dot(J[a], patch)
        solve(L, q)
        length = put_step(H, q, half, geometric)
        if not length < np.inf:
            return DIVERGED
        if np.hypot(H[0, 2] - x0, H[1, 2] - y0) > max_shift:
            return TOO_FAR
        if not coarse:
            if length * max(CONTRACTION, length / previous) < stop:
                return MATCHED
            previous = length
        coarse = coarse and length > COARSE_STEP
    return DIVERGED


@njit(cache=True, nogil=True, fastmath=True)
def resample_patch(grey, H, half, kind, wx, wy, patch):  # type: ignore[no-untyped-def]
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


@njit(cache=True, nogil=True)
def put_step(H, q, half, geometric):  # type: ignore[no-untyped-def]
    """Put the step q on H, H <- H dH^-1; returns the shift in px, inf if the patch is turned inside out."""
    beta = q[geometric + 1]
    if not beta > 0.0:
        return np.inf
    x, y = H[0, 2], H[1, 2]
    d00, d01, d02 = 1.0, 0.0, half * q[0] / beta
    d10, d11, d12 = 0.0, 1.0, half * q[1] / beta
    d20, d21 = 0.0, 0.0
    if geometric > 2:
        d00 += q[2] / beta
        d01 += q[3] / beta
        d10 += q[4] / beta
        d11 += q[5] / beta
    if geometric > 6:
        d20, d21 = q[6] / (beta * half), q[7] / (beta * half)
    # adjugate of dH; its determinant is only a scale, which the norm H[2, 2] = 1 takes out
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
    return np.hypot(H[0, 2] - x, H[1, 2] - y)


@njit(cache=True, nogil=True)
def area_ratio(H):  # type: ignore[no-untyped-def]
    """Area in the right photograph of a unit area at the point: the determinant of d(H x)/dx at x = 0."""
    xx, xy = H[0, 0] - H[0, 2] * H[2, 0], H[0, 1] - H[0, 2] * H[2, 1]
    yx, yy = H[1, 0] - H[1, 2] * H[2, 0], H[1, 1] - H[1, 2] * H[2, 1]
    return xx * yy - xy * yx


@njit(cache=True, nogil=True)
def judge(half, kind, geometric, min_r, J, N, L, q, rhs, patch, wx, wy, H, out):  # type: ignore[no-untyped-def]
    """Residuals, covariance of the shift and correlation of the last step; returns the flag.

    A resampled intensity has the noise of a pixel times the sum of the squared weights, and neighbours have
    noise in common. To texture that the kernel lets pass it is as harmful as that of the pixels themselves,
    or more where the right patch is the smaller one and its pixels are used more than once.
    """
    n = len(patch)
    alpha, beta = q[geometric], q[geometric + 1]
    square, total, cross = dot(patch, patch), rhs[geometric], rhs[geometric + 1]
    T, TT = N[geometric, geometric + 1], N[geometric + 1, geometric + 1]
    spread = (square - total * total / n) * (TT - T * T / n)
    r = (cross - total * T / n) / np.sqrt(spread) if spread > 0.0 else 0.0
    subtract(patch, q, J)
    residual = dot(patch, patch)
    gain = kernel_noise(H, half, kind, wx, wy)
    variance = residual / (n - len(q)) / (1.0 + gain)  # of one intensity, right units
    white = min(variance, white_noise(patch, 2 * half + 1) / (1.0 + gain))
    noise = n * white / (beta * beta) * SLOPE_NOISE * half * half  # what it adds to the normal equations
    xx, xy, yy = N[0, 0] - noise, N[0, 1], N[1, 1] - noise
    weakest = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    out[1], out[2] = H[0, 2], H[1, 2]
    out[6], out[7], out[8], out[9] = beta, alpha, r, np.sqrt(residual / (n - len(q)))
    variance *= 1.0 + max(1.0, 1.0 / area_ratio(H))  # of the difference of two, as texture meets it
    # The solution obeys J'^T (S - ...) = 0 with noisy J': its covariance is (J'^T J)^-1 J'^T J' (J^T J')^-1.
    variance *= (1.0 + 2.0 * noise / max(xx + yy, noise)) * (half / beta) ** 2
    q[:] = 0.0
    q[0] = 1.0
    solve(L, q)
    cxx, cxy = q[0], q[1]
    q[:] = 0.0
    q[1] = 1.0
    solve(L, q)
    cyy = q[1]
    for k in range(3):
        i, j = k // 2, (k + 1) // 2
        ix, iy = H[i, 0] - H[i, 2] * H[2, 0], H[i, 1] - H[i, 2] * H[2, 1]
        jx, jy = H[j, 0] - H[j, 2] * H[2, 0], H[j, 1] - H[j, 2] * H[2, 1]
        out[3 + k] = variance * (ix * (cxx * jx + cxy * jy) + iy * (cxy * jx + cyy * jy))
    if weakest < LEAST_TEXTURE * noise:
        return FLAT_TEXTURE
    return LOW_CORRELATION if r < min_r else MATCHED


@njit(cache=True, nogil=True, fastmath=True)
def subtract(patch, q, J):  # type: ignore[no-untyped-def]
    """Turn the patch into its residuals."""
    for a in range(len(q)):
        factor, row = np.float32(q[a]), J[a]
        for p in range(len(patch)):
            patch[p] -= factor * row[p]


@njit(cache=True, nogil=True, fastmath=True)
def white_noise(residual, side):  # type: ignore[no-untyped-def]
    """Variance of the part of the residuals that is different from pixel to pixel.

    Source: Immerkaer (1996), CVIU 64(2): the mask (1 -2 1)^T (1 -2 1), whose squares add up to 36.
    """
    total = 0.0
    for i in range(1, side - 1):
        for j in range(1, side - 1):
            p = i * side + j
            up = residual[p - side - 1] - 2 * residual[p - side] + residual[p - side + 1]
            mid = residual[p - 1] - 2 * residual[p] + residual[p + 1]
            low = residual[p + side - 1] - 2 * residual[p + side] + residual[p + side + 1]
            d = up - 2 * mid + low
            total += d * d
    return total / (36.0 * (side - 2) ** 2)


@njit(cache=True, nogil=True)
def kernel_noise(H, half, kind, wx, wy):  # type: ignore[no-untyped-def]
    """Mean sum of the squared weights over the window: what resampling leaves of the noise of a pixel."""
    stride = max(1, half // 2)  # 25 places tell the mean
    total, count = 0.0, 0
    for b in range(-half, half + 1, stride):
        for a in range(-half, half + 1, stride):
            w = H[2, 0] * a + H[2, 1] * b + H[2, 2]
            x = (H[0, 0] * a + H[0, 1] * b + H[0, 2]) / w
            y = (H[1, 0] * a + H[1, 1] * b + H[1, 2]) / w
            kernel_weights(kind, np.float32(x - np.floor(x)), wx)
            kernel_weights(kind, np.float32(y - np.floor(y)), wy)
            along, down = 0.0, 0.0
            for k in range(TAPS):
                along += wx[k] * wx[k]
                down += wy[k] * wy[k]
            total += along * down
            count += 1
    return total / count
