"""The work of `kolinear match`, and the input files of `kolinear resect`.

`match_command` reads two photographs and points, matches the points, and writes a table, JSON and a picture.
`read_tasks` reads the points of one photograph and its interior orientation.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sfm.files.csv_tables import read_table
from sfm.matching.conjugate import match_points
from sfm.matching.conjugate_patches import MatchSettings
from sfm.model.camera import camera_from_values, tangents_from_pixel
from sfm.model.conventions import AnyArray, FloatArray, pixel_from_image
from sfm.model.errors import PhotographError, SurveyFileError
from sfm.photographs.reading import read_photograph
from sfm.report.figures.overlays import draw_patches
from sfm.report.single_photographs import (
    NAMES,
    matches_json,
    matches_table,
    picture_file,
    refuse_outputs,
    whole_outputs,
)
from sfm.textbook.resection.by_method import Task

_DISTORTION = ("K1", "K2", "K3", "P1", "P2", "b1", "b2")
_CAMERA = ("c", "x0", "y0", *_DISTORTION)
_UNIT_PIXEL = np.array([1.0, 1.0])


def match_command(
    left_path: Path,
    right_path: Path,
    *,
    point: str | None = None,
    points: Path | None = None,
    settings: MatchSettings | None = None,
    as_json: bool = False,
    out: Path | None = None,
    picture: Path | None = None,
) -> tuple[str, bool]:
    """Match points of two photograph files.

    Args:
        left_path: photograph in which the points are given.
        right_path: photograph in which the points are searched for.
        point: "COL,ROW" in the left photograph, px; give either this or `points`.
        points: table of points, see `read_points_to_match`.
        settings: how they are matched.
        as_json: whether to return JSON instead of the table.
        out: file .csv or .json for the table, which is then not printed.
        picture: PNG file for the template, the matched patch and their difference.

    Returns:
        The text to print, and whether any point was matched.

    Raises:
        KolinearError: unreadable photographs, points or table, windows of even width, or files that cannot be
            written.
    """
    if (point is None) == (points is None):
        raise SurveyFileError("match: give either --point COL,ROW or --points FILE")
    settings = settings or MatchSettings()
    if not 0.0 <= settings.min_correlation <= 1.0:
        raise SurveyFileError(f"match: --min-correlation {settings.min_correlation:g}, expected 0 to 1")
    inputs = (left_path, right_path, *(() if points is None else (points,)))
    refuse_outputs(out, picture, inputs, as_json)
    if points is not None:
        names, xy, start = read_points_to_match(points)
    else:
        names, xy, start = ("1",), _parse_point(str(point)), None
    left, right = _photograph("LEFT", left_path), _photograph("RIGHT", right_path)
    with whole_outputs(out, picture) as (table_file, picture_part):
        matches = match_points(left, right, xy, settings, xy_right=start)
        as_json = as_json or (out is not None and out.suffix.lower() == ".json")
        if picture_part is not None:
            drawing = draw_patches(names, left, right, matches, settings.template_px)
            picture_part.write_bytes(picture_file(drawing))
        if table_file is not None:
            text = matches_json(names, matches) if as_json else matches_table(names, matches).csv
            table_file.write_bytes(text.encode())
    matched = int(matches.good.sum())
    if out is not None:
        return f"{matched} of {len(matches)} points matched: {out}\n", matched > 0
    return matches_json(names, matches) if as_json else matches_table(names, matches).text, matched > 0


def read_points_to_match(path: Path) -> tuple[tuple[str, ...], FloatArray, FloatArray | None]:
    """Read a table point,x_px,y_px[,x_right_px,y_right_px].

    Args:
        path: CSV file; the last two columns are the centres of the search windows.

    Returns:
        Names, points in the left photograph (k, 2), and centres (k, 2) or None, px.

    Raises:
        SurveyFileError: the file is unreadable or empty, has wrong columns, repeats a name, or has a value
            that is not a finite number.
    """
    table = read_table(path, NAMES[:1], NAMES[1:3], NAMES[3:5])
    values = table.values
    return table.keys("point"), values[:, :2], values[:, 2:] if values.shape[1] > 2 else None


def _photograph(which: str, path: Path) -> AnyArray:
    """Read a photograph. The message on a folder names the argument, as the path alone may be just a dot."""
    if path.is_dir():
        raise PhotographError(f"{which} {path}: is a folder, expected a photograph")
    return read_photograph(path)


def _parse_point(text: str) -> FloatArray:
    try:
        xy = np.array([[float(part) for part in text.split(",")]])
    except ValueError:
        xy = np.zeros((1, 0))
    if xy.shape != (1, 2) or not np.isfinite(xy).all():
        raise SurveyFileError(f"match: --point {text!r}, expected COL,ROW such as 812.5,403")
    return xy


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
    values = _read_camera(camera_file) if camera_file is not None else {}
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


def _read_camera(path: Path) -> dict[str, float]:
    table = read_table(path, ("parameter",), ("value",), ignored=None)
    parameters = table.keys("parameter")
    for line, name in zip(table.line, parameters, strict=True):
        if name not in _CAMERA:
            raise SurveyFileError(
                f"{path}, line {line}: unknown parameter '{name}', expected one of {', '.join(_CAMERA)}"
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
        raise SurveyFileError(f"--start '{text}': expected X,Y,Z or X,Y,Z,omega,phi,kappa (deg)")
    values[3:] = np.radians(values[3:])
    return values
