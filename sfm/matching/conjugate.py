"""Conjugate points: from points of one photograph to the same points in another, and how well.

Correlation finds the place to a pixel in a search window, least squares matching takes it from there. Points
not found in this way are looked for again with templates that are turned and scaled.

Matching without any key point: templates turned and scaled in steps, in the search window.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.arguments import checked_arguments
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
from sfm.matching.correlation.ncc import ambiguous, independent_pixels, match_ncc, match_ncc_warped
from sfm.matching.local_affinity import LocalAffinities, equally_blurred, local_affinities
from sfm.matching.match_flags import LsmFlag, NccFlag, in_words
from sfm.matching.radiometry import grey_of, grey_of_8_bit

# Correlation tolerates a rotation of 5 degrees and a scale of 7 % between template and photograph.
ANGLES_DEG = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 30.0)
SCALES = (1 / 1.3, 1 / 1.14, 1.0, 1.14, 1.3)
SAME_PX = 5.0  # peaks of two shapes this near are one place
REACH_PX = 3  # of the match that follows
OWN_PX = 500  # around a point, for others like it
MIN_CORRELATION = 0.7  # half of the variance of one patch is then explained by the other
BACK_PX = 1.0  # a point that leads back farther than this from where it came is another one
MIN_TEMPLATE_PX = 7  # smaller ones look like anything once they are turned and scaled
REACH_SIGMAS = 3.0  # of the place that key points predict
MIN_REACH_PX = 4  # of that search
# Reasons for a larger template, which shows more: a second place is as good, or there is hardly texture.
TOO_LITTLE_TEXTURE = (in_words(NccFlag, NccFlag.AMBIGUOUS), in_words(LsmFlag, LsmFlag.FLAT_TEXTURE))


@checked_arguments(xy_left="k 2", xy_right="k 2")
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
    it says; else in their search windows turned by up to 30 degrees and scaled by up to 1.3. Those that are
    ambiguous or without texture are looked for once more with templates twice as large.

    Where one photograph is blurred more, the other is smoothed to it, and both are reduced until that blur is
    one of a sharp photograph: templates and windows then have as many of the larger pixels.

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
    seen = equally_blurred(left, right)
    reach = -(-((search_px - template_px) // 2) // seen.shrink)
    back = None if back_px is None else back_px / seen.shrink
    by = Settings(
        method, template_px, template_px + 2 * reach, equalise, interpolation, min_correlation, back
    )
    found = _match_by_size(
        seen.left,
        seen.right,
        seen.small(a),
        seen.small(b),
        by,
        given=xy_right is not None,
        wide=wide and template_px >= MIN_TEMPLATE_PX,
    )
    right_xy = np.where(found.good[:, None], seen.full(found.right), np.nan)
    covariance = np.where(found.good[:, None, None], seen.shrink**2 * found.covariance, np.nan)
    warp = found.warp.copy()
    warp[:, :2, 2], warp[:, 2, :2] = seen.full(warp[:, :2, 2]), warp[:, 2, :2] / seen.shrink
    return replace(found, left=a, right=right_xy, covariance=covariance, warp=warp)


def _match_by_size(
    left: AnyArray, right: AnyArray, a: FloatArray, b: FloatArray, by: Settings, *, given: bool, wide: bool
) -> ConjugatePoints:
    """Match points with templates as asked for, and larger ones where these show too little.

    Args:
        left: the left photograph.
        right: the right photograph.
        a: points in the left photograph, px, (k, 2).
        b: centres of the search windows, px, (k, 2).
        by: how points are matched.
        given: whether the centres are known, and not those of the left photograph.
        wide: whether what is not found is looked for turned, scaled, and with larger templates.
    """
    if not wide:
        return confirmed(left, right, match_upright(left, right, a, b, by), by)
    maps = local_affinities(left, right, a)
    if given:
        maps.xy[~(np.abs(maps.xy - b) <= by.search_px // 2).all(axis=1)] = np.nan
    matched = _match(left, right, a, b, by, maps, given=given)
    few = np.flatnonzero([why in TOO_LITTLE_TEXTURE for why in matched.reason])
    if len(few):
        more = by.template_px - 1
        larger = replace(by, template_px=by.template_px + more, search_px=by.search_px + more)
        again = _match(left, right, a[few], b[few], larger, maps.rows(few), given=given)
        matched = matched.with_rows(few[again.good], again.rows(again.good))
    return matched


def _match(
    left: AnyArray,
    right: AnyArray,
    a: FloatArray,
    b: FloatArray,
    by: Settings,
    maps: LocalAffinities,
    *,
    given: bool,
) -> ConjugatePoints:
    """Match points with templates of one size: upright, led by key points, or turned.

    Args:
        left: the left photograph.
        right: the right photograph.
        a: points in the left photograph, px, (k, 2).
        b: centres of the search windows, px, (k, 2).
        by: how points are matched.
        maps: where key points lead.
        given: whether the centres are known, and not those of the left photograph.
    """
    matched = confirmed(left, right, match_upright(left, right, a, b, by), by)
    lost = np.array([bool(why) and "left photograph" not in why for why in matched.reason], dtype=bool)
    led = np.isfinite(maps.xy).all(axis=1)
    rows = np.flatnonzero(lost & led)
    if len(rows):
        least = np.ceil(REACH_SIGMAS * maps.spread_px[rows]).astype(np.int64)
        reach = np.maximum(least, MIN_REACH_PX)
        again = match_warped(left, right, a[rows], Starts(maps.xy[rows], maps.linear[rows], reach), by)
        again = confirmed(left, right, again, by, 2 * reach)
        matched = matched.with_rows(rows[again.good], again.rows(again.good))
    rows = np.flatnonzero(lost & ~led)
    if len(rows):
        again = match_turned(left, right, a[rows], b[rows], by, given=given)
        again = confirmed(left, right, again, by, np.full(len(rows), by.reach_px))
        matched = matched.with_rows(rows[again.good], again.rows(again.good))
    return matched


def match_turned(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    xy_right: FloatArray,
    by: Settings,
    *,
    given: bool,
) -> ConjugatePoints:
    """Match points whose templates are turned by up to 30 degrees and scaled by up to 1.3 in the right.

    The two best places of all shapes are matched, and the better one is taken where it is better by more than
    chance: a template in steps of 10 degrees is not alike enough to decide beforehand.

    Args:
        left: the left photograph.
        right: the right photograph.
        xy_left: points in the left photograph, px, (k, 2).
        xy_right: centres of the search windows, px, (k, 2).
        by: how points are matched.
        given: whether the centres are known. Where they are not, the place may be outside of its window, and
            what is in the window another one like it: then the template must be the only one of its kind in
            the left photograph, as far as OWN_PX.
    """
    best, rival, second = _starts(left, right, xy_left, xy_right, by)
    one, other = (match_warped(left, right, xy_left, start, by) for start in (best, rival))
    swap = other.good & ~(one.good & (one.correlation >= other.correlation))
    r = np.where(swap, other.correlation, one.correlation)
    lesser, is_other = (
        np.where(swap, one.correlation, other.correlation),
        np.where(swap, one.good, other.good),
    )
    second = np.where(is_other, np.fmax(lesser, second), second)
    if not given:
        to_left = match_ncc(
            left, left, xy_left, xy_left, template_px=by.template_px, search_px=2 * OWN_PX + 1
        )
        second = np.fmax(second, to_left.second)
    pixels = independent_pixels(grey_of(left), xy_left, by.template_px)
    doubt = one.good | other.good
    doubt &= ambiguous(r, second, pixels)
    reason = np.where(swap, np.array(other.reason, dtype=object), np.array(one.reason, dtype=object))
    reason[doubt] = in_words(NccFlag, NccFlag.AMBIGUOUS)
    chosen = one.with_rows(np.flatnonzero(swap), other.rows(swap))
    return replace(chosen, second=second, reason=tuple(reason.tolist()))


def _starts(
    left: AnyArray, right: AnyArray, xy_left: FloatArray, xy_right: FloatArray, by: Settings
) -> tuple[Starts, Starts, FloatArray]:
    """Return the best place of all shapes, the best one elsewhere, and the second r of that best shape."""
    grey_left, grey_right = grey_of_8_bit(left), grey_of_8_bit(right)
    shapes, peaks, r, second = [], [], [], []
    for angle in np.radians(ANGLES_DEG):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        for scale in SCALES:
            linear = np.tile(scale * turn, (len(xy_left), 1, 1))
            found = match_ncc_warped(
                grey_left,
                grey_right,
                xy_left,
                xy_right,
                linear,
                reach_px=np.full(len(xy_left), max(round(by.reach_px / scale), 1)),
                template_px=by.template_px,
                min_correlation=by.start_correlation,
            )
            shapes.append(linear)
            peaks.append(found.peak)
            r.append(np.nan_to_num(found.correlation, nan=-1.0))
            second.append(np.nan_to_num(found.second, nan=-1.0))
    every, places, one = np.array(r), np.array(peaks), np.arange(len(xy_left))
    best = every.argmax(axis=0)
    elsewhere = np.where(np.linalg.norm(places - places[best, one], axis=2) > SAME_PX, every, -1.0)
    rival = elsewhere.argmax(axis=0)
    starts = []
    for number, least in ((best, every[best, one]), (rival, elsewhere[rival, one])):
        place = np.where((least >= by.start_correlation)[:, None], places[number, one], np.nan)
        starts.append(Starts(place, np.array(shapes)[number, one], np.full(len(one), REACH_PX)))
    return starts[0], starts[1], np.array(second)[best, one]
