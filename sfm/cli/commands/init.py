"""The command `init`, which drafts a survey file."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import Frames, Pitch
from sfm.cli.survey_runs import SURVEY_FILE, draft_folder, photographs_of, write_draft


def init(
    photographs: Annotated[
        Path,
        typer.Argument(
            metavar="PHOTOS|VIDEO",
            help="Folder that contains the photographs directly, or a video or folder of videos.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE.toml",
            help="File to write; an existing file is not replaced.  [default: PHOTOS/survey.toml, of a "
            "video VIDEO.toml beside it]",
        ),
    ] = None,
    pitch: Pitch = None,
    frames: Frames = None,
) -> None:
    """Draft a survey file from a folder of photographs.

    Cameras are recognised by the metadata of the photographs, and targets by measuring a few photographs. A
    comment states the source of each value. Use kolinear run to measure and adjust the survey. Of a video,
    sharp frames are written beside the survey file, spaced by the motion of the camera.
    """
    from sfm.files.whole_files import refuse_existing
    from sfm.photographs.video_files import is_video

    of_video = is_video(photographs)
    usual = photographs.with_suffix(".toml") if of_video else photographs / SURVEY_FILE
    file = usual if out is None else out
    refuse_existing(file)
    photographs, name = photographs_of(photographs, file, frames)
    draft = draft_folder(photographs, file, pitch, name)
    write_draft(draft, photographs, file)
    print(f"Run it: kolinear run {shlex.quote(str(file))}")
