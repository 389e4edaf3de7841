"""The command that opens a result to be explored."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.commands.starting import loading
from sfm.display import counted
from sfm.errors import OutputError
from sfm.runtime.faults import working_on

if TYPE_CHECKING:
    from sfm.conventions import BoolArray, FloatArray
    from sfm.solution import Solution

PICTURES = "pictures"  # folder of the photographs in that of a result


def view(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER", help="Result folder, COLMAP model, or another format that is known."
        ),
    ],
    images: Annotated[
        Path | None,
        typer.Option(
            "--images",
            metavar="DIR",
            help="Folder of the photographs.  [default: pictures of a result folder]",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE.html",
            help="Page to write; an earlier one is replaced.  [default: FOLDER.html]",
        ),
    ] = None,
    from_format: Annotated[
        str | None, typer.Option("--from", metavar="F", help="Format of FOLDER; by default from its content.")
    ] = None,
    budget: Annotated[
        float,
        typer.Option("--pictures-mb", metavar="MB", min=0.0, help="Largest size of the pictures."),
    ] = 15.0,
    browser: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")] = True,
) -> None:
    """Write one page with a result to explore, and open it.

    A 3D scene, photographs, crops of the targets and tables, in one file without a server.
    """
    with loading():
        import webbrowser

        from adapters.formats.registry import format_of, read_comparable
        from adapters.formats.result_tables import read_targets
        from sfm.files.globs import why_no_folder
        from sfm.kernels.threads import cores
        from sfm.report.figures.overlays import overlay_names
        from sfm.report.view_page import photographs_in, refuse_foreign_page, write_view
        from sfm.report.viewer.solution_scene import scene_of_stored
        from sfm.runtime.progress_bar import drawn_progress

    place = Path(os.path.abspath(source))  # through no link, as pages are written
    page = place.with_name(f"{place.name}.html") if out is None else out
    refuse_foreign_page(page)
    if images is not None and not images.is_dir():
        raise OutputError(f"--images {images}: {why_no_folder(images)}")
    with working_on(str(source)):
        stored = read_comparable(source, from_format)
        rejected = w = seen = None
        if (from_format or format_of(source).name) == "tables":
            stored, rejected, w = _with_rejected(source, stored)
            seen = read_targets(source, stored.network)
        scene = scene_of_stored(stored, w=w, rejected=rejected, seen_targets=seen)
    if images is not None:
        paths = photographs_in(images, scene.photographs)
    elif (source / PICTURES).is_dir() and (source / PICTURES).resolve().is_relative_to(source.resolve()):
        names = overlay_names(scene.photographs)
        found = photographs_in(source / PICTURES, names)
        paths = {
            image: found[name] for image, name in zip(scene.photographs, names, strict=True) if name in found
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
        print("No browser could be opened here: open the page by hand.")


def _with_rejected(folder: Path, stored: Solution) -> tuple[Solution, BoolArray, FloatArray]:
    """Return a result with its rejected image points, which these are, and w of all."""
    from dataclasses import replace

    from adapters.formats.result_tables import read_image_points

    seen, rejected, w = read_image_points(folder, stored.network)
    return replace(stored, network=replace(stored.network, image_points=seen)), rejected, w
