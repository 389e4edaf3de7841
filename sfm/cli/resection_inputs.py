"""The input files of `kolinear resect` and `kolinear orient`: photo coordinates, interior orientation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sfm.files.csv_tables import read_table
from sfm.model.camera import camera_from_values, tangents_from_pixel
from sfm.model.conventions import FloatArray, pixel_from_image
from sfm.model.errors import SurveyFileError
from sfm.textbook.resection.by_method import Task

_DISTORTION = ("K1", "K2", "K3", "P1", "P2", "b1", "b2")
_CAMERA = ("c", "x0", "y0", *_DISTORTION)
METRES = tuple((f"{axis}_m", axis) for axis in "XYZ")  # columns of object coordinates in m
_UNIT_PIXEL = np.array([1.0, 1.0])


def read_tasks(
    points_file: Path,
    *,
    c_mm: float | None = None,
    camera_file: Path | None = None,
    start: str | None = None,
    tolerance_mm: float | None = None,
) -> tuple[Task, Task]:
    """Read the points of one photograph and its interior orientation, also with distortion of opposite signs.

    Args:
        points_file: CSV with point,X,Y,Z,x_mm,y_mm.
        c_mm: principal distance, mm; not needed if the camera file has it.
        camera_file: CSV with parameter,value[,...] for c, x0, y0, K1-K3, P1, P2, b1, b2 of model `brown`
            (corrections of the measured point, mm).
        start: start values "X,Y,Z" or "X,Y,Z,omega,phi,kappa" with angles in deg.
        tolerance_mm: largest residual that `robust` accepts as correct, mm; if None, from the data.

    Returns:
        The task with distortion added to measured coordinates; and with it subtracted, as in some programs.

    Raises:
        SurveyFileError: a file cannot be read, a column is missing, a value is not a number, or c is not
            given.
    """
    table = read_table(points_file, ("point",), (*"XYZ", "x_mm", "y_mm"), aliases=METRES, ignored=None)
    names, points, xy = table.texts[0], table.values[:, :3], table.values[:, 3:]
    values = read_interior("resect", c_mm, camera_file)
    begin: FloatArray | None = None
    if start is not None:
        try:
            begin = np.array([float(part) for part in start.split(",")])
        except ValueError:
            begin = np.empty(0)
        if len(begin) not in (3, 6) or not np.isfinite(begin).all():
            raise SurveyFileError(f"--start '{start}': expected X,Y,Z or X,Y,Z,omega,phi,kappa (deg)")
        begin[3:] = np.radians(begin[3:])
    opposite = values | {name: -values[name] for name in _DISTORTION if name in values}

    def task(values: Mapping[str, float]) -> Task:
        return Task(names, xy, tangents_of_photo(xy, values), points, values["c"], begin, tolerance_mm)

    return task(values), task(opposite)


def read_interior(
    command: str, c_mm: float | None, camera_file: Path | None, known: tuple[str, ...] = _CAMERA
) -> dict[str, float]:
    """Return the interior orientation of a camera file, model `brown`, mm, with its principal distance c.

    Args:
        command: what needs it, for error messages.
        c_mm: principal distance, which replaces that of the file; None if the file has it.
        camera_file: CSV with parameter,value[,...]; None for an ideal camera.
        known: parameters that the file may have.

    Raises:
        SurveyFileError: the file cannot be read or has other parameters, or there is no positive c.
    """
    values: dict[str, float] = {}
    if camera_file is not None:
        table = read_table(camera_file, ("parameter",), ("value",), ignored=None)
        parameters = table.keys("parameter")
        for line, name in zip(table.line, parameters, strict=True):
            if name not in known:
                raise SurveyFileError(
                    f"{camera_file}, line {line}: unknown parameter '{name}', expected one of "
                    f"{', '.join(known)}"
                )
        values = dict(zip(parameters, table.values[:, 0].tolist(), strict=True))
    if c_mm is not None:
        values["c"] = c_mm
    if "c" not in values:
        raise SurveyFileError(
            f"{command}: the principal distance is missing, give --c or a camera file with c"
        )
    if not values["c"] > 0:
        raise SurveyFileError(
            f"{command}: the principal distance is {values['c']:g} mm, expected more than 0"
        )
    return values


def tangents_of_photo(xy_mm: FloatArray, interior: Mapping[str, float]) -> FloatArray:
    """Return the tangents of measured photo coordinates, (n, 2), with `read_interior`."""
    # a camera with pixels of 1 mm, so image coordinates in mm can be converted to its pixel coordinates
    camera = camera_from_values(
        "photograph", "brown", (1, 1), (1.0, 1.0), c_mm=interior["c"], values=tuple(interior.items())
    )
    return tangents_from_pixel(camera, pixel_from_image(xy_mm, (1, 1), _UNIT_PIXEL))
