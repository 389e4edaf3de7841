"""The command `orient fiducials`: measured coordinates in the system of the fiducial marks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.process import loading
from sfm.runtime.faults import working_on


def orient_fiducials(
    marks: Annotated[
        Path, typer.Argument(metavar="MARKS.csv", help="Table mark,x,y,x_mm,y_mm: measured and calibrated.")
    ],
    points: Annotated[
        Path | None,
        typer.Option("--points", metavar="POINTS.csv", help="Table point,x,y of points to transform."),
    ] = None,
    kind: Annotated[
        str, typer.Option("--kind", help="Transformation: affine (6 parameters) or similarity (4).")
    ] = "affine",
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE.csv", help="New file for point,x_mm,y_mm of --points."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Transform measured to photo coordinates by fiducial marks.

    Measured coordinates are those of a comparator or a scan. Columns and rows of a scan count downwards, and
    need the affine transformation.
    """
    with loading():
        from sfm.cli.photo_tables import PHOTO, read_points, write_points
        from sfm.model.errors import SurveyFileError
        from sfm.report.orientations import fiducials_report
        from sfm.textbook.photo_coordinates import orient_fiducials as orient

    if out is not None and points is None:
        raise SurveyFileError(f"--out {out}: expected --points, which are written there")
    with working_on(str(marks)):
        names, coordinates = read_points(marks, ("x", "y", *PHOTO), name="mark")
        transformation = orient(coordinates[:, :2], coordinates[:, 2:], kind=kind)
    shown: tuple[str, ...] = ()
    photo = coordinates[:0, :2]
    if points is not None:
        with working_on(str(points)):
            shown, measured = read_points(points, ("x", "y"))
        photo = transformation.apply(measured)
    if out is not None:
        write_points(out, PHOTO, shown, photo)
    report = fiducials_report(
        transformation,
        names,
        shown,
        photo,
        measured=coordinates[:, :2],
        calibrated=coordinates[:, 2:],
    )
    print(report.said(as_json))
