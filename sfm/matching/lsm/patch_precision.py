"""How well a patch was matched: residuals, covariance of the shift, and whether to believe it."""

from __future__ import annotations

import numpy as np

from sfm.conventions import AnyArray, FloatArray
from sfm.kernels.compiling import compiled, compiled_fast
from sfm.kernels.sampling import TAPS, kernel_weights
from sfm.kernels.small_algebra import factorise, solve_factorised
from sfm.matching.lsm.patch_equations import BLUR_NOISE, RADIOMETRIC, SLOPE_NOISE, Workspace, area_ratio, dot
from sfm.matching.match_flags import FLAT_TEXTURE, LOW_CORRELATION, MATCHED

# Texture is flat in a direction in which the gradients of the window together have no more energy than noise
# has by chance: its mean and so many standard deviations more.
TEXTURE_SIGMAS = 3.0
# Variance of such an energy of n pixels, times n, for a mean of 1: twice the sum of squared autocorrelations
# of white noise seen through the difference formula, and through the mask by which its variance is estimated.
ENERGY_VARIANCE = 2.0 * 1.576 + 2.0 * (35.0 / 18.0) ** 2
# Columns of what is found out about a patch: place with its covariances, gain, offset, r, sigma0, steps.
OUTPUTS = 11
FLAG, X, Y, CXX, CXY, CYY, GAIN, OFFSET, R, SIGMA0, STEPS = range(OUTPUTS)


@compiled
def judge(work: Workspace, min_r: float, H: FloatArray, out: FloatArray) -> int:
    """Fill covariance of the shift, radiometry and correlation of the last step; return the flag.

    A resampled intensity has the noise of a pixel times the sum of the squared weights, and neighbours have
    noise in common. To texture that the kernel lets pass it is as harmful as that of the pixels themselves,
    or more where the right patch is the smaller one and its pixels are used more than once.
    """
    half, geometric, N, q, rhs, patch = work.half, work.geometric, work.N, work.q, work.rhs, work.patch
    n = len(patch)
    alpha, beta = q[geometric], q[geometric + 1]
    square, total, cross = dot(patch, patch), rhs[geometric], rhs[geometric + 1]
    T, TT = N[geometric, geometric + 1], N[geometric + 1, geometric + 1]
    spread = (square - total * total / n) * (TT - T * T / n)
    r = (cross - total * T / n) / np.sqrt(spread) if spread > 0.0 else 0.0
    subtract(patch, q, work.J)
    residual = dot(patch, patch)
    gain = kernel_noise(H, half, work.kind, work.wx, work.wy)
    if work.blurred:
        residual = residual_as_sharp(work, square)
    variance = residual / (n - len(q)) / (1.0 + gain)  # of one intensity, right units
    white = min(variance, white_noise(patch, 2 * half + 1) / (1.0 + gain))
    out[X], out[Y] = H[0, 2], H[1, 2]
    out[GAIN], out[OFFSET], out[R], out[SIGMA0] = beta, alpha, r, np.sqrt(residual / (n - len(q)))
    variance *= 1.0 + max(1.0, 1.0 / area_ratio(H))  # of the difference of two, as texture meets it
    variance *= (half / beta) ** 2
    # The solution obeys J'^T (S - ...) = 0 with noisy J': its covariance is (J'^T J)^-1 J'^T J' (J^T J')^-1,
    # where J'^T J' = N, and J'^T J is N less what noise adds to it.
    least = 1.0 + TEXTURE_SIGMAS * np.sqrt(ENERGY_VARIANCE / n)
    clean = without_noise(N, least * white / (beta * beta), half, geometric)
    flat = not factorise(clean, clean, 0.0)
    clean = N.copy() if flat else without_noise(N, white / (beta * beta), half, geometric)
    factorise(clean, clean, 0.0)
    column, middle = np.empty(len(q)), np.empty(len(q))
    for k in range(2):
        column[:] = 0.0
        column[k] = 1.0
        solve_factorised(clean, column)
        for i in range(len(q)):
            middle[i] = 0.0
            for j in range(len(q)):
                middle[i] += N[i, j] * column[j]
        solve_factorised(clean, middle)
        if k == 0:
            cxx = middle[0]
        cxy, cyy = middle[0], middle[1]
    for k in range(3):
        i, j = k // 2, (k + 1) // 2
        ix, iy = H[i, 0] - H[i, 2] * H[2, 0], H[i, 1] - H[i, 2] * H[2, 1]
        jx, jy = H[j, 0] - H[j, 2] * H[2, 0], H[j, 1] - H[j, 2] * H[2, 1]
        out[CXX + k] = variance * (ix * (cxx * jx + cxy * jy) + iy * (cxy * jx + cyy * jy))
    if flat:
        return FLAT_TEXTURE
    return LOW_CORRELATION if r < min_r else MATCHED


