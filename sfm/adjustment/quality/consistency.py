"""Consistency: tests if points and photographs were measured equally well, and finds doubtful rejections.

A bent target or a blurred photograph can leave residuals that pass the tests of single image coordinates, and
yet are jointly larger than chance allows. All tests use the a posteriori sigma0 with adjusted cameras and
orientations, which makes them slightly too cautious.

A rejection is doubtful if another ray of the same point could have been rejected just as well. Of three rays,
two always nearly meet, and only the misfit along the epipolar line shows which ray is wrong. With an error of
ten standard deviations, data snooping rejects the wrong ray in a quarter of such points. So both explanations
are compared by their remaining misfit. If the difference may be due to chance, the point is doubtful.

`PointNormals` is the contribution of each ray to the normal equations of its object point, with adjusted
cameras. With it, the tests of single points try other explanations of residuals without a new adjustment.

Source: Bartlett (1937), Proc. R. Soc. A 160; Luhmann et al., Close-Range Photogrammetry (2020), sec. 7.2;
Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.5 (separability of alternative
hypotheses).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.quality.variance_components import VarianceComponents, by_photograph
from sfm.adjustment.result import Adjustment, computed_once
from sfm.model.camera import project, ray_jacobian
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distributions import chi2_isf, chi2_sf, f_sf, level_of_single, normal_ppf, t_ppf
from sfm.model.network import rows_of, sum_rows
from sfm.model.remarks.row import EXPECTED_SIGMAS

# Ratio r of the largest component of a photograph to the median, or of the differences between two parts to
# their standard deviations, below which it does not matter: equal weights of two groups cost at most
# (1 + r^2) / 2r of the best precision, here 8 %. Right rendered surveys of texture reach 1.35.
MIN_UNEVEN_RATIO = 1.5
MIN_PART = 2  # photographs, and rays of a point, with which a part determines it
MAX_DIVISIONS = 15  # evenly spread ends of the first part that are tried


@dataclass(frozen=True)
class Uneven:
    """Photographs with residuals of unequal size."""

    probability: float  # chance probability of components that differ as much, by Bartlett's test
    worst: str  # photograph with the largest component
    largest: float  # its component
    median: float  # median component of all photographs


@dataclass(frozen=True)
class Change:
    """Two parts of the photographs, one after the other, that give different points."""

    first: str  # last photograph of the first part
    next: str  # first photograph of the second part
    points: int  # that both parts determine
    times: float  # RMS difference over its standard deviation
    # largest difference of a coordinate of the result, the weighted mean of both parts, from those of the
    # nearer part, over its standard deviation
    shift: float


@dataclass(frozen=True)
class Consistency:
    """Results of the consistency tests."""

    large: tuple[str, ...]  # points with residuals jointly larger than chance allows
    uneven: Uneven | None  # None if the photographs are equally good
    outlying: tuple[str, ...] = ()  # those of `large` that stand out from the spread of all points
    tested: int = 0  # points whose residuals were tested together
    doubtful: tuple[DoubtfulPoint, ...] = ()  # points with another ray that may be the wrong one
    parts: int = 0  # ways of dividing the photographs in two parts that were compared
    change: Change | None = None  # parts that give different points; None if chance explains the difference


@computed_once
def consistency_of(adjustment: Adjustment) -> Consistency:
    """Return the results of the tests of points and photographs; empty without covariance or noise.

    Args:
        adjustment: finished adjustment.
    """
    if not np.isfinite(adjustment.redundancy_numbers).any() or adjustment.is_exact:
        return Consistency((), None)
    parts = point_normals(adjustment)
    rays = parts.rows_of_points(adjustment)
    exact = ~adjustment.covariance.points.any(axis=(1, 2))
    fixed = {adjustment.network.points[j] for j in np.flatnonzero(exact)}
    doubtful = tuple(
        doubtful_point
        for doubtful_point in doubtful_points(adjustment, parts, rays)
        if doubtful_point.point not in fixed
    )
    level = adjustment.levels.family
    large, outlying, tested = _large(adjustment, parts, rays, level)
    uneven = _uneven(by_photograph(adjustment), level)
    return Consistency(large, uneven, outlying, tested, doubtful, *_change(adjustment, parts, level))


def _large(
    adjustment: Adjustment, parts: PointNormals, rays: list[IntArray], level: float
) -> tuple[tuple[str, ...], tuple[str, ...], int]:
    """Return the points with jointly large residuals, those that stand out, and the number of tested points.

    Accepted residuals of a point are large if chance does not explain them. Real targets differ in
    quality, so that many are. A point stands out if its normal score is beyond the spread of all scores.
    """
    network, n = adjustment.network, len(adjustment.network.points)
    single = level_of_single(level, n)
    probability = np.ones(n)
    for j, rows in enumerate(rays):
        accepted = rows[~adjustment.rejected[rows]]
        r = float(adjustment.redundancy_numbers[accepted].sum())
        if r > 1:
            probability[j] = float(chi2_sf(parts.q[accepted].sum(), r))
    tested = np.flatnonzero(probability < 1)
    large = probability[tested] < single
    smallest = np.finfo(float).tiny
    score = -normal_ppf(np.clip(probability[tested], smallest, 1 - np.finfo(float).eps))
    outlying = large & larger_than_the_others(score, level=level)
    return (
        tuple(network.points[j] for j in tested[large]),
        tuple(network.points[j] for j in tested[outlying]),
        len(tested),
    )


def _change(adjustment: Adjustment, parts: PointNormals, level: float) -> tuple[int, Change | None]:
    """Return how many divisions of the photographs were tried, and the parts that give different points.

    The points of both parts are intersected with the adjusted cameras and orientations. Their differences are
    compared with the residuals that remain by the F test. It is cautious, as the orientations have adapted to
    both parts. It needs no stated standard deviation, and finds any change of shape at one time, even if half
    of the points moved and no residual is large: in all of 32 networks of 12 to 19 photographs with half of
    the points turned by 0.7 mm of 1 m, and in none of 32 right ones.
    """
    a, seen = adjustment, adjustment.network.image_points
    m, n = len(a.network.images), len(a.network.points)
    if m < 2 * MIN_PART:
        return 0, None
    rows = np.flatnonzero(~a.rejected & np.isfinite(parts.q) & np.isfinite(parts.b).all(axis=1))
    image, point = seen.image[rows], seen.point[rows]
    total, redundancy = float(parts.q[rows].sum()), float(a.redundancy_numbers[rows].sum())
    sigma = np.sqrt(np.maximum(np.diagonal(a.covariance.points, axis1=1, axis2=2), 0.0))
    ends = np.unique(np.linspace(MIN_PART - 1, m - MIN_PART - 1, MAX_DIVISIONS).round().astype(int))
    best, least = None, level / len(ends)
    for end in ends.tolist():
        halves = [(rows[part], point[part]) for part in (image <= end, image > end)]
        known = np.minimum(*(np.bincount(of_point, minlength=n) for _, of_point in halves)) >= MIN_PART
        place = np.cumsum(known) - 1
        (first, Q1), (second, Q2) = (
            parts.intersections(of[known[of_point]], place[of_point[known[of_point]]], int(known.sum()))
            for of, of_point in halves
        )
        d, freedom = second - first, 3 * len(first)
        weighted = np.einsum("nij,nj->ni", np.linalg.pinv(Q1 + Q2, hermitian=True), d)
        square = float((d * weighted).sum())
        if not 0 < freedom < redundancy:
            continue
        F = square / freedom / max((total - square) / (redundancy - freedom), np.finfo(float).tiny)
        probability = float(f_sf(F, freedom, redundancy - freedom))
        if probability < least and F > MIN_UNEVEN_RATIO**2:
            from_first = np.einsum("nij,nj->ni", Q1, weighted)  # to the weighted mean of both parts
            scale = np.where(sigma[known] > 0, sigma[known], np.inf)
            nearest = min(float((np.abs(away) / scale).max()) for away in (from_first, d - from_first))
            names = a.network.images[end], a.network.images[end + 1]
            best = Change(*names, int(known.sum()), float(np.sqrt(F)), nearest)
            least = probability
    return len(ends), best


def larger_than_the_others(values: FloatArray, *, level: float) -> BoolArray:
    """Return which values exceed the others by more than chance explains, fewer than half of them, (n,).

    Args:
        values: values to compare, (n,).
        level: probability that chance alone marks any of them.

    Source: Rosner (1983), Percentage points for a generalized ESD many-outlier procedure, Technometrics
    25(2), 165-172; one-sided.
    """
    n = len(values)
    large: BoolArray = np.zeros(n, dtype=bool)
    order = np.argsort(-values, kind="stable")
    removed = np.arange(min((n - 1) // 2, n - 2))
    if not len(removed):
        return large
    kept = values[order] - np.median(values)
    left = n - removed
    total, squares = (np.cumsum(part[::-1])[::-1][removed] for part in (kept, kept**2))
    mean = total / left
    spread = np.sqrt(np.maximum(squares - total * mean, 0.0) / (left - 1))
    t = t_ppf(1 - level / left, left - 2)
    critical = (left - 1) * t / np.sqrt((left - 2 + t**2) * left)
    beyond = np.flatnonzero(kept[removed] - mean > critical * spread)
    large[order[: beyond[-1] + 1 if len(beyond) else 0]] = True
    return large


def _uneven(photographs: VarianceComponents, level: float) -> Uneven | None:
    """Test by Bartlett's test whether all photographs have the same variance component."""
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
    if probability > level or sigma[worst] < MIN_UNEVEN_RATIO * median:
        return None
    name = photographs.names[int(np.flatnonzero(known)[worst])]
    return Uneven(probability, name, float(sigma[worst]), median)


