"""The folders of photographs that a person named for survey files, so that these may lie elsewhere.

A survey file states the folder of its photographs, `[survey] photographs`. A stranger's file could lead to
any folder of the computer. A folder outside that of the survey file is therefore read only if the person
named it for this file on a command line: at its draft, or by `--images`. That is noted in the user's cache
folder, where no one else can write, by the paths of both. After either has moved, the person names it again.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from sfm.files.user_cache import make_user_folder, user_folder
from sfm.model.errors import OutputError

if TYPE_CHECKING:
    from sfm.survey.inputs.survey import Survey
    from sfm.survey.inputs.survey_file import SurveyFile


def named_folder(survey: Survey | SurveyFile, images: Path | None = None) -> Path | None:
    """Return the folder that a person named for the photographs of a survey; None if no one did.

    Args:
        survey: the survey or its file.
        images: folder that this command line names, which is noted if it is the one of the survey file.

    Raises:
        OutputError: other users can write into the folder of the notes.
    """
    if survey.photographs is None:
        return images
    file, stated = Path(survey.source), survey.folder / survey.photographs
    with suppress(OSError, ValueError, RuntimeError):  # not a path: refused where photographs are searched
        if images is not None:
            if images.is_dir() and images.resolve() == stated.resolve():
                note_named(file, images)
        elif _entry(file, stated).is_file():
            return stated
    return images


def note_named(file: Path, photographs: Path) -> None:
    """Note that a person named a folder for the photographs of a survey file.

    If that fails, it has to be named again.

    Args:
        file: the survey file.
        photographs: the folder.
    """
    with suppress(OSError, OutputError):
        entry = _entry(file, photographs)
        make_user_folder(entry.parents[1])
        make_user_folder(entry.parent)
        entry.touch(mode=0o600)


def _entry(file: Path, photographs: Path) -> Path:
    """Return the file that notes a survey file and the folder of its photographs."""
    paths = f"{os.path.realpath(file)}\0{os.path.realpath(photographs)}"
    key = hashlib.sha256(os.fsencode(paths)).hexdigest()
    return user_folder("named", "notes on folders of photographs") / key[:2] / key
