"""The test of the points of two results with all that is known of their covariance.

Source: Caspary (2000), Concepts of network and deformation analysis, sec. 7.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.comparison.congruency import Congruency, congruency
from sfm.comparison.pairing import Pairing
from sfm.comparison.point_pairs import PointPairs, rounding_of
from sfm.comparison.stable_points import critical_value
from sfm.conventions import METRES, BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.remarks.remark import Remark, remark
from sfm.similarity import Similarity
from sfm.solution import Solution

FREE_DATUMS = ("free", "")  # in which the covariance of single points gives about what the whole one does


@dataclass(frozen=True)
class PointTest:
    """Results of the tests of the points."""

    sigma: FloatArray  # of the differences, NaN where not known, (n, 3)
    untested: Remark | None  # why there is no test
    statistic: FloatArray
    critical: float
    significant: BoolArray
    global_statistic: float
    global_critical: float
    stable: BoolArray
    approximate: bool = False
    majority: bool = True

    @property
    def agrees(self) -> bool:
        """Whether no test shows that the points differ."""
        return not (
            self.global_statistic > self.global_critical or self.significant.any() or not self.majority
        )


def judge_points(
    a: Solution,
    b: Solution,
    pairing: Pairing,
    pairs: tuple[PointPairs, IntArray, BoolArray],
    transform: Similarity,
    align: str,
    chosen: BoolArray,
    alpha: float,
) -> PointTest:
    """Test the differences of the common points with all that is known of their covariance.

    Args:
        a: first result.
        b: second result.
        pairing: what they have in common.
        pairs: the points with their covariances, which these are, and which are known, by `pairs_of_results`.
        transform: a_from_b.
        align: what they are aligned by.
        chosen: points that the alignment may be over, (n,).
        alpha: of all tests together.
    """
    pa, pb = pairing.points.T
    n = len(pa)
    rounding = rounding_of(a.estimate.points[pa]) ** 2
    blocks = _sum(a.point_covariance, b.point_covariance, pa, pb, transform, rounding)
    variance = np.einsum("njj->nj", blocks)
    sigma = np.sqrt(np.where(variance >= 0, variance, np.nan))
    nothing = np.full(n, np.nan)
    every = np.ones(n, dtype=bool)

    def without(why: Remark) -> PointTest:
        return PointTest(sigma, why, nothing, np.nan, ~every, np.nan, np.nan, every)

    if not n:
        return without(remark("no_common_points"))
    if not any(has_sigma(one) for one in (a, b)):
        return without(remark("no_sigmas"))
    known = [one for one in (a, b) if has_sigma(one)]
    points, free, together = pairs
    if all(one.covariance is not None for one in known):
        if align == "none" and not all(one.datum == "control" for one in known):
            return without(remark("no_common_datum"))
        d, Q = points.differences(transform)
        try:
            found = congruency(
                *(d, Q, points.a),
                motion="none" if align == "none" else "similarity" if points.scale is None else "rigid",
                redundancy=points.redundancy,
                reference=chosen[free],
                alpha=alpha,
            )
        except GeometryError as error:
            return without(remark("untestable", reason=str(error)))
        sigma[together] = 0.0  # held in both, or written over
        return _of_congruency(found, free, sigma, together)
    if not all(one.datum in FREE_DATUMS for one in known):
        return without(remark("no_joint_covariance"))
    difference = transform.apply(b.estimate.points[pb]) - a.estimate.points[pa]
    statistic, critical, global_critical = _single_tests(difference, blocks, points.redundancy, alpha)
    if not np.isfinite(statistic).any():
        return without(remark("no_sigmas"))
    mean = float(np.nanmean(statistic))
    return PointTest(
        *(sigma, None, statistic, critical, statistic > critical, mean, global_critical, every),
        approximate=True,
    )


def _of_congruency(found: Congruency, tested: IntArray, sigma: FloatArray, together: BoolArray) -> PointTest:
    """Return the test of all points where some took no part, held in both results or of unknown correlation.

    Args:
        found: of the tested points.
        tested: their indices, (k,).
        sigma: of all differences, written over where tested, (n, 3).
        together: points whose covariance together is known, on which alone an alignment may rest, (n,).
    """
    n = len(together)
    statistic = np.full(n, np.nan)
    sigma[tested] = np.sqrt(np.diagonal(found.covariance).reshape(-1, 3).clip(0))
    statistic[tested] = found.statistic
    stable = together.copy()
    stable[tested] = found.stable
    significant = np.zeros(n, dtype=bool)
    significant[tested] = found.moved
    first, critical = found.first_test, float(found.critical[found.reference][0])
    return PointTest(
        *(sigma, None, statistic, critical, significant, first.statistic, first.critical),
        *(stable, False, found.agreed),
    )


def _sum(
    a: FloatArray | None,
    b: FloatArray | None,
    pa: IntArray,
    pb: IntArray,
    transform: Similarity,
    rounding: float,
) -> FloatArray:
    """Covariance of the differences, NaN where neither is known; one that is not known counts as 0."""
    unknown = np.full((len(pa), 3, 3), np.nan)
    J = transform.scale * transform.rotation
    ours = unknown if a is None else a[pa]
    theirs = unknown if b is None else J @ b[pb] @ J.T
    first = np.isfinite(ours).all(axis=(1, 2), keepdims=True)
    second = np.isfinite(theirs).all(axis=(1, 2), keepdims=True)
    total = np.where(first, ours, 0.0) + np.where(second, theirs, 0.0) + rounding * np.eye(3)
    return np.where(first | second, total, np.nan)


def _single_tests(
    difference: FloatArray, covariance: FloatArray, redundancy: int | None, alpha: float
) -> tuple[FloatArray, float, float]:
    """T of each point, its critical value for one of all points, and that of the mean of T."""
    statistic = np.full(len(difference), np.nan)
    testable = np.isfinite(covariance).all(axis=(1, 2)) & (
        np.linalg.matrix_rank(np.nan_to_num(covariance)) == 3
    )
    d = difference[testable]
    statistic[testable] = (
        np.einsum("ni,ni->n", d, np.linalg.solve(covariance[testable], d[..., None])[..., 0]) / 3
    )
    tested = max(1, int(testable.sum()))
    single = critical_value(alpha / 2 / tested, 3, redundancy)
    return statistic, single, critical_value(alpha / 2, 3 * tested, redundancy)


def known_scale(a: Solution, b: Solution) -> float | None:
    """Return the scale of a over b where both have one, None where it has to be estimated."""
    if not (a.has_scale and b.has_scale):
        return None
    if a.unit == b.unit:
        return 1.0
    return METRES[b.unit] / METRES[a.unit] if a.unit in METRES and b.unit in METRES else None


def has_sigma(result: Solution) -> bool:
    """Whether the standard deviation of any point is known."""
    return result.point_covariance is not None and bool(np.isfinite(result.point_covariance).any())
