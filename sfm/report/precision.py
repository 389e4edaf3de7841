"""Precision of the unknowns over the whole network; what is fixed has none and does not count."""

from __future__ import annotations

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray


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


def words_of_limiting(precision: FloatArray) -> str:
    """Return why a limiting standard deviation is above the achieved one; empty where none is.

    With the cameras held, shift, rotation and scale of the points are theirs; inner constraints on the
    points take these out, and can take out more of a coordinate than the errors of the cameras add.

    Args:
        precision: as `point_precision` returns it, (3, 4).
    """
    if not (precision[2] > precision[0]).any():
        return ""
    return (
        "The limiting precision is in the datum of the cameras, in which a coordinate can be less precise "
        "than in that of the adjustment."
    )


def root_mean_squares(values: FloatArray) -> FloatArray:
    """Return the root mean square of each column (n, d) and of all, of the values known, (d + 1,)."""
    return np.array([root_mean_square(column) for column in (*values.T, values)])


def root_mean_square(values: FloatArray) -> float:
    """Return the root mean square of the values that are known, NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def largest(values: FloatArray) -> FloatArray:
    """Return the largest of each column (n, d) and of all, of the values known, (d + 1,)."""
    columns = np.where(np.isfinite(values), values, -np.inf).max(axis=0, initial=-np.inf)
    found = np.array([*columns, columns.max()])
    return np.asarray(np.where(np.isfinite(found), found, np.nan))


def fixed_points(adjustment: Adjustment) -> int:
    """Return how many object points have fixed coordinates, as control or in a minimal datum."""
    return int((np.einsum("nii->ni", adjustment.covariance.points) == 0).any(axis=1).sum())


def without_fixed(adjustment: Adjustment) -> str:
    """Say that fixed coordinates do not count; empty where there are none."""
    count = fixed_points(adjustment)
    return f"without the fixed coordinates of {count} point{'s' if count > 1 else ''}" if count else ""
