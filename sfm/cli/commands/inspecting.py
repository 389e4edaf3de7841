"""Commands for finished results: measure, accept and view."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.commands.starting import loading
from sfm.model.display import counted
from sfm.model.errors import OutputError
from sfm.runtime.faults import working_on

if TYPE_CHECKING:
    from sfm.model.conventions import BoolArray, FloatArray
    from sfm.model.solution import Solution

PICTURES = "pictures"  # folder of photographs in a result folder
MAX_PRINTED = 40  # distances, angles and heights on the terminal; quantities.csv lists all
if TYPE_CHECKING:
    from sfm.products.inspection.measure import Measurement


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
) -> None:
    """Measure shapes, distances and tolerances in a result.

    Every value has a standard deviation, propagated from the covariance of all points.
    """
    with loading():
        from adapters.formats.mesh import read_mesh
        from adapters.formats.registry import read_comparable
        from sfm.cli.console import exit_by, print_verdict
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.products.inspection.features_file import read_features_file
        from sfm.products.inspection.measure import measure_result
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
    print(f"Report: {page}")
    exit_by(measurement.verdict)


def accept(
    source: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder of a survey.")],
    lengths: Annotated[
        Path, typer.Argument(metavar="LENGTHS.csv", help="Calibrated lengths: line,from,to,length[,sigma].")
    ],
    a: Annotated[
        float, typer.Option("--limit-a", metavar="A", help="A of the error limit A + K L, object unit.")
    ],
    k: Annotated[
        float, typer.Option("--limit-k", metavar="K", help="K of the error limit, such as 2e-5.")
    ] = 0.0,
    b: Annotated[
        float | None, typer.Option("--limit-b", metavar="B", help="Largest error limit, object unit.")
    ] = None,
    coverage: Annotated[
        float,
        typer.Option(
            "--coverage", metavar="k", min=1.0, help="Coverage factor k of U = k sigma of the calibration."
        ),
    ] = 2.0,
    diagonal: Annotated[
        float | None,
        typer.Option(
            "--diagonal",
            metavar="D",
            help="Body diagonal of the measuring volume, object unit.  [default: of the box around all "
            "points]",
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the table and the page.")
    ] = Path("out/acceptance"),
) -> None:
    """Test a result against calibrated lengths (VDI/VDE 2634 part 1).

    The scale must come from other bars than the tested ones. Exit code 1 if an error of a length provably
    exceeds the limit, or simply exceeds it where the calibration has no standard deviation.
    """
    with loading():
        from adapters.formats.result_tables import read_result, read_scale_sources
        from sfm.cli.console import exit_by, print_verdict
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.products.inspection.acceptance import LengthLimit, accept_result, read_lengths
        from sfm.report.pages import write_page

    refuse_foreign_folder(out)
    with working_on(str(source)):
        result = read_result(source)
        bars, control = read_scale_sources(source)
    acceptance = accept_result(
        result,
        read_lengths(lengths),
        LengthLimit(a, k, float("inf") if b is None else b),
        bars=bars,
        control=control,
        coverage=coverage,
        diagonal=diagonal,
    )
    page = write_page(acceptance, out)
    print_verdict(acceptance.verdict)
    print(f"largest error of a length: {acceptance.largest:.4g} {acceptance.unit}")
    print(f"Report: {page}")
    exit_by(acceptance.verdict)


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
    write_dxf(folder / "measurement.dxf", names=points.names, xyz=points.xyz, layers=layers, lines=lines,
              circles=circles, texts=texts)  # fmt: skip


def view(
    source: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Result folder, COLMAP model, or another known format."),
    ],
    images: Annotated[
        Path | None,
        typer.Option(
            "--images",
            metavar="DIR",
            help="Folder of the photographs.  [default: the pictures of a result folder]",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE.html",
            help="Page to write; an earlier page is replaced.  [default: FOLDER.html]",
        ),
    ] = None,
    from_format: Annotated[
        str | None, typer.Option("--from", metavar="F", help="Format of FOLDER.  [default: by its content]")
    ] = None,
    budget: Annotated[
        float,
        typer.Option("--pictures-mb", metavar="MB", min=0.0, help="Largest total size of the pictures."),
    ] = 15.0,
    browser: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")] = True,
) -> None:
    """Write a result as one page to explore, and open it.

    The page is a single file that needs no server. It has a 3D scene, photographs, crops of the targets and
    tables.
    """
    with loading():
        import webbrowser

        from adapters.formats.registry import format_of, read_comparable
        from adapters.formats.result_tables import read_targets
        from sfm.files.globs import why_no_folder
        from sfm.report.figures.overlays import overlay_names
        from sfm.report.view_page import photographs_in, refuse_foreign_page, write_view
        from sfm.report.viewer.embedded import scene_of_stored
        from sfm.runtime.progress_bar import drawn_progress
        from sfm.runtime.threads import cores

    place = Path(os.path.abspath(source))  # links are not followed, as when pages are written
    page = place.with_name(f"{place.name}.html") if out is None else out
    refuse_foreign_page(page)
    if images is not None and not images.is_dir():
        raise OutputError(f"--images {images}: {why_no_folder(images)}")
    with working_on(str(source)):
        stored = read_comparable(source, from_format)
        rejected = w = seen = None
        if (from_format or format_of(source).name) == "tables":
            stored, rejected, w = _read_rejected(source, stored)
            seen = read_targets(source, stored.network)
        scene = scene_of_stored(stored, w=w, rejected=rejected, seen_targets=seen)
    if images is not None:
        paths = photographs_in(images, scene.photographs)
    elif (source / PICTURES).is_dir() and (source / PICTURES).resolve().is_relative_to(source.resolve()):
        names = overlay_names(scene.photographs)
        pictures = photographs_in(source / PICTURES, names)
        paths = {
            image: pictures[name]
            for image, name in zip(scene.photographs, names, strict=True)
            if name in pictures
        }
    else:
        paths = {}
    with drawn_progress() as progress:
        progress.stage("pictures", len(scene.photographs) if paths else 0)
        write_view(
            scene, page, source=str(source), paths=paths, budget_mb=budget, jobs=cores(), progress=progress
        )
    print(
        f"{counted(len(scene.photographs), 'photograph')}, "
        f"{counted(len(scene.points), 'point')}, {counted(len(scene.rays), 'image point')}"
    )
    for note in scene.notes:
        print(note)
    print(f"Page: {page}")
    if browser and not webbrowser.open(page.resolve().as_uri()):
        print("No browser could be opened; open the page yourself.")


def _read_rejected(folder: Path, stored: Solution) -> tuple[Solution, BoolArray, FloatArray]:
    """Return a result with its rejected image points, the mask of these, and w of all image points."""
    from dataclasses import replace

    from adapters.formats.result_tables import read_image_points

    seen, rejected, w = read_image_points(folder, stored.network)
    return replace(stored, network=replace(stored.network, image_points=seen)), rejected, w
