"""The command `init`, which drafts a survey file."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import Pitch
from sfm.cli.survey_runs import SURVEY_FILE, draft_folder, write_draft


def init(
    photographs: Annotated[
        Path, typer.Argument(metavar="PHOTOS", help="Folder that contains the photographs directly.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE.toml",
            help="File to write; an existing file is not replaced.  [default: PHOTOS/survey.toml]",
        ),
    ] = None,
    pitch: Pitch = None,
) -> None:
    """Draft a survey file from a folder of photographs.

    Cameras are recognised by the metadata of the photographs, and targets by measuring a few photographs. A
    comment states the source of each value. Use kolinear run to measure and adjust the survey.
    """
    from sfm.files.whole_files import refuse_existing

    file = photographs / SURVEY_FILE if out is None else out
    refuse_existing(file)
    draft = draft_folder(photographs, file, pitch)
    write_draft(draft, photographs, file)
    print(f"Run it: kolinear run {shlex.quote(str(file))}")
