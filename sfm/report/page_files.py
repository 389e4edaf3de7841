"""Folders of a page and its tables, whole or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sfm.files.folder_lock import locked
from sfm.files.whole_files import remove_leftovers, whole_folder


def write_files(out: Path, contents: Sequence[tuple[str, str]], *, main: str) -> Path:
    """Write text files into a folder that is new, empty or an unchanged earlier one, whole or not at all.

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
        with whole_folder(out, "the result", replaceable=True) as folder:
            for name, text in contents:
                (folder / name).write_text(text, encoding="utf-8", newline="")
    return out / main
