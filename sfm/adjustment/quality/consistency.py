"""Tests inside a result: every point, every photograph, and patterns of residuals over the format.

A point that moved, two targets of one name, a focus that changed: each leaves the residuals small enough for
the tests of single image coordinates, and yet not as chance would have them. All tests are against sigma0 a
posteriori, with cameras and orientations as adjusted, which makes them a little too cautious, since the
residuals of an adjustment are smaller than errors.

Source: Koch (1999), Parameter Estimation and Hypothesis Testing in Linear Models, sec. 4.2 (tests of
additional parameters); Bartlett (1937), Proc. R. Soc. A 160; Luhmann et al., Close-Range Photogrammetry
(2020), sec. 7.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.gross_errors.doubtful_rays import DoubtfulPoint, doubtful_points
from sfm.adjustment.quality.point_normals import PointNormals, intersected, point_normals
from sfm.adjustment.quality.variance_components import VarianceComponents, by_photograph
from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, IntArray
from sfm.distributions import chi2_sf
from sfm.network import rows_of

FAMILY = 0.01  # chance with which each test says anything of a survey in which nothing is wrong
EXPLAINED = 0.001  # chance with which two positions that are right do not explain the residuals
APART = 3.0  # standard deviations of the distance of two positions, below which it may be none
MANY = 20_000  # points from which only those are tried whose residuals are conspicuous by themselves
CONSPICUOUS = 0.05
UNEVEN = 1.5  # largest component of a photograph over their median, below which a difference is of no use
CELLS = 5  # of the format in each direction
PATTERN = 0.05  # share of the residuals' squares that a pattern must explain to be of use


@dataclass(frozen=True)
class TwoPositions:
    """A point that was at one place in some photographs and at another in the others."""

    point: str
    distance: float  # between the two, object unit
    over_sigma: float  # the same in its standard deviations
    first: tuple[str, ...]  # photographs that show the one
    second: tuple[str, ...]  # photographs that show the other


@dataclass(frozen=True)
class Uneven:
    """Photographs whose residuals are not alike."""

    probability: float  # of so different components by chance, Bartlett's test
    worst: str  # photograph with the largest component
    largest: float  # its component
    median: float  # of all photographs


@dataclass(frozen=True)
class Pattern:
    """Residuals of one camera that depend on the place in the photograph."""

    camera: str
    probability: float  # of so strong a pattern by chance
    explained: float  # share of the sum of squares
    largest_px: float  # longest mean residual of a cell


@dataclass(frozen=True)
class Consistency:
    """What the tests inside a result have found."""

    two_positions: tuple[TwoPositions, ...]
    large: tuple[str, ...]  # points whose residuals are larger than chance, without that explanation
    uneven: Uneven | None  # None where the photographs are alike
    patterns: tuple[Pattern, ...]
    doubtful: tuple[DoubtfulPoint, ...] = ()  # points of which another ray may be the wrong one


def consistency_of(adjustment: Adjustment) -> Consistency:
    """Return what the tests of points, photographs and the format find; nothing without a covariance."""
    if not np.isfinite(adjustment.redundancy_numbers).any() or not adjustment.sigma0 > 0:
        return Consistency((), (), None, ())
    parts = point_normals(adjustment)
    rays = parts.rows_of_points(adjustment)
    two, large = _points(adjustment, parts, rays)
    doubtful = doubtful_points(adjustment, parts, rays)
    return Consistency(two, large, _uneven(by_photograph(adjustment)), _patterns(adjustment), doubtful)


def _points(
    adjustment: Adjustment, parts: PointNormals, rays: list[IntArray]
) -> tuple[tuple[TwoPositions, ...], tuple[str, ...]]:
    """Test every point: one position for all its rays, two positions, and the size of its residuals."""
    network, n = adjustment.network, len(adjustment.network.points)
    level = 1 - (1 - FAMILY) ** (1 / max(n, 1))
    two: list[TwoPositions] = []
    large: list[str] = []
    for j, rows in enumerate(rays):
        accepted = rows[~adjustment.rejected[rows]]
        found = _two_positions(adjustment, parts, rows, level) if len(rows) >= 4 else None
        if found is not None:
            two.append(found)
            continue
        r = float(adjustment.redundancy_numbers[accepted].sum())
        if r > 1 and chi2_sf(parts.q[accepted].sum(), r) < level:
            large.append(network.points[j])
    return tuple(sorted(two, key=lambda one: -one.over_sigma)), tuple(large)


def _two_positions(
    adjustment: Adjustment, parts: PointNormals, rows: IntArray, level: float
) -> TwoPositions | None:
    """Return the two positions of a point of these rows, in order of photographs; None where one will do.

    Tried are all changes between one photograph and the next, and the rays that the test rejected against
    those that it accepted. Two positions must explain everything, and far better than one wrong ray does.
    """
    m = len(rows)
    one = parts.misfit(rows)
    if len(adjustment.network.points) > MANY and chi2_sf(one, 2 * m - 3) > CONSPICUOUS:
        return None
    splits = np.arange(m) < np.arange(2, m - 1)[:, None]
    rejected = adjustment.rejected[rows]
    if 2 <= rejected.sum() <= m - 2:
        splits = np.vstack([splits, ~rejected])
    if chi2_sf(one, 3) * len(splits) > level:  # all of it could not be enough
        return None
    misfit = parts.misfits(splits, rows) + parts.misfits(~splits, rows)
    best = int(np.argmin(misfit))
    split, left = splits[best], float(misfit[best])
    if chi2_sf(one - left, 3) * len(splits) > level:
        return None
    if rejected.any() and chi2_sf(left, 2 * m - 6) < EXPLAINED:
        split = ~rejected  # far apart: by the rays that the test has told from one another
        if not 2 <= split.sum() <= m - 2:
            return None
    groups = [intersected(adjustment, rows[split]), intersected(adjustment, rows[~split])]
    left = groups[0][2] + groups[1][2]
    if chi2_sf(left, 2 * m - 6) < EXPLAINED:
        return None
    without = parts.misfits(~np.eye(m, dtype=bool), rows).min()
    if chi2_sf(without - left, 1) * len(splits) > level:
        return None
    network, seen = adjustment.network, adjustment.network.image_points
    apart = groups[1][0] - groups[0][0]
    distance = float(np.linalg.norm(apart))
    over_sigma = float(np.sqrt(apart @ np.linalg.pinv(groups[0][1] + groups[1][1]) @ apart))
    if over_sigma < APART:
        return None
    names = [tuple(network.images[i] for i in seen.image[rows[s]]) for s in (split, ~split)]
    return TwoPositions(network.points[seen.point[rows[0]]], distance, over_sigma, names[0], names[1])


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


def _patterns(adjustment: Adjustment) -> tuple[Pattern, ...]:
    """Test for each camera whether the mean residuals of the cells of its format are 0."""
    network, estimate = adjustment.network, adjustment.estimate
    seen, used = network.image_points, ~adjustment.rejected
    whitened = _whitened(adjustment)
    out = []
    of_camera = rows_of(network.camera[seen.image], len(estimate.cameras))
    for camera, rows in zip(estimate.cameras, of_camera, strict=True):
        own = rows[used[rows]]
        width, height = camera.size_px
        column = np.clip((CELLS * seen.xy[own, 0] / width).astype(np.int64), 0, CELLS - 1)
        row = np.clip((CELLS * seen.xy[own, 1] / height).astype(np.int64), 0, CELLS - 1)
        cell = CELLS * row + column
        count = np.bincount(cell, minlength=CELLS**2)
        if (count > 0).sum() < 3 or len(own) < 2 * CELLS**2:
            continue
        mean, in_px = (_means(values[own], cell, count) for values in (whitened, adjustment.residuals))
        between = float((count[:, None] * mean**2).sum())
        probability = float(chi2_sf(between, 2 * int((count > 0).sum())))
        explained = between / float((whitened[own] ** 2).sum())
        if probability < FAMILY / len(estimate.cameras) and explained > PATTERN:
            longest = float(np.linalg.norm(in_px, axis=1).max())
            out.append(Pattern(camera.name, probability, explained, longest))
    return tuple(out)


def _means(values: FloatArray, cell: IntArray, count: IntArray) -> FloatArray:
    """Return the mean of vectors (k, 2) in each cell, 0 where there is none, (cells, 2)."""
    total = np.stack([np.bincount(cell, weights=axis, minlength=len(count)) for axis in values.T], axis=1)
    return np.asarray(total / np.maximum(count, 1)[:, None])


def _whitened(adjustment: Adjustment) -> FloatArray:
    """Return residuals in their standard deviations a posteriori, (k, 2)."""
    F = np.linalg.cholesky(np.linalg.inv(adjustment.image_covariance))
    return np.asarray(np.einsum("kba,kb->ka", F, adjustment.residuals) / adjustment.sigma0)
