"""The input files of `kolinear resect`: points of one photograph, and its interior orientation."""

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
    units = tuple((f"{axis}_m", axis) for axis in "XYZ")
    columns = ("X", "Y", "Z", "x_mm", "y_mm")
    table = read_table(points_file, ("point",), columns, aliases=units, ignored=None)
    names, points, xy = table.texts[0], table.values[:, :3], table.values[:, 3:]
    values: dict[str, float] = {}
    if camera_file is not None:
        camera_table = read_table(camera_file, ("parameter",), ("value",), ignored=None)
        parameters = camera_table.keys("parameter")
        for line, name in zip(camera_table.line, parameters, strict=True):
            if name not in _CAMERA:
                raise SurveyFileError(
                    f"{camera_file}, line {line}: unknown parameter '{name}', expected one of "
                    f"{', '.join(_CAMERA)}"
                )
        values = dict(zip(parameters, camera_table.values[:, 0].tolist(), strict=True))
    if c_mm is not None:
        values["c"] = c_mm
    if "c" not in values:
        raise SurveyFileError("resect: the principal distance is missing, give --c or a camera file with c")
    if not values["c"] > 0:
        raise SurveyFileError(f"resect: the principal distance is {values['c']:g} mm, expected more than 0")
    c, begin = values["c"], _parse_start(start)
    opposite = values | {name: -values[name] for name in _DISTORTION if name in values}

    def task(values: Mapping[str, float]) -> Task:
        # a camera with pixels of 1 mm, so image coordinates in mm can be converted to its pixel coordinates
        camera = camera_from_values(
            "resect", "brown", (1, 1), (1.0, 1.0), c_mm=c, values=tuple(values.items())
        )
        tangents = tangents_from_pixel(camera, pixel_from_image(xy, (1, 1), _UNIT_PIXEL))
        return Task(names, xy, tangents, points, c, begin, tolerance_mm)

    return task(values), task(opposite)


def _parse_start(text: str | None) -> FloatArray | None:
    if text is None:
        return None
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.empty(0)
    if len(values) not in (3, 6) or not np.isfinite(values).all():
        raise SurveyFileError(f"--start '{text}': expected X,Y,Z or X,Y,Z,omega,phi,kappa (deg)")
    values[3:] = np.radians(values[3:])
    return values
