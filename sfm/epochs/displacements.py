"""Displacements between two epochs in the datum of the points that did not move, tested and with their power.

The global test says whether the points taken as reference are congruent in both epochs at all. If they are
not, those that moved are removed one by one, once from all of them and once from those that a robust
alignment leaves; the larger set that agrees is proposed. Every other point is then tested in that datum, with
the level shared out among the points.

Source: Caspary (2000), Concepts of network and deformation analysis, secs. 7 and 8; Niemeier (2008),
Ausgleichungsrechnung, secs. 12.2 to 12.4; Baarda (1968) for the power of a test.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ncfdtr

from sfm.adjustment.quality.statistics import POWER
from sfm.comparison.congruency import MIN_STABLE, STABLE_FRACTION, bending, smooth_fraction
from sfm.comparison.stable_points import (
    StablePoints,
    critical_value,
    find_stable_points,
    in_datum,
    point_blocks,
    robust_weights,
    single_tests,
)
from sfm.conventions import BoolArray, FloatArray
from sfm.distributions import chi2_isf
from sfm.epochs.differences import Differences
from sfm.errors import GeometryError

ALPHA = 0.05  # level of all tests of a pair of epochs together
RANK = 1e-6  # of the largest singular value below which the points of reference are on a line
MANY = 10**6  # redundancy above which Fisher's F is chi-square


@dataclass(frozen=True)
class Displacements:
    """What moved between two epochs."""

    differences: Differences
    reference: BoolArray  # points that could carry the datum, (n,)
    search: StablePoints  # from all points of reference
    robust: StablePoints | None  # from those that a robust alignment leaves; None where all agree
    stable: BoolArray  # the set that is proposed, (n,)
    agreed: bool  # whether a majority of the reference agrees
    displacement: FloatArray  # in the datum of the stable points, object unit, (n, 3)
    covariance: FloatArray  # of all displacements together, object unit^2, (3 n, 3 n)
    statistic: FloatArray  # T of each point: its drop of Omega if it is stable, else its own test, (n,)
    critical: FloatArray  # of T, the level shared out, (n,)
    moved: BoolArray  # (n,)
    detectable: (
        FloatArray  # smallest displacement, in its worst direction, found with POWER, object unit, (n,)
    )
    smooth: float  # fraction of Omega of the reference that a bending of the whole takes away
    alpha: float

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the displacements, object unit, (n, 3)."""
        variance = np.diagonal(self.covariance).reshape(-1, 3)
        return np.asarray(np.sqrt(variance.clip(0)))

    @property
    def undecided(self) -> BoolArray:
        """Points of reference that left the stable set, and did not move by their own test, (n,)."""
        return self.reference & ~self.stable & ~self.moved

    @property
    def changed(self) -> bool:
        """Whether anything moved."""
        return bool(self.moved.any()) or not self.agreed


def displacements(
    found: Differences, *, reference: BoolArray | None = None, alpha: float = ALPHA
) -> Displacements:
    """Test which points moved.

    Half of alpha is spent on the test of all points together and half on single points.

    Args:
        found: the differences of two epochs.
        reference: points that are taken as stable until a test says otherwise, (n,); all if not given.
        alpha: probability of saying that something moved where nothing did.

    Raises:
        GeometryError: fewer than four points of reference, or a covariance that is singular beyond its datum.
    """
    n = len(found.points)
    every = np.ones(n, dtype=bool)
    candidates = every if reference is None else reference
    first = int(candidates.sum())
    if first < MIN_STABLE:
        raise GeometryError(f"epochs: {first} points of reference, expected {MIN_STABLE} or more")
    d, Q, G = found.difference, found.covariance, found.motions
    if np.linalg.matrix_rank(G[np.repeat(candidates, 3)], tol=RANK * np.linalg.norm(G, 2)) < G.shape[1]:
        raise GeometryError("epochs: the points of reference lie on a line, which holds no rotation about it")
    least = max(MIN_STABLE, math.ceil(STABLE_FRACTION * first))

    def search(start: BoolArray) -> StablePoints:
        return find_stable_points(
            *(d, Q, G),
            candidates=start,
            least=least,
            redundancy=found.redundancy,
            alpha=alpha / 2,
            alpha_single=alpha / 2,
        )

    whole = search(candidates)
    robust = None
    if len(whole.steps) > 1:
        robust = _from_robust_start(found, candidates, least, alpha, search)
    best = whole
    if (
        robust is not None
        and robust.agreed
        and (not whole.agreed or robust.stable.sum() > whole.stable.sum())
    ):
        best = robust
    smooth = 0.0 if best.agreed else smooth_fraction(d, Q, G, bending(found.xyz), candidates)
    d_S, Q_S = in_datum(d, Q, G, best.stable.astype(float))
    T = np.where(best.stable, best.drops, single_tests(d_S, Q_S))
    level = np.where(candidates, alpha / 2 / first, alpha / 2 / max(1, n - first))
    critical = np.array([critical_value(a, 3, found.redundancy) for a in level.tolist()])
    return Displacements(
        differences=found,
        reference=candidates,
        search=whole,
        robust=robust,
        stable=best.stable,
        agreed=best.agreed,
        displacement=d_S,
        covariance=Q_S,
        statistic=T,
        critical=critical,
        moved=~best.stable & (critical < T) & best.agreed,
        detectable=_detectable(Q_S, best, level, found),
        smooth=smooth,
        alpha=alpha,
    )


def detectable_shift(alpha: float, power: float, m: int, redundancy: int | None) -> float:
    """Return the displacement, in standard deviations, that a test of m coordinates finds with a power.

    Args:
        alpha: level of the test.
        power: probability of finding it.
        m: coordinates that are tested together.
        redundancy: of the variance; None if it is known.

    Returns:
        The square root of the noncentrality.

    Source: Baarda (1968), A testing procedure for use in geodetic networks, sec. 4.
    """
    freedom = min(MANY, redundancy or MANY)
    limit = critical_value(alpha, m, redundancy)
    low, high = 0.0, 4 * float(chi2_isf(alpha, m)) + 100.0
    for _ in range(60):
        middle = (low + high) / 2
        missed = float(ncfdtr(m, freedom, middle, limit))
        low, high = (middle, high) if missed > 1 - power else (low, middle)
    return math.sqrt(high)


def _from_robust_start(
    found: Differences,
    candidates: BoolArray,
    least: int,
    alpha: float,
    search: Callable[[BoolArray], StablePoints],
) -> StablePoints | None:
    """Search from the points that fit a robust alignment; None where those are too few."""
    weight = robust_weights(found.difference, found.motions, candidates)
    T = single_tests(*in_datum(found.difference, found.covariance, found.motions, weight))
    fits = candidates & ~(critical_value(alpha / 2 / int(candidates.sum()), 3, found.redundancy) < T)
    if fits.sum() < least:
        return None
    return search(fits)


def _detectable(Q: FloatArray, best: StablePoints, alpha: FloatArray, found: Differences) -> FloatArray:
    """Return the smallest displacement of each point that would be found, in its worst direction, (n,).

    A stable point is found by the drop of Omega, another one by its own test in the datum.
    """
    shift = {a: detectable_shift(a, POWER, 3, found.redundancy) for a in set(alpha.tolist())}
    variance = point_blocks(Q, 3)
    variance[best.stable] = np.linalg.inv(best.weights[best.stable])
    worst = np.sqrt(np.linalg.eigvalsh(variance)[:, -1].clip(0))
    return np.asarray(worst * np.array([shift[a] for a in alpha.tolist()]))
