"""Control and check points of a result: control.csv of converted tables, control_points.csv of a survey.

    control.csv         id,X,Y,Z,sX,sY,sZ[,cXY,cXZ,cYZ][,checkX,checkY,checkZ], empty where not known
    control_points.csv  a row for each coordinate

Source: RFC 4180 for CSV; the columns are described in the README.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from adapters.formats.content import PAIRS
from sfm.conventions import BoolArray, FloatArray
from sfm.files.csv_tables import read_header, read_table
from sfm.files.plain_text import csv_text
from sfm.files.result_tables import CONTROL_POINTS
from sfm.network import Network, ObjectPoints

AXES, SIGMAS = ("X", "Y", "Z"), ("sX", "sY", "sZ")
COVARIANCES, CHECKS = ("cXY", "cXZ", "cYZ"), ("checkX", "checkY", "checkZ")
CONTROL = "control.csv"


def read_known_points(
    folder: Path, network: Network, control: ObjectPoints
) -> tuple[ObjectPoints, ObjectPoints]:
    """Return control and check points of a result.

    Args:
        folder: of the result.
        network: what `read_result` has read of it.
        control: what given.csv says took part.

    Raises:
        SurveyFileError: a table is damaged.
    """
    if (folder / CONTROL).is_file():
        return _of_control(folder / CONTROL, network)
    path = folder / CONTROL_POINTS.file
    if not path.is_file() or not path.read_text(encoding="utf-8").strip().partition("\n")[2]:
        return control, ObjectPoints()
    table = CONTROL_POINTS.read(folder)
    index = {name: j for j, name in enumerate(network.points)}
    found: dict[str, dict[int, tuple[FloatArray, FloatArray]]] = {"control": {}, "check": {}}
    for use, name, axis, (given, sigma) in zip(*table.texts, table.values.tolist(), strict=True):
        if use in found and name in index and axis in AXES and np.isfinite(given):
            xyz, variance = found[use].setdefault(index[name], (np.zeros(3), np.full(3, np.inf)))
            k = AXES.index(axis)
            xyz[k], variance[k] = given, sigma**2 if np.isfinite(sigma) else 0.0
    points = _points(found["control"])
    covariance = points.covariance.copy()
    for j, C in zip(control.point, control.covariance, strict=True):  # of what took part
        covariance[points.point == j] += np.where(np.eye(3, dtype=bool), 0.0, C)
    return replace(points, covariance=covariance), _points(found["check"])


def _points(found: dict[int, tuple[FloatArray, FloatArray]]) -> ObjectPoints:
    return ObjectPoints(
        np.array(list(found), dtype=np.int64),
        np.array([xyz for xyz, _ in found.values()]).reshape(-1, 3),
        np.array([np.diag(variance) for _, variance in found.values()]).reshape(-1, 3, 3),
    )


def _of_control(path: Path, network: Network) -> tuple[ObjectPoints, ObjectPoints]:
    """Return control and check points of the table of a survey."""
    header = read_header(path)
    covariances = COVARIANCES if COVARIANCES[0] in header else ()
    checks = CHECKS if CHECKS[0] in header else ()
    columns = (*AXES, *SIGMAS, *covariances, *checks)
    table = read_table(path, ("id",), columns, blank=columns)
    xyz, sigma, between, check = np.split(table.values, (3, 6, 6 + len(covariances)), axis=1)
    index = {name: j for j, name in enumerate(network.points)}
    names = table.keys("id")
    known = np.isfinite(xyz)
    C = np.zeros((len(names), 3, 3))
    for k, (row, column) in enumerate(PAIRS if covariances else ()):
        C[:, row, column] = C[:, column, row] = np.nan_to_num(between[:, k])
    there = np.array([name in index for name in names], dtype=bool)
    only = check == 1 if checks else np.zeros_like(known)

    def chosen(part: BoolArray) -> ObjectPoints:
        rows = np.flatnonzero(there & part.any(axis=1))
        covariance = C[rows] * (part[rows][:, :, None] & part[rows][:, None, :])
        covariance[:, range(3), range(3)] = np.where(part[rows], sigma[rows] ** 2, np.inf)
        point = np.array([index[names[k]] for k in rows], dtype=np.int64)
        return ObjectPoints(point, np.where(part[rows], xyz[rows], 0.0), covariance)

    return chosen(known & ~only), chosen(known & only)


def write_known_points(
    path: Path, points: tuple[str, ...], control: ObjectPoints, checks: ObjectPoints
) -> None:
    """Write the table of control and check points, empty cells where a coordinate is not known."""
    found: dict[int, tuple[FloatArray, FloatArray, BoolArray]] = {}
    for one, flag in ((control, False), (checks, True)):
        for j, xyz, C in zip(one.point.tolist(), one.xyz, one.covariance, strict=True):
            known = np.isfinite(np.diagonal(C))
            unknown = (np.full(6, np.nan), np.zeros(3), np.zeros(3, dtype=bool))
            row, between, check = found.setdefault(j, unknown)
            row[:3][known], row[3:][known] = xyz[known], np.sqrt(np.diagonal(C)[known])
            between += [C[r, c] if known[r] and known[c] else 0.0 for r, c in PAIRS]
            check |= known & flag
    correlated = any(between.any() for _, between, _ in found.values())
    checked = any(check.any() for _, _, check in found.values())
    rows = [
        (
            points[j],
            *("" if np.isnan(v) else v for v in row.tolist()),
            *(between.tolist() if correlated else ()),
            *(check.astype(int).tolist() if checked else ()),
        )
        for j, (row, between, check) in found.items()
    ]
    header = ("id", *AXES, *SIGMAS, *(COVARIANCES if correlated else ()), *(CHECKS if checked else ()))
    path.write_text(csv_text(header, rows), encoding="utf-8", newline="")
