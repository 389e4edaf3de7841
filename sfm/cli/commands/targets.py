"""The command `targets`: coded targets, tags and boards to print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.process import loading
from sfm.model.errors import SurveyFileError

if TYPE_CHECKING:
    from sfm.model.conventions import IntArray

MAX_TARGETS = 10_000  # per sheet; no family has more codes


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

    radii = None
    if ring_radii is not None:
        try:
            inner, outer = (float(part) for part in ring_radii.split(","))
        except ValueError as error:
            raise SurveyFileError(f"--ring-radii {ring_radii}: expected two numbers such as 2,3") from error
        radii = inner, outer
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
