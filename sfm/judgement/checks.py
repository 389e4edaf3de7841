"""Agreement of observations with one another and with control, and precision of unknowns.

These checks are the basis of a verdict. Standard deviations are those stated before the adjustment; sigma0
shows by how much they were wrong, and must not hide it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sfm.adjustment.quality.variance_components import IMAGE_POINTS, variance_components
from sfm.adjustment.result import Adjustment, computed_once
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.observations.kind import is_observed

MAX_LISTED = 10  # largest residuals
TOLD_APART = 0.01  # relative difference beyond which sigma0 of the image points is stated separately
MEDIAN_LENGTH = 1.1774  # median length of a normal vector in the plane over its sigma: sqrt(2 ln 2)


@dataclass(frozen=True)
class ObservationCounts:
    """Number of scalar observations in an adjustment by type."""

    image: int  # accepted image coordinates
    control: int  # weighted coordinates of control; fixed ones are not observations
    exterior: int  # observed parameters of exterior orientation
    interior: int  # observed parameters of interior orientation
    scale_bars: int
    further: int  # of other kinds, less the parameters that these kinds add
    constraints: int  # datum constraints
    total: int  # without the constraints


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


def count_observations(adjustment: Adjustment) -> ObservationCounts:
    """Return the number of observations of each type that took part."""
    network = adjustment.network
    image = 2 * int((~adjustment.rejected).sum())
    control = 0
    if adjustment.datum == "control":
        control = int(is_observed(np.diagonal(network.control.covariance, axis1=1, axis2=2)).sum())
    exterior = int(is_observed(np.diagonal(network.exterior.covariance, axis1=1, axis2=2)).sum())
    sigma = network.interior.sigma
    interior = int(((sigma > 0) & np.isfinite(sigma)).sum())
    first = len(network.observations) - len(network.further)
    further = sum(part.count for part in adjustment.observed if part.index >= first)
    bars = adjustment.observations - image - control - exterior - interior - further
    return ObservationCounts(
        image,
        control,
        exterior,
        interior,
        bars,
        further,
        adjustment.redundancy + adjustment.discount - adjustment.observations + adjustment.unknowns,
        adjustment.observations,
    )


def largest_residuals(adjustment: Adjustment, count: int = MAX_LISTED) -> tuple[tuple[Any, ...], ...]:
    """Return the accepted image points with the largest standardised residuals, largest first.

    Returns:
        Photograph, point, residuals vx and vy, px, and Baarda's w and Pope's tau of the worse coordinate.
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


@dataclass(frozen=True)
class Precision:
    """Standard deviations of points and photographs: of X, Y, Z or omega, phi, kappa, and of all together."""

    points: FloatArray  # of each coordinate, 0 where fixed, object unit, (n, 3)
    limiting_points: FloatArray  # the same if the cameras are free of error
    exterior: FloatArray  # of each photograph, object unit and rad, (m, 6)
    rms: FloatArray  # of the points, object unit, (4,)
    largest: FloatArray  # of the points, object unit, (4,)
    limiting: FloatArray  # RMS of the points if the cameras are free of error, object unit, (4,)
    centres: FloatArray  # RMS of the projection centres, object unit, (4,)
    angles: FloatArray  # RMS of omega, phi, kappa, rad, (4,)
    fixed_points: int  # points with fixed coordinates, from control or a minimal datum

    @property
    def exterior_deg(self) -> FloatArray:
        """Standard deviations of each photograph, object unit and deg, (m, 6)."""
        return np.asarray(self.exterior * np.repeat([1.0, np.degrees(1.0)], 3))


def precision_of(adjustment: Adjustment) -> Precision:
    """Return the precision of the unknowns."""
    covariance = adjustment.covariance
    exterior = adjusted_sigmas(covariance.exterior)
    rms, largest_of_all, limiting = point_precision(adjustment)
    return Precision(
        standard_deviations(covariance.points),
        standard_deviations(covariance.points_limiting),
        standard_deviations(covariance.exterior),
        rms,
        largest_of_all,
        limiting,
        root_mean_squares(exterior[:, :3]),
        root_mean_squares(exterior[:, 3:]),
        int((np.einsum("nii->ni", covariance.points) == 0).any(axis=1).sum()),
    )


def adjusted_sigmas(covariance: FloatArray) -> FloatArray:
    """Return standard deviations from covariances (n, d, d), NaN where fixed or not known, (n, d)."""
    variance = np.einsum("nii->ni", covariance)
    adjusted = variance > 0
    return np.asarray(np.where(adjusted, np.sqrt(np.where(adjusted, variance, 1.0)), np.nan))


def point_precision(adjustment: Adjustment) -> FloatArray:
    """Return RMS, largest, and RMS limiting standard deviation of X, Y, Z and all, object unit, (3, 4).

    The limiting precision assumes cameras free of error. NaN if no coordinate was adjusted.
    """
    sigma = adjusted_sigmas(adjustment.covariance.points)
    limiting = adjusted_sigmas(adjustment.covariance.points_limiting)
    return np.array([root_mean_squares(sigma), largest(sigma), root_mean_squares(limiting)])


def root_mean_squares(values: FloatArray) -> FloatArray:
    """Return the root mean square of the known values of each column (n, d) and of all, (d + 1,)."""
    return np.array([root_mean_square(column) for column in (*values.T, values)])


def root_mean_square(values: FloatArray) -> float:
    """Return the root mean square of the known values, NaN if none is known."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def rms_of_groups(index: IntArray, v: FloatArray, count: int) -> FloatArray:
    """Return the RMS residual per coordinate of each photograph or point, px, NaN if unknown, (n,).

    Args:
        index: photograph or point of each image point, (k,).
        v: residuals, NaN where not known, px, (k, 2).
        count: number of photographs or points, n.
    """
    known = np.isfinite(v).all(axis=1)
    number = np.bincount(index[known], minlength=count)
    total = np.bincount(index[known], weights=(v[known] ** 2).sum(axis=1), minlength=count)
    mean = np.divide(total, 2 * number, out=np.full(count, np.nan), where=number > 0)
    return np.asarray(np.sqrt(mean))


def largest(values: FloatArray) -> FloatArray:
    """Return the largest known value of each column (n, d) and of all, (d + 1,)."""
    columns = np.where(np.isfinite(values), values, -np.inf).max(axis=0, initial=-np.inf)
    maxima = np.array([*columns, columns.max()])
    return np.asarray(np.where(np.isfinite(maxima), maxima, np.nan))


def point_sigma(covariance: FloatArray) -> tuple[float, float]:
    """Return RMS and largest known standard deviation of points of covariances (n, 3, 3), NaN if unknown."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    known = sigma[np.isfinite(sigma)]
    return root_mean_square(sigma), float(known.max()) if len(known) else float("nan")


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
