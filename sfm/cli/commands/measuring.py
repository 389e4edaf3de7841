"""Commands for single photographs: match, resect and targets."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.commands.starting import loading
from sfm.model.errors import SurveyFileError
from sfm.runtime.faults import working_on
from sfm.textbook.resection import METHODS

if TYPE_CHECKING:
    from sfm.model.conventions import IntArray
NONE_MATCHED = 1  # exit code
MAX_TARGETS = 10_000  # per sheet; no family has more codes


def match(
    left: Annotated[Path, typer.Argument(metavar="LEFT", help="Photograph in which the points are given.")],
    right: Annotated[
        Path, typer.Argument(metavar="RIGHT", help="Photograph in which they are searched for.")
    ],
    point: Annotated[
        str | None, typer.Option("--point", metavar="COL,ROW", help="One point of LEFT, px.")
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option("--points", metavar="FILE", help="Table point,x_px,y_px[,x_right_px,y_right_px]."),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            "--method", help="Method: ncc, lsm (6 affine + 2 radiometric parameters), lsm8 or shift."
        ),
    ] = "lsm",
    template: Annotated[
        int, typer.Option("--template", metavar="N", help="Width of the template, odd, px.")
    ] = 21,
    search: Annotated[
        int, typer.Option("--search", metavar="N", help="Width of the search window, px.")
    ] = 121,
    equalise: Annotated[
        bool, typer.Option("--equalise", help="Equalise the histograms before least squares matching.")
    ] = False,
    interpolation: Annotated[
        str,
        typer.Option(
            "--interpolation",
            help="Interpolation: six_tap, or bicubic or bilinear if a photograph was itself shifted by "
            "interpolation.",
        ),
    ] = "six_tap",
    min_correlation: Annotated[
        float,
        typer.Option(
            "--min-correlation", metavar="R", help="Smallest correlation coefficient r of a match, 0 to 1."
        ),
    ] = 0.7,
    back: Annotated[
        bool,
        typer.Option(
            "--back/--no-back",
            help="Whether matching from RIGHT to LEFT must lead back to within 1 px of the point.",
        ),
    ] = True,
    wide: Annotated[
        bool,
        typer.Option(
            "--wide/--no-wide",
            help="Whether points not found are searched for again: at positions predicted by key points "
            "around them, or rotated by up to 30 degrees and scaled by up to 1.3.",
        ),
    ] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="Write the table to this file, .csv or .json, instead of printing it.",
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture", metavar="FILE.png", help="Write a picture of template, match and difference."
        ),
    ] = None,
) -> None:
    """Find conjugate points of two photographs.

    Points are matched by cross correlation, then by least squares matching. A match is ambiguous if r at the
    second-best position of the search window is not significantly lower (5 %, by Fisher's z). If the table
    has no centres of search windows, key points may lead anywhere in RIGHT.

    --out and --picture replace only files that this command wrote. Exit code 1 if no point was matched.
    """
    with loading():
        from sfm.cli.commands.matching import match_command
        from sfm.matching.conjugate_patches import BACK_PX

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
        str,
        typer.Option("--method", help=f"Method: {', '.join(METHODS)}, or all for a table of all methods."),
    ] = "robust",
    camera: Annotated[
        Path | None,
        typer.Option(
            "--camera",
            metavar="CAMERA.csv",
            help="Table parameter,value of the interior orientation, model brown, mm.",
        ),
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
            help="Largest residual of a correct point for method robust, mm.  [default: from the data]",
        ),
    ] = None,
    opposite_signs: Annotated[
        bool,
        typer.Option(
            "--opposite-signs",
            help="Distortion of the camera file is subtracted from measured coordinates, not added.",
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Orient one photograph from known points (space resection).

    Uses one method, or all methods for a comparison.
    """
    with loading():
        from sfm.cli.commands.matching import read_tasks
        from sfm.report.single_photographs import (
            comparison_json,
            comparison_table,
            resection_json,
            resection_text,
        )
        from sfm.textbook.resection.by_method import resect as resect_by
        from sfm.textbook.resection.by_method import resect_by_all, signs_warning

    with working_on(str(points)):
        tasks = read_tasks(points, c_mm=c, camera_file=camera, start=start, tolerance_mm=tolerance)
        task, opposite = reversed(tasks) if opposite_signs else tasks
        warning = "" if camera is None else signs_warning(task, opposite)
    if method == "all":
        results = resect_by_all(task)
        text = comparison_table(results, task.c) + (f"\nwarning: {warning}" if warning else "")
        values: object = comparison_json(results, task.c)
    else:
        result = resect_by(task, method)
        result = replace(result, warning="; ".join(filter(None, (result.warning, warning))))
        text, values = resection_text(result, task.c), resection_json(result, task.c)
    print(json.dumps(values, indent=2, allow_nan=False) if as_json else text)


def targets(
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="FILE", help="Sheet to write, .pdf or .svg; only another sheet is replaced."
        ),
    ],
    family: Annotated[
        str,
        typer.Option(
            "--family",
            help="Code family: ring12, ring14, ring20, arcs, a family of tags (apriltag36h11, aruco4x4_50 "
            "...), cctag3, cctag4, or a code table file.",
        ),
    ] = "ring14",
    ids: Annotated[
        str | None,
        typer.Option(
            "--ids",
            metavar="A-B,C",
            help="Code numbers, each once.  [default: the first 100 of the family]",
        ),
    ] = None,
    diameter: Annotated[
        float,
        typer.Option(
            "--diameter-mm",
            metavar="MM",
            help="Diameter of the dot, at least 1 mm. For cctag3 and cctag4, diameter of the outer edge; for "
            "square tags, length of a side.",
        ),
    ] = 10.0,
    page: Annotated[str, typer.Option("--page", help="Page size: a4, a3, letter ...")] = "a4",
    bright: Annotated[bool, typer.Option("--bright", help="Print white targets on dark squares.")] = False,
    ring_radii: Annotated[
        str | None,
        typer.Option(
            "--ring-radii",
            metavar="R1,R2",
            help="Inner and outer radius of the code ring (not for tags), in radii of the dot.",
        ),
    ] = None,
) -> None:
    """Write a sheet of coded targets for printing.

    The sheet is drawn to scale and has a ruler to check the print.
    """
    with loading():
        from sfm.products.printing.sheet import lay_out_sheet, write_sheet

    radii = None if ring_radii is None else _parse_two_numbers(ring_radii)
    sheet = lay_out_sheet(
        family,
        None if ids is None else _parse_ids(ids),
        diameter_mm=diameter,
        page=page,
        dark=not bright,
        ring_radii=radii,
    )
    for path in write_sheet(sheet, out):
        print(path)


def _parse_two_numbers(text: str) -> tuple[float, float]:
    """Return the two numbers in a text such as `2,3`."""
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError as error:
        raise SurveyFileError(f"--ring-radii {text}: expected two numbers such as 2,3") from error
    return first, second


def _parse_ids(text: str) -> IntArray:
    """Return the code numbers in a text such as `1-100,205`."""
    import numpy as np

    numbers: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise SurveyFileError(f"--ids {text}: '{part}' is neither a number nor a range such as 1-100")
        begin, end = int(first), int(last if dash else first)
        if end < begin or end - begin >= MAX_TARGETS or len(numbers) + end - begin >= MAX_TARGETS:
            raise SurveyFileError(
                f"--ids {text}: '{part}' must ascend, and a sheet has at most {MAX_TARGETS} targets"
            )
        numbers += range(begin, end + 1)
    return np.array(numbers, dtype=np.int64)
