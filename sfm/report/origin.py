"""Survey file and photographs of the result in a folder, which no other survey replaces unseen."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from sfm.display import counted, listed
from sfm.errors import OutputError, SurveyFileError
from sfm.files.csv_tables import read_table
from sfm.files.json_files import Content, Name, read_json
from sfm.report.log import LOG, read_log


@dataclass(frozen=True)
class Origin:
    """Origin of a result: the files that it was computed from."""

    file: Path  # the survey file
    images: Path  # folder of the photographs

    def written(self, out: Path) -> dict[str, str]:
        """Return the paths from the folder of the result, which stay true where all are moved together."""
        return {"survey_at": path_from(out, self.file), "images_at": path_from(out, self.images)}


def read_origin(out: Path) -> Origin | None:
    """Return of what the result in a folder is; None without a result that states it."""
    try:
        lines = read_log(out / LOG)
    except OSError:
        return None
    begun = next((line for line in lines if line.get("event") == "start"), {})
    file, images = begun.get("survey_at"), begun.get("images_at")
    if not isinstance(file, str) or not isinstance(images, str):
        return None
    return Origin(out / file, out / images)


class _Summary(Content):
    """The part of summary.json that is read."""

    survey: Name


def refuse_other_origin(out: Path, origin: Origin, *, survey: str = "", photographs: bool = True) -> None:
    """Raise OutputError where a folder has the result of another survey file or of other photographs.

    A result that does not state its origin, as one that a script wrote, is another's if it has another name,
    or none of the photographs.

    Args:
        out: the folder.
        origin: of what is to be written there.
        survey: its name, where it is known.
        photographs: whether it is of photographs.
    """
    earlier = read_origin(out)
    if earlier is None:
        try:
            name = read_json(out / "summary.json", _Summary, "the summary of a result").survey
        except SurveyFileError:
            return  # no result
        try:
            images = read_table(out / "images.csv", ("image",), (), ignored=None).texts[0]
        except SurveyFileError:
            images = ()
        other_name = bool(survey) and name != survey
        present = any((origin.images / one).is_file() for one in images)
        if other_name or (photographs and not present):
            of = f"{counted(len(images), 'photograph')} ({listed(images)})"
            what = of if images else "no table of photographs"
            raise OutputError(
                f"{out}: has the result of survey {name} with {what}, which --overwrite replaces; "
                "--out names another folder"
            )
        return
    for what, there, here in (
        ("the survey", earlier.file, origin.file),
        ("the photographs in", earlier.images, origin.images),
    ):
        if os.path.realpath(there) != os.path.realpath(here):
            raise OutputError(
                f"{out}: has the result of {what} {os.path.normpath(there)}, which --overwrite replaces; "
                "--out names another folder"
            )


def path_from(folder: Path, path: Path) -> str:
    """Return a path from a folder, which stays true where both are moved together."""
    folder, path = Path(os.path.realpath(folder)), Path(os.path.realpath(path))
    try:
        return os.path.relpath(path, folder)
    except ValueError:  # on another drive
        return str(path)
