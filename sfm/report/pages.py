"""Folders of a page and its tables, whole or not at all."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from sfm.errors import OutputError
from sfm.files.folder_lock import locked
from sfm.files.whole_files import remove_leftovers, whole_folder


def refuse_other_files(out: Path, names: Collection[str]) -> None:
    """Raise OutputError unless the folder is absent, empty, or holds files of these names and nothing else.

    It is called before the work starts, too, so that nobody waits for a result that has no place.
    """
    if not out.exists() and not out.is_symlink():
        return
    if not out.is_dir():
        raise OutputError(f"{out}: a file is in the way, --out needs a folder")
    try:
        foreign = sorted({path.name for path in out.iterdir()} - set(names))
    except OSError as error:
        raise OutputError(f"{out}: the folder cannot be read: {error.strerror}") from error
    if foreign:
        raise OutputError(f"{out}: the folder holds '{foreign[0]}'; --out needs a new or empty folder")


def write_files(out: Path, contents: Sequence[tuple[str, str]], *, main: str) -> Path:
    """Write text files into a folder that is new, empty or holds the same files, whole or not at all.

    Args:
        out: the folder.
        contents: name and text of each file.
        main: name of the file to return.

    Returns:
        Path of the main file.

    Raises:
        OutputError: the folder holds something else or cannot be written, or another run is writing it.
    """
    with locked(out.parent / f".{out.name}.lock", out):
        remove_leftovers(out)
        refuse_other_files(out, [name for name, _ in contents])
        with whole_folder(out, "the result") as folder:
            for name, text in contents:
                (folder / name).write_text(text, encoding="utf-8", newline="")
    return out / main
