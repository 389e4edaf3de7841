"""The command `orient pair`: two photographs relative to each other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.process import loading
from sfm.runtime.faults import working_on


def orient_pair(
    left: Annotated[Path, typer.Argument(metavar="LEFT.csv", help="Table point,x_mm,y_mm of photograph 1.")],
    right: Annotated[
        Path, typer.Argument(metavar="RIGHT.csv", help="Table point,x_mm,y_mm of photograph 2.")
    ],
    c: Annotated[
        float | None, typer.Option("--c", metavar="MM", help="Principal distance of both, mm.")
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            "--camera",
            metavar="CAMERA.csv",
            help="Table parameter,value of the interior orientation of both, model brown, mm.",
        ),
    ] = None,
    camera_right: Annotated[
        Path | None,
        typer.Option("--camera-right", metavar="CAMERA.csv", help="The same of photograph 2, if another."),
    ] = None,
    kind: Annotated[
        str,
        typer.Option(
            "--kind",
            help="Parameters: dependent (in the frame of photograph 1) or independent (of the base).",
        ),
    ] = "dependent",
    bx: Annotated[
        float, typer.Option("--bx", metavar="BX", help="X component of the base of a dependent pair.")
    ] = 1.0,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="MODEL.csv", help="New file for point,X,Y,Z of the model.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Orient two photographs relative to each other.

    The model is computed too. Points of the same name are conjugate; at least six are needed. `orient
    absolute` brings the model onto control points.
    """
    with loading():
        import numpy as np

        from sfm.cli.photo_tables import OBJECT, read_pair, write_points
        from sfm.model.errors import SurveyFileError
        from sfm.report.orientations import pair_report
        from sfm.textbook.pair import intersect_pair, orient_dependent, orient_independent

    if kind not in ("dependent", "independent"):
        raise SurveyFileError(f"--kind {kind}: expected dependent or independent")
    with working_on(f"{left} and {right}"):
        pair = read_pair(left, right, c, camera, camera_right)
        if kind == "dependent":
            orientation = orient_dependent(pair.first, pair.second, bx=bx)
        else:
            orientation = orient_independent(pair.first, pair.second)
        model = intersect_pair(orientation, pair.first, pair.second)
    if out is not None:
        placed = np.flatnonzero(np.isfinite(model).all(axis=1))
        write_points(out, OBJECT, [pair.names[k] for k in placed.tolist()], model[placed])
    print(pair_report(orientation, pair.names, model, c_mm=pair.c_mm, alone=pair.alone).said(as_json))
