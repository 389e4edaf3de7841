"""The body of `kolinear match`: two photographs and points in, a table, JSON and a picture out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfm.conventions import AnyArray, FloatArray
from sfm.errors import PhotographError, SurveyFileError
from sfm.files.csv_tables import read_table
from sfm.matching.conjugate import BACK_PX, MIN_CORRELATION, match_points
from sfm.photographs.reading import read_photograph
from sfm.report.figures.patches import draw_patches
from sfm.report.matching import (
    NAMES,
    matches_json,
    matches_table,
    picture_file,
    refuse_outputs,
    whole_outputs,
)


def match_command(
    left_path: Path,
    right_path: Path,
    *,
    point: str | None = None,
    points: Path | None = None,
    method: str = "lsm",
    template_px: int = 21,
    search_px: int = 121,
    equalise: bool = False,
    interpolation: str = "six_tap",
    min_correlation: float = MIN_CORRELATION,
    back_px: float | None = BACK_PX,
    wide: bool = True,
    as_json: bool = False,
    out: Path | None = None,
    picture: Path | None = None,
) -> tuple[str, bool]:
    """Match points of two photograph files.

    Args:
        left_path: the photograph in which points are given.
        right_path: the photograph in which they are found.
        point: "COL,ROW" in the left photograph, px; either this or `points`.
        points: table of points, see `read_points_to_match`.
        method: this and the next six as in `sfm.matching.conjugate.match_points`.
        template_px: width of the template, px.
        search_px: width of the search area, px.
        equalise: whether the histograms of both photographs are equalised before.
        interpolation: between pixels.
        min_correlation: least correlation coefficient.
        back_px: largest distance of matching back, px; None for no matching back.
        wide: whether points that are not found are looked for again, turned and scaled.
        as_json: JSON in place of the table.
        out: file .csv or .json that gets the table, in place of the terminal.
        picture: PNG file that gets template, matched patch and their difference.

    Returns:
        The text that the command line prints, and whether any point was matched.

    Raises:
        KolinearError: unreadable photographs, points or table, even windows, or files that cannot be written.
    """
    if (point is None) == (points is None):
        raise SurveyFileError("match: give either --point COL,ROW or --points FILE")
    if not 0.0 <= min_correlation <= 1.0:
        raise SurveyFileError(f"match: --min-correlation {min_correlation:g}, needed 0 to 1")
    inputs = (left_path, right_path, *(() if points is None else (points,)))
    refuse_outputs(out, picture, inputs, as_json)
    if points is not None:
        names, xy, start = read_points_to_match(points)
    else:
        names, xy, start = ("1",), _parse_point(str(point)), None
    left, right = _photograph("LEFT", left_path), _photograph("RIGHT", right_path)
    with whole_outputs(out, picture) as (table_file, picture_part):
        found = match_points(
            left,
            right,
            xy,
            xy_right=start,
            method=method,
            template_px=template_px,
            search_px=search_px,
            equalise=equalise,
            interpolation=interpolation,
            min_correlation=min_correlation,
            back_px=back_px,
            wide=wide,
        )
        as_json = as_json or (out is not None and out.suffix.lower() == ".json")
        if picture_part is not None:
            drawing = draw_patches(names, left, right, found, template_px)
            picture_part.write_bytes(picture_file(drawing))
        if table_file is not None:
            text = matches_json(names, found) if as_json else matches_table(names, found).csv
            table_file.write_bytes(text.encode())
    matched = int(found.good.sum())
    if out is not None:
        return f"{matched} of {len(found)} points matched: {out}\n", matched > 0
    return matches_json(names, found) if as_json else matches_table(names, found).text, matched > 0


def read_points_to_match(path: Path) -> tuple[tuple[str, ...], FloatArray, FloatArray | None]:
    """Read point,x_px,y_px[,x_right_px,y_right_px]; the last two are centres of the search windows.

    Returns:
        Names, left points (k, 2) and centres (k, 2) or None, px.

    Raises:
        SurveyFileError: unreadable, wrong columns, no rows, a name twice, or not a finite number.
    """
    table = read_table(path, NAMES[:1], NAMES[1:3], NAMES[3:5])
    values = table.values
    return table.keys("point"), values[:, :2], values[:, 2:] if values.shape[1] > 2 else None


def _photograph(which: str, path: Path) -> AnyArray:
    """Read a photograph; a folder has no name to be called by, so the argument is named."""
    if path.is_dir():
        raise PhotographError(f"{which} {path}: a folder, a photograph is needed")
    return read_photograph(path)


def _parse_point(text: str) -> FloatArray:
    try:
        xy = np.array([[float(part) for part in text.split(",")]])
    except ValueError:
        xy = np.zeros((1, 0))
    if xy.shape != (1, 2) or not np.isfinite(xy).all():
        raise SurveyFileError(f"match: --point {text!r}, needed COL,ROW such as 812.5,403")
    return xy
