"""Whether all points and all photographs of a result were measured alike, by the sizes of their residuals.

A bent target or a blurred photograph leaves residuals small enough for the tests of single image coordinates,
and yet larger than chance makes them together. All tests are against sigma0 a posteriori, with cameras and
orientations as adjusted, which makes them a little too cautious.

Source: Bartlett (1937), Proc. R. Soc. A 160; Luhmann et al., Close-Range Photogrammetry (2020), sec. 7.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.gross_errors.doubtful_rays import DoubtfulPoint, doubtful_points
from sfm.adjustment.quality.point_normals import PointNormals, point_normals
from sfm.adjustment.quality.reliability import level_of_single
from sfm.adjustment.quality.variance_components import VarianceComponents, by_photograph
from sfm.adjustment.result import Adjustment
from sfm.conventions import IntArray
from sfm.distributions import chi2_sf

FAMILY = 0.01  # chance with which each test says anything of a survey in which nothing is wrong
UNEVEN = 1.5  # largest component of a photograph over their median, below which a difference is of no use


@dataclass(frozen=True)
class Uneven:
    """Photographs whose residuals are not alike."""

    probability: float  # of so different components by chance, Bartlett's test
    worst: str  # photograph with the largest component
    largest: float  # its component
    median: float  # of all photographs


@dataclass(frozen=True)
class Consistency:
    """What the tests inside a result have found."""

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
    if probability > FAMILY or sigma[worst] < UNEVEN * median:
        return None
    name = photographs.names[int(np.flatnonzero(known)[worst])]
    return Uneven(probability, name, float(sigma[worst]), median)
