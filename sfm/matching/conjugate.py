"""Conjugate points: from points of one photograph to the same points in another, and how well.

Correlation finds the place to a pixel in a search window, least squares matching takes it from there. What is
not found in this way is looked for again with templates that are turned and scaled.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.conventions import AnyArray, FloatArray
from sfm.errors import GeometryError
from sfm.matching.conjugate_patches import (
    METHODS,
    ConjugatePoints,
    Settings,
    Starts,
    confirmed,
    match_upright,
    match_warped,
)
from sfm.matching.local_affinity import local_affinities
from sfm.matching.turned_templates import match_turned

MIN_CORRELATION = 0.7  # half of the variance of one patch is then explained by the other
BACK_PX = 1.0  # a point that leads back farther than this from where it came is another one
MIN_TEMPLATE_PX = 7  # smaller ones look like anything once they are turned and scaled
REACH_SIGMAS = 3.0  # of the place that key points tell
REACH_PX = (4, 15)  # of that search, at least and at most


def match_points(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    *,
    xy_right: FloatArray | None = None,
    method: str = "lsm",
    template_px: int = 21,
    search_px: int = 121,
    equalise: bool = False,
    interpolation: str = "six_tap",
    min_correlation: float = MIN_CORRELATION,
    back_px: float | None = BACK_PX,
    wide: bool = True,
) -> ConjugatePoints:
    """Find points of the left photograph in the right one.

    Points that are not found in their search windows as they are, are looked for again (`wide`): where the
    key points around them agree on an affine map to the right photograph, at the place and in the shape that
    it says; else in their search windows turned by up to 30 degrees and scaled by up to 1.3.

    Args:
        left: photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: the other photograph.
        xy_left: points in the left photograph, px, (k, 2).
        xy_right: centres of the search windows, px, (k, 2); the same places as in the left if not given.
            Where they are given, key points lead to no place outside the windows.
        method: ncc, or ncc and then shift (2), lsm (6) or lsm8 (8 geometric parameters).
        template_px: odd side of the template; document 002 has 19.
        search_px: odd side of the search window; document 002 has 21.
        equalise: equalise the histograms of both photographs before least squares matching.
        interpolation: six_tap, bicubic or bilinear; see `sfm.matching.lsm.two_photo.match_lsm`.
        min_correlation: smallest r of a match. Least squares matching is started from 0.5 on, as the warp
            makes patches more alike.
        back_px: a point must lead back to within this of where it came from, px; None: it need not.
        wide: look again for what is not found; without it photographs must be turned by less than 5 degrees
            and of one scale to 10 %.

    Returns:
        One result for each point.

    Raises:
        GeometryError: unknown method, even windows, or points that do not go in pairs.

    Source: document 002, sec. 2 (equations 2.1 to 2.20).
    """
    if method not in METHODS:
        raise GeometryError(f"matching: method '{method}', expected one of {', '.join(METHODS)}")
    a = np.asarray(xy_left, dtype=float).reshape(-1, 2)
    b = a if xy_right is None else np.asarray(xy_right, dtype=float).reshape(-1, 2)
    by = Settings(method, template_px, search_px, equalise, interpolation, min_correlation, back_px)
    matched = confirmed(left, right, match_upright(left, right, a, b, by), by)
    lost = np.flatnonzero([bool(why) and "left photograph" not in why for why in matched.reason])
    if wide and len(lost) and template_px >= MIN_TEMPLATE_PX:
        maps = local_affinities(left, right, a[lost])
        known = np.isfinite(maps.xy).all(axis=1)
        if xy_right is not None:
            known &= (np.abs(maps.xy - b[lost]) <= search_px // 2).all(axis=1)
        reach = np.clip(np.ceil(REACH_SIGMAS * maps.spread_px[known]), *REACH_PX).astype(np.int64)
        start = Starts(maps.xy[known], maps.linear[known], reach)
        again = match_warped(left, right, a[lost[known]], start, by)
        again = confirmed(left, right, again, by, 2 * reach)
        matched = matched.with_rows(lost[known][again.good], again.rows(again.good))
        rest = lost[~known]
        if len(rest):
            again = match_turned(left, right, a[rest], b[rest], by)
            again = confirmed(left, right, again, by, np.full(len(rest), by.reach_px))
            matched = matched.with_rows(rest[again.good], again.rows(again.good))
    bad = ~matched.good
    return replace(
        matched,
        right=np.where(bad[:, None], np.nan, matched.right),
        covariance=np.where(bad[:, None, None], np.nan, matched.covariance),
    )
