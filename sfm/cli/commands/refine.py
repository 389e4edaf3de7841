"""The command `refine`, which measures the key points of a COLMAP model again."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import Pdf, names_in
from sfm.cli.process import FAILED, compile_first, loading
from sfm.runtime.faults import working_on

PINHOLES = {"SIMPLE_PINHOLE", "PINHOLE"}  # COLMAP's models that trainers of radiance fields read


def refine(
    model: Annotated[Path, typer.Argument(metavar="COLMAP_MODEL", help="Folder of cameras, images, points.")],
    images: Annotated[Path, typer.Option("--images", metavar="DIR", help="Folder of its photographs.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="New folder for the refined model.  [default: beside the model]"
        ),
    ] = None,
    window: Annotated[
        int | None,
        typer.Option(
            "--window",
            metavar="N",
            help="Width of the windows, odd, 3 to 101 px.  [default: 15 or 11, whichever measures better]",
        ),
    ] = None,
    min_correlation: Annotated[
        float,
        typer.Option(
            "--min-correlation",
            metavar="R",
            help="Smallest correlation coefficient r between a window and its template, 0 to 1.",
        ),
    ] = 0.7,
    fix: Annotated[
        str,
        typer.Option(
            "--fix", metavar="NAMES", help="Interior parameters to hold fixed, such as f,fx,fy,cx,cy,k1."
        ),
    ] = "",
    masks: Annotated[
        Path | None,
        typer.Option(
            "--masks", metavar="DIR", help="Folder of masks, NAME.png for photograph NAME; black is ignored."
        ),
    ] = None,
    survey: Annotated[
        Path | None,
        typer.Option(
            "--survey",
            metavar="FILE",
            help="Survey file with coded targets, control and scale bars to add to the model.",
        ),
    ] = None,
    one_camera: Annotated[
        bool,
        typer.Option("--one-camera", help="Join cameras of one size and lens model into one."),
    ] = False,
    pdf: Pdf = False,
) -> None:
    """Remeasure the key points of a COLMAP model.

    Key points are measured by least squares matching, then the model is adjusted again. The new model keeps
    identifiers, colours, camera models, rigs and points with two rays. Its folder has a page,
    refinement.html, and the standard deviations of points, photographs and cameras (sigma_*.csv).

    The principal point is also estimated if a camera took four or more photographs; hold it fixed with
    --fix cx,cy. With a survey file, the coded targets that it describes are measured and adjusted with the
    key points; its control and scale bars define the frame and scale of the model.

    If halves of the points do not agree better than before, the model as it came is kept: the folder has the
    page alone, and the exit code is 1. With --one-camera it has the model with its own key points and the
    joined cameras.
    """
    with loading():
        from adapters.colmap.camera_models import write_scene
        from adapters.colmap.refined_model import (
            interior_rows,
            join_cameras_of,
            keep_key_points,
            key_points_of,
            open_model,
            place_model,
            update_model,
        )
        from sfm.cli.console import print_page
        from sfm.files.globs import name_of_model
        from sfm.files.whole_files import refuse_unwritable, whole_folder
        from sfm.products.refining.joined_cameras import join_cameras
        from sfm.products.refining.oriented_windows import measure_model_targets
        from sfm.products.refining.page import Numbers, describe_key_points
        from sfm.products.refining.refinement import RefineSettings, refine_model, refinement_text
        from sfm.report.pages import page_of, texts_of
        from sfm.runtime.progress_bar import drawn_progress
        from sfm.survey.inputs.settings import AdjustSettings
        from sfm.survey.inputs.survey import read_survey

    out = model.resolve().with_name(f"{model.resolve().name}_refined") if out is None else out
    refuse_unwritable(out)
    with working_on(str(model)):
        opened = open_model(model)
        if one_camera:
            opened = join_cameras_of(opened, *join_cameras(opened.network, opened.estimate))
        given = None if survey is None else read_survey(survey)
    compile_first()
    with working_on(str(model)), drawn_progress() as progress:
        targets = None
        if given is not None:
            targets = measure_model_targets(given, opened.network, opened.estimate, images, progress=progress)
            opened, targets = place_model(opened, targets.placement), targets.placed()
        refinement = refine_model(
            opened.network,
            opened.estimate,
            images,
            RefineSettings(
                window,
                min_correlation,
                fixed=names_in(fix),
                masks_dir=masks,
                false_alarm=(AdjustSettings() if given is None else given.adjust).false_alarm,
            ),
            targets=targets,
            progress=progress,
        )
    written = refinement.better or one_camera  # cameras that were joined are in no model so far
    of_new = refinement.better or not written
    after, a = (
        (refinement.estimate, refinement.adjustment)
        if of_new
        else (refinement.as_it_came, refinement.readjusted)
    )
    interior = interior_rows(opened, refinement.start, after, a.covariance.interior)
    if refinement.better:
        update_model(
            opened,
            refinement.estimate,
            xy=refinement.xy,
            measured=refinement.accepted,
            images=refinement.images,
            points=refinement.points_anew,
        )
    elif written:
        keep_key_points(opened, refinement.as_it_came)
    of_files = key_points_of(opened) if written else (0, math.nan)
    numbers = Numbers(opened.image_ids, opened.point_ids, interior, *of_files)
    print(refinement_text(refinement), end="")
    page = page_of(refinement, numbers=numbers, title=name_of_model(model))
    with whole_folder(out) as folder:
        if written:
            write_scene(folder, opened.scene)
        for name, text in texts_of(page).items():
            (folder / name).write_text(text, encoding="utf-8")
    if written:
        print(describe_key_points(refinement, numbers))
    if set(opened.models) <= PINHOLES and not {"cx", "cy"} <= set(names_in(fix)):
        print("cameras       are pinholes, of which some programs read f alone: for these add --fix cx,cy")
    print(f"Model: {out if written else model}")
    print_page("Report", out / page.path, pdf=pdf)
    if not (refinement.dependable and refinement.better):
        raise SystemExit(FAILED)
