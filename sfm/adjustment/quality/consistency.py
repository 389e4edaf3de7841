"""Whether all points and all photographs of a result were measured alike, by the sizes of their residuals.

A bent target or a blurred photograph leaves residuals small enough for the tests of single image coordinates,
and yet larger than chance makes them together. All tests are against sigma0 a posteriori, with cameras and
orientations as adjusted, which makes them a little too cautious.

Source: Bartlett (1937), Proc. R. Soc. A 160; Luhmann et al., Close-Range Photogrammetry (2020), sec. 7.2.

Rejected rays for which another ray of the same point could have been rejected just as well.

Of three rays two always nearly meet: which one is wrong is decided by what remains along the epipolar line,
and data snooping blames the wrong one in a quarter of such points with an error of ten standard deviations.
Both explanations are compared by what they leave; where they differ by less than chance, the point is
doubtful.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.5 (separability of alternative
hypotheses).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.point_normals import PointNormals, point_normals
from sfm.adjustment.quality.reliability import level_of_single
from sfm.adjustment.quality.variance_components import VarianceComponents, by_photograph
from sfm.adjustment.result import Adjustment
from sfm.conventions import IntArray
from sfm.distributions import chi2_isf, chi2_sf

CHANCE = 1e-3  # of so much larger a misfit where the other explanation is the true one
MOVED_SIGMAS = 3.0  # standard deviations by which the other explanation moves the point, for it to matter

FAMILY = 0.01  # chance with which each test reports anything in a survey in which nothing is wrong
# Largest component of a photograph over their median, below which a difference is of no use.
MIN_UNEVEN_RATIO = 1.5


@dataclass(frozen=True)
class Uneven:
    """Photographs whose residuals are not alike."""

    probability: float  # of so different components by chance, Bartlett's test
    worst: str  # photograph with the largest component
    largest: float  # its component
    median: float  # of all photographs


@dataclass(frozen=True)
class Consistency:
    """Results of the tests inside a result."""

    large: tuple[str, ...]  # points whose residuals are together larger than chance
    uneven: Uneven | None  # None where the photographs are alike
    doubtful: tuple[DoubtfulPoint, ...] = ()  # points of which another ray may be the wrong one


def consistency_of(adjustment: Adjustment) -> Consistency:
    """Return what the tests of points and photographs find; nothing without covariance or noise."""
    if not np.isfinite(adjustment.redundancy_numbers).any() or adjustment.is_exact:
        return Consistency((), None)
    parts = point_normals(adjustment)
    rays = parts.rows_of_points(adjustment)
    of_point = zip(adjustment.network.points, adjustment.covariance.points, strict=True)
    fixed = {name for name, covariance in of_point if not covariance.any()}
    doubtful = tuple(one for one in doubtful_points(adjustment, parts, rays) if one.point not in fixed)
    return Consistency(_large(adjustment, parts, rays), _uneven(by_photograph(adjustment)), doubtful)


def _large(adjustment: Adjustment, parts: PointNormals, rays: list[IntArray]) -> tuple[str, ...]:
    """Return the points whose accepted residuals are together larger than chance makes them."""
    network, n = adjustment.network, len(adjustment.network.points)
    level = level_of_single(FAMILY, n)
    large: list[str] = []
    for j, rows in enumerate(rays):
        accepted = rows[~adjustment.rejected[rows]]
        r = float(adjustment.redundancy_numbers[accepted].sum())
        if r > 1 and chi2_sf(parts.q[accepted].sum(), r) < level:
            large.append(network.points[j])
    return tuple(large)


def _uneven(photographs: VarianceComponents) -> Uneven | None:
    """Test whether all photographs were measured alike, by Bartlett's test of their components."""
    known = np.isfinite(photographs.sigma0) & (photographs.redundancy > 1)
    s2, r = photographs.sigma0[known] ** 2, photographs.redundancy[known]
    if known.sum() < 3 or not (s2 > 0).all():
        return None
    g, total = len(s2), float(r.sum())
    pooled = float(r @ s2 / total)
    correction = 1 + (float((1 / r).sum()) - 1 / total) / (3 * (g - 1))
    statistic = (total * np.log(pooled) - float(r @ np.log(s2))) / correction
    probability = float(chi2_sf(statistic, g - 1))
    sigma = np.sqrt(s2)
    worst, median = int(np.argmax(sigma)), float(np.median(sigma))
    if probability > FAMILY or sigma[worst] < MIN_UNEVEN_RATIO * median:
        return None
    name = photographs.names[int(np.flatnonzero(known)[worst])]
    return Uneven(probability, name, float(sigma[worst]), median)


@dataclass(frozen=True)
class DoubtfulPoint:
    """A point of which another ray may be the wrong one."""

    point: str
    rejected: str  # photograph of the ray that was rejected
    instead: str  # photograph of the ray that may as well be wrong
    misfit: float  # v'Pv that is left over sigma0^2
    other: float  # the same with the other ray rejected in its place


def doubtful_points(
    adjustment: Adjustment, parts: PointNormals, rows_of: list[IntArray]
) -> tuple[DoubtfulPoint, ...]:
    """Return the points of which another ray could have been rejected, the most doubtful first.

    Args:
        adjustment: with rejected image points.
        parts: its normal equations by image point.
        rows_of: usable image points of each object point.
    """
    images, seen = adjustment.network.images, adjustment.network.image_points
    limit = float(chi2_isf(CHANCE, 1))
    found = []
    for j in np.unique(seen.point[adjustment.rejected]).tolist():
        rows = rows_of[j]
        out, kept = rows[adjustment.rejected[rows]], rows[~adjustment.rejected[rows]]
        if not len(out) or len(kept) < 2:
            continue
        left = parts.misfit(kept)
        others = [
            (parts.misfit(np.append(np.delete(kept, s), r)), int(r), int(kept[s]))
            for r in out
            for s in range(len(kept))
        ]
        other, r, instead = min(others)
        if other - left < limit and _moved(parts, kept, np.append(kept[kept != instead], r)) > MOVED_SIGMAS:
            names = images[seen.image[r]], images[seen.image[instead]]
            found.append(DoubtfulPoint(adjustment.network.points[j], *names, left, other))
    return tuple(sorted(found, key=lambda one: one.other - one.misfit))


def _moved(parts: PointNormals, kept: IntArray, other: IntArray) -> float:
    """Return how far a point moves from one choice of its rays to another, in standard deviations."""
    step = parts.step(other) - parts.step(kept)
    return float(np.sqrt(step @ parts.N[kept].sum(axis=0) @ step))
