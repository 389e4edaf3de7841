"""How well a patch was matched: residuals, covariance of the shift, and whether to believe it."""

from __future__ import annotations

import numpy as np

from sfm.conventions import AnyArray, FloatArray
from sfm.kernels.cholesky import solve_factorised
from sfm.kernels.options import compiled, compiled_fast
from sfm.kernels.sampling import TAPS, kernel_weights
from sfm.matching.lsm.patch_equations import SLOPE_NOISE, Workspace, dot
from sfm.matching.lsm.warp import area_ratio
from sfm.matching.match_flags import FLAT_TEXTURE, LOW_CORRELATION, MATCHED

# Texture is flat in a direction in which its gradients have less than this many times the energy of noise.
MIN_TEXTURE = 3.0
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
    variance = residual / (n - len(q)) / (1.0 + gain)  # of one intensity, right units
    white = min(variance, white_noise(patch, 2 * half + 1) / (1.0 + gain))
    noise = n * white / (beta * beta) * SLOPE_NOISE * half * half  # what it adds to the normal equations
    xx, xy, yy = N[0, 0] - noise, N[0, 1], N[1, 1] - noise
    weakest = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    out[X], out[Y] = H[0, 2], H[1, 2]
    out[GAIN], out[OFFSET], out[R], out[SIGMA0] = beta, alpha, r, np.sqrt(residual / (n - len(q)))
    variance *= 1.0 + max(1.0, 1.0 / area_ratio(H))  # of the difference of two, as texture meets it
    # The solution obeys J'^T (S - ...) = 0 with noisy J': its covariance is (J'^T J)^-1 J'^T J' (J^T J')^-1.
    variance *= (1.0 + 2.0 * noise / max(xx + yy, noise)) * (half / beta) ** 2
    q[:] = 0.0
    q[0] = 1.0
    solve_factorised(work.L, q)
    cxx, cxy = q[0], q[1]
    q[:] = 0.0
    q[1] = 1.0
    solve_factorised(work.L, q)
    cyy = q[1]
    for k in range(3):
        i, j = k // 2, (k + 1) // 2
        ix, iy = H[i, 0] - H[i, 2] * H[2, 0], H[i, 1] - H[i, 2] * H[2, 1]
        jx, jy = H[j, 0] - H[j, 2] * H[2, 0], H[j, 1] - H[j, 2] * H[2, 1]
        out[CXX + k] = variance * (ix * (cxx * jx + cxy * jy) + iy * (cxy * jx + cyy * jy))
    if weakest < MIN_TEXTURE * noise:
        return FLAT_TEXTURE
    return LOW_CORRELATION if r < min_r else MATCHED


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
