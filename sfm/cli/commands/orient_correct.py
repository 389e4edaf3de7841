"""The command `orient correct`: photo coordinates for which the collinearity equations hold."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.process import loading
from sfm.runtime.faults import working_on


def orient_correct(
    points: Annotated[Path, typer.Argument(metavar="POINTS.csv", help="Table point,x_mm,y_mm, y up.")],
    c: Annotated[float | None, typer.Option("--c", metavar="MM", help="Principal distance, mm.")] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            "--camera",
            metavar="CAMERA.csv",
            help="Table parameter,value of c, x0, y0, K1, K2, K3, P1, P2, model brown, mm.",
        ),
    ] = None,
    radial: Annotated[
        Path | None,
        typer.Option(
            "--radial",
            metavar="TABLE.csv",
            help="Table radius_mm,distortion_mm of a certificate, positive outwards.",
        ),
    ] = None,
    flying_height: Annotated[
        float | None,
        typer.Option(
            "--flying-height", metavar="KM", help="Height above sea level, km; corrects the refraction."
        ),
    ] = None,
    terrain_height: Annotated[
        float,
        typer.Option("--terrain-height", metavar="KM", help="Height of the terrain above sea level, km."),
    ] = 0.0,
    curvature: Annotated[
        bool,
        typer.Option(
            "--curvature",
            help="Correct the curvature of the earth; not for control in Cartesian coordinates.",
        ),
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.csv", help="New file for point,x_mm,y_mm.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Correct photo coordinates for the collinearity equations.

    Principal point, radial and decentring distortion, refraction and curvature of the earth. The result needs
    no camera file in `resect` and `orient pair`, only --c.
    """
    with loading():
        from sfm.cli.photo_tables import PHOTO, read_corrections, read_points, write_points
        from sfm.report.orientations import corrections_report
        from sfm.textbook.photo_coordinates import correct_photo_coordinates

    with working_on(str(points)):
        names, measured = read_points(points, PHOTO)
    corrections, c_mm = read_corrections(
        c,
        camera,
        radial,
        flying_height_km=flying_height,
        terrain_height_km=terrain_height,
        curvature=curvature,
    )
    corrected = correct_photo_coordinates(measured, corrections, c_mm=c_mm)
    if out is not None:
        write_points(out, PHOTO, names, corrected)
    print(corrections_report(names, measured, corrected).said(as_json))
