"""Normalised cross-correlation: a template of one photograph looked for in a window of another.

The coefficient r is that of equation (2.6) of document 002; cv2.matchTemplate does the sums. The peak is
refined by a parabola, which is good to a tenth of a pixel where the patches differ by a shift only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntFlag

import cv2
import numpy as np
from numba import njit

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.matching.radiometry import grey_of, odd_window

PEAK_ZONE = 2  # a second peak is at least this many pixels farther from the first in a row or column, px
# Standard deviation below which a template is flat, part of the full scale of 8 bit (of 16 bit alike).
LEAST_CONTRAST = 1.0 / 255.0


class NccFlag(IntFlag):
    """Why correlation gives no position, one bit each."""

    NONE = 0
    FLAT_TEXTURE = 1 << 0  # template or search window without contrast
    OUTSIDE = 1 << 2  # the template reaches beyond its photograph, or the search window beyond the other
    AT_BORDER = 1 << 3  # the best place is at the border of the search window: it may lie outside
    LOW_CORRELATION = 1 << 4  # nothing alike in the search window
    AMBIGUOUS = 1 << 5  # the second-best place is nearly as good
    NOT_CONFIRMED = 1 << 6  # matching back leads elsewhere


@dataclass(frozen=True)
class NccMatches:
    """Best places of templates in their search windows; NaN in `xy` where the flag says why."""

    xy: FloatArray  # place in the right photograph, px, (k, 2)
    peak: FloatArray  # best place to a whole pixel, whatever the flag, px, (k, 2)
    covariance: FloatArray  # of xy, from r and the curvature of its peak, px^2, (k, 2, 2)
    correlation: FloatArray  # r at the best whole pixel, (k,)
    second: FloatArray  # r of the second-best peak, -1 where there is none, (k,)
    gain: FloatArray  # beta of right = alpha + beta left, (k,)
    offset: FloatArray  # alpha, right intensity units, (k,)
    flag: IntArray  # see NccFlag, 0 = matched, (k,)

    def __len__(self) -> int:
        return len(self.xy)

    @property
    def good(self) -> BoolArray:
        """Which templates were found, (k,)."""
        return np.asarray(self.flag == 0)


def match_ncc(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    xy_right: FloatArray,
    *,
    template_px: int = 19,
    search_px: int = 121,
    min_correlation: float = 0.5,
    max_second: float = 1.0,
    back_px: float | None = None,
) -> NccMatches:
    """Look for the surroundings of points of the left photograph in windows of the right one.

    Args:
        left, right: photographs, (H, W), 8 or 16 bit or float, grey or colour.
        xy_left: points in the left photograph, px, (k, 2); the template is centred at the nearest pixel, and
            the fraction is added to the result.
        xy_right: centres of the search windows, px, (k, 2).
        template_px: odd side of the template.
        search_px: odd side of the window in which the whole template moves. It is cut at the border of the
            photograph.
        min_correlation: smallest r of a match.
        max_second: largest ratio of the second-best r to the best.
        back_px: if given, the place found must lead back to within this of the left point.

    Returns:
        One result for each point.

    Raises:
        GeometryError: even windows, a search window not larger than the template, or unpaired points.

    Source: document 002, sec. 2.2, eq. 2.6; Foerstner (1993), in Haralick and Shapiro, Computer and Robot
    Vision II, sec. 16.3, for the precision.
    """
    side = odd_window("NCC template", template_px)
    if odd_window("NCC search", search_px) <= side:
        raise GeometryError(
            f"NCC: a search window of {search_px} px for a template of {side} px, needed more"
        )
    a = np.asarray(xy_left, dtype=float).reshape(-1, 2)
    b = np.asarray(xy_right, dtype=float).reshape(-1, 2)
    if len(a) != len(b):
        raise GeometryError(f"NCC: {len(a)} points in the left photograph, {len(b)} windows in the right")
    grey_left, grey_right = grey_of(left), grey_of(right)
    least = LEAST_CONTRAST * max(_scale(left), _scale(right))
    out = np.zeros((len(a), OUTPUTS))
    half, reach = side // 2, search_px // 2
    corners = _corners(a, b, half, reach, grey_left.shape, grey_right.shape)
    for k, (x, y, x0, y0, x1, y1) in enumerate(corners.tolist()):
        if x < 0 or x1 - x0 < side or y1 - y0 < side:
            out[k, 0] = int(NccFlag.OUTSIDE)
            continue
        template, window = grey_left[y : y + side, x : x + side], grey_right[y0:y1, x0:x1]
        surface = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
        _read_peak(template, window, surface, surface, least, min_correlation, max_second, out[k])
    fraction = a - np.rint(a)
    xy = corners[:, 2:4] + out[:, 1:3] + half + fraction
    peak = np.rint(xy - fraction) + fraction
    flag = out[:, 0].astype(np.int64)
    flag[~np.isfinite(a).all(axis=1) | ~np.isfinite(b).all(axis=1)] = int(NccFlag.OUTSIDE)
    matches = NccMatches(
        np.where((flag == 0)[:, None], xy, np.nan), peak,
        np.stack([out[:, 3], out[:, 4], out[:, 4], out[:, 5]], axis=1).reshape(-1, 2, 2),
        out[:, 6], out[:, 7], out[:, 8], out[:, 9], flag,
    )  # fmt: skip
    return matches if back_px is None else _confirm(left, right, a, matches, side, search_px, back_px)


OUTPUTS = 10  # flag; x, y in the surface, their three covariances; r, second r, gain, offset


def match_pyramid(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    xy_right: FloatArray,
    *,
    template_px: int = 19,
    search_px: int = 121,
    levels: int = 3,
    min_correlation: float = 0.5,
) -> NccMatches:
    """Look for templates from coarse to fine: the whole search window at the top, a few pixels below.

    Args:
        left, right, xy_left, xy_right, template_px, search_px, min_correlation: as in `match_ncc`; search_px
            counts pixels of the photograph.
        levels: photographs in the pyramid, each half the size of the one before.

    Returns:
        The matches in the photographs of full size; those lost on the way carry the flag of their level.
    """
    if levels < 1:
        raise GeometryError(f"NCC: a pyramid of {levels} levels, needed at least 1")
    side = odd_window("NCC template", template_px)
    pyramids = [_pyramid(grey_of(left), levels), _pyramid(grey_of(right), levels)]
    a, b = np.asarray(xy_left, dtype=float).reshape(-1, 2), np.asarray(xy_right, dtype=float).reshape(-1, 2)
    matches: NccMatches | None = None
    for level in range(levels - 1, -1, -1):
        scale = 2.0**-level
        coarsest = level == levels - 1
        reach = round((search_px - side) * scale) + 2 if coarsest else 2 * FINE_REACH
        found = match_ncc(
            pyramids[0][level],
            pyramids[1][level],
            a * scale,
            b * scale,
            template_px=side,
            search_px=side + 2 * (reach // 2 + 1),
            min_correlation=min_correlation,
        )
        if matches is not None:  # what was lost above stays lost, with the reason of that level
            flag = np.where(matches.flag != 0, matches.flag, found.flag)
            found = replace(found, flag=flag, xy=np.where((flag == 0)[:, None], found.xy, np.nan))
        matches = found
        b = np.where(np.isfinite(found.xy), found.xy / scale, b)
    assert matches is not None
    return matches


FINE_REACH = 4  # a pixel of the level above is two here, and as much again for its error, px


def match_along_line(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    lines: Sequence[FloatArray],
    *,
    template_px: int = 19,
    width_px: int = 3,
    min_correlation: float = 0.5,
    max_second: float = 1.0,
) -> NccMatches:
    """Look for templates along lines of the right photograph, such as epipolar lines.

    Args:
        left, right, xy_left, template_px, min_correlation, max_second: as in `match_ncc`.
        lines: for each point the polygon along which it is looked for, px, k arrays (n_i, 2); with distortion
            an epipolar line is curved. Parts outside the photograph are passed over.
        width_px: how far from the line the best place may be.

    Returns:
        One result for each point.
    """
    side = odd_window("NCC template", template_px)
    a = np.asarray(xy_left, dtype=float).reshape(-1, 2)
    if len(lines) != len(a):
        raise GeometryError(f"NCC: {len(a)} points in the left photograph, {len(lines)} lines in the right")
    grey_left, grey_right = grey_of(left), grey_of(right)
    least = LEAST_CONTRAST * max(_scale(left), _scale(right))
    half = side // 2
    height, width = grey_right.shape
    out, origin = np.zeros((len(a), OUTPUTS)), np.zeros((len(a), 2))
    corners = _corners(a, np.zeros_like(a), half, half, grey_left.shape, grey_right.shape)
    for k, line in enumerate(lines):
        x, y = int(corners[k, 0]), int(corners[k, 1])
        path = np.asarray(line, dtype=float).reshape(-1, 2)
        near = np.asarray((path > -width) & (path < 2 * np.array([width, height])))
        path = path[near.all(axis=1)]
        if x < 0 or len(path) < 2:
            out[k, 0] = int(NccFlag.OUTSIDE)
            continue
        margin = half + width_px
        low = np.maximum(np.floor(path.min(axis=0)).astype(int) - margin, 0)
        high = np.minimum(np.ceil(path.max(axis=0)).astype(int) + margin + 1, [width, height])
        if (high - low < side).any():
            out[k, 0] = int(NccFlag.OUTSIDE)
            continue
        template, window = (
            grey_left[y : y + side, x : x + side],
            grey_right[low[1] : high[1], low[0] : high[0]],
        )
        surface = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
        band = np.zeros(surface.shape, dtype=np.uint8)
        vertices = np.rint((path - low - half) * 256).astype(np.int32)
        cv2.polylines(band, [vertices], False, 1, thickness=2 * width_px + 1, shift=8)
        allowed = np.where(band == 0, np.float32(-1.0), surface)
        _read_peak(template, window, allowed, surface, least, min_correlation, max_second, out[k])
        origin[k] = low
    fraction = a - np.rint(a)
    xy = origin + out[:, 1:3] + half + fraction
    peak = np.rint(xy - fraction) + fraction
    flag = out[:, 0].astype(np.int64)
    return NccMatches(
        np.where((flag == 0)[:, None], xy, np.nan), peak,
        np.stack([out[:, 3], out[:, 4], out[:, 4], out[:, 5]], axis=1).reshape(-1, 2, 2),
        out[:, 6], out[:, 7], out[:, 8], out[:, 9], flag,
    )  # fmt: skip


def _corners(
    a: FloatArray, b: FloatArray, half: int, reach: int, left: tuple[int, ...], right: tuple[int, ...]
) -> AnyArray:
    """Return corner of each template (-1: outside), first and last corner of each search window, (k, 6)."""
    at, to = np.nan_to_num(np.rint(a), nan=-1e6), np.nan_to_num(np.rint(b), nan=-1e6)
    size_left, size_right = np.array(left[1::-1]), np.array(right[1::-1])
    outside = np.asarray(((at < half) | (at > size_left - 1 - half)).any(axis=1))
    corner = np.where(outside[:, None], -1, at - half)
    low = np.clip(to - reach, 0, size_right)
    high = np.clip(to + reach + 1, 0, size_right)
    return np.column_stack([corner, low, high]).astype(np.int64)


def _scale(photograph: AnyArray) -> float:
    """Full scale of the intensities; floats count as 8 bit."""
    return 65535.0 if np.asarray(photograph).dtype == np.uint16 else 255.0


def _pyramid(grey: AnyArray, levels: int) -> list[AnyArray]:
    """Photographs of half the size each; cv2.pyrDown keeps the centre of the top-left pixel where it is."""
    out = [grey]
    for _ in range(levels - 1):
        out.append(cv2.pyrDown(out[-1]))
    return out


def _confirm(
    left: AnyArray, right: AnyArray, a: FloatArray, matches: NccMatches, side: int, search: int, limit: float
) -> NccMatches:
    """Match back from right to left and flag what does not return."""
    good = np.flatnonzero(matches.good)
    back = match_ncc(right, left, matches.xy[good], a[good], template_px=side, search_px=search)
    lost = good[~(np.linalg.norm(back.xy - a[good], axis=1) <= limit)]
    flag, xy = matches.flag.copy(), matches.xy.copy()
    flag[lost] |= int(NccFlag.NOT_CONFIRMED)
    xy[lost] = np.nan
    return replace(matches, flag=flag, xy=xy)


FLAT, BORDER, LOW, DOUBT = 1, 8, 16, 32


@njit(cache=True, nogil=True, fastmath=True)
def _largest(row):  # type: ignore[no-untyped-def]
    largest = row[0]
    for value in row:
        largest = max(largest, value)
    return largest


@njit(cache=True, nogil=True)
def _read_peak(template, window, surface, whole, least, min_r, max_second, out):  # type: ignore[no-untyped-def]
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
    if tt < n * least * least or ww < n * least * least:
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
    out[3], out[4], out[5] = -hyy * c, hxy * c, -hxx * c
