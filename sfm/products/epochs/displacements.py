"""Displacements between two epochs in the datum of the stable points, with tests and their power.

`sfm.comparison.congruency` searches for the stable points. Every other point is tested in their datum, and
the level is divided among the points.

Source: Caspary (2000), Concepts of network and deformation analysis, secs. 7 and 8; Niemeier (2008),
Ausgleichungsrechnung, secs. 12.2 to 12.4; Baarda (1968) for the power of a test.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ncfdtr

from sfm.comparison.causes import Cause, find_cause
from sfm.comparison.congruency import Congruency, congruency
from sfm.comparison.stable_points import critical_value, point_blocks
from sfm.model.arguments import checked_arguments
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.distributions import FALSE_ALARM, POWER, chi2_isf
from sfm.products.epochs.differences import Differences

MAX_F_REDUNDANCY = 10**6  # redundancy above which Fisher's F is chi-square


@dataclass(frozen=True)
class Displacements:
    """Displacements between two epochs."""

    differences: Differences
    congruency: Congruency  # the search for the stable points, and the datum of those
    detectable: (
        FloatArray  # smallest displacement found with POWER, in the worst direction, object unit, (n,)
    )
    cause: Cause | None  # cause of the differences; None if single points moved, or without a cause
    alpha: float

    @property
    def reference(self) -> BoolArray:
        """Points that could carry the datum, (n,)."""
        return self.congruency.reference

    @property
    def stable(self) -> BoolArray:
        """Stable points; all reference points if no majority agrees, (n,)."""
        return self.congruency.stable

    @property
    def agreed(self) -> bool:
        """Whether a majority of the reference points agrees."""
        return self.congruency.agreed

    @property
    def moved(self) -> BoolArray:
        """Points that do not agree with the stable ones, (n,)."""
        return self.congruency.moved

    @property
    def displacement(self) -> FloatArray:
        """Displacements in the datum of the stable points, object unit, (n, 3)."""
        return self.congruency.difference

    @property
    def covariance(self) -> FloatArray:
        """Joint covariance of all displacements, object unit^2, (3 n, 3 n)."""
        return self.congruency.covariance

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the displacements, object unit, (n, 3)."""
        variance = np.diagonal(self.covariance).reshape(-1, 3)
        return np.asarray(np.sqrt(variance.clip(0)))

    @property
    def undecided(self) -> BoolArray:
        """Reference points that are not stable, but did not move by the test of each, (n,)."""
        return self.reference & ~self.stable & ~self.moved

    @property
    def changed(self) -> bool:
        """Whether anything moved."""
        return bool(self.moved.any()) or not self.agreed or self.cause is not None


@checked_arguments()
def find_displacements(
    differences: Differences, *, reference: BoolArray | None = None, alpha: float = FALSE_ALARM
) -> Displacements:
    """Test which points moved.

    Args:
        differences: the differences of two epochs.
        reference: points that are assumed stable until a test shows otherwise, (n,); all if not given.
        alpha: probability of reporting a displacement if nothing moved.

    Raises:
        GeometryError: fewer than four reference points, or a covariance that is singular beyond its datum.
    """
    tested = congruency(
        differences.difference,
        differences.covariance,
        differences.xyz,
        motion=differences.motion,
        redundancy=differences.redundancy,
        reference=reference,
        alpha=alpha,
    )
    # A stable point is tested by the drop of Omega, any other point by a separate test in the datum.
    shift = {a: detectable_shift(a, POWER, 3, differences.redundancy) for a in set(tested.level.tolist())}
    variance = point_blocks(tested.covariance, 3)
    variance[tested.stable] = np.linalg.inv(tested.weights[tested.stable])
    worst = np.sqrt(np.linalg.eigvalsh(variance)[:, -1].clip(0))
    return Displacements(
        differences=differences,
        congruency=tested,
        detectable=worst * np.array([shift[a] for a in tested.level.tolist()]),
        cause=find_cause(
            differences.pairs,
            reference=tested.reference,
            changed=not (tested.agreed and tested.stable[tested.reference].all()),
            deforms=True,
        ),
        alpha=alpha,
    )


def detectable_shift(alpha: float, power: float, m: int, redundancy: int | None) -> float:
    """Return the displacement, in standard deviations, that a test of m coordinates finds with a given power.

    Args:
        alpha: level of the test.
        power: probability of finding the displacement.
        m: number of coordinates that are tested together.
        redundancy: redundancy of the variance; None if the variance is known.

    Returns:
        The square root of the noncentrality.

    Source: Baarda (1968), A testing procedure for use in geodetic networks, sec. 4.
    """
    freedom = min(MAX_F_REDUNDANCY, redundancy or MAX_F_REDUNDANCY)
    limit = critical_value(alpha, m, redundancy)
    low, high = 0.0, 4 * float(chi2_isf(alpha, m)) + 100.0
    for _ in range(60):
        middle = (low + high) / 2
        missed = float(ncfdtr(m, freedom, middle, limit))
        low, high = (middle, high) if missed > 1 - power else (low, middle)
    return math.sqrt(high)
