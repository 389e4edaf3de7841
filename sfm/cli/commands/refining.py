"""The command refine: key points of a COLMAP model measured anew."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.commands.starting import FAILED, compile_first, loading
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
        int | None,
        typer.Option(
            "--window",
            metavar="N",
            help="Side of the windows, odd, 3 to 101 px; by default 15 or 11, whichever measure better.",
        ),
    ] = None,
    min_correlation: Annotated[
        float,
        typer.Option(
            "--min-correlation", metavar="R", help="Smallest r of a window and its template, 0 to 1."
        ),
    ] = 0.7,
    fix: Annotated[
        str, typer.Option("--fix", metavar="NAMES", help="Interior parameters to hold, as f,fx,fy,cx,cy,k1.")
    ] = "",
    masks: Annotated[
        Path | None,
        typer.Option("--masks", metavar="DIR", help="Folder of masks: NAME.png beside a photograph's NAME."),
    ] = None,
    survey: Annotated[
        Path | None,
        typer.Option(
            "--survey",
            metavar="FILE",
            help="Survey file: coded targets, control and scale bars join the model.",
        ),
    ] = None,
) -> None:
    """Remeasure the key points of a COLMAP model.

    By least squares matching; then the model is adjusted again. The new model keeps numbers,
    colours, camera models, rigs and the points of two photographs, and has a page, refinement.html, and the
    standard deviations of points, photographs and cameras beside it (sigma_*.csv). The principal point is
    estimated, too, where four photographs or more have been taken with a camera; hold it with --fix cx,cy.
    Of masks, black is left out. With a survey file the coded targets that it describes are measured and
    adjusted with the key points; its control and scale bars give the model its frame and scale.
    """
    with loading():
        from adapters.colmap.camera_models import write_scene
        from adapters.colmap.refined_model import (
            interior_rows,
            key_points_of,
            open_model,
            place_model,
            update_model,
        )
        from sfm.files.whole_files import refuse_unwritable, whole_folder
        from sfm.report.pages import page_of, texts_of
        from sfm.report.refinement import Numbers, describe_key_points
        from sfm.runtime.progress_bar import drawn_progress
        from sfm.survey.inputs.survey import read_survey
        from sfm.survey.refining.oriented_windows import measure_model_targets
        from sfm.survey.refining.refinement import RefineSettings, refine_model, refinement_text

    out = model.resolve().with_name(f"{model.resolve().name}_refined") if out is None else out
    refuse_unwritable(out)
    with working_on(str(model)):
        opened = open_model(model)
        given = None if survey is None else read_survey(survey)
    compile_first()
    with working_on(str(model)), drawn_progress() as progress:
        targets = None
        if given is not None:
            targets = measure_model_targets(given, opened.network, opened.estimate, images, progress=progress)
            opened, targets = place_model(opened, targets.placement), targets.placed()
        found = refine_model(
            opened.network,
            opened.estimate,
            images,
            RefineSettings(
                window, min_correlation, tuple(name.strip() for name in fix.split(",") if name.strip()), masks
            ),
            targets=targets,
            progress=progress,
        )
    a = found.adjustment
    interior = interior_rows(opened, found.start, found.estimate, a.covariance.interior)
    update_model(
        opened,
        found.estimate,
        xy=found.xy,
        measured=found.accepted,
        images=found.images,
        points=found.points_anew,
    )
    numbers = Numbers(opened.image_ids, opened.point_ids, interior, *key_points_of(opened))
    print(refinement_text(found), end="")
    page = page_of(found, numbers=numbers, title=model.resolve().name)
    with whole_folder(out) as folder:
        write_scene(folder, opened.scene)
        for name, text in texts_of(page).items():
            (folder / name).write_text(text, encoding="utf-8")
    print(describe_key_points(found, numbers))
    print(f"Model: {out}")
    print(f"Report: {out / 'refinement.html'}")
    if not found.dependable:
        raise SystemExit(FAILED)
