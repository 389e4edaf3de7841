"""Inputs of `kolinear orient` and `georeference`: tables of points, pairs of photographs, corrections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.cli.resection_inputs import METRES, read_interior, tangents_of_photo
from sfm.files.csv_tables import read_table
from sfm.files.plain_text import csv_text
from sfm.files.whole_files import whole_file
from sfm.model.conventions import FloatArray
from sfm.model.display import counted
from sfm.model.errors import SurveyFileError
from sfm.textbook.photo_coordinates import PhotoCorrections, RadialTable

PHOTO, OBJECT = ("x_mm", "y_mm"), ("X", "Y", "Z")
_CORRECTED = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2")


def read_points(
    path: Path, columns: tuple[str, ...], *, name: str = "point"
) -> tuple[tuple[str, ...], FloatArray]:
    """Return the names and the coordinates of points, (n, columns), each name once.

    Raises:
        SurveyFileError: the file cannot be read, a column is missing, or a point is there twice.
    """
    table = read_table(path, (name,), columns, aliases=METRES, ignored=None)
    return table.keys(name), table.values


def write_points(path: Path, columns: tuple[str, ...], names: Sequence[str], values: FloatArray) -> None:
    """Write points to a new CSV file; an existing one is left alone."""
    rows = [(name, *row) for name, row in zip(names, values.tolist(), strict=True)]
    with whole_file(path) as part:
        part.write_text(csv_text(("point", *columns), rows), encoding="utf-8", newline="")


@dataclass(frozen=True)
class ConjugateRays:
    """Points that both photographs of a pair show."""

    names: tuple[str, ...]
    first: FloatArray  # tangents in photograph 1, (n, 2)
    second: FloatArray  # tangents in photograph 2, (n, 2)
    c_mm: float  # mean principal distance
    alone: tuple[str, ...]  # points of one photograph only


def read_pair(
    left: Path, right: Path, c_mm: float | None, camera: Path | None, camera_right: Path | None
) -> ConjugateRays:
    """Read the photo coordinates of two photographs and return the conjugate rays.

    Args:
        left: table point,x_mm,y_mm of photograph 1.
        right: the same of photograph 2.
        c_mm: principal distance of photographs whose camera file has none, mm.
        camera: interior orientation, see `read_interior`.
        camera_right: the same of photograph 2; None for that of photograph 1.
    """
    interior = [read_interior("orient pair", c_mm, path) for path in (camera, camera_right or camera)]
    (first, xy), (second, xy_right) = (read_points(path, PHOTO) for path in (left, right))
    common = set(first) & set(second)
    names = tuple(name for name in first if name in common)
    if not names:
        raise SurveyFileError(f"{left} and {right}: no point has the same name in both")

    def rays(every: tuple[str, ...], xy_mm: FloatArray, values: dict[str, float]) -> FloatArray:
        row = {name: k for k, name in enumerate(every)}
        return tangents_of_photo(xy_mm[[row[name] for name in names]], values)

    alone = tuple(name for name in (*first, *second) if name not in common)
    return ConjugateRays(
        names,
        rays(first, xy, interior[0]),
        rays(second, xy_right, interior[1]),
        c_mm=(interior[0]["c"] + interior[1]["c"]) / 2,
        alone=alone,
    )


def read_control(
    path: Path, names: Sequence[str]
) -> tuple[tuple[str, ...], FloatArray, FloatArray | None, tuple[str, ...]]:
    """Return control points that a model has: names, coordinates, weights; and the names of the others.

    Raises:
        SurveyFileError: the file cannot be read, a standard deviation is not positive, or fewer than three of
            the points are in the model.
    """
    table = read_table(path, ("point",), OBJECT, ("sigma",), aliases=METRES, ignored=None)
    given = table.keys("point")
    known = set(names)
    rows = [k for k, name in enumerate(given) if name in known]
    absent = tuple(name for name in given if name not in known)
    if len(rows) < 3:
        raise SurveyFileError(
            f"{path}: {counted(len(rows), 'control point')} of the model, at least 3 are needed"
        )
    weights = None
    if table.values.shape[1] > 3:
        sigma = table.values[rows, 3]
        if not (sigma > 0).all():
            line = table.line[rows][int(np.argmin(sigma))]
            raise SurveyFileError(f"{path}, line {line}: sigma is {sigma.min():g}, expected more than 0")
        weights = 1 / sigma**2
    return tuple(given[k] for k in rows), table.values[rows, :3], weights, absent


def read_corrections(
    c_mm: float | None,
    camera: Path | None,
    radial: Path | None,
    *,
    flying_height_km: float | None,
    terrain_height_km: float,
    curvature: bool,
) -> tuple[PhotoCorrections, float]:
    """Return the corrections of photo coordinates, and the principal distance, mm.

    Raises:
        SurveyFileError: a file cannot be read, radii do not ascend from 0, or a height is missing.
    """
    values = read_interior("orient correct", c_mm, camera, _CORRECTED)
    table = None
    if radial is not None:
        rows = read_table(radial, (), ("radius_mm", "distortion_mm"), ignored=None).values
        if rows[0, 0] != 0 or not (np.diff(rows[:, 0]) > 0).all():
            raise SurveyFileError(f"{radial}: expected ascending radii from 0")
        table = RadialTable(rows[:, 0], rows[:, 1])
    if curvature and flying_height_km is None:
        raise SurveyFileError("orient correct: --curvature needs --flying-height")
    above = None if not curvature or flying_height_km is None else flying_height_km - terrain_height_km

    def of(*names: str) -> FloatArray:
        return np.array([values.get(name, 0.0) for name in names])

    corrections = PhotoCorrections(
        of("x0", "y0"),
        table,
        of("K1", "K2", "K3"),
        of("P1", "P2"),
        flying_height_km,
        terrain_height_km,
        above,
    )
    return corrections, values["c"]


def parse_extent(text: str | None) -> tuple[float, float, float, float] | None:
    """Return X0, Y0, X1, Y1 of --extent; None without it.

    Raises:
        SurveyFileError: not four numbers.
    """
    if text is None:
        return None
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        raise SurveyFileError(f"--extent '{text}': expected X0,Y0,X1,Y1") from None
    return x0, y0, x1, y1
