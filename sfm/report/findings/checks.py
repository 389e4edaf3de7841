"""How well the observations agree with one another: residuals in standard deviations, checks at control.

The basis of a verdict. Standard deviations are those stated before the adjustment; sigma0 shows by how
much they were wrong, and must not hide it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm.adjustment.quality.variance_components import IMAGE_POINTS, variance_components
from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray
from sfm.observations.kind import is_observed
from sfm.result import SurveyResult

MAX_LISTED = 10  # largest residuals
TOLD_APART = 0.01  # relative difference from which sigma0 of the image points is stated beside that of all
MEDIAN_LENGTH = 1.1774  # median length of a normal vector in the plane over its sigma: sqrt(2 ln 2)


@dataclass(frozen=True)
class ObservationCounts:
    """Scalar observations of an adjustment by type."""

    image: int  # image coordinates that were accepted
    control: int  # weighted coordinates of control; fixed ones are no observations
    exterior: int  # observed parameters of exterior orientation
    interior: int  # observed parameters of interior orientation
    scale_bars: int
    further: int  # of other kinds, less the parameters that these add
    constraints: int  # of the datum
    total: int  # without the constraints


@dataclass(frozen=True)
class Sigma0:
    """Standard deviation of an image coordinate, a posteriori and as stated."""

    px: float  # a posteriori, of all observations together: control that contradicts raises it, px
    ratio: float  # of the image points by themselves, a posteriori over that stated
    stated_px: float  # a priori, px
    pixel_mm: float = float("nan")  # mean size of a pixel over the image points, mm

    @property
    def mm(self) -> float:
        """A posteriori, of all observations together, on the sensor, mm."""
        return self.px * self.pixel_mm

    @property
    def image_points_px(self) -> float:
        """A posteriori, of the image points by themselves, px."""
        return self.ratio * self.stated_px

    @property
    def differs(self) -> bool:
        """Whether the image points by themselves show another one than all observations."""
        return abs(self.px - self.image_points_px) > TOLD_APART * self.image_points_px


@dataclass(frozen=True)
class LongestResidual:
    """The accepted image point whose residual is the longest in standard deviations."""

    image: str
    point: str
    length_px: float
    over_sigma: float  # its length in standard deviations, times the factor on its weight
    weight: float  # factor on its weight, below 1 by reweighting


def sigma0_of(result: SurveyResult) -> Sigma0:
    """Return sigma0 of all observations, and of the image points by themselves.

    The latter is by the variance component of the image points; without redundancy of theirs it is sigma0
    of all observations.
    """
    a = result.adjustment
    factor = variance_components(a, np.zeros(len(a.rejected), dtype=np.int64), (IMAGE_POINTS,)).sigma0[0]
    ratio = float(factor if np.isfinite(factor) else a.sigma0_px / a.stated_px)
    size = np.array([camera.pixel_mm.mean() for camera in a.estimate.cameras])
    used = a.network.camera[a.network.image_points.image[~a.rejected]]
    return Sigma0(a.sigma0_px, ratio, a.stated_px, float(size[used].mean()) if len(used) else float("nan"))


def longest_residual(adjustment: Adjustment) -> LongestResidual:
    """Return the longest residual in standard deviations; of length 0 without image points.

    A residual of a reweighted image point counts by its influence, weight times length, which Huber's weights
    bound. The standard
    deviation is the a priori one, or that which the median of the residuals shows if it is larger, so
    that a cautious guess of it makes no good image point an outlier.
    """
    used, seen = np.flatnonzero(~adjustment.rejected), adjustment.network.image_points
    if not len(used):
        return LongestResidual("", "", 0.0, 0.0, 1.0)
    v = adjustment.residuals[used]
    P = np.linalg.inv(adjustment.image_covariance[used])
    length = np.sqrt(np.einsum("ka,kab,kb->k", v, P, v))
    if len(adjustment.weights):
        length = length * adjustment.weights[used]
    shown = float(np.median(length)) / MEDIAN_LENGTH
    worst = int(np.argmax(length))
    row = int(used[worst])
    return LongestResidual(
        adjustment.network.images[seen.image[row]],
        adjustment.network.points[seen.point[row]],
        float(np.linalg.norm(adjustment.residuals[row])),
        float(length[worst] / max(1.0, shown)),
        float(adjustment.weights[row]) if len(adjustment.weights) else 1.0,
    )


def count_observations(adjustment: Adjustment) -> ObservationCounts:
    """Return how many observations of each type took part."""
    network = adjustment.network
    image = 2 * int((~adjustment.rejected).sum())
    control = 0
    if adjustment.datum == "control":
        control = int(is_observed(_variances(network.control.covariance)).sum())
    exterior = int(is_observed(_variances(network.exterior.covariance)).sum())
    sigma = network.interior.sigma
    interior = int(((sigma > 0) & np.isfinite(sigma)).sum())
    first = len(network.kinds) - len(network.observations)
    further = sum(one.count for one in adjustment.observed if one.index >= first)
    bars = adjustment.observations - image - control - exterior - interior - further
    return ObservationCounts(
        image,
        control,
        exterior,
        interior,
        bars,
        further,
        adjustment.redundancy - adjustment.observations + adjustment.unknowns,
        adjustment.observations,
    )


def largest_residuals(adjustment: Adjustment, count: int = MAX_LISTED) -> tuple[tuple[Any, ...], ...]:
    """Return the accepted image points with the largest standardised residuals, largest first.

    Returns:
        Photograph, point, residuals vx and vy, px, Baarda's w of the worse coordinate and Pope's tau of it.
    """
    a, seen = adjustment, adjustment.network.image_points
    if len(a.standardised) != len(a.rejected):
        return ()
    w = np.nan_to_num(np.abs(a.standardised))
    size = np.where(a.rejected, -1.0, w.max(axis=1, initial=0.0))
    rows = np.argsort(-size, kind="stable")[: min(count, int((~a.rejected).sum()))]
    names = [(a.network.images[seen.image[k]], a.network.points[seen.point[k]]) for k in rows]
    worse = np.argmax(w[rows], axis=1)
    tests = np.column_stack([a.residuals[rows], a.standardised[rows, worse], a.tau[rows, worse]]).tolist()
    return tuple((*name, *test) for name, test in zip(names, tests, strict=True))


def _variances(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("nii->ni", covariance))
