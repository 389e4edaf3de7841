"""Commands about single photographs: match, resect and targets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.commands.starting import loading
from sfm.errors import SurveyFileError
from sfm.runtime.faults import working_on
from sfm.textbook.resection import METHODS

if TYPE_CHECKING:
    from sfm.conventions import IntArray
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
        from sfm.cli.commands.matching import match_command
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
        from sfm.cli.commands.matching import read_task
        from sfm.report.single_photographs import (
            comparison_json,
            comparison_table,
            resection_json,
            resection_text,
        )
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
