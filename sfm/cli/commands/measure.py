"""The command `measure`: shapes, distances, alignment and tolerances of a result."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.options import Pdf
from sfm.cli.process import loading
from sfm.model.display import counted
from sfm.runtime.faults import working_on

if TYPE_CHECKING:
    from sfm.products.inspection.measurement import Measurement

MAX_PRINTED = 40  # distances, angles and heights on the terminal; quantities.csv lists all


def measure(
    source: Annotated[
        Path,
        typer.Argument(metavar="RESULT", help="Result folder, COLMAP model, or another known format."),
    ],
    features: Annotated[
        Path | None,
        typer.Option("--features", metavar="FILE.toml", help="Shapes, alignment, distances and tolerances."),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the tables and the page.")
    ] = Path("out/measurement"),
    from_format: Annotated[
        str | None, typer.Option("--from", metavar="F", help="Format of RESULT.  [default: by its content]")
    ] = None,
    outside: Annotated[
        bool, typer.Option("--allow-outside", help="Let the features file refer to files outside its folder.")
    ] = False,
    pdf: Pdf = False,
) -> None:
    """Measure shapes, distances and tolerances in a result.

    Every value has a standard deviation, propagated from the covariance of all points.
    """
    with loading():
        from adapters.formats.mesh import read_mesh
        from adapters.formats.registry import read_comparable
        from sfm.cli.console import exit_by, print_page, print_verdict
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.products.inspection.features_file import read_features_file
        from sfm.products.inspection.measurement import measure_result
        from sfm.products.inspection.page import describe_measured, parameter_rows, quantity_table
        from sfm.report.pages import write_page
        from sfm.report.phrases import with_sigma

    refuse_foreign_folder(out)
    asked, paths = (None, {}) if features is None else read_features_file(features, allow_outside=outside)
    with working_on(str(source)):
        result = read_comparable(source, from_format)
        measurement = measure_result(result, asked, paths=paths, read_mesh=read_mesh)
    page = write_page(measurement, out, also=partial(_write_drawings, measurement), result=result)
    print_verdict(measurement.verdict)
    print(describe_measured(measurement))
    for fit in measurement.shapes:
        said = [
            f"{name} {' +- '.join(with_sigma(value, sigma))} {unit}"
            for name, axis, value, sigma, unit in parameter_rows(fit, measurement.unit)
            if not axis
        ]
        what = f"{fit.shape.kind.name} {fit.name}: {', '.join((*said, ''))}"
        print(f"{what}form error {fit.form_error:.3g} {measurement.unit}, {counted(fit.used.sum(), 'point')}")
    rows = quantity_table(measurement).rows
    for name, what, _, _, value, sigma, unit, remark in rows[:MAX_PRINTED]:
        line = f"{name} ({what}): {value} +- {sigma} {unit}"
        print(f"{line}{f'; {remark}' if remark else ''}")
    if len(rows) > MAX_PRINTED:
        print(f"and {len(rows) - MAX_PRINTED} more in {page.with_name('quantities.csv')}")
    print_page("Report", page, pdf=pdf)
    exit_by(measurement.verdict)


def _write_drawings(measurement: Measurement, folder: Path) -> None:
    """Write the files of a measurement for other programs: covariance, point cloud and drawing."""
    import numpy as np

    from adapters.formats.dxf import DxfCircle, DxfLine, write_dxf
    from sfm.files.csv_tables import write_ply
    from sfm.products.inspection.page import point_sigma, write_point_covariance

    points = measurement.points
    sigma = point_sigma(measurement)
    layers = [measurement.group_of(j) or "points" for j in range(len(points.names))]
    lines, circles, texts = [], [], []
    for fit in measurement.shapes:
        shape = fit.shape
        texts.append((fit.name, f"{shape.kind.name} {fit.name}", shape.origin))
        if shape.kind.name in ("line", "cylinder", "cone", "paraboloid"):
            along = (points.xyz[fit.points] - shape.origin) @ shape.axis
            ends = (shape.origin + x * shape.axis for x in (along.min(), along.max()))
            lines.append(DxfLine(fit.name, *ends))
        if shape.kind.name in ("circle", "cylinder", "torus"):
            circles.append(DxfCircle(fit.name, shape.origin, shape.axis, float(shape.form[0])))
    write_point_covariance(measurement, folder)
    known = sigma if np.isfinite(sigma).all() else None
    write_ply(folder / "points.ply", points.xyz, names=points.names, sigma=known)
    write_dxf(folder / "measurement.dxf", names=points.names, xyz=points.xyz, layers=layers,
              unit=points.unit, lines=lines, circles=circles, texts=texts)  # fmt: skip
