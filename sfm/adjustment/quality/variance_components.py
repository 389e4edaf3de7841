"""Variance components: the precision of groups of observations, from their residuals.

Groups are photographs, cameras, and kinds of observations. The variance factor of a group is its v'Pv over
its redundancy. The redundancy of image points is the sum of their redundancy numbers. The redundancy of
another kind is its count minus tr(P Q), with the cofactors Q of the observed functions.

Source: Foerstner (1979), Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten; Luhmann et
al., Close-Range Photogrammetry (2020), sec. 2.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.result import MIN_SIGMA_PX, Adjustment
from sfm.model.camera import camera_families
from sfm.model.conventions import BoolArray, FloatArray, IntArray

LAST_CHANGE = 1e-3  # relative change of a variance component at which the estimation ends
LAST_CHANGE_OF_PARTS = 0.01  # the same for a covariance of two parts, and for the share of one part
MAX_ROUNDS = 20
MAX_LONGER = 5.0  # ratio of a step by the secant to a plain one
# Redundancy of a group of image points below which its variance component is not estimated.
MIN_REDUNDANCY = 1.0
IMAGE_POINTS = "image points"
INTERIOR = "interior orientation"
FEW_OF_A_KIND = 0.1  # the same for another kind, which may consist of a few scale bars only


@dataclass(frozen=True)
class VarianceComponents:
    """Variance factors of groups of image points."""

    names: tuple[str, ...]
    sigma0: FloatArray  # a posteriori over stated standard deviation, (g,); NaN with too little redundancy
    redundancy: FloatArray  # redundancy of each group, (g,)
    count: IntArray  # number of scalar observations in each group, (g,)


def variance_components(
    adjustment: Adjustment, group: IntArray, names: tuple[str, ...]
) -> VarianceComponents:
    """Return the variance factor of each group of image points, v'Pv over the group's redundancy.

    P belongs to the stated standard deviations, without the factor that the adjustment applied to them.

    Args:
        adjustment: finished adjustment.
        group: group of each image point, shape (k,).
        names: names of the groups, g of them.
    """
    covariance = adjustment.network.image_points.covariance
    return _components(adjustment, covariance, group, names, few=MIN_REDUNDANCY)


def _components(
    adjustment: Adjustment, covariance: FloatArray, group: IntArray, names: tuple[str, ...], *, few: float
) -> VarianceComponents:
    """Return the variance factor of each group of image points relative to given covariances, (k, 2, 2)."""
    g = len(names)
    used = ~adjustment.rejected
    v = adjustment.residuals[used]
    P = np.linalg.inv(covariance[used])
    squares = adjustment.weights[used] * (v * np.einsum("kab,kb->ka", P, v)).sum(axis=1)
    r = adjustment.redundancy_numbers[used].sum(axis=1)
    vPv, redundancy = (
        np.asarray(np.bincount(group[used], of, minlength=g), dtype=float) for of in (squares, r)
    )
    sigma0 = adjustment.inflation * _root_ratio(vPv, redundancy, few)
    return VarianceComponents(names, sigma0, redundancy, 2 * np.bincount(group[used], minlength=g))


def _root_ratio(vPv: FloatArray, redundancy: FloatArray, few: float) -> FloatArray:
    """Return sqrt(v'Pv / r) of groups, NaN where the redundancy is too small."""
    enough = redundancy > few
    return np.where(enough, np.sqrt(np.maximum(vPv, 0) / np.where(enough, redundancy, 1.0)), np.nan)


def by_photograph(adjustment: Adjustment) -> VarianceComponents:
    """Return the variance factor of each photograph.

    Args:
        adjustment: finished adjustment.
    """
    network = adjustment.network
    return variance_components(adjustment, network.image_points.image, network.images)


def by_camera(adjustment: Adjustment) -> VarianceComponents:
    """Return the variance factor of each camera; cameras that share parameters form one group.

    Args:
        adjustment: finished adjustment.
    """
    network = adjustment.network
    names, family = camera_families(adjustment.estimate.cameras, network.camera)
    return variance_components(adjustment, family[network.camera[network.image_points.image]], names)


def by_source(adjustment: Adjustment) -> VarianceComponents:
    """Return the variance factor of each source of image points.

    It is relative to what was stated of the source, before sources got their weights against one another.

    Args:
        adjustment: finished adjustment.
    """
    sources = adjustment.network.sources
    of_weights = variance_components(
        adjustment, adjustment.network.source, tuple(source.name for source in sources)
    )
    return replace(of_weights, sigma0=of_weights.sigma0 * [source.balance for source in sources])


def by_kind(adjustment: Adjustment) -> VarianceComponents:
    """Return the variance factor of each kind of observation.

    Kinds are image points and those of `Network.observations` that took part. The redundancies of all kinds
    add up to that of the adjustment.

    Args:
        adjustment: finished adjustment.
    """
    a, network = adjustment, adjustment.network
    groups = np.zeros(len(a.rejected), dtype=np.int64)
    image = _components(a, network.image_points.covariance, groups, (IMAGE_POINTS,), few=FEW_OF_A_KIND)
    squares: dict[str, FloatArray] = {}
    for observed_kind in a.observed:
        name = network.observations[observed_kind.index].name
        squares[name] = squares.get(name, np.zeros(3)) + np.array(
            [observed_kind.vPv, observed_kind.redundancy, observed_kind.count]
        )
    vPv, redundancies, count = np.array(list(squares.values())).reshape(-1, 3).T
    return VarianceComponents(
        (IMAGE_POINTS, *squares),
        np.concatenate([image.sigma0, _root_ratio(vPv, redundancies, FEW_OF_A_KIND)]),
        np.concatenate([image.redundancy, redundancies]),
        np.concatenate([image.count, count.astype(np.int64)]),
    )


def least_factor(stated_px: float) -> float:
    """Return the smallest factor on a stated standard deviation, which gives MIN_SIGMA_PX, but at most 1.

    Args:
        stated_px: stated standard deviation of image points, px.
    """
    return min(MIN_SIGMA_PX / stated_px, 1.0)


def estimate_components(
    adjust_with: Callable[[FloatArray], Adjustment],
    group: IntArray,
    names: tuple[str, ...],
    *,
    start: float = 1.0,
) -> tuple[Adjustment, FloatArray, bool]:
    """Return the adjustment with the weights of groups of image points estimated from the data.

    The standard deviations of each group are multiplied by the root of its variance factor, and the network
    is adjusted again, until the factors of the accepted image points are 1. Standard deviations do not fall
    below MIN_SIGMA_PX. If they reach that limit, the result has the standard deviations of sigma0 = 1.

    Args:
        adjust_with: adjusts a network from fixed start values with the factor on the stated standard
            deviations of each image point, (k,), and returns the adjustment.
        group: group of each image point, shape (k,).
        names: names of the groups, g of them.
        start: first factor.

    Returns:
        Last adjustment, standard deviation of each group over the stated one, shape (g,), and whether the
        factors converged. Factors may recur in a cycle because each weighting rejects other image points;
        then it is the adjustment of the cycle that rejects fewest.
    """
    factor = np.full(len(names), start)
    adjustment = adjust_with(factor[group])
    covariance = adjustment.network.image_points.covariance
    stated = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    least = np.array([least_factor(float(np.median(stated[group == g]))) for g in range(len(names))])
    tried, rejected, missing = [factor], [adjustment.rejected], list[FloatArray]()
    for _ in range(MAX_ROUNDS):
        sigma0 = _components(adjustment, adjustment.image_covariance, group, names, few=MIN_REDUNDANCY).sigma0
        sigma0 = np.where(np.isfinite(sigma0) & (sigma0 > 0), sigma0, 1.0)
        sigma0 = np.maximum(sigma0, least / factor)
        if np.abs(sigma0 - 1).max() <= LAST_CHANGE:
            at_least = (factor <= (1 + LAST_CHANGE) * least).any() and adjustment.sigma0 < 1
            # If image points are better than their weights, the a posteriori sigma0 would also scale the
            # standard deviations of control.
            if at_least and adjustment.sigma0 > 0:
                adjustment = replace(adjustment, sigma0=1.0, covariance=adjustment.cofactors)
            return adjustment, factor, True
        missing.append(np.log(sigma0))
        factor = np.maximum(factor * np.exp(_secant_steps(np.log(tried), missing)), least)
        # All rounds start from the same values, so the same factors lead to the same adjustments again: a
        # cycle, if other image points were rejected meanwhile.
        again = [
            at
            for at in range(len(tried))
            if np.abs(factor / tried[at] - 1).max() <= LAST_CHANGE
            and not all(np.array_equal(rejected[at], later) for later in rejected[at + 1 :])
        ]
        if again:
            chosen = min(range(again[-1], len(tried)), key=lambda at: int(rejected[at].sum()))
            if chosen < len(tried) - 1:
                adjustment = adjust_with(tried[chosen][group])
            return adjustment, tried[chosen], False
        adjustment = adjust_with(factor[group])
        tried.append(factor)
        rejected.append(adjustment.rejected)
    return adjustment, factor, False


def _secant_steps(tried: FloatArray, missing: list[FloatArray]) -> FloatArray:
    """Return the next steps of the logarithms of factors, (g,).

    A group with little of the redundancy gets its own variance factor only in part in each round, as its
    residuals follow its weights. The secant of the last two rounds says which part.

    Args:
        tried: logarithms of the factors of each round, (rounds, g).
        missing: logarithms of the variance factors found with them, (g,) each, which are to vanish.
    """
    if len(missing) < 2:
        return missing[-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        longer = (tried[-1] - tried[-2]) / (missing[-2] - missing[-1])
    longer = np.clip(np.where(np.isfinite(longer), longer, 1.0), 1.0, MAX_LONGER)
    return np.asarray(missing[-1] * longer)


def estimate_common_part(
    adjust_with: Callable[[FloatArray], Adjustment],
    covariance: FloatArray,
    common_px: float,
    *,
    rows: BoolArray | None = None,
) -> tuple[float, float]:
    """Return the factor on stated standard deviations of image points, and the sigma of a common part.

    The covariance of an image point is f^2 C + s^2 I. C is stated for each image point, for example by
    matching, and f is a common factor on it. The common part s covers effects that C does not contain, such
    as the shape of a surface inside a window or an unsteady lens. The squares of both are estimated from the
    residuals by Fisher scoring. The redundancy of an image point is assumed equal in all directions.

    Args:
        adjust_with: adjusts a network with covariances of its image points, px^2, (k, 2, 2).
        covariance: stated covariances C, px^2, (k, 2, 2).
        common_px: start value of s, px.
        rows: which image points of the adjusted network these are; all if not given.

    Returns:
        f, which may be 0, and s, at least MIN_SIGMA_PX; after MAX_ROUNDS the last values.

    Source: Koch (1999), Parameter Estimation and Hypothesis Testing in Linear Models, sec. 3.6 (iterated best
    invariant quadratic unbiased estimation).
    """
    parts = np.stack([covariance, np.broadcast_to(np.eye(2), covariance.shape)])
    squares = np.array([1.0, common_px**2])
    for _ in range(MAX_ROUNDS):
        C = np.einsum("p,pkab->kab", squares, parts)
        adjustment = adjust_with(C)
        of_parts = slice(None) if rows is None else rows
        used = ~adjustment.rejected[of_parts]
        P = np.linalg.inv(C[used])
        PV = P @ parts[:, used]
        Pv = np.einsum("kab,kb->ka", P, adjustment.residuals[of_parts][used])
        redundancy = adjustment.redundancy_numbers[of_parts][used].mean(axis=1)
        S = np.einsum("k,pkab,qkba->pq", redundancy, PV, PV)
        scores = np.einsum("ka,pkab,kb->p", Pv, parts[:, used], Pv)
        before, squares = squares, np.linalg.solve(S, scores)
        for row, other in ((0, 1), (1, 0)):
            if squares[row] < 0:  # 0 in its place
                squares[row], squares[other] = 0.0, scores[other] / S[other, other]
        change = np.sqrt(_median_trace(squares, parts) / _median_trace(before, parts)) - 1
        share = squares[1] / _median_trace(squares, parts) - before[1] / _median_trace(before, parts)
        if max(abs(change), abs(share)) <= LAST_CHANGE_OF_PARTS:
            break
    factor, common = np.sqrt(squares).tolist()
    return factor, max(common, MIN_SIGMA_PX)


def _median_trace(squares: FloatArray, parts: FloatArray) -> float:
    """Return the median variance of an image coordinate, px^2."""
    C = np.einsum("p,pkab->kab", squares, parts)
    return float(np.median(np.trace(C, axis1=1, axis2=2))) / 2
