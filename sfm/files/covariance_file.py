"""The covariance of all object points together, in a file beside the table of the points.

    point_covariance.npy    upper triangle, by rows, of the matrix of X Y Z of every row of points.csv
    point_covariance_points.csv    id of the points that it is of, where it is not of all

In object units squared; a plain array of NumPy's format 1.0, from which nothing is run. Its size is checked
before it is read.

Source: NumPy, Enhancement Proposal 1 (a simple file format for NumPy arrays).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from sfm.conventions import FloatArray, IntArray
from sfm.display import counted
from sfm.errors import SurveyFileError
from sfm.files.csv_tables import read_table
from sfm.files.plain_text import csv_text

NAME = "point_covariance.npy"
POINTS_NAME = "point_covariance_points.csv"
MAX_POINTS = 1000  # of whom a matrix is kept: 36 MB
MAX_WORK = (
    5_000_000  # points times points of the sample: the matrix of many points takes their product in time
)
SEED = 1
UNCODED = re.compile(r"u\d+")  # names that Kolinear gives to points without one, anew in every run
HEADER_BYTES = 128  # of a one-dimensional array
SAME = 1e-6  # relative difference from the standard deviations of the table, which are the same numbers


def points_kept_together(names: tuple[str, ...]) -> IntArray:
    """Return the points whose joint covariance is kept: all of up to 1000, a sample of more, in rising order.

    Points with names of their own come first, since another result knows them too; the others are drawn at
    random, so that they lie where the points lie.

    Args:
        names: of all points.
    """
    n = len(names)
    if n <= MAX_POINTS:
        return np.arange(n)
    named = np.array([UNCODED.fullmatch(name) is None for name in names])
    order = np.random.default_rng(SEED).permutation(n)
    order = np.concatenate([order[named[order]], order[~named[order]]])
    return np.sort(order[: min(MAX_POINTS, MAX_WORK // n)])


def write_covariance(
    folder: Path, covariance: FloatArray, names: tuple[str, ...], points: IntArray | None
) -> None:
    """Write the covariance of the points into a folder.

    Args:
        folder: that of points.csv.
        covariance: of the points in the order of that table, object unit^2, (3 k, 3 k).
        names: of all points.
        points: which of them the covariance is of, in rising order, (k,); all if None.
    """
    np.save(folder / NAME, covariance[np.triu_indices(len(covariance))], allow_pickle=False)
    if points is not None:
        text = csv_text(("id",), ((names[j],) for j in points))
        (folder / POINTS_NAME).write_text(text, encoding="utf-8")


def read_covariance(
    folder: Path, names: tuple[str, ...], sigma: FloatArray
) -> tuple[FloatArray | None, IntArray | None]:
    """Read the covariance of the points, None where there is no such file.

    Args:
        folder: that of points.csv.
        names: ids of points.csv, n of them.
        sigma: standard deviations of points.csv, which must be those of the file, (n, 3).

    Returns:
        The matrix (3 k, 3 k), and which points it is of (k,), None for all of them.

    Raises:
        SurveyFileError: the file belongs to another table or is damaged.
    """
    path = folder / NAME
    points = None
    if (folder / POINTS_NAME).exists():
        table = read_table(folder / POINTS_NAME, ("id",), (), ignored=None)
        place = {name: j for j, name in enumerate(names)}
        for line, name in zip(table.line, table.keys("id"), strict=True):
            if name not in place:
                raise SurveyFileError(f"{table.path}, line {line}: point '{name}' is not in points.csv")
        points = np.array([place[name] for name in table.keys("id")], dtype=np.int64)
        sigma = sigma[points]
    try:
        size = path.stat().st_size
    except FileNotFoundError:
        return None, None
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    u = sigma.size
    due = HEADER_BYTES + 8 * (u * (u + 1) // 2)
    if size != due or len(sigma) > MAX_POINTS:
        raise SurveyFileError(
            f"{path}: {size} bytes, expected {due} for the {counted(len(sigma), 'point')} of "
            f"{'points.csv' if points is None else POINTS_NAME}"
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
    return matrix, points
