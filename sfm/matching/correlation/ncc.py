"""Normalised cross-correlation: a template of one photograph looked for in a window of another.

The coefficient r is that of equation (2.6) of document 002; cv2.matchTemplate does the sums. The peak is
refined by a parabola, which is good to a tenth of a pixel where the patches differ by a shift only. The sigma
includes the misfit of the parabola: errors are 0.5 to 1.9 times as large on the textures tried, 2.6 times on
a smooth one without noise at whole pixels, as nine values do not show the third powers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.matching.correlation.peak import (
    CXX,
    CXY,
    CYY,
    FLAG,
    GAIN,
    NOT_COMPARED,
    OFFSET,
    OUTPUTS,
    SECOND,
    R,
    X,
    Y,
    read_peak,
)
from sfm.matching.match_flags import NccFlag
from sfm.matching.radiometry import full_scale, grey_of, odd_window

# Standard deviation below which a template is flat, part of the full scale of 8 bit (of 16 bit alike).
MIN_CONTRAST = 1.0 / 255.0


@dataclass(frozen=True)
class NccMatches:
    """Best places of templates in their search windows; NaN in `xy` where the flag gives the reason."""

    xy: FloatArray  # place in the right photograph, px, (k, 2)
    peak: FloatArray  # best place to a whole pixel, whatever the flag, px, (k, 2)
    covariance: FloatArray  # of xy, from r, its curvature and what the parabola misses, px^2, (k, 2, 2)
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


@checked_arguments(xy_left="k 2", xy_right="n 2")
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
        left: photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: the other photograph.
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
            f"NCC: a search window of {search_px} px for a template of {side} px, it must be larger"
        )
    a = np.asarray(xy_left, dtype=float).reshape(-1, 2)
    b = np.asarray(xy_right, dtype=float).reshape(-1, 2)
    if len(a) != len(b):
        raise GeometryError(
            f"NCC: {counted(len(a), 'point')} in the left photograph, {len(b)} windows in the right"
        )
    grey_left, grey_right = grey_of(left), grey_of(right)
    least = least_deviations(left, right)
    out = np.zeros((len(a), OUTPUTS))
    half, reach = side // 2, search_px // 2
    corners = _corners(a, b, half, reach, grey_left.shape, grey_right.shape)
    for k, (x, y, x0, y0, x1, y1) in enumerate(corners.tolist()):
        if x < 0 or x1 - x0 < side or y1 - y0 < side:
            out[k] = NOT_COMPARED
            continue
        template = np.ascontiguousarray(grey_left[y : y + side, x : x + side])
        window = np.ascontiguousarray(grey_right[y0:y1, x0:x1])
        surface = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
        read_peak(template, window, surface, surface, least, min_correlation, max_second, out[k])
    out[~np.isfinite(a).all(axis=1) | ~np.isfinite(b).all(axis=1)] = NOT_COMPARED
    matches = matches_of(out, corners[:, 2:4], a, half)
    return matches if back_px is None else _confirm(left, right, a, matches, side, search_px, back_px)


def matches_of(out: FloatArray, origin: FloatArray | IntArray, xy_left: FloatArray, half: int) -> NccMatches:
    """Return what was read from surfaces of r, (k, OUTPUTS); their windows begin at `origin`, px, (k, 2)."""
    fraction = xy_left - np.rint(xy_left)
    xy = origin + out[:, [X, Y]] + half + fraction
    peak = np.rint(xy - fraction) + fraction
    flag = out[:, FLAG].astype(np.int64)
    return NccMatches(
        np.where((flag == 0)[:, None], xy, np.nan), peak,
        out[:, [CXX, CXY, CXY, CYY]].reshape(-1, 2, 2),
        out[:, R], out[:, SECOND], out[:, GAIN], out[:, OFFSET], flag,
    )  # fmt: skip


def least_deviations(left: AnyArray, right: AnyArray) -> tuple[float, float]:
    """Return the standard deviations of intensities below which a template, and a window, are flat."""
    return MIN_CONTRAST * full_scale(left), MIN_CONTRAST * full_scale(right)


def _corners(
    a: FloatArray, b: FloatArray, half: int, reach: int, left: tuple[int, ...], right: tuple[int, ...]
) -> AnyArray:
    """Return corner of each template (-1: outside), first and last corner of each search window, (k, 6)."""
    to, size_right = np.nan_to_num(np.rint(b), nan=-1e6), np.array(right[1::-1])
    low = np.clip(to - reach, 0, size_right)
    high = np.clip(to + reach + 1, 0, size_right)
    return np.column_stack([template_corners(a, half, left), low, high]).astype(np.int64)


def template_corners(a: FloatArray, half: int, shape: tuple[int, ...]) -> IntArray:
    """Return the first column and row of the template at each point, -1 where it reaches outside, (k, 2)."""
    at = np.nan_to_num(np.rint(a), nan=-1e6)
    outside = np.asarray(((at < half) | (at > np.array(shape[1::-1]) - 1 - half)).any(axis=1))
    return np.asarray(np.where(outside[:, None], -1, at - half), dtype=np.int64)


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