@dataclass(frozen=True)
class DoubtfulPoint:
    """A point with another ray that may be the wrong one."""

    point: str
    rejected: str  # photograph of the rejected ray
    instead: str  # photograph of the other ray that may be wrong
    misfit: float  # remaining v'Pv over sigma0^2
    other: float  # the same with the other ray rejected instead


def doubtful_points(
    adjustment: Adjustment, parts: PointNormals, rows_of: list[IntArray]
) -> tuple[DoubtfulPoint, ...]:
    """Return the points with another ray that could have been rejected, most doubtful first.

    Args:
        adjustment: adjustment with rejected image points.
        parts: normal equations of its image points.
        rows_of: usable image points of each object point.
    """
    images, seen = adjustment.network.images, adjustment.network.image_points
    limit = float(chi2_isf(adjustment.levels.question, 1))
    doubtful = []
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
        if (
            other - left < limit
            and _moved(parts, kept, np.append(kept[kept != instead], r)) > EXPECTED_SIGMAS
        ):
            names = images[seen.image[r]], images[seen.image[instead]]
            doubtful.append(DoubtfulPoint(adjustment.network.points[j], *names, left, other))
    return tuple(sorted(doubtful, key=lambda doubtful_point: doubtful_point.other - doubtful_point.misfit))


