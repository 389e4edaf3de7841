"""Matches with windows as large as the surface is plane over: smaller ones where it is not.

The middle of a window and the mean of what it shows are at one place only on a plane. On a curved surface a
match is off by the parallax of the mean depth over the window, which grows with the square of its side.
Smaller windows lead elsewhere then.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from sfm.conventions import AnyArray, FloatArray, IntArray
from sfm.matching.lsm.two_photo import LsmMatches, match_lsm
from sfm.matching.lsm.warp import linear_part

SIDE_RATIO = 0.75  # side of the next window
MIN_WINDOW_PX = 9  # smaller ones hardly hold the parameters of an affine warp
# Squared difference of two windows, in that of the smaller one's noise, from which the larger one is off.
# Half of that noise is common to both: chance leads so far in less than one of a hundred.
MAX_SQUARED_RATIO = 6.0
ROUNDING_PX = 1e-6  # of places in intensities of single precision


def match_where_plane(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    matches: LsmMatches,
    *,
    window_px: int,
    interpolation: str = "six_tap",
) -> tuple[LsmMatches, FloatArray]:
    """Return the match of the largest window of each point that no smaller one leads away from.

    Args:
        left: photograph, (H, W).
        right: the other photograph.
        xy_left: points in the left photograph, px, (k, 2).
        matches: of them, with an affine or projective warp.
        window_px: odd side of the windows of these.
        interpolation: kernel for the right photograph.

    Returns:
        The matches, and by how much those of smaller windows may still be off, px, (k, 2).

    Source: Lepski (1991), Theory Probab. Appl. 35(3), for the choice; Kanade and Okutomi (1994), IEEE Trans.
    PAMI 16(9), for windows that adapt to the surface.
    """
    rows = np.flatnonzero(matches.good)
    start, linear = matches.xy[rows].copy(), linear_part(matches.warp[rows])
    sides, found = [window_px], [_rows(matches, rows)]
    while len(rows) and (side := int(SIDE_RATIO * sides[-1]) | 1) >= MIN_WINDOW_PX:
        one = match_lsm(
            left, right, xy_left[rows], start, window_px=side, interpolation=interpolation, start=linear
        )
        start[one.good], linear[one.good] = one.xy[one.good], linear_part(one.warp[one.good])
        sides.append(side)
        found.append(one)
    chosen, off = _largest_that_agrees(found), np.zeros((len(matches), 2))
    columns = {field.name: getattr(matches, field.name).copy() for field in fields(matches)}
    for number in range(1, len(sides)):
        of_size = np.flatnonzero(chosen == number)
        for name, column in columns.items():
            column[rows[of_size]] = getattr(found[number], name)[of_size]
        moved = found[number].xy[of_size] - found[0].xy[of_size]
        off[rows[of_size]] = moved * sides[number] ** 2 / (sides[0] ** 2 - sides[number] ** 2)
    return LsmMatches(**columns), off


def _rows(matches: LsmMatches, rows: IntArray) -> LsmMatches:
    """Return some of the matches."""
    return LsmMatches(**{field.name: getattr(matches, field.name)[rows] for field in fields(matches)})


def _largest_that_agrees(found: list[LsmMatches]) -> IntArray:
    """Return the number of the first window of each point whose place no smaller window contradicts, (k,).

    Args:
        found: of the same points with smaller and smaller windows; all of the first are good.
    """
    chosen = np.full(len(found[0]), -1, dtype=np.int64)
    for number in reversed(range(len(found))):
        agrees = found[number].good
        for smaller in found[number + 1 :]:
            both = np.flatnonzero(agrees & smaller.good)
            d, C = smaller.xy[both] - found[number].xy[both], smaller.covariance[both]
            agrees[both] = squares_over_covariance(d, C) <= MAX_SQUARED_RATIO
        chosen[agrees] = number
    return chosen


def squares_over_covariance(d: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return d' C^-1 d of differences of places, px, (k,); NaN where C is.

    Of photographs without noise C is 0, but no place is known better than ROUNDING_PX.
    """
    C = covariance + ROUNDING_PX**2 * np.eye(2)
    return np.asarray(np.einsum("ki,ki->k", d, np.linalg.solve(C, d[:, :, None])[:, :, 0]))
