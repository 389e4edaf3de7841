"""Files that a glob names, looked for in a bounded number of places, and through no links that may not be."""

from __future__ import annotations

import fnmatch
import os
import re
from collections.abc import Callable, Iterator
from difflib import get_close_matches
from glob import has_magic
from pathlib import Path

from sfm.errors import SurveyFileError
from sfm.files.plain_text import as_plain

MAX_ENTRIES = 500_000  # files and folders that are looked at
BELOW = "**"  # a folder and all below it


def why_no_folder(path: Path) -> str:
    """Return why something is no folder: a file, or nothing, with the nearest name there is."""
    return (
        "is a file, a folder is needed" if path.exists() else f"there is no such folder{nearest_name(path)}"
    )


def nearest_name(path: Path) -> str:
    """Return a question for the name beside a path that does not exist which is most like it, or nothing."""
    try:
        names = sorted(os.listdir(path.parent))[:MAX_ENTRIES]
    except OSError:
        return ""
    like = get_close_matches(path.name, names, 1)
    return f", did you mean {as_plain(str(path.with_name(like[0])))}?" if like else ""


def find_files(
    folder: Path,
    pattern: str,
    *,
    enter: Callable[[Path], object] = lambda _: None,
    folders: bool = False,
    hidden: bool = True,
) -> list[Path]:
    """Return the files that a glob names, sorted; `**` follows no links.

    Args:
        folder: where to look.
        pattern: glob relative to it.
        enter: called with every link to a folder, and every `..`, before what is in it is looked at; raises
            where it may not be.
        folders: whether folders are returned, too.
        hidden: whether wildcards match names that begin with a dot.

    Raises:
        SurveyFileError: there is too much to look through.
        ValueError: the pattern is no relative glob.
    """
    given = Path(pattern)
    parts = [
        part for k, part in enumerate(given.parts) if given.parts[k - 1 : k] != (BELOW,) or part != BELOW
    ]
    if not parts or given.anchor or any(BELOW in part and part != BELOW for part in parts):
        raise ValueError("no relative glob")
    found: set[Path] = set()
    waiting = [(folder, 0)]
    left = MAX_ENTRIES
    while waiting:
        path, k = waiting.pop()
        part, last = parts[k], k == len(parts) - 1
        if part == BELOW and not last:
            waiting.append((path, k + 1))
        for child, is_below in _entries(path, part, hidden=hidden):
            left -= 1
            if left < 0:
                raise SurveyFileError(
                    f"{folder}: more than {MAX_ENTRIES} files and folders to look through for '{pattern}', "
                    "a narrower glob is needed"
                )
            if not is_below:
                continue
            is_folder = child.is_dir()
            if part == BELOW:
                if is_folder and not child.is_symlink():
                    waiting.append((child, k))
                    if last and folders:
                        found.add(child)
            elif last:
                if folders or not is_folder:
                    found.add(child)
            elif is_folder:
                if child.is_symlink() or part == "..":
                    enter(child)
                waiting.append((child, k + 1))
    return sorted(found)


def _entries(path: Path, part: str, *, hidden: bool) -> Iterator[tuple[Path, bool]]:
    """Yield what is in a folder, and whether it matches a part of a glob."""
    if part != BELOW and not has_magic(part):
        child = path / part
        if child.exists():
            yield child, True
        return
    matches = re.compile(fnmatch.translate(os.path.normcase("*" if part == BELOW else part))).match
    try:
        with os.scandir(path) as entries:
            for entry in entries:
                shown = hidden or not entry.name.startswith(".") or part.startswith(".")
                yield path / entry.name, shown and matches(os.path.normcase(entry.name)) is not None
    except PermissionError:  # as pathlib's and the shell's globs do
        return
