"""Image points that were measured several times in one photograph, in a table or by several sources.

Agreeing measurements of one table are averaged, and contradicting ones are left out. Of those of two sources
the first is used. Both may state sigmas that are too small, which the differences at all their common image
points show; by these, also an offset is found, such as another origin of pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from sfm.judgement.given.values import MAX_FACTOR
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.distributions import LEVEL, chi2_isf, chi2_ppf
from sfm.model.network import ImagePoints, Source, rows_of
from sfm.model.remarks.remark import Remark, remark
from sfm.model.remarks.row import Quantity

FEWEST_COMMON = 4  # image points of two sources that show an offset between them


@dataclass(frozen=True)
class MergedImagePoints:
    """Image points without repetitions."""

    image_points: ImagePoints
    same: tuple[tuple[int, int], ...]  # (photograph, point) of identical image points, merged
    averaged: tuple[tuple[int, int], ...]  # of those that differ by no more than chance, averaged
    dropped: tuple[tuple[int, int], ...]  # of those that contradict one another, left out
    dropped_rows: int  # number of image points that are left out

    def remarks(self, images: tuple[str, ...], points: tuple[str, ...]) -> tuple[Remark, ...]:
        """Return the remarks on repeated image points that are used."""
        same, averaged = (
            [f"{points[j]} in {images[i]}" for i, j in pairs] for pairs in (self.same, self.averaged)
        )
        remarks = []
        if same:
            remarks.append(remark("rows_identical", rows=same))
        if averaged:
            remarks.append(remark("image_points_averaged", image_points=averaged))
        return tuple(remarks)


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
        row = rows[0]
        different = np.unique(seen.xy[rows], axis=0, return_index=True)[1]
        kind = 0
        if len(different) > 1:
            P = np.linalg.inv(seen.covariance[rows[different]])
            Q = np.linalg.inv(P.sum(axis=0))
            mean = Q @ np.einsum("nab,nb->a", P, seen.xy[rows[different]])
            d = seen.xy[rows[different]] - mean
            chi2 = float(np.einsum("na,nab,nb->", d, P, d))
            kind = 1 if chi2 <= chi2_ppf(1 - LEVEL, 2 * (len(different) - 1)) else 2
            xy[row], covariance[row] = mean, Q
        if kind == 2:
            keep[row] = False
            dropped += len(rows)
        kinds[kind].append((int(seen.image[row]), int(seen.point[row])))
    merged = replace(seen, xy=xy, covariance=covariance).select(keep)
    same, averaged, contradicting = (tuple(pairs) for pairs in kinds)
    return MergedImagePoints(merged, same, averaged, contradicting, dropped)


@dataclass(frozen=True)
class OfOneSource:
    """Image points of several sources, each measured once."""

    image_points: ImagePoints
    contradicting: tuple[
        tuple[int, int], ...
    ]  # (photograph, point) that sources measure at different positions
    remarks: tuple[Remark, ...]  # on sources that are offset


def without_repeated(seen: ImagePoints, sources: tuple[Source, ...]) -> OfOneSource:
    """Return the image points of several sources without those that an earlier source has as well.

    Both measured the same pixels, so that their mean would hardly be better, and only look better. Those of
    both are left out where they contradict one another, beside the differences at all their common points.

    Args:
        seen: image points of all sources, without repetitions in a source.
        sources: the sources, the more precise first.
    """
    key = seen.image * (int(seen.point.max(initial=0)) + 1) + seen.point
    source = np.zeros(len(seen), dtype=np.int64) if seen.source is None else seen.source
    keep: BoolArray = np.ones(len(seen), dtype=bool)
    contradicting: list[tuple[int, int]] = []
    remarks = []
    for a, b in combinations(range(len(sources)), 2):
        rows = [np.flatnonzero(source == k) for k in (a, b)]
        _, first, second = np.intersect1d(key[rows[0]], key[rows[1]], return_indices=True)
        if not len(first):
            continue
        of_a, of_b = rows[0][first], rows[1][second]
        keep[of_b] = False
        difference, C = seen.xy[of_b] - seen.xy[of_a], seen.covariance[of_a] + seen.covariance[of_b]
        offset = np.zeros(2)
        distance = Quantity(float(np.median(np.linalg.norm(difference, axis=1))), "px")
        said = partial(
            remark,
            "sources_contradict",
            sources=[sources[k].noun or sources[k].name for k in (b, a)],
            distance=distance,
            common=len(of_a),
        )
        if len(of_a) >= FEWEST_COMMON:  # of fewer the stated sigmas decide
            offset = np.median(difference, axis=0)
            scale = max(1.0, float(np.median(_squares(difference - offset, C)) / chi2_ppf(0.5, 2)))
            if scale > MAX_FACTOR**2:  # beyond any that a wrong standard deviation explains
                remarks.append(said())
                continue
            C = C * scale
            # the variance of a median is pi / 2 of that of a mean; what is below one sigma does not matter
            together = _squares(offset[None], np.median(C, axis=0)[None])[0]
            if together > max(1.0, np.pi / 2 * chi2_isf(LEVEL, 2) / len(of_a)):
                x, y = (Quantity(float(component), "px") for component in offset)
                remarks.append(said(offset=Quantity(float(np.linalg.norm(offset)), "px"), x=x, y=y))
        wrong = _squares(difference - offset, C) > chi2_isf(LEVEL / len(of_a), 2)
        keep[of_a[wrong]] = False
        contradicting += zip(seen.image[of_a[wrong]].tolist(), seen.point[of_a[wrong]].tolist(), strict=True)
    return OfOneSource(seen.select(keep), tuple(contradicting), tuple(remarks))


def _squares(d: FloatArray, C: FloatArray) -> FloatArray:
    """Return the squares of differences (n, 2) in units of their covariances (n, 2, 2), (n,)."""
    return np.asarray(np.einsum("na,nab,nb->n", d, np.linalg.inv(C), d))
