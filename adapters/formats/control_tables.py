"""Given values, control points and check points of a result, read from and written to tables.

    control.csv         of converted tables: id,X,Y,Z,sX,sY,sZ[,cXY,cXZ,cYZ][,checkX,checkY,checkZ], or empty
    control_points.csv  of a survey: a row for each coordinate

Source: RFC 4180 for CSV; docs/reference/results.md describes each column.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from adapters.formats.content import PAIRS
from sfm.files.csv_tables import read_header, read_table
from sfm.files.plain_text import Content, csv_text, read_json
from sfm.files.result_tables import CONTROL_POINTS, GIVEN
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import ExteriorObservations, Network, ObjectPoints, ScaleBars
from sfm.model.observation_residuals import given_residuals, given_rows
from sfm.model.solution import CONTROL_COVARIANCE

AXES, SIGMAS = ("X", "Y", "Z"), ("sX", "sY", "sZ")
COVARIANCES, CHECKS = ("cXY", "cXZ", "cYZ"), ("checkX", "checkY", "checkZ")
CONTROL = "control.csv"
ORIENTATION = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
COVARIANCE_PAIRS = ("XY", "XZ", "YZ")  # of correlated coordinates


class Statistics(Content):
    """Unit of weight as stated in summary.json."""

    sigma0: Annotated[float, Field(gt=0, lt=1e9)] | None = None
    sigma0_px: Annotated[float, Field(gt=0, lt=1e9)] | None = None


@dataclass(frozen=True)
class GivenValues:
    """Given values of a survey that took part, with standard deviations."""

    bars: ScaleBars
    control: ObjectPoints
    interior: tuple[tuple[str, str, float, float], ...]  # camera, parameter, value, sigma
    exterior: ExteriorObservations = field(default_factory=ExteriorObservations)
    sigma0: float = 1.0  # of unit weight, the scale of the covariance of the result
    sigma0_px: float | None = None  # a posteriori of an image coordinate, the median, px; None if not known


def read_given(folder: Path, network: Network) -> GivenValues:
    """Read the given values with standard deviations of the survey of a result, from given.csv.

    Args:
        folder: folder of the result.
        network: network of the result from `read_result`.

    Raises:
        SurveyFileError: a missing or invalid file, with its line number.
    """
    path = folder / GIVEN.file
    summary = read_json(folder / "summary.json", Statistics, "the summary of a result")
    if not path.is_file() or not path.read_text(encoding="utf-8").strip().partition("\n")[2]:
        return GivenValues(
            ScaleBars(),
            ObjectPoints(),
            interior=(),
            sigma0=summary.sigma0 or 1.0,
            sigma0_px=summary.sigma0_px,
        )
    table = GIVEN.read(folder)
    table.refuse(table.values[:, 1:], table.values[:, 1:] < 0, ("sigma",), "0 or more, or nothing")
    given = [
        _GivenValue(kind, name, coordinate, value, sigma)
        for kind, name, coordinate, (value, sigma) in zip(*table.texts, table.values.tolist(), strict=True)
    ]
    interior = []
    for kind, name, _, value, sigma in given:
        if kind == "interior orientation":
            parameter, _, camera = name.partition(" of camera ")
            interior.append((camera, parameter, value, sigma))
    index = {name: j for j, name in enumerate(network.points)}
    bars = []
    for kind, name, _, value, sigma in given:
        words = name.split(" - ") if kind == "scale bar" else []
        for k in range(1, len(words)):  # names of points may contain dashes
            first, second = " - ".join(words[:k]), " - ".join(words[k:])
            if first in index and second in index:
                bars.append((index[first], index[second], value, sigma))
                break
    rows = np.array(bars, dtype=float).reshape(-1, 4)
    return GivenValues(
        ScaleBars(rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64), rows[:, 2], rows[:, 3]),
        _control(given, network),
        tuple(interior),
        _exterior(given, network),
        summary.sigma0 or 1.0,
        summary.sigma0_px,
    )


class _GivenValue(NamedTuple):
    """A row of given.csv."""

    kind: str
    name: str
    coordinate: str
    value: float
    sigma: float


def _control(given: list[_GivenValue], network: Network) -> ObjectPoints:
    """Return the control points; the rows of covariances follow those of their points."""
    index = {name: j for j, name in enumerate(network.points)}
    control: dict[int, tuple[FloatArray, FloatArray]] = {}
    for kind, name, coordinate, value, sigma in given:
        if kind == "control point" and name in index and coordinate in AXES:
            xyz, C = control.setdefault(index[name], (np.zeros(3), np.diag(np.full(3, np.inf))))
            k = AXES.index(coordinate)
            xyz[k], C[k, k] = value, sigma**2 if np.isfinite(sigma) else np.inf
        elif kind == CONTROL_COVARIANCE and index.get(name) in control and coordinate in COVARIANCE_PAIRS:
            C, (row, column) = control[index[name]][1], map(AXES.index, coordinate)
            C[row, column] = C[column, row] = value
    return object_points(control)


def _exterior(given: list[_GivenValue], network: Network) -> ExteriorObservations:
    index = {name: i for i, name in enumerate(network.images)}
    exterior: dict[int, tuple[FloatArray, FloatArray]] = {}  # values and variances by photograph
    for kind, name, coordinate, value, sigma in given:
        if kind in ("projection centre", "rotation") and name in index and coordinate in ORIENTATION:
            values, variances = exterior.setdefault(index[name], (np.zeros(6), np.full(6, np.inf)))
            k = ORIENTATION.index(coordinate)
            factor = 1.0 if k < 3 else np.radians(1.0)
            values[k], variances[k] = factor * value, (factor * sigma) ** 2
    return ExteriorObservations(
        np.array(list(exterior), dtype=np.int64),
        np.array([values[:3] for values, _ in exterior.values()]).reshape(-1, 3),
        np.array([values[3:] for values, _ in exterior.values()]).reshape(-1, 3),
        np.array([np.diag(variances) for _, variances in exterior.values()]).reshape(-1, 6, 6),
    )


def object_points(values: dict[int, tuple[FloatArray, FloatArray]]) -> ObjectPoints:
    """Return points from their coordinates (3,) and covariances (3, 3), by their index in a network."""
    return ObjectPoints(
        np.array(list(values), dtype=np.int64),
        np.array([xyz for xyz, _ in values.values()]).reshape(-1, 3),
        np.array([C for _, C in values.values()]).reshape(-1, 3, 3),
    )


def write_given(folder: Path, network: Network, estimate: Estimate, unit: str) -> None:
    """Write the given values of a network with standard deviations, without tests; no file without any."""
    kinds = [kind for _, kind in given_residuals(network, estimate, unit)]
    rows = list(given_rows(kinds, network, unit))
    if rows:
        GIVEN.write_rows(folder, rows)


def read_known_points(
    folder: Path, network: Network, control: ObjectPoints
) -> tuple[ObjectPoints, ObjectPoints]:
    """Return control and check points of a result.

    Args:
        folder: folder of the result.
        network: network of the result from `read_result`.
        control: control that took part, from given.csv.

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
    values: dict[str, dict[int, tuple[FloatArray, FloatArray]]] = {"control": {}, "check": {}}
    for use, name, axis, (given, sigma) in zip(*table.texts, table.values.tolist(), strict=True):
        if use in values and name in index and axis in AXES and np.isfinite(given):
            xyz, C = values[use].setdefault(index[name], (np.zeros(3), np.diag(np.full(3, np.inf))))
            k = AXES.index(axis)
            xyz[k], C[k, k] = given, sigma**2 if np.isfinite(sigma) else 0.0
    points = object_points(values["control"])
    covariance = points.covariance.copy()
    for j, C in zip(control.point, control.covariance, strict=True):  # correlations of what took part
        covariance[points.point == j] += np.where(np.eye(3, dtype=bool), 0.0, C)
    return replace(points, covariance=covariance), object_points(values["check"])


