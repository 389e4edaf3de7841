"""Image points that stand more than once in a table: one point measured twice in one photograph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.conventions import BoolArray
from sfm.distributions import chi2_ppf
from sfm.network import ImagePoints, rows_of
from sfm.remarks.remark import Remark, remark

ALPHA = 0.001  # probability with which measurements that say the same are taken for contradicting ones


@dataclass(frozen=True)
class Merged:
    """Image points of which each stands once."""

    image_points: ImagePoints
    same: tuple[tuple[int, int], ...]  # (photograph, point) of identical ones, merged
    averaged: tuple[tuple[int, int], ...]  # of those that differ by no more than chance, averaged
    dropped: tuple[tuple[int, int], ...]  # of those that contradict one another, left out
    dropped_rows: int  # image points that are left out

    def remarks(self, images: tuple[str, ...], points: tuple[str, ...]) -> tuple[Remark, ...]:
        """Return what was done with the image points that stand more than once."""
        kinds = {
            "image_points_identical": self.same,
            "image_points_averaged": self.averaged,
            "image_points_contradicting": self.dropped,
        }
        return tuple(
            remark(kind, image_points=[f"{points[j]} in {images[i]}" for i, j in pairs])
            for kind, pairs in kinds.items()
            if pairs
        )


def merge_repeated(seen: ImagePoints) -> Merged:
    """Return image points of which each stands once in its photograph, where it stood first.

    Identical positions are one measurement that was written twice. Different ones are two measurements:
    their weighted mean, if a chi-square test of their differences passes; else nobody knows which is right.
    """
    key = seen.image * (int(seen.point.max(initial=0)) + 1) + seen.point
    _, first, group, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    if (count == 1).all():
        return Merged(seen, (), (), (), 0)
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
            kind = 1 if chi2 <= chi2_ppf(1 - ALPHA, 2 * (len(different) - 1)) else 2
            xy[one], covariance[one] = mean, Q
        if kind == 2:
            keep[one] = False
            dropped += len(rows)
        kinds[kind].append((int(seen.image[one]), int(seen.point[one])))
    merged = ImagePoints(seen.image, seen.point, xy, covariance, seen.stated).select(keep)
    same, averaged, contradicting = (tuple(pairs) for pairs in kinds)
    return Merged(merged, same, averaged, contradicting, dropped)
