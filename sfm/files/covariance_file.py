"""Covariances of a result, in files beside its tables.

    point_covariance.npy    upper triangle, by rows, of the matrix of X Y Z of every row of points.csv
    point_covariance_points.csv    ids of the points of this matrix, if it does not have all points
    covariances.npz    image_names (m,), exterior (m, 6, 6)    X0, Y0, Z0, omega, phi, kappa of a photograph
                       camera_names (a,), interior_0 (f, f) ...    free parameters of each camera
                       rig_parameters (s,), rigs (s, s)    joint matrix of all of these and of X, Y, Z,
                           omega, phi, kappa of each mount; only with rigs
                       point_names (n,), points (n, 3, 3)    X, Y, Z of a point; only of surveys, not read
                       back

Photographs and points without a covariance are left out, so that all numbers are finite. Units are object
units and rad. The files are NumPy arrays without executable content, and their sizes are checked before they
are read.

Source: NumPy, Enhancement Proposal 1 (a simple file format for NumPy arrays).
"""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sfm.files.csv_tables import read_table
from sfm.files.plain_text import csv_text
from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import SurveyFileError
from sfm.model.solution import MAX_POINTS, Solution

NAME = "point_covariance.npy"
ARRAYS = "covariances.npz"
MAX_BYTES = 2**31  # of the unpacked arrays
POINTS_NAME = "point_covariance_points.csv"
HEADER_BYTES = 128  # of a one-dimensional array
SAME = 1e-6  # largest relative difference from the standard deviations in the table


def write_covariance(
    folder: Path, covariance: FloatArray, names: tuple[str, ...], points: IntArray | None
) -> None:
    """Write the covariance of the points into a folder.

    Args:
        folder: folder of points.csv.
        covariance: joint covariance of k points in the order of that table, object unit^2, (3 k, 3 k).
        names: names of all points.
        points: indices of the k points, in rising order, (k,); all points if None.
    """
    np.save(folder / NAME, covariance[np.triu_indices(len(covariance))], allow_pickle=False)
    if points is not None:
        text = csv_text(("id",), ((names[j],) for j in points))
        (folder / POINTS_NAME).write_text(text, encoding="utf-8")


def read_covariance(
    folder: Path, names: tuple[str, ...], sigma: FloatArray
) -> tuple[FloatArray | None, IntArray | None]:
    """Read the covariance of the points, None if there is no such file.

    Args:
        folder: folder of points.csv.
        names: ids of points.csv, (n,).
        sigma: standard deviations of points.csv, which must agree with the file, (n, 3).

    Returns:
        The matrix, (3 k, 3 k), and the indices of its points, (k,), None for all points.

    Raises:
        SurveyFileError: the file belongs to another table or is damaged.
    """
    path = folder / NAME
    points = None
    if (folder / POINTS_NAME).exists():
        table = read_table(folder / POINTS_NAME, ("id",), (), ignored=None)
        table.refuse_duplicates(table.texts[0], ("id",))
        points = table.places("id", names, "points.csv", what="point")
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
        raise SurveyFileError(f"{path}: not an array of NumPy") from error
    if packed.dtype != np.float64 or packed.shape != (u * (u + 1) // 2,) or not np.isfinite(packed).all():
        raise SurveyFileError(f"{path}: expected {u * (u + 1) // 2} finite numbers of 8 bytes")
    matrix = np.zeros((u, u))
    matrix[np.triu_indices(u)] = packed
    matrix += np.triu(matrix, 1).T
    variance = sigma.ravel() ** 2
    if (np.abs(np.diagonal(matrix) - variance) > SAME * np.maximum(variance, 0.0) + 1e-300).any():
        raise SurveyFileError(f"{path}: its standard deviations are not those of points.csv beside it")
    return matrix, points


def write_covariances(folder: Path, solution: Solution, *, points: bool = False) -> None:
    """Write covariances.npz, the known covariances of exterior orientation, interior orientation and rigs.

    Args:
        folder: folder of the result.
        solution: has its covariances.
        points: whether the covariance of each point is written too.
    """
    network = solution.network
    arrays: dict[str, Any] = {}
    if points and solution.point_covariance is not None:
        arrays["point_names"], arrays["points"] = _known(network.points, solution.point_covariance)
    if solution.exterior_covariance is not None:
        arrays["image_names"], arrays["exterior"] = _known(network.images, solution.exterior_covariance)
    arrays["camera_names"] = np.array([camera.name for camera in solution.estimate.cameras])
    arrays |= {f"interior_{k}": Q for k, Q in enumerate(solution.interior_covariance)}
    if solution.rig_covariance is not None:
        arrays |= {"rig_parameters": np.array(solution.rig_parameters), "rigs": solution.rig_covariance}
    np.savez_compressed(folder / ARRAYS, **arrays)


def _known(names: tuple[str, ...], covariance: FloatArray) -> tuple[AnyArray, FloatArray]:
    """Return the names and covariances that are finite."""
    rows = np.isfinite(covariance).all(axis=(1, 2))
    return np.array(names)[rows], covariance[rows]


def read_covariances(folder: Path, result: Solution) -> Solution:
    """Return a result with the covariances of exterior orientation, interior orientation and rigs.

    Args:
        folder: folder of the result; the file may be missing.
        result: the result from the tables in this folder.

    Raises:
        SurveyFileError: the file is damaged or belongs to other tables.
    """
    path = folder / ARRAYS
    if not path.is_file():
        return result
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
                raise SurveyFileError(f"{path}: arrays of more than {MAX_BYTES} bytes, no more are read")
        with np.load(path, allow_pickle=False) as arrays:
            known = {name: arrays[name] for name in arrays.files if name not in ("points", "point_names")}
    except (OSError, ValueError, EOFError, SyntaxError, KeyError, zipfile.BadZipFile) as error:
        raise SurveyFileError(f"{path}: not an array of NumPy") from error
    images, cameras = result.network.images, result.estimate.cameras
    free = [int(camera.free.sum()) for camera in cameras]
    interior = tuple(known.get(f"interior_{k}", np.zeros((0, 0))) for k in range(len(cameras)))
    fits = all(Q.shape in ((f, f), (0, 0)) for Q, f in zip(interior, free, strict=True))
    exterior, stored = None, known.get("exterior")
    if stored is not None:
        names = np.asarray(known.get("image_names", ())).tolist()
        exterior = np.full((len(images), 6, 6), np.nan)
        fits &= stored.shape == (len(names), 6, 6) and len(set(names)) == len(names)
        fits &= set(names) <= set(images)
        if fits:
            place = {name: i for i, name in enumerate(images)}
            exterior[[place[name] for name in names]] = stored
    rigs = known.get("rigs")
    solution = replace(
        result, exterior_covariance=exterior, interior_covariance=interior, rig_covariance=rigs
    )
    if rigs is not None:
        unknowns = solution.rig_parameters
        fits &= tuple(known.get("rig_parameters", ())) == unknowns
        fits &= rigs.shape == (len(unknowns), len(unknowns))
    matrices = (*interior, *(Q for Q in (stored, rigs) if Q is not None))
    if not (fits and all(Q.dtype == np.float64 for Q in matrices)):
        raise SurveyFileError(f"{path}: its photographs or cameras are not those of the tables beside it")
    return solution
