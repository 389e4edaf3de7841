"""The command `run`: from photographs to the report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import (
    AllowOutside,
    Calibration,
    Cluster,
    Frames,
    Jobs,
    Out,
    Overwrite,
    Pdf,
    PicturesMb,
    Pitch,
    SurveyOrPhotographs,
    Verbose,
    Weighted,
)
from sfm.cli.survey_runs import RunOptions, run_survey_file, stated_or_drafted
from sfm.cli.watching import run_or_watch
from sfm.model.errors import KolinearError


def run(
    survey_file: SurveyOrPhotographs,
    images: Annotated[
        Path | None,
        typer.Option(
            "--images",
            metavar="DIR",
            help="Folder of the photographs, instead of the folder that the survey file states.",
        ),
    ] = None,
    watched: Annotated[
        bool,
        typer.Option(
            "--watch",
            help="Run again whenever photographs are added to the folder, and say which ones are next.",
        ),
    ] = False,
    until: Annotated[
        float,
        typer.Option(
            "--until",
            metavar="SIGMA",
            min=0.0,
            help="Standard deviation of the worst point, unit of the survey, at which --watch ends.",
        ),
    ] = 0.0,
    pitch: Pitch = None,
    frames: Frames = None,
    camera: Calibration = None,
    camera_weighted: Weighted = False,
    out: Out = None,
    overwrite: Overwrite = False,
    jobs: Jobs = None,
    cluster: Cluster = None,
    pictures_mb: PicturesMb = 15.0,
    allow_outside: AllowOutside = False,
    verbose: Verbose = False,
    pdf: Pdf = False,
) -> None:
    """Run a survey from its photographs to the report.

    If a folder is given, its survey.toml is run. If it has none, a survey file is drafted from the
    photographs, written beside the result and run; edit it there and run it again. Of a video, or of the
    videos of a folder without photographs, sharp frames are written there and are the photographs.

    Exit code 0 with a dependable result, with or without remarks; 1 if the result is not dependable, for the
    reasons in the report, or a stage cannot go on; 2 if the input must be corrected.
    """
    from sfm.photographs.video_files import is_video

    if images is not None and (survey_file.is_dir() or is_video(survey_file)):
        raise KolinearError(f"{survey_file}: photographs and videos need no --images {images}")
    from sfm.cli.watched_survey import SurveySoFar

    rounds = SurveySoFar(is_watched=watched, until=until)

    def run_once() -> None:
        stays = rounds.begin()
        file, folder, photographs, written = stated_or_drafted(
            survey_file,
            out,
            None if stays else pitch,
            frames=None if stays else frames,
            overwrite=overwrite,
        )
        rounds.note_drafted(written)
        options = RunOptions(
            images=photographs or images,
            out=folder,
            jobs=jobs,
            cluster=cluster,
            allow_outside=allow_outside,
            verbose=verbose,
            from_photographs=True,
            camera=camera,
            weighted=camera_weighted,
            overwrite=overwrite,
            pictures_mb=pictures_mb,
            pdf=pdf,
            product=rounds if watched else None,
        )
        run_survey_file(file, options)

    run_or_watch(survey_file, run_once, rounds)
