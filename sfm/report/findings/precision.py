"""Precision of the unknowns over the whole network; what is fixed has none and does not count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, IntArray


@dataclass(frozen=True)
class Precision:
    """Standard deviations of points and photographs; of X, Y, Z or omega, phi, kappa, and of all together."""

    points: FloatArray  # of each coordinate, 0 where fixed, object unit, (n, 3)
    limiting_points: FloatArray  # the same with the cameras free of error
    exterior: FloatArray  # of each photograph, object unit and rad, (m, 6)
    rms: FloatArray  # of the points, object unit, (4,)
    largest: FloatArray  # of the points, object unit, (4,)
    limiting: FloatArray  # RMS of the points with the cameras free of error, object unit, (4,)
    centres: FloatArray  # RMS of the projection centres, object unit, (4,)
    angles: FloatArray  # RMS of omega, phi, kappa, rad, (4,)
    fixed_points: int  # points with fixed coordinates, as control or in a minimal datum

    @property
    def exterior_deg(self) -> FloatArray:
        """Standard deviations of each photograph, object unit and deg, (m, 6)."""
        return np.asarray(self.exterior * np.repeat([1.0, np.degrees(1.0)], 3))

    @property
    def angles_arcsec(self) -> FloatArray:
        """RMS of omega, phi, kappa, arc seconds, (4,)."""
        return np.degrees(self.angles) * 3600


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
    """Return standard deviations of covariance matrices (n, d, d), NaN where fixed or not known, (n, d)."""
    variance = np.einsum("nii->ni", covariance)
    adjusted = variance > 0
    return np.asarray(np.where(adjusted, np.sqrt(np.where(adjusted, variance, 1.0)), np.nan))


def point_precision(adjustment: Adjustment) -> FloatArray:
    """Return RMS, largest, and RMS limiting standard deviation of X, Y, Z and all, object unit, (3, 4).

    Limiting is the precision with the cameras free of error. NaN where no coordinate was adjusted.
    """
    sigma = adjusted_sigmas(adjustment.covariance.points)
    limiting = adjusted_sigmas(adjustment.covariance.points_limiting)
    return np.array([root_mean_squares(sigma), largest(sigma), root_mean_squares(limiting)])


def root_mean_squares(values: FloatArray) -> FloatArray:
    """Return the root mean square of each column (n, d) and of all, of the values known, (d + 1,)."""
    return np.array([root_mean_square(column) for column in (*values.T, values)])


def root_mean_square(values: FloatArray) -> float:
    """Return the root mean square of the values that are known, NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def rms_of_groups(index: IntArray, v: FloatArray, count: int) -> FloatArray:
    """Return the RMS residual per coordinate of each photograph or point, px, NaN without any, (n,).

    Args:
        index: photograph or point of each image point, (k,).
        v: residuals, NaN where not known, px, (k, 2).
        count: of photographs or points, n.
    """
    known = np.isfinite(v).all(axis=1)
    number = np.bincount(index[known], minlength=count)
    total = np.bincount(index[known], weights=(v[known] ** 2).sum(axis=1), minlength=count)
    mean = np.divide(total, 2 * number, out=np.full(count, np.nan), where=number > 0)
    return np.asarray(np.sqrt(mean))


def largest(values: FloatArray) -> FloatArray:
    """Return the largest of each column (n, d) and of all, of the values known, (d + 1,)."""
    columns = np.where(np.isfinite(values), values, -np.inf).max(axis=0, initial=-np.inf)
    found = np.array([*columns, columns.max()])
    return np.asarray(np.where(np.isfinite(found), found, np.nan))


def point_sigma(covariance: FloatArray) -> tuple[float, float]:
    """Return RMS and largest known standard deviation of the coordinates of points, object unit, NaN without.

    Args:
        covariance: of the points, object unit^2, (n, 3, 3).
    """
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    known = sigma[np.isfinite(sigma)]
    return root_mean_square(sigma), float(known.max()) if len(known) else float("nan")


def standard_deviations(covariance: FloatArray) -> FloatArray:
    """Return standard deviations of covariance matrices (..., d, d), shape (..., d)."""
    diagonal = np.einsum("...ii->...i", covariance)
    return np.asarray(np.sqrt(np.where(diagonal >= 0, diagonal, np.nan)))