@compiled
def without_noise(N: FloatArray, white: float, half: int, geometric: int) -> FloatArray:
    """Return a normal matrix less what white noise of the template adds to it on average.

    Args:
        N: normal matrix of `patch_equations.gradients`, (u, u).
        white: variance of the noise of an intensity of the template.
        half: half the side of the window, px.
        geometric: geometric parameters.
    """
    clean = N.copy()
    n = (2 * half + 1) ** 2
    noise = n * white * SLOPE_NOISE * half * half  # of gradients along x and y, which have none in common
    second = (half + 1.0) / (3.0 * half)  # mean squares of the window coordinates, and their fourth powers
    fourth = second * (3.0 * half * half + 3.0 * half - 1.0) / (5.0 * half * half)
    for a in range(geometric):
        if a < 2:
            clean[a, a] -= noise
        elif a < 6:
            clean[a, a] -= noise * second
        else:
            clean[a, a] -= noise * (fourth + second * second)
            clean[a, a - 6] += noise * second
            clean[a - 6, a] += noise * second
    clean[geometric + 1, geometric + 1] -= n * white
    first = geometric + RADIOMETRIC
    if len(N) > first:
        same, other, mixed, intensity = BLUR_NOISE
        clean[first + 1, first + 1] -= n * white * mixed
        for a, b in ((first, first + 2), (first + 2, first)):
            clean[a, a] -= n * white * same
            clean[a, b] -= n * white * other
            clean[a, geometric + 1] -= n * white * intensity
            clean[geometric + 1, a] -= n * white * intensity
    return clean


@compiled
def residual_as_sharp(work: Workspace, square: float) -> float:
    """Return the sum of squared residuals of a fit without blur.

    A blur that makes the template less noisy fits better than the true one: its residuals are too small.

    Args:
        work: normal equations with blur in the last rows.
        square: sum of squared intensities of the patch.
    """
    size = work.geometric + RADIOMETRIC
    factor = np.empty((size, size))
    q = work.rhs[:size].copy()
    factorise(work.N[:size, :size], factor, 0.0)
    solve_factorised(factor, q)
    for a in range(size):
        square -= q[a] * work.rhs[a]
    return max(square, 0.0)  # rounding, where nothing is left


@compiled_fast
def subtract(patch: AnyArray, q: FloatArray, J: AnyArray) -> None:
    """Turn the patch into its residuals."""
    for a in range(len(q)):
        factor, row = np.float32(q[a]), J[a]
        for p in range(len(patch)):
            patch[p] -= factor * row[p]


@compiled_fast
def white_noise(residual: AnyArray, side: int) -> float:
    """Return the variance of the part of the residuals that is different from pixel to pixel.

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


@compiled
def kernel_noise(H: FloatArray, half: int, kind: int, wx: AnyArray, wy: AnyArray) -> float:
    """Return the mean sum of squared weights over the window: what resampling leaves of a pixel's noise."""
    stride = max(1, half // 2)  # 25 places give the mean
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
