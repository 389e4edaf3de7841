"""Agreement of observations with one another and with control.

These checks are the basis of a verdict. Standard deviations are those stated before the adjustment; sigma0
shows by how much they were wrong, and must not hide it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm.adjustment.quality.variance_components import IMAGE_POINTS, variance_components
from sfm.adjustment.result import Adjustment, computed_once
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import FloatArray

TOLD_APART = 0.01  # relative difference beyond which sigma0 of the image points is stated separately
MEDIAN_LENGTH = 1.1774  # median length of a normal vector in the plane over its sigma: sqrt(2 ln 2)


@dataclass(frozen=True)
class Sigma0:
    """Standard deviation of an image coordinate: a posteriori, and as stated."""

    px: float  # a posteriori, from all observations together, px; contradictory control raises it
    ratio: float  # a posteriori over stated, from the image points alone
    stated_px: float  # a priori, px
    pixel_mm: float = float("nan")  # mean size of a pixel over the image points, mm

    @property
    def mm(self) -> float:
        """Sigma0 a posteriori of all observations together, on the sensor, mm."""
        return self.px * self.pixel_mm

    @property
    def image_points_px(self) -> float:
        """Sigma0 a posteriori of the image points alone, px."""
        return self.ratio * self.stated_px

    @property
    def differs(self) -> bool:
        """Return whether sigma0 of the image points alone differs from that of all observations."""
        return abs(self.px - self.image_points_px) > TOLD_APART * self.image_points_px


class ControlCoordinate(NamedTuple):
    """A coordinate of a control or check point, before and after the adjustment."""

    use: str  # control | check
    point: str
    coordinate: str
    given: float  # object unit
    prior: float  # stated standard deviation, 0 fixed, object unit
    adjusted: float  # object unit
    posterior: float  # standard deviation of the adjusted coordinate, object unit
    difference: float  # adjusted minus given, object unit
    test: float  # difference over its expected standard deviation, NaN if nothing checks it


@dataclass(frozen=True)
class LongestResidual:
    """The accepted image point with the longest residual in standard deviations."""

    image: str
    point: str
    length_px: float
    over_sigma: float  # length in standard deviations, multiplied by the factor on its weight
    weight: float  # factor on its weight, below 1 after reweighting


@computed_once
def sigma0_of(adjustment: Adjustment) -> Sigma0:
    """Return sigma0 of all observations, and of the image points alone.

    Sigma0 of the image points comes from their variance component. If they have no redundancy, it is sigma0
    of all observations.
    """
    a = adjustment
    factor = variance_components(a, np.zeros(len(a.rejected), dtype=np.int64), (IMAGE_POINTS,)).sigma0[0]
    ratio = float(factor if np.isfinite(factor) else a.sigma0_px / a.stated_px)
    size = np.array([camera.pixel_mm.mean() for camera in a.estimate.cameras])
    used = a.network.camera[a.network.image_points.image[~a.rejected]]
    return Sigma0(a.sigma0_px, ratio, a.stated_px, float(size[used].mean()) if len(used) else float("nan"))


def longest_residual(adjustment: Adjustment) -> LongestResidual:
    """Return the longest residual in standard deviations; its length is 0 without image points.

    The residual of a reweighted image point counts by its influence, weight times length, which Huber's
    weights bound. The standard deviation is the a priori one, or the one that the median of the residuals
    shows if that is larger. A cautious a priori value therefore makes no good image point an outlier.
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


def root_mean_square(values: FloatArray) -> float:
    """Return the root mean square of the known values, NaN if none is known."""
    return float(root_mean_squares_of_rows(values.reshape(1, -1))[0])


def root_mean_squares_of_rows(values: FloatArray) -> FloatArray:
    """Return the root mean square of the known values of each row, (n, d), NaN where none is known, (n,)."""
    known = np.isfinite(values)
    squares, count = (np.where(known, values, 0.0) ** 2).sum(axis=1), known.sum(axis=1)
    return np.asarray(np.sqrt(np.where(count > 0, squares, np.nan) / np.maximum(count, 1)))


def standard_deviations(covariance: FloatArray) -> FloatArray:
    """Return standard deviations of covariance matrices (..., d, d), shape (..., d)."""
    diagonal = np.einsum("...ii->...i", covariance)
    return np.asarray(np.sqrt(np.where(diagonal >= 0, diagonal, np.nan)))


def check_coordinates(result: SurveyResult, *, placed: bool = False) -> tuple[ControlCoordinate, ...]:
    """Return the coordinates that check a datum of control, with the test of their differences.

    If asked for, those that check a network placed on its control, too; their standard deviations do not
    include those of the placing.
    """
    a = result.adjustment
    compared = a.datum == "control" or (placed and result.control_check is not None)
    index_of = {name: j for j, name in enumerate(a.network.points)}
    posterior = standard_deviations(a.covariance.points)
    points = a.estimate.points
    return tuple(
        compare_coordinate(
            point.point, c, given, point.sigma[c], points[j, c], posterior[j, c], points[j, c] - given
        )
        for point in (result.check_points if compared else ())
        if (j := index_of.get(point.point)) is not None
        for c, given in enumerate(point.xyz)
        if np.isfinite(given)
    )


def compare_coordinate(
    point: str, c: int, given: float, prior: float, adjusted: float, posterior: float, difference: float
) -> ControlCoordinate:
    """Return coordinate c, 0, 1 or 2 for X, Y or Z, of a point that took no part, as a `ControlCoordinate`.

    Its difference is tested against its expected standard deviation.
    """
    expected = float(np.hypot(prior, posterior))
    test = difference / expected if expected > 0 else np.nan
    numbers = map(float, (given, prior, adjusted, posterior, difference, test))
    return ControlCoordinate("check", point, "XYZ"[c], *numbers)
