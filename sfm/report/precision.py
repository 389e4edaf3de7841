"""Observations, largest residuals and precision of an adjustment, as pages state them.

Standard deviations are those stated before the adjustment; sigma0 shows by how much they were wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.judgement.checks import root_mean_square, standard_deviations
from sfm.model.conventions import FloatArray
from sfm.model.observations.kind import is_observed

MAX_LISTED = 10  # largest residuals


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


def point_sigma(covariance: FloatArray) -> tuple[float, float]:
    """Return RMS and largest known standard deviation of points of covariances (n, 3, 3), NaN if unknown."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    known = sigma[np.isfinite(sigma)]
    return root_mean_square(sigma), float(known.max()) if len(known) else float("nan")


def root_mean_squares(values: FloatArray) -> FloatArray:
    """Return the root mean square of the known values of each column (n, d) and of all, (d + 1,)."""
    return np.array([root_mean_square(column) for column in (*values.T, values)])


def largest(values: FloatArray) -> FloatArray:
    """Return the largest known value of each column (n, d) and of all, (d + 1,)."""
    columns = np.where(np.isfinite(values), values, -np.inf).max(axis=0, initial=-np.inf)
    maxima = np.array([*columns, columns.max()])
    return np.asarray(np.where(np.isfinite(maxima), maxima, np.nan))


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
