"""The command `match`: conjugate points of two photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import AsJson
from sfm.cli.process import loading
from sfm.runtime.faults import working_on

NONE_MATCHED = 1  # exit code


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
    as_json: AsJson = False,
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
        from sfm.cli.matched_photographs import match_photographs
        from sfm.matching.conjugate_patches import BACK_PX, MatchSettings

    with working_on(f"{left} and {right}"):
        text, matched = match_photographs(
            left,
            right,
            point=point,
            points=points,
            settings=MatchSettings(
                method=method,
                template_px=template,
                search_px=search,
                equalise=equalise,
                interpolation=interpolation,
                min_correlation=min_correlation,
                back_px=BACK_PX if back else None,
                wide=wide,
            ),
            as_json=as_json,
            out=out,
            picture=picture,
        )
    print(text, end="")
    if not matched:
        raise SystemExit(NONE_MATCHED)
