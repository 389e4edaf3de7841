"""Correlation from coarse to fine, in pyramids of photographs of half the size each."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import AnyArray, FloatArray
from sfm.errors import GeometryError
from sfm.matching.correlation.ncc import NccMatches, match_ncc
from sfm.matching.radiometry import FULL_SCALE_8, full_scale, grey_of_8_bit, odd_window

FINE_REACH = 4  # a pixel of the level above is two here, and as much again for its error, px


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
    """Look for templates from coarse to fine: the whole search window at the top, a few pixels below.

    Args:
        left: photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: the other photograph.
        xy_left: points in the left photograph, px, (k, 2).
        xy_right: centres of the search windows, px, (k, 2).
        template_px: odd side of the template, the same on every level, px of that level.
        search_px: odd side of the search window, px of the photograph.
        levels: photographs in the pyramid, each half the size of the one before.
        min_correlation: smallest r of a match on any level.

    Returns:
        The matches in the photographs of full size; those lost on the way carry the flag of their level.

    Raises:
        GeometryError: fewer than one level, or windows as in `match_ncc`.

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
    scale_left, scale_right = FULL_SCALE_8 / full_scale(left), FULL_SCALE_8 / full_scale(right)
    return replace(matches, gain=matches.gain * scale_left / scale_right, offset=matches.offset / scale_right)


def _pyramid(photograph: AnyArray, levels: int) -> list[AnyArray]:
    """Photographs of half the size each; cv2.pyrDown keeps the centre of the top-left pixel where it is."""
    out: list[AnyArray] = [grey_of_8_bit(photograph)]
    for _ in range(levels - 1):
        out.append(cv2.pyrDown(out[-1]))
    return out
