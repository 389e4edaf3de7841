"""The command `resect`: one photograph on known points."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import AsJson
from sfm.cli.process import loading
from sfm.runtime.faults import working_on
from sfm.textbook.resection import METHODS


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
    photograph: Annotated[
        str | None,
        typer.Option(
            "--photograph", metavar="NAME", help="Name of the photograph.  [default: that of POINTS.csv]"
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Orient one photograph from known points (space resection).

    Uses one method, or all methods for a comparison. What --json prints of one method can be
    given to compare.
    """
    with loading():
        from sfm.cli.resection_inputs import read_tasks
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
        text = resection_text(result, task.c)
        values = resection_json(result, task.c, photograph or points.stem)
    print(json.dumps(values, indent=2, allow_nan=False) if as_json else text)