def _moved(parts: PointNormals, kept: IntArray, other: IntArray) -> float:
    """Return the shift of a point from one choice of its rays to another, in standard deviations."""
    step = parts.step(other) - parts.step(kept)
    return float(np.sqrt(step @ parts.N[kept].sum(axis=0) @ step))


@dataclass(frozen=True)
class PointNormals:
    """Contribution of each image point to the normal equations of its object point, divided by sigma0^2."""

    N: FloatArray  # (k, 3, 3)
    b: FloatArray  # A'Pv, (k, 3)
    q: FloatArray  # v'Pv, (k,)

    def misfit(self, rows: IntArray) -> float:
        """Return v'Pv after fitting the point to these image points alone."""
        N, b = self.N[rows].sum(axis=0), self.b[rows].sum(axis=0)
        return float(self.q[rows].sum() - b @ np.linalg.lstsq(N, b, rcond=None)[0])

    def misfits(self, groups: BoolArray, rows: IntArray) -> FloatArray:
        """Return v'Pv after fitting the point to each of several groups of image points, (g,).

        Args:
            groups: which image points are in each group, (g, m).
            rows: image points of one object point, (m,).
        """
        weights = groups.astype(float)
        N, b = np.tensordot(weights, self.N[rows], 1), weights @ self.b[rows]
        fitted = np.einsum("gi,gij,gj->g", b, np.linalg.pinv(N, hermitian=True), b)
        return np.asarray(weights @ self.q[rows] - fitted)

    def intersections(self, rows: IntArray, point: IntArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return shifts (n, 3) and cofactors (n, 3, 3) of points from these image points alone.

        Args:
            rows: image points.
            point: object point of each of them.
            count: number of object points, n.
        """
        N, b = (sum_rows(point, of[rows], count) for of in (self.N, self.b))
        Q: FloatArray = np.asarray(np.linalg.pinv(N, hermitian=True), dtype=float)
        return -np.einsum("nij,nj->ni", Q, b), Q

    def step(self, rows: IntArray) -> FloatArray:
        """Return the shift of the point when fitted to these image points alone, (3,)."""
        N, b = self.N[rows].sum(axis=0), self.b[rows].sum(axis=0)
        return np.asarray(-np.linalg.lstsq(N, b, rcond=None)[0])

    def rows_of_points(self, adjustment: Adjustment) -> list[IntArray]:
        """Return the usable image points of each object point, in order of photographs."""
        seen = adjustment.network.image_points
        usable = np.isfinite(self.q) & np.isfinite(self.b).all(axis=1)
        order = np.lexsort((seen.image, seen.point))
        order = order[usable[order]]
        bounds = np.searchsorted(seen.point[order], np.arange(1, len(adjustment.network.points)))
        return np.split(order, bounds)


MAX_STEPS = 10  # most steps of an intersection, which starts at the adjusted point
LAST_STEP_SIGMAS = 1e-3  # standard deviations


def intersect_rays(adjustment: Adjustment, rows: IntArray) -> tuple[FloatArray, FloatArray, float]:
    """Return position (3,), cofactors (3, 3) and v'Pv over sigma0^2 of a point from some of its rays alone.

    It iterates, because a position far from the adjusted point needs more than one step. This happens, for
    example, if two points have the same name.

    Args:
        adjustment: finished adjustment.
        rows: image points of one object point.
    """
    network = adjustment.network
    j = int(network.image_points.point[rows[0]])
    alone = replace(
        adjustment,
        network=replace(network, image_points=network.image_points.select(rows)),
        image_sigma_factor=adjustment.image_sigma_factor[rows],
        residuals=adjustment.residuals[rows],
    )
    X, every = adjustment.estimate.points[j], np.arange(len(rows))
    for _ in range(MAX_STEPS):
        parts = point_normals(alone, adjustment.image_sigma0)
        if not np.isfinite(parts.q).all():
            return X, np.full((3, 3), np.nan), np.inf
        Q = np.linalg.pinv(parts.N.sum(axis=0))
        step = -Q @ parts.b.sum(axis=0)
        if step @ parts.N.sum(axis=0) @ step < LAST_STEP_SIGMAS**2:
            break
        X = X + step
        seen, estimate = alone.network.image_points, alone.estimate
        points = estimate.points.copy()
        points[j] = X
        computed = [
            project(
                estimate.cameras[alone.network.camera[i]], estimate.position[i], estimate.rotation[i], X[None]
            )
            for i in seen.image
        ]
        alone = replace(
            alone,
            residuals=np.concatenate(computed) - seen.xy,
            estimate=replace(estimate, points=points),
        )
    return X, Q, parts.misfit(every)


def point_normals(adjustment: Adjustment, sigma0: float | None = None) -> PointNormals:
    """Return the normal equations of all image points, including rejected ones.

    Args:
        adjustment: finished adjustment, or one reduced to some of its image points.
        sigma0: standard deviation of unit weight of the image points; that of the adjustment if not given.
    """
    network, estimate = adjustment.network, adjustment.estimate
    seen = network.image_points
    R, X = estimate.rotation[seen.image], estimate.points[seen.point] - estimate.position[seen.image]
    UVW = np.einsum("kji,kj->ki", R, X)
    A = np.empty((len(seen), 2, 3))
    of_camera = rows_of(network.camera[seen.image], len(estimate.cameras))
    for camera, rows_of_camera in zip(estimate.cameras, of_camera, strict=True):
        if len(rows_of_camera):
            by_ray = ray_jacobian(camera, seen.xy[rows_of_camera], UVW[rows_of_camera])
            A[rows_of_camera] = by_ray @ np.swapaxes(R[rows_of_camera], 1, 2)
    P = (
        np.linalg.inv(adjustment.image_covariance)
        / (adjustment.image_sigma0 if sigma0 is None else sigma0) ** 2
    )
    v = adjustment.residuals
    AP = np.einsum("kai,kab->kib", A, P)
    return PointNormals(AP @ A, np.einsum("kib,kb->ki", AP, v), np.einsum("ka,kab,kb->k", v, P, v))
