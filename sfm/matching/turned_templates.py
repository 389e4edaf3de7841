"""Matching without any key point: templates turned and scaled in steps, in the search window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.conventions import AnyArray, FloatArray
from sfm.matching.conjugate_patches import ConjugatePoints, Settings, Starts, match_warped
from sfm.matching.correlation.ambiguity import ambiguous, independent_pixels
from sfm.matching.correlation.ncc import match_ncc
from sfm.matching.correlation.warped import match_ncc_warped
from sfm.matching.match_flags import NccFlag, in_words
from sfm.matching.radiometry import grey_of, grey_of_8_bit

# Correlation tolerates a rotation of 5 degrees and a scale of 7 % between template and photograph.
ANGLES_DEG = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 30.0)
SCALES = (1 / 1.3, 1 / 1.14, 1.0, 1.14, 1.3)
SAME_PX = 5.0  # peaks of two shapes this near are one place
REACH_PX = 3  # of the match that follows
OWN_PX = 500  # around a point, for others like it


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
