"""The work of `kolinear match`: two photographs, the points in one, and the files of the result."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfm.files.csv_tables import read_table
from sfm.matching.conjugate import match_points
from sfm.matching.conjugate_patches import MatchSettings
from sfm.model.conventions import AnyArray, FloatArray
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


def match_photographs(
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
        try:
            xy = np.array([[float(part) for part in str(point).split(",")]])
        except ValueError:
            xy = np.zeros((1, 0))
        if xy.shape != (1, 2) or not np.isfinite(xy).all():
            raise SurveyFileError(f"match: --point {str(point)!r}, expected COL,ROW such as 812.5,403")
        names, start = ("1",), None
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
