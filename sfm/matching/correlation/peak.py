"""The peak of a surface of correlation: best and second-best place, regression, parabola, precision."""

from __future__ import annotations

import numpy as np

from sfm.conventions import AnyArray, FloatArray
from sfm.kernels.options import compiled, compiled_fast
from sfm.matching.match_flags import NccFlag

PEAK_ZONE = 2  # a second peak is at least this many pixels farther from the first in a row or column, px
# Columns of what is read from a surface: x and y in it with their covariances, r, second r, gain, offset.
OUTPUTS = 10
FLAG, X, Y, CXX, CXY, CYY, R, SECOND, GAIN, OFFSET = range(OUTPUTS)
NOT_COMPARED = np.array([int(NccFlag.OUTSIDE)] + [np.nan] * (OUTPUTS - 1))
FLAT, BORDER, LOW, DOUBT = (
    int(f) for f in (NccFlag.FLAT_TEXTURE, NccFlag.AT_BORDER, NccFlag.LOW_CORRELATION, NccFlag.AMBIGUOUS)
)


@compiled
def read_peak(
    template: AnyArray,
    window: AnyArray,
    surface: AnyArray,
    whole: AnyArray,
    least: tuple[float, float],
    min_r: float,
    max_second: float,
    out: FloatArray,
) -> None:
    """Fill best and second-best peak of a surface of r, its parabola and the regression of intensities.

    Args:
        template: intensities, float32, (s, s); contiguous, as all of these: there is one compiled form.
        window: intensities of the search window, float32, (H, W).
        surface: r where a match is allowed, else -1, float32, (H - s + 1, W - s + 1).
        whole: r everywhere, for the parabola; same shape.
        least: standard deviations below which a template, and a window, are flat.
        min_r: smallest r of a match.
        max_second: largest ratio of the second-best r to the best.
        out: receives the columns FLAG to OFFSET.
    """
    rows, cols = surface.shape
    side = template.shape[0]
    n = side * side
    highest = np.empty(rows, np.float32)  # of each row: most rows need no second look
    bi, bj = 0, 0
    for i in range(rows):
        highest[i] = _largest(surface[i])
        if highest[i] > highest[bi]:
            bi = i
    while bj < cols - 1 and surface[bi, bj] < highest[bi]:
        bj += 1
    # the sums of cv2 are in float32: the best place in double precision
    tm, wm = 0.0, 0.0
    for i in range(side):
        for j in range(side):
            tm += template[i, j]
            wm += window[bi + i, bj + j]
    tm, wm = tm / n, wm / n
    tt, ww, tw = 0.0, 0.0, 0.0
    for i in range(side):
        for j in range(side):
            t, w = template[i, j] - tm, window[bi + i, bj + j] - wm
            tt += t * t
            ww += w * w
            tw += t * w
    out[X], out[Y] = bj, bi
    if tt < n * least[0] ** 2 or ww < n * least[1] ** 2:
        out[FLAG] = FLAT
        return
    r = tw / np.sqrt(tt * ww)
    out[R], out[GAIN], out[OFFSET] = r, tw / tt, wm - tw / tt * tm
    second = np.float32(-1.0)
    for i in range(rows):
        if highest[i] <= second:
            continue
        for j in range(cols):
            r2 = surface[i, j]
            if r2 <= second or (abs(i - bi) <= PEAK_ZONE and abs(j - bj) <= PEAK_ZONE):
                continue
            top = True  # of its neighbours, or it is only the slope of a peak
            for u in range(max(0, i - 1), min(rows, i + 2)):
                for v in range(max(0, j - 1), min(cols, j + 2)):
                    top = top and surface[u, v] <= r2
            if top:
                second = r2
    out[SECOND] = second
    if r < min_r:
        out[FLAG] = LOW
    elif bi == 0 or bj == 0 or bi == rows - 1 or bj == cols - 1:
        out[FLAG] = BORDER
    elif second > max_second * r:
        out[FLAG] = DOUBT
    if out[FLAG] != 0:
        return
    # least squares parabola through the nine coefficients around the peak (their weights in closed form)
    gx, gy, hxx, hyy, hxy = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(-1, 2):
        for j in range(-1, 2):
            s = whole[bi + i, bj + j]
            gx += j * s / 6.0
            gy += i * s / 6.0
            hxy += i * j * s / 4.0
            hxx += (j * j - 2.0 / 3.0) * s
            hyy += (i * i - 2.0 / 3.0) * s
    det = hxx * hyy - hxy * hxy
    if not (hxx < 0.0 and det > 0.0):
        out[FLAG] = DOUBT
        return
    dx, dy = (hxy * gy - hyy * gx) / det, (hxy * gx - hxx * gy) / det
    out[X] += min(1.0, max(-1.0, dx))
    out[Y] += min(1.0, max(-1.0, dy))
    # least squares of the shift has N = sum g g^T = -r'' sum f^2 / r, sigma^2 = (1 - r^2) sum f^2 / (n - 4)
    c = (1.0 - r * r) * r / (n - 4) / det
    # r is no parabola: what the nine coefficients miss it by, of 9 - 6 degrees of freedom, is in the gradient
    mean = 0.0
    for i in range(-1, 2):
        for j in range(-1, 2):
            mean += whole[bi + i, bj + j] / 9.0
    misfit = 0.0
    for i in range(-1, 2):
        for j in range(-1, 2):
            bend = hxx * (j * j - 2.0 / 3.0) / 2.0 + hyy * (i * i - 2.0 / 3.0) / 2.0 + hxy * i * j
            misfit += (whole[bi + i, bj + j] - mean - gx * j - gy * i - bend) ** 2
    m = misfit / 3.0 / 6.0 / (det * det)
    out[CXX] = -hyy * c + m * (hyy * hyy + hxy * hxy)
    out[CXY] = hxy * c - m * hxy * (hxx + hyy)
    out[CYY] = -hxx * c + m * (hxx * hxx + hxy * hxy)


@compiled_fast
def _largest(row: AnyArray) -> float:
    """Return the largest of some numbers."""
    largest: float = row[0]
    for value in row:
        largest = max(largest, value)
    return largest
