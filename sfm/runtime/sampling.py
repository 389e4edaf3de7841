"""Interpolation: intensities and their gradients between the pixels of a photograph.

A kernel is a row of six weights for the pixels -2 ... 3 around the whole pixel left of (above) the position.
Kernels with fewer taps leave the outer weights 0, so that one loop samples every photograph. The weights add
up to 1, and at whole pixels each kernel returns the pixel itself.
"""

from __future__ import annotations

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import AnyArray, BoolArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.runtime.compiling import compiled, compiled_fast, inlined_fast

NEAREST, BILINEAR, BICUBIC, SIX_TAP = 0, 1, 2, 3
INTERPOLATIONS = {"nearest": NEAREST, "bilinear": BILINEAR, "bicubic": BICUBIC, "six_tap": SIX_TAP}
TAPS = 8  # six weights and two zeros: a row of intensities is then one vector of the processor
BEFORE, AFTER = 2, 5  # pixels that a position needs left of (above) its whole pixel, and right of it


def interpolation_index(name: str) -> int:
    """Return the number of a kernel in compiled code.

    Raises:
        GeometryError: no such kernel.
    """
    if name not in INTERPOLATIONS:
        raise GeometryError(f"interpolation '{name}', expected one of {', '.join(INTERPOLATIONS)}")
    return INTERPOLATIONS[name]


def as_grey(photograph: AnyArray) -> AnyArray:
    """Return intensities in the type that compiled code expects, float32 (exact for 16 bit), (H, W).

    Kernels are compiled for each type of array, and those for target fits take 15 s.
    """
    return np.ascontiguousarray(photograph, dtype=np.float32)


@checked_arguments(photograph="h w", xy="... 2")
def resample(photograph: AnyArray, xy: FloatArray, *, interpolation: str = "six_tap") -> FloatArray:
    """Return the intensities of a photograph at any positions.

    Args:
        photograph: intensities, shape (H, W).
        xy: positions in the pixel frame, px, shape (..., 2).
        interpolation: nearest, bilinear, bicubic (Keys) or six_tap (Lagrange).

    Returns:
        Intensities, shape (...); NaN where the kernel reaches beyond the photograph.

    Raises:
        GeometryError: no such kernel.

    Source: Keys (1981), IEEE Trans. ASSP 29(6), eq. 15 with a = -1/2; Lagrange's polynomial of degree 5
    through the six nearest pixels (Schafer and Rabiner 1973, Proc. IEEE 61(6)).
    """
    kind = interpolation_index(interpolation)
    positions = np.ascontiguousarray(xy, dtype=float)
    return np.asarray(_resample(as_grey(photograph), positions.reshape(-1, 2), kind)).reshape(
        positions.shape[:-1]
    )


def is_shown(hidden: BoolArray, xy: FloatArray) -> BoolArray:
    """Return which positions in a photograph are on pixels that are not masked, (k,).

    Args:
        hidden: masked pixels, (H, W).
        xy: positions, px, (k, 2); those outside the photograph count as at its border.
    """
    last = np.array(hidden.shape[::-1]) - 1
    column, row = np.clip(np.rint(np.nan_to_num(xy)).astype(np.int64), 0, last).T
    return np.asarray(~hidden[row, column])


@compiled
def _resample(grey: AnyArray, xy: FloatArray, kind: int) -> FloatArray:
    """Resample each position with only the pixels of its kernel, so that positions near the border work."""
    height, width = grey.shape
    wx, wy = np.zeros(TAPS, np.float32), np.zeros(TAPS, np.float32)
    reach = (0, 0, 1, 2)[kind]
    out = np.empty(len(xy))
    for i in range(len(xy)):
        x, y = xy[i, 0], xy[i, 1]
        out[i] = np.nan
        if not (x >= 0.0 and y >= 0.0 and x <= width - 1.0 and y <= height - 1.0):
            continue
        col, row = min(int(x), width - 2), min(int(y), height - 2)
        if kind == NEAREST:
            out[i] = grey[int(y + 0.5), int(x + 0.5)]
            continue
        if col < reach or row < reach or col + 1 + reach > width - 1 or row + 1 + reach > height - 1:
            continue
        kernel_weights(kind, np.float32(x - col), wx)
        kernel_weights(kind, np.float32(y - row), wy)
        total = 0.0
        for b in range(-reach, 2 + reach):
            line = 0.0
            for a in range(-reach, 2 + reach):
                line += wx[2 + a] * grey[row + b, col + a]
            total += wy[2 + b] * line
        out[i] = total
    return out


@compiled_fast
def kernel_weights(kind: int, t: np.float32, w: AnyArray) -> None:
    """Fill the weights of the pixels -2 ... 3 for the fraction t of a pixel, 0 <= t <= 1."""
    one = np.float32(1.0)
    half = np.float32(0.5)
    if kind == SIX_TAP:
        a, b, c = t + np.float32(2.0), t + one, t
        d, e, f = t - one, t - np.float32(2.0), t - np.float32(3.0)
        ab, ef = a * b, e * f
        abc, def_ = ab * c, d * ef
        w[0] = b * c * def_ * np.float32(-1.0 / 120.0)
        w[1] = a * c * def_ * np.float32(1.0 / 24.0)
        w[2] = ab * def_ * np.float32(-1.0 / 12.0)
        w[3] = abc * ef * np.float32(1.0 / 12.0)
        w[4] = abc * d * f * np.float32(-1.0 / 24.0)
        w[5] = abc * d * e * np.float32(1.0 / 120.0)
    elif kind == BICUBIC:
        w[0] = np.float32(0.0)
        w[1] = half * t * (t * (np.float32(2.0) - t) - one)
        w[2] = half * (t * t * (np.float32(3.0) * t - np.float32(5.0)) + np.float32(2.0))
        w[3] = half * t * (t * (np.float32(4.0) - np.float32(3.0) * t) + one)
        w[4] = half * t * t * (t - one)
        w[5] = np.float32(0.0)
    else:
        w[0] = w[1] = w[4] = w[5] = np.float32(0.0)
        if kind == BILINEAR:
            w[2], w[3] = one - t, t
        else:
            w[2], w[3] = (one, np.float32(0.0)) if t < half else (np.float32(0.0), one)


@inlined_fast
def sample(flat: AnyArray, at: np.uintp, width: np.uintp, wx: AnyArray, wy: AnyArray) -> np.float32:
    """Return the weighted mean of 6 rows of 8 pixels of a photograph stored row by row, from index `at` on.

    Unsigned indices (np.uintp) avoid the test for negative ones and make a row one vector: three times
    faster.
    """
    w2 = width + width
    w3, w4 = w2 + width, w2 + w2
    w5 = w4 + width
    total = np.float32(0.0)
    for a in range(TAPS):
        p = at + np.uintp(a)
        line = wy[0] * flat[p] + wy[1] * flat[p + width] + wy[2] * flat[p + w2]
        line += wy[3] * flat[p + w3] + wy[4] * flat[p + w4] + wy[5] * flat[p + w5]
        total += wx[a] * line
    return total


@compiled
def bilinear(image: AnyArray, x: float, y: float) -> float:
    """Return the intensity between four pixels; x, y from 0 to below the last column and row."""
    row, column = int(y), int(x)
    fy, fx = y - row, x - column
    top = image[row, column] * (1 - fx) + image[row, column + 1] * fx
    bottom = image[row + 1, column] * (1 - fx) + image[row + 1, column + 1] * fx
    return float(top * (1 - fy) + bottom * fy)
