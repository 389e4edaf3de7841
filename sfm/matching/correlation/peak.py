"""The peak of a surface of correlation: best and second-best place, regression, parabola, precision."""

from __future__ import annotations

import numpy as np
from numba import njit

from sfm.matching.match_flags import NccFlag

PEAK_ZONE = 2  # a second peak is at least this many pixels farther from the first in a row or column, px
OUTPUTS = 10  # flag; x, y in the surface, their three covariances; r, second r, gain, offset
NOT_COMPARED = np.array([int(NccFlag.OUTSIDE)] + [np.nan] * (OUTPUTS - 1))
FLAT, BORDER, LOW, DOUBT = (
    int(f) for f in (NccFlag.FLAT_TEXTURE, NccFlag.AT_BORDER, NccFlag.LOW_CORRELATION, NccFlag.AMBIGUOUS)
)


@njit(cache=True, nogil=True)
def read_peak(template, window, surface, whole, least, min_r, max_second, out):  # type: ignore[no-untyped-def]
    """Best and second-best peak of the surface of r, parabola in the whole of it, regression; see OUTPUTS."""
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
    out[1], out[2] = bj, bi
    if tt < n * least[0] ** 2 or ww < n * least[1] ** 2:
        out[0] = FLAT
        return
    r = tw / np.sqrt(tt * ww)
    out[6], out[8], out[9] = r, tw / tt, wm - tw / tt * tm
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
    out[7] = second
    if r < min_r:
        out[0] = LOW
    elif bi == 0 or bj == 0 or bi == rows - 1 or bj == cols - 1:
        out[0] = BORDER
    elif second > max_second * r:
        out[0] = DOUBT
    if out[0] != 0:
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
        out[0] = DOUBT
        return
    dx, dy = (hxy * gy - hyy * gx) / det, (hxy * gx - hxx * gy) / det
    out[1] += min(1.0, max(-1.0, dx))
    out[2] += min(1.0, max(-1.0, dy))
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
    out[3] = -hyy * c + m * (hyy * hyy + hxy * hxy)
    out[4] = hxy * c - m * hxy * (hxx + hyy)
    out[5] = -hxx * c + m * (hxx * hxx + hxy * hxy)


@njit(cache=True, nogil=True, fastmath=True)
def _largest(row):  # type: ignore[no-untyped-def]
    largest = row[0]
    for value in row:
        largest = max(largest, value)
    return largest
