"""Cross-correlation from coarse to fine, and along lines such as epipolar lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from sfm.matching.correlation import (
    NOT_COMPARED,
    OUTPUTS,
    NccLimits,
    NccMatches,
    least_deviations,
    match_ncc,
    matches_of,
    read_peak,
    template_corners,
)
from sfm.matching.radiometry import FULL_SCALE_8, full_scale, grey_of, grey_of_8_bit, odd_window
from sfm.model.arguments import checked_arguments
from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError

FINE_REACH = 4  # px: a pixel of the level above is 2 px here; doubled to allow for its error


@checked_arguments(xy_left="k 2", xy_right="n 2")
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
    """Match templates from coarse to fine in image pyramids.

    The top level searches the whole window. Every level below searches a few pixels around the match of the
    level above.

    Args:
        left: left photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: right photograph, like the left one.
        xy_left: points in the left photograph, px, (k, 2).
        xy_right: centres of the search windows, px, (k, 2).
        template_px: odd side of the template on every level, px of that level.
        search_px: odd side of the search window, px of the photograph.
        levels: number of levels of the pyramid; each has half the size of the one before.
        min_correlation: smallest r of a match on any level.

    Returns:
        The matches in the full-size photographs. A match that fails on a level carries the flag of that
        level.

    Raises:
        GeometryError: there is no level, or `match_ncc` refuses the windows.

    Source: Luhmann et al. (2020), sec. 5.5.3 (image pyramids), levels by cv2.pyrDown; r as in `match_ncc`.
    """
    if levels < 1:
        raise GeometryError(f"NCC: a pyramid of {levels} levels, at least 1 is needed")
    side = odd_window("NCC template", template_px)
    pyramids = [_pyramid(left, levels), _pyramid(right, levels)]
    a, b = np.asarray(xy_left, dtype=float).reshape(-1, 2), np.asarray(xy_right, dtype=float).reshape(-1, 2)
    matches: NccMatches | None = None
    for level in range(levels - 1, -1, -1):
        scale = 2.0**-level
        coarsest = level == levels - 1
        reach = round((search_px - side) * scale) + 2 if coarsest else 2 * FINE_REACH
        of_level = match_ncc(
            pyramids[0][level],
            pyramids[1][level],
            a * scale,
            b * scale,
            template_px=side,
            search_px=side + 2 * (reach // 2 + 1),
            limits=NccLimits(min_correlation=min_correlation),
        )
        if matches is not None:  # a match that failed on a level above keeps the flag of that level
            flag = np.where(matches.flag != 0, matches.flag, of_level.flag)
            of_level = replace(of_level, flag=flag, xy=np.where((flag == 0)[:, None], of_level.xy, np.nan))
        matches = of_level
        b = np.where(np.isfinite(of_level.xy), of_level.xy / scale, b)
    assert matches is not None
    scale_left, scale_right = FULL_SCALE_8 / full_scale(left), FULL_SCALE_8 / full_scale(right)
    return replace(matches, gain=matches.gain * scale_left / scale_right, offset=matches.offset / scale_right)


def _pyramid(photograph: AnyArray, levels: int) -> list[AnyArray]:
    """Return an image pyramid; cv2.pyrDown keeps the centre of the top-left pixel in position."""
    out: list[AnyArray] = [grey_of_8_bit(photograph)]
    for _ in range(levels - 1):
        out.append(cv2.pyrDown(out[-1]))
    return out


@checked_arguments(xy_left="k 2")
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
    """Match templates along lines of the right photograph, such as epipolar lines.

    Args:
        left: left photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: right photograph, like the left one.
        xy_left: points in the left photograph, px, (k, 2).
        lines: search line of each point as a polyline, px, k arrays (n_i, 2); distortion curves an epipolar
            line. Parts outside the photograph are ignored.
        template_px: odd side of the template, px.
        width_px: largest distance of the match from the line, px.
        min_correlation: smallest r of a match.
        max_second: largest ratio of the second-best r to the best.

    Returns:
        One match for each point.

    Raises:
        GeometryError: the template has an even side, or points and lines differ in number.

    Source: document 002, sec. II.1.2.1 (epipolar lines) with eq. 2.6 for r; precision as in `match_ncc`.
    """
    side = odd_window("NCC template", template_px)
    a = np.asarray(xy_left, dtype=float).reshape(-1, 2)
    if any(line.ndim != 2 or line.shape[1] != 2 for line in lines):
        raise GeometryError(
            "match_along_line: a line is not an array of shape (n, 2), expected its vertices in px"
        )
    if len(lines) != len(a):
        raise GeometryError(
            f"NCC: {counted(len(a), 'point')} in the left photograph, {counted(len(lines), 'line')} in "
            "the right"
        )
    grey_left, grey_right = grey_of(left), grey_of(right)
    least = least_deviations(left, right)
    half = side // 2
    height, width = grey_right.shape
    out, origin = np.zeros((len(a), OUTPUTS)), np.zeros((len(a), 2))
    corners = template_corners(a, half, grey_left.shape)
    for k, line in enumerate(lines):
        x, y = corners[k].tolist()
        path = np.asarray(line, dtype=float).reshape(-1, 2)
        near = np.asarray((path > -width) & (path < 2 * np.array([width, height])))
        path = path[near.all(axis=1)]
        if x < 0 or len(path) < 2:
            out[k] = NOT_COMPARED
            continue
        margin = half + width_px
        low = np.maximum(np.floor(path.min(axis=0)).astype(int) - margin, 0)
        high = np.minimum(np.ceil(path.max(axis=0)).astype(int) + margin + 1, [width, height])
        if (high - low < side).any():
            out[k] = NOT_COMPARED
            continue
        template = np.ascontiguousarray(grey_left[y : y + side, x : x + side])
        window = np.ascontiguousarray(grey_right[low[1] : high[1], low[0] : high[0]])
        surface = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
        band = np.zeros(surface.shape, dtype=np.uint8)
        vertices = np.rint((path - low - half) * 256).astype(np.int32)
        cv2.polylines(band, [vertices], False, 1, thickness=2 * width_px + 1, shift=8)
        allowed = np.where(band == 0, np.float32(-1.0), surface)
        read_peak(template, window, allowed, surface, least, min_correlation, max_second, out[k])
        origin[k] = low
    return matches_of(out, origin, a, half)
