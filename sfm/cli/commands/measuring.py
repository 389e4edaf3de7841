"""Commands about single photographs: match, resect and targets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from sfm.camera import camera_from_values, tangents_from_pixel
from sfm.cli.commands.starting import loading
from sfm.conventions import AnyArray, FloatArray, pixel_from_image
from sfm.errors import PhotographError, SurveyFileError
from sfm.files.csv_tables import read_table
from sfm.matching.conjugate import MIN_CORRELATION, match_points
from sfm.photographs.reading import read_photograph
from sfm.report.figures.overlays import draw_patches
from sfm.report.measuring import (
    NAMES,
    matches_json,
    matches_table,
    picture_file,
    refuse_outputs,
    whole_outputs,
)
from sfm.runtime.faults import working_on
from sfm.textbook.resection import METHODS
from sfm.textbook.resection.by_method import Task

if TYPE_CHECKING:
    from sfm.conventions import IntArray

_DISTORTION = ("K1", "K2", "K3", "P1", "P2", "b1", "b2")
_CAMERA = ("c", "x0", "y0", *_DISTORTION)
_UNIT_PIXEL = np.array([1.0, 1.0])
NONE_MATCHED = 1  # exit code
MAX_TARGETS = 10_000  # on one sheet; no family has more codes


def match(
    left: Annotated[Path, typer.Argument(metavar="LEFT", help="Photograph in which the points are given.")],
    right: Annotated[Path, typer.Argument(metavar="RIGHT", help="Photograph in which they are looked for.")],
    point: Annotated[
        str | None, typer.Option("--point", metavar="COL,ROW", help="One point of LEFT, px.")
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option("--points", metavar="FILE", help="Table point,x_px,y_px[,x_right_px,y_right_px]."),
    ] = None,
    method: Annotated[
        str, typer.Option("--method", help="ncc, lsm (6 affine + 2 radiometric parameters), lsm8 or shift.")
    ] = "lsm",
    template: Annotated[
        int, typer.Option("--template", metavar="N", help="Side of the patch, odd, px.")
    ] = 21,
    search: Annotated[int, typer.Option("--search", metavar="N", help="Side of the window, px.")] = 121,
    equalise: Annotated[
        bool, typer.Option("--equalise", help="Equalise the histograms before least squares matching.")
    ] = False,
    interpolation: Annotated[
        str,
        typer.Option(
            "--interpolation",
            help="six_tap; bicubic or bilinear where a photograph was itself shifted by interpolation.",
        ),
    ] = "six_tap",
    min_correlation: Annotated[
        float, typer.Option("--min-correlation", metavar="R", help="Smallest r of a match, 0 to 1.")
    ] = 0.7,
    back: Annotated[
        bool,
        typer.Option(
            "--back/--no-back", help="Whether a match must lead back to within 1 px of where it came from."
        ),
    ] = True,
    wide: Annotated[
        bool,
        typer.Option(
            "--wide/--no-wide",
            help="Whether points not found are looked for again where key points around them lead, or turned "
            "by up to 30 degrees and scaled by up to 1.3.",
        ),
    ] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON in place of a table.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write the table: .csv or .json.")
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", metavar="FILE.png", help="Picture of template, match and difference."),
    ] = None,
) -> None:
    """Find conjugate points of two photographs.

    By cross correlation, then least squares matching. A match is ambiguous if the second-best place of the
    search window has an r that is not lower by more than chance (5 %, by Fisher's z). Without centres of
    search windows in the table, key points may lead anywhere in RIGHT.
    Files given with --out and --picture may replace earlier ones of this command, and nothing else. Exit
    code 1 if no point was matched.
    """
    with loading():
        from sfm.matching.conjugate import BACK_PX

    with working_on(f"{left} and {right}"):
        text, matched = match_command(
            left,
            right,
            point=point,
            points=points,
            method=method,
            template_px=template,
            search_px=search,
            equalise=equalise,
            interpolation=interpolation,
            min_correlation=min_correlation,
            back_px=BACK_PX if back else None,
            wide=wide,
            as_json=as_json,
            out=out,
            picture=picture,
        )
    print(text, end="")
    if not matched:
        raise SystemExit(NONE_MATCHED)


def resect(
    points: Annotated[Path, typer.Argument(metavar="POINTS.csv", help="Table point,X,Y,Z,x_mm,y_mm.")],
    c: Annotated[float | None, typer.Option("--c", metavar="MM", help="Principal distance, mm.")] = None,
    method: Annotated[
        str, typer.Option("--method", help=f"{', '.join(METHODS)}, or all for a table of them.")
    ] = "robust",
    camera: Annotated[
        Path | None,
        typer.Option("--camera", metavar="CAMERA.csv", help="Table parameter,value of model brown, mm."),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option("--start", metavar="X,Y,Z[,omega,phi,kappa]", help="Start values, object unit and deg."),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            "--tolerance",
            metavar="MM",
            help="Largest residual of a good point for robust, mm; from the data if not given.",
        ),
    ] = None,
    opposite_signs: Annotated[
        bool,
        typer.Option("--opposite-signs", help="Distortion is subtracted from what was measured, not added."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON in place of a table.")] = False,
) -> None:
    """Orient one photograph on known points.

    By any of the methods, or all of them for a comparison.
    """
    with loading():
        from sfm.report.measuring import comparison_json, comparison_table, resection_json, resection_text
        from sfm.textbook.resection.by_method import resect as resect_by
        from sfm.textbook.resection.by_method import resect_by_all

    with working_on(str(points)):
        task = read_task(
            points,
            c_mm=c,
            camera_file=camera,
            start=start,
            tolerance_mm=tolerance,
            opposite_signs=opposite_signs,
        )
    if method == "all":
        found = resect_by_all(task)
        text = comparison_table(found, task.c)
        values: object = comparison_json(found, task.c)
    else:
        one = resect_by(task, method)
        text, values = resection_text(one, task.c), resection_json(one, task.c)
    print(json.dumps(values, indent=2, allow_nan=False) if as_json else text)


def targets(
    out: Annotated[
        Path,
        typer.Option("--out", metavar="FILE", help="Sheet to write: .pdf or .svg; replaces only a sheet."),
    ],
    family: Annotated[
        str,
        typer.Option(
            "--family",
            help="ring12, ring14, ring20, arcs, a family of tags (apriltag36h11, aruco4x4_50 ...), cctag3, "
            "cctag4, or a code table file.",
        ),
    ] = "ring14",
    ids: Annotated[
        str | None,
        typer.Option("--ids", metavar="A-B,C", help="Code numbers, each once; the first 100 of the family."),
    ] = None,
    diameter: Annotated[
        float,
        typer.Option(
            "--diameter-mm",
            metavar="MM",
            help="Diameter of the dot, at least 1 mm; of cctag3 and cctag4 "
            "that of the outer edge; of square tags the side.",
        ),
    ] = 10.0,
    page: Annotated[str, typer.Option("--page", help="a4, a3, letter ...")] = "a4",
    bright: Annotated[bool, typer.Option("--bright", help="White targets on dark squares.")] = False,
    ring_radii: Annotated[
        str | None,
        typer.Option(
            "--ring-radii",
            metavar="R1,R2",
            help="Inner and outer radius of rings (not tags), in radii of the dot.",
        ),
    ] = None,
) -> None:
    """Write a sheet of coded targets for printing.

    It is in true scale and has a ruler to check the print.
    """
    with loading():
        from sfm.printing.sheet import lay_out_sheet, write_sheet

    radii = None if ring_radii is None else _two(ring_radii)
    sheet = lay_out_sheet(
        family,
        None if ids is None else _numbers(ids),
        diameter_mm=diameter,
        page=page,
        dark=not bright,
        ring_radii=radii,
    )
    for path in write_sheet(sheet, out):
        print(path)


def _two(text: str) -> tuple[float, float]:
    """Return the two numbers of `2,3`."""
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError as error:
        raise SurveyFileError(f"--ring-radii {text}: needed two numbers such as 2,3") from error
    return first, second


def _numbers(text: str) -> IntArray:
    """Return the code numbers that `1-100,205` names."""
    import numpy as np

    numbers: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise SurveyFileError(f"--ids {text}: '{part}' is neither a number nor a range such as 1-100")
        begin, end = int(first), int(last if dash else first)
        if end < begin or end - begin >= MAX_TARGETS or len(numbers) + end - begin >= MAX_TARGETS:
            raise SurveyFileError(
                f"--ids {text}: '{part}' must run upwards, a sheet has at most {MAX_TARGETS} targets"
            )
        numbers += range(begin, end + 1)
    return np.array(numbers, dtype=np.int64)


def match_command(
    left_path: Path,
    right_path: Path,
    *,
    point: str | None = None,
    points: Path | None = None,
    template_px: int = 21,
    min_correlation: float = MIN_CORRELATION,
    as_json: bool = False,
    out: Path | None = None,
    picture: Path | None = None,
    **how: Any,
) -> tuple[str, bool]:
    """Match points of two photograph files.

    Args:
        left_path: the photograph in which points are given.
        right_path: the photograph in which they are found.
        point: "COL,ROW" in the left photograph, px; either this or `points`.
        points: table of points, see `read_points_to_match`.
        template_px: width of the template, px.
        min_correlation: least correlation coefficient.
        as_json: JSON in place of the table.
        out: file .csv or .json that gets the table, in place of the terminal.
        picture: PNG file that gets template, matched patch and their difference.
        how: more of what `sfm.matching.conjugate.match_points` takes.

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
            template_px=template_px,
            min_correlation=min_correlation,
            **how,
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
