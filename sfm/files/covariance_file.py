"""The covariance of all object points together, in a file beside the table of the points.

    point_covariance.npy    upper triangle, by rows, of the matrix of X Y Z of every row of points.csv

In object units squared; a plain array of NumPy's format 1.0, from which nothing is run. Its size is checked
before it is read.

Source: NumPy, Enhancement Proposal 1 (a simple file format for NumPy arrays).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfm.conventions import FloatArray
from sfm.errors import SurveyFileError

NAME = "point_covariance.npy"
MAX_POINTS = 1000  # of whom a matrix is kept: 36 MB
HEADER_BYTES = 128  # of a one-dimensional array
SAME = 1e-6  # relative difference from the standard deviations of the table, which are the same numbers


def write_covariance(folder: Path, covariance: FloatArray) -> None:
    """Write the covariance of all points into a folder.

    Args:
        folder: that of points.csv.
        covariance: of the points in the order of that table, object unit^2, (3 n, 3 n).
    """
    np.save(folder / NAME, covariance[np.triu_indices(len(covariance))], allow_pickle=False)


def read_covariance(folder: Path, sigma: FloatArray) -> FloatArray | None:
    """Read the covariance of all points, None where there is no such file.

    Args:
        folder: that of points.csv.
        sigma: standard deviations of points.csv, which must be those of the file, (n, 3).

    Raises:
        SurveyFileError: the file belongs to another table or is damaged.
    """
    path = folder / NAME
    try:
        size = path.stat().st_size
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    u = sigma.size
    due = HEADER_BYTES + 8 * (u * (u + 1) // 2)
    if size != due or len(sigma) > MAX_POINTS:
        raise SurveyFileError(
            f"{path}: {size} bytes, expected {due} for the {len(sigma)} points of points.csv"
        )
    try:
        packed = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        raise SurveyFileError(f"{path}: is no array of NumPy") from error
    if packed.dtype != np.float64 or packed.shape != (u * (u + 1) // 2,) or not np.isfinite(packed).all():
        raise SurveyFileError(f"{path}: expected {u * (u + 1) // 2} finite numbers of 8 bytes")
    matrix = np.zeros((u, u))
    matrix[np.triu_indices(u)] = packed
    matrix += np.triu(matrix, 1).T
    variance = sigma.ravel() ** 2
    if (np.abs(np.diagonal(matrix) - variance) > SAME * np.maximum(variance, 0.0) + 1e-300).any():
        raise SurveyFileError(f"{path}: its standard deviations are not those of points.csv beside it")
    return matrix
