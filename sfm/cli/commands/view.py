"""The command `view`: a result or a COLMAP model as one page to explore."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import OpenPage
from sfm.cli.process import loading
from sfm.model.display import counted
from sfm.model.errors import OutputError
from sfm.runtime.faults import working_on

PICTURES = "pictures"  # folder of photographs in a result folder


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
    browser: OpenPage = True,
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
            from dataclasses import replace

            from adapters.formats.result_tables import read_image_points

            measured, rejected, w = read_image_points(source, stored.network)
            stored = replace(stored, network=replace(stored.network, image_points=measured))
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
