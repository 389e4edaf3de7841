"""How well the observations agree with one another: residuals in standard deviations, checks at control.

What a verdict rests on. Standard deviations are those stated before the adjustment; sigma0 tells by how
much they were wrong, and must not hide it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.engine.observed_unknowns import observed
from sfm.adjustment.quality.variance_components import IMAGE_POINTS, variance_components
from sfm.adjustment.result import Adjustment
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.report.markup import finer_unit, significant
from sfm.result import ControlCheck, SurveyResult

TOLD_APART = 0.01  # relative difference from which sigma0 of the image points is told beside that of all
MEDIAN_LENGTH = 1.1774  # median length of a normal vector in the plane over its sigma: sqrt(2 ln 2)


@dataclass(frozen=True)
class ObservationCounts:
    """Scalar observations of an adjustment by type."""

    image: int  # image coordinates that were accepted
    control: int  # weighted coordinates of control; fixed ones are no observations
    exterior: int  # observed parameters of exterior orientation
    interior: int  # observed parameters of interior orientation
    scale_bars: int
    constraints: int  # of the datum
    total: int  # without the constraints


@dataclass(frozen=True)
class WorstResiduals:
    """The accepted image points with the largest standardised residuals."""

    row: IntArray  # index among the image points, (w,)
    v: FloatArray  # residual, px, (w, 2)
    w: FloatArray  # Baarda's w of the worse coordinate, (w,)
    tau: FloatArray  # Pope's tau of the same coordinate, (w,)


def sigma0_ratio(result: SurveyResult) -> float:
    """Return the a posteriori over the stated a priori standard deviation of the image coordinates.

    By the variance component of the image points alone; without redundancy of their own it is sigma0 of all
    observations.
    """
    a = result.adjustment
    own = variance_components(a, np.zeros(len(a.rejected), dtype=np.int64), (IMAGE_POINTS,)).sigma0[0]
    return float(own if np.isfinite(own) else a.sigma0_px / a.stated_px)


def words_of_sigma0(result: SurveyResult) -> tuple[str, str]:
    """Return sigma0 and what it is to the stated one, with the image points where they show another.

    Sigma0 is that of all observations together, so that control that contradicts the photographs raises it
    above what their residuals show.
    """
    a, ratio = result.adjustment, sigma0_ratio(result)
    stated = a.stated_px
    own, times = ratio * stated, f"{ratio:.3f} times the {significant(stated)} px expected"
    if not abs(a.sigma0_px - own) > TOLD_APART * own:
        return f"{a.sigma0_px:.4f} px", times
    return f"{a.sigma0_px:.4f} px", f"of all observations; image points by themselves {own:.4f} px, {times}"


def longest_residual(adjustment: Adjustment) -> tuple[float, int]:
    """Return the longest residual in standard deviations, and its index; (0, -1) without image points.

    A residual of a reweighted image point counts as much as it did in the adjustment. The standard
    deviation is the a priori one, or that which the median of the residuals shows if it is larger, so
    that a cautious guess of it makes no good image point an outlier.
    """
    used = np.flatnonzero(~adjustment.rejected)
    if not len(used):
        return 0.0, -1
    v = adjustment.residuals[used]
    P = np.linalg.inv(adjustment.image_covariance[used])
    length = np.sqrt(np.einsum("ka,kab,kb->k", v, P, v))
    if len(adjustment.weights):
        length = length * np.sqrt(adjustment.weights[used])
    shown = float(np.median(length)) / MEDIAN_LENGTH
    worst = int(np.argmax(length))
    return float(length[worst] / max(1.0, shown)), int(used[worst])


def count_observations(adjustment: Adjustment) -> ObservationCounts:
    """Return how many observations of each type took part."""
    network = adjustment.network
    image = 2 * int((~adjustment.rejected).sum())
    control = 0
    if adjustment.datum == "control":
        control = int(observed(_variances(network.control.covariance)).sum())
    exterior = int(observed(_variances(network.exterior.covariance)).sum())
    sigma = network.interior.sigma
    interior = int(((sigma > 0) & np.isfinite(sigma)).sum())
    bars = adjustment.observations - image - control - exterior - interior
    return ObservationCounts(
        image,
        control,
        exterior,
        interior,
        bars,
        adjustment.redundancy - adjustment.observations + adjustment.unknowns,
        adjustment.observations,
    )


def worst_residuals(adjustment: Adjustment, count: int = 10) -> WorstResiduals:
    """Return the accepted image points with the largest standardised residuals, largest first."""
    if len(adjustment.standardised) != len(adjustment.rejected):
        none = np.zeros(0)
        return WorstResiduals(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), none, none)
    w = np.nan_to_num(np.abs(adjustment.standardised))
    size = np.where(adjustment.rejected, -1.0, w.max(axis=1, initial=0.0))
    row = np.argsort(-size, kind="stable")[: min(count, int((~adjustment.rejected).sum()))]
    axis = np.argmax(w[row], axis=1)
    return WorstResiduals(
        row, adjustment.residuals[row], adjustment.standardised[row, axis], adjustment.tau[row, axis]
    )


def check_over_sigma(result: SurveyResult, check: ControlCheck) -> tuple[FloatArray, BoolArray]:
    """Return the largest coordinate of each difference at control over its expected standard deviation, (n,).

    Expected are the precision of the adjusted point, its mean over the axes, and that of the control
    together. The second array says which control states standard deviations, (n,).
    """
    a = result.adjustment
    control = a.network.control
    place = {a.network.points[j]: k for k, j in enumerate(control.point)}
    known = [place[name] for name in check.points if name in place]
    if len(known) != len(check.points):
        return np.full(len(check.points), np.nan), np.zeros(len(check.points), dtype=bool)
    given = _variances(control.covariance[known])
    given = np.where(np.isfinite(given), given, np.nan)
    adjusted = _variances(a.covariance.points[control.point[known]])
    expected = np.sqrt(np.nan_to_num(given) + adjusted.mean(axis=1)[:, None])
    ratio = _ratio(np.abs(check.differences), expected, expected > 0)
    return ratio.max(axis=1), np.asarray(np.nansum(given, axis=1) > 0)


def words_of_check(check: ControlCheck, unit: str) -> str:
    """Return how far the placed points are from control that took no part.

    Args:
        check: the differences.
        unit: object unit.
    """
    length = np.linalg.norm(check.differences, axis=1)
    worst = int(np.argmax(length))
    factor, finer = finer_unit(unit, float(length[worst]))
    rms = ", ".join(significant(value * factor) for value in check.rms)
    return (
        f"RMS {rms} {finer} in X, Y, Z at {len(check.points)} points; largest "
        f"{significant(float(length[worst]) * factor)} {finer} at {check.points[worst]}"
    )


def object_size(points: FloatArray) -> float:
    """Return the diagonal of the box around points, object unit."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def _variances(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("nii->ni", covariance))


def _ratio(difference: FloatArray, sigma: FloatArray, known: BoolArray) -> FloatArray:
    return np.asarray(np.where(known, difference / np.where(known, sigma, 1.0), np.nan))