def _of_control(path: Path, network: Network) -> tuple[ObjectPoints, ObjectPoints]:
    """Return control and check points from the table of a survey."""
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
    """Write the table of control and check points, with empty cells for unknown coordinates."""
    cells: dict[int, tuple[FloatArray, FloatArray, BoolArray]] = {}
    for known_points, flag in ((control, False), (checks, True)):
        for j, xyz, C in zip(
            known_points.point.tolist(), known_points.xyz, known_points.covariance, strict=True
        ):
            known = np.isfinite(np.diagonal(C))
            unknown = (np.full(6, np.nan), np.zeros(3), np.zeros(3, dtype=bool))
            row, between, check = cells.setdefault(j, unknown)
            row[:3][known], row[3:][known] = xyz[known], np.sqrt(np.diagonal(C)[known])
            between += [C[r, c] if known[r] and known[c] else 0.0 for r, c in PAIRS]
            check |= known & flag
    correlated = any(between.any() for _, between, _ in cells.values())
    checked = any(check.any() for _, _, check in cells.values())
    rows = []
    for j, (row, between, check) in cells.items():
        values = ["" if np.isnan(value) else value for value in row.tolist()]
        values += between.tolist() if correlated else []
        values += check.astype(int).tolist() if checked else []
        rows.append((points[j], *values))
    header = ("id", *AXES, *SIGMAS, *(COVARIANCES if correlated else ()), *(CHECKS if checked else ()))
    path.write_text(csv_text(header, rows), encoding="utf-8", newline="")
