"""The command refine: key points of a COLMAP model measured anew."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.commands.starting import loading
from sfm.cli.first_use import compile_first
from sfm.runtime.faults import working_on


def refine(
    model: Annotated[Path, typer.Argument(metavar="COLMAP_MODEL", help="Folder of cameras, images, points.")],
    images: Annotated[Path, typer.Option("--images", metavar="DIR", help="Folder of its photographs.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="New folder for the refined model; beside the model if not given."
        ),
    ] = None,
    window: Annotated[
        int, typer.Option("--window", metavar="N", help="Side of the windows, odd, 3 to 101 px.")
    ] = 15,
    min_correlation: Annotated[
        float,
        typer.Option(
            "--min-correlation", metavar="R", help="Smallest r of a window and its template, 0 to 1."
        ),
    ] = 0.7,
    fix: Annotated[
        str, typer.Option("--fix", metavar="NAMES", help="Interior parameters to hold, as fx,fy,cx,cy,k1.")
    ] = "",
) -> None:
    """Remeasure the key points of a COLMAP model.

    By multi-photo least squares matching; then the model is adjusted again.
    """
    with loading():
        from adapters.colmap.camera_models import read_model, write_model
        from sfm.files.whole_files import refuse_existing, whole_folder
        from sfm.runtime.progress_bar import drawn_progress
        from sfm.survey.refine import refine_model, refinement_text

    out = model.resolve().with_name(f"{model.resolve().name}_refined") if out is None else out
    refuse_existing(out)
    with working_on(str(model)):
        network, estimate = read_model(model)
    compile_first()
    with working_on(str(model)), drawn_progress() as progress:
        found = refine_model(
            network,
            estimate,
            images,
            window_px=window,
            min_correlation=min_correlation,
            fixed=tuple(name.strip() for name in fix.split(",") if name.strip()),
            progress=progress,
        )
    print(refinement_text(found), end="")
    a = found.adjustment
    with whole_folder(out) as folder:
        write_model(folder, a.network, a.estimate, rejected=a.rejected)
    print(f"Model: {out}")
