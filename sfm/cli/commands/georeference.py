"""The command `georeference`: one photograph of a flat object in the frame of its control points."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.process import loading
from sfm.runtime.faults import working_on


def georeference(
    photograph: Annotated[Path, typer.Argument(metavar="PHOTO", help="Photograph or scan.")],
    control: Annotated[Path, typer.Argument(metavar="CONTROL.csv", help="Table point,x_px,y_px,X,Y.")],
    out: Annotated[
        Path,
        typer.Option("--out", metavar="FILE", help="New picture, .png, .tif or .jpg, beside its world file."),
    ],
    model: Annotated[
        str,
        typer.Option("--model", help="Transformation: projective, affine, polynomial2 or polynomial3."),
    ] = "projective",
    pixel: Annotated[
        float | None,
        typer.Option(
            "--pixel",
            metavar="SIZE",
            help="Side of a new pixel, unit of the control.  [default: that of the photograph]",
        ),
    ] = None,
    extent: Annotated[
        str | None,
        typer.Option(
            "--extent", metavar="X0,Y0,X1,Y1", help="Part of the object.  [default: around the control]"
        ),
    ] = None,
    crs: Annotated[
        str | None,
        typer.Option("--crs", metavar="CRS", help="Coordinate system of the control, as EPSG:32749."),
    ] = None,
) -> None:
    """Draw a photograph of a flat object onto its control points.

    A photograph of a plane is a projective image of it. Facades, floors, plans and scans are georeferenced
    so; relief is not corrected. All transformations that the points determine are compared by how well each
    point is predicted from the others.
    """
    with loading():
        from sfm.cli.photo_tables import parse_extent, read_points
        from sfm.model.display import listed
        from sfm.model.errors import GeometryError
        from sfm.photographs.exif import read_metadata
        from sfm.photographs.reading import read_for_display
        from sfm.products.georeferencing.resampled import (
            map_grid,
            projection_of,
            refuse_map,
            resample_to_map,
            write_map,
        )
        from sfm.products.georeferencing.transformation import fit_plane
        from sfm.report.orientations import georeferencing_report

    refuse_map(out)
    projection = None if crs is None else projection_of(crs)
    with working_on(str(control)):
        names, values = read_points(control, ("x_px", "y_px", "X", "Y"))
        xy, places = values[:, 2:], values[:, :2]
        transformation = fit_plane(xy, places, model=model)
        grid = map_grid(transformation, xy, pixel=pixel, extent=parse_extent(extent))
    with working_on(str(photograph)):
        pixels, is_turned = read_for_display(photograph), read_metadata(photograph).orientation != 1
        height, width = pixels.shape[:2]
        outside = [
            name
            for name, (x, y) in zip(names, places.tolist(), strict=True)
            if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5)
        ]
        if outside:
            raise GeometryError(
                f"georeferencing: control points outside the photograph of {width} x {height} pixels"
                f"{', which viewers turn by its EXIF data' if is_turned else ''}: {listed(outside)}"
            )
        drawn, shown = resample_to_map(pixels, transformation, grid)
    write_map(out, drawn, shown, grid, projection)
    report = georeferencing_report(transformation, names, xy, places, grid, is_turned=is_turned)
    print(report.said(as_json=False))
    print(f"Picture: {out}")
