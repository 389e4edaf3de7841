"""Windows that cover photographs: of how many pixels, and those that do not overlap.

Windows that overlap measure the same pixels twice, and their errors have these in common: the precision of a
result would be told too good, and no residual shows it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.conventions import BoolArray
from sfm.network import ImagePoints, rows_of

# That are tried. Larger ones tell no more where they cover a photograph, and where the surface is curved they
# measure its mean depth over them, in all photographs alike, which no residual shows.
WINDOWS_PX = (15, 11)
# Ratio of precisions for the same pixels up to which the larger windows, which are fewer, are taken.
ALIKE = 1.1
COVERED = 0.5  # part of the photographs of a point in which others take its place


def largest_alike(costs: Sequence[tuple[int, float]]) -> int:
    """Return the side of the largest windows that are about as precise as the best for the same pixels, px.

    The standard deviation of a window's place falls with its side, the number of windows with the square of
    that: for noise alone the product is the same for all. Where it grows, the surface is not plane over them.

    Args:
        costs: side of the windows, px, and the spread of their places times the side; the largest first.
    """
    best = min(cost for _, cost in costs)
    return next(window for window, cost in costs if cost <= ALIKE * best)


def points_apart(seen: ImagePoints, fits: BoolArray, spacing_px: float, *, n_points: int) -> BoolArray:
    """Choose points, those with the most rays first, that others do not cover, (n,).

    Args:
        seen: image points.
        fits: which of them count, (k,).
        spacing_px: side of the squares that a point takes, one in each photograph.
        n_points: number of points.
    """
    kept = np.zeros(n_points, dtype=bool)
    rows = np.flatnonzero(fits)
    cells = np.floor(seen.xy[rows] / spacing_px).astype(np.int64)
    keys = list(zip(seen.image[rows].tolist(), cells[:, 0].tolist(), cells[:, 1].tolist(), strict=True))
    of_point = rows_of(seen.point[rows], n_points)
    taken: set[tuple[int, int, int]] = set()
    for point in np.argsort([-len(own) for own in of_point], kind="stable").tolist():
        own = [keys[k] for k in of_point[point].tolist()]
        if own and sum(key in taken for key in own) < COVERED * len(own):
            kept[point] = True
            taken.update(own)
    return kept
