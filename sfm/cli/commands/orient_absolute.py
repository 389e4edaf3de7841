"""The command `orient absolute`: a model in the frame of its control points."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.process import loading
from sfm.runtime.faults import working_on


def orient_absolute(
    model: Annotated[Path, typer.Argument(metavar="MODEL.csv", help="Table point,X,Y,Z of the model.")],
    control: Annotated[
        Path, typer.Argument(metavar="CONTROL.csv", help="Table point,X,Y,Z[,sigma] of the control points.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE.csv", help="New file for point,X,Y,Z in the frame of control."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Bring a model onto its control points.

    By scale, three rotations and three shifts. The model may come from `orient pair` or from another
    program. With sigma, points are weighted by 1 / sigma^2.
    """
    with loading():
        from sfm.cli.photo_tables import OBJECT, read_control, read_points, write_points
        from sfm.model.similarity import orient_absolute as orient
        from sfm.report.orientations import absolute_report

    with working_on(str(model)):
        names, xyz = read_points(model, OBJECT)
    with working_on(str(control)):
        common, target, weights, absent = read_control(control, names)
    rows = [names.index(name) for name in common]
    orientation = orient(xyz[rows], target, weights=weights)
    moved = orientation.similarity.apply(xyz)
    if out is not None:
        write_points(out, OBJECT, names, moved)
    report = absolute_report(orientation, xyz[rows], target, weights, common, absent, names, moved)
    print(report.said(as_json))
