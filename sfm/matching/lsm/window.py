"""Windows: the intensities of a photograph on the grid of a window, shifted or warped."""

from __future__ import annotations

import numpy as np

from sfm.conventions import AnyArray, FloatArray
from sfm.kernels.options import compiled, compiled_fast
from sfm.kernels.sampling import AFTER, BEFORE, BILINEAR, kernel_weights, sample


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
