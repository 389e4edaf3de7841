"""Image points that were measured several times in one photograph, in a table or by several sources.

Agreeing measurements are averaged, and contradicting ones are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.conventions import BoolArray
from sfm.distributions import LEVEL, chi2_ppf
from sfm.network import ImagePoints, rows_of
from sfm.remarks.remark import Remark, remark


@dataclass(frozen=True)
class MergedImagePoints:
    """Image points without repetitions."""

    image_points: ImagePoints
    same: tuple[tuple[int, int], ...]  # (photograph, point) of identical image points, merged
    averaged: tuple[tuple[int, int], ...]  # of those that differ by no more than chance, averaged
    dropped: tuple[tuple[int, int], ...]  # of those that contradict one another, left out
    dropped_rows: int  # number of image points that are left out

    def remarks(self, images: tuple[str, ...], points: tuple[str, ...]) -> tuple[Remark, ...]:
        """Return the remarks on repeated image points."""
        kinds = {
            "image_points_averaged": self.averaged,
            "image_points_contradicting": self.dropped,
        }
        same = [f"{points[j]} in {images[i]}" for i, j in self.same]
        return (
            *((remark("rows_identical", rows=same),) if same else ()),
            *(
                remark(kind, image_points=[f"{points[j]} in {images[i]}" for i, j in pairs])
                for kind, pairs in kinds.items()
                if pairs
            ),
        )


def merge_repeated(seen: ImagePoints) -> MergedImagePoints:
    """Merge repeated image points, at the position of their first row.

    Identical positions are one measurement that was written several times. Different positions are several
    measurements. If a chi-square test of their differences passes, their weighted mean is used. Otherwise it
    is unknown which is correct, and all are left out.
    """
    key = seen.image * (int(seen.point.max(initial=0)) + 1) + seen.point
    _, first, group, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    if (count == 1).all():
        return MergedImagePoints(seen, (), (), (), 0)
    xy, covariance = seen.xy.copy(), seen.covariance.copy()
    keep: BoolArray = np.zeros(len(seen), dtype=bool)
    keep[first] = True
    kinds: tuple[list[tuple[int, int]], ...] = ([], [], [])
    dropped = 0
    of_group = rows_of(group, len(count))
    for g in np.flatnonzero(count > 1):
        rows = of_group[g]
        one = rows[0]
        different = np.unique(seen.xy[rows], axis=0, return_index=True)[1]
        kind = 0
        if len(different) > 1:
            P = np.linalg.inv(seen.covariance[rows[different]])
            Q = np.linalg.inv(P.sum(axis=0))
            mean = Q @ np.einsum("nab,nb->a", P, seen.xy[rows[different]])
            d = seen.xy[rows[different]] - mean
            chi2 = float(np.einsum("na,nab,nb->", d, P, d))
            kind = 1 if chi2 <= chi2_ppf(1 - LEVEL, 2 * (len(different) - 1)) else 2
            xy[one], covariance[one] = mean, Q
        if kind == 2:
            keep[one] = False
            dropped += len(rows)
        kinds[kind].append((int(seen.image[one]), int(seen.point[one])))
    merged = replace(seen, xy=xy, covariance=covariance).select(keep)
    same, averaged, contradicting = (tuple(pairs) for pairs in kinds)
    return MergedImagePoints(merged, same, averaged, contradicting, dropped)
