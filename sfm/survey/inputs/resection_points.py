"""The points of one photograph and its interior orientation, read from files for `kolinear resect`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfm.camera import camera_from_values, tangents_from_pixel
from sfm.conventions import FloatArray, pixel_from_image
from sfm.errors import SurveyFileError
from sfm.files.csv_tables import read_table
from sfm.textbook.resection.by_method import Task

_DISTORTION = ("K1", "K2", "K3", "P1", "P2", "b1", "b2")
_CAMERA = ("c", "x0", "y0", *_DISTORTION)
_UNIT_PIXEL = np.array([1.0, 1.0])


def read_task(
    points_file: Path,
    *,
    c_mm: float | None = None,
    camera_file: Path | None = None,
    start: str | None = None,
    tolerance_mm: float | None = None,
    opposite_signs: bool = False,
) -> Task:
    """Return the points of a photograph from files.

    Args:
        points_file: CSV with point,X,Y,Z,x_mm,y_mm.
        c_mm: principal distance, mm; not needed if the camera file has it.
        camera_file: CSV with parameter,value[,...] for c, x0, y0, K1-K3, P1, P2, b1, b2 of `brown`
            (corrections of the measured point, mm).
        start: "X,Y,Z" or "X,Y,Z,omega,phi,kappa" with angles in deg.
        tolerance_mm: largest residual that `robust` takes for right, mm; from the data if not given.
        opposite_signs: whether distortion is subtracted from measured coordinates, as some programs do.

    Raises:
        SurveyFileError: a file cannot be read, a column is missing, a value is not a number, or there
            is no c.
    """
    names, points, xy = _read_points(points_file)
    values = _read_camera(camera_file) if camera_file is not None else {}
    if opposite_signs:
        values |= {name: -values[name] for name in _DISTORTION if name in values}
    if c_mm is not None:
        values["c"] = c_mm
    if "c" not in values:
        raise SurveyFileError("resect: the principal distance is missing, give --c or a camera file with c")
    if not values["c"] > 0:
        raise SurveyFileError(f"resect: the principal distance is {values['c']:g} mm, it must be positive")
    # a camera of 1 mm pixels, whose pixel frame serves as the image frame
    camera = camera_from_values(
        "resect", "brown", (1, 1), (1.0, 1.0), c_mm=values["c"], values=tuple(values.items())
    )
    tangents = tangents_from_pixel(camera, pixel_from_image(xy, (1, 1), _UNIT_PIXEL))
    c = values["c"]
    return Task(names, xy, tangents, points, c, _parse_start(start), tolerance_mm)


def _read_points(path: Path) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    units = tuple((f"{axis}_m", axis) for axis in "XYZ")
    table = read_table(path, ("point",), ("X", "Y", "Z", "x_mm", "y_mm"), aliases=units, ignored=None)
    return table.texts[0], table.values[:, :3], table.values[:, 3:]


def _read_camera(path: Path) -> dict[str, float]:
    table = read_table(path, ("parameter",), ("value",), ignored=None)
    parameters = table.keys("parameter")
    for line, name in zip(table.line, parameters, strict=True):
        if name not in _CAMERA:
            raise SurveyFileError(
                f"{path}, line {line}: no parameter '{name}', known are {', '.join(_CAMERA)}"
            )
    return dict(zip(parameters, table.values[:, 0].tolist(), strict=True))


def _parse_start(text: str | None) -> FloatArray | None:
    if text is None:
        return None
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.empty(0)
    if len(values) not in (3, 6) or not np.isfinite(values).all():
        raise SurveyFileError(f"--start '{text}': X,Y,Z or X,Y,Z,omega,phi,kappa (deg) is needed")
    values[3:] = np.radians(values[3:])
    return values
