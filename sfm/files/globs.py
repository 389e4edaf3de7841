"""Search for the files of a glob, with a limited number of entries and a check of every link on the way."""

from __future__ import annotations

import fnmatch
import os
import re
from collections.abc import Callable, Iterator
from difflib import get_close_matches
from glob import has_magic
from pathlib import Path

from sfm.files.plain_text import as_plain
from sfm.model.errors import SurveyFileError

MAX_ENTRIES = 500_000  # files and folders that are examined
NUMBERED_MODELS = "sparse"  # folder of COLMAP's models 0, 1, ...
BELOW = "**"  # a folder and everything below it
_BRACKETED = re.compile(r"\[([*?[])\]")  # a wildcard that stands for itself
COMPANION = "._"  # begins the name of a file of macOS on other disks, which has the name of another after it


def why_no_folder(path: Path) -> str:
    """Return why a path is not a folder: it is a file, or it does not exist, with the most similar name."""
    return (
        "is a file, a folder is needed" if path.exists() else f"there is no such folder{nearest_name(path)}"
    )


def nearest_name(path: Path) -> str:
    """Return a question for the most similar name beside a missing path, or an empty text."""
    try:
        names = sorted(os.listdir(path.parent))[:MAX_ENTRIES]
    except OSError:
        return ""
    like = get_close_matches(path.name, names, 1)
    return f", did you mean {as_plain(str(path.with_name(like[0])))}?" if like else ""


def name_of_model(path: Path) -> str:
    """Return what to call a model: its file or folder, and those above one that is a number or `sparse`.

    COLMAP numbers the models of a project, so that each project has one that is called 0.
    """
    parts = path.resolve().parts  # of "." too
    at = len(parts) - 1
    while at > 1 and (parts[at].isdigit() or parts[at] == NUMBERED_MODELS):
        at -= 1
    return "/".join(parts[at:])


def find_files(
    folder: Path,
    pattern: str,
    *,
    enter: Callable[[Path], object] = lambda _: None,
    folders: bool = False,
    hidden: bool = True,
) -> list[Path]:
    """Return the files that match a glob, sorted; `**` follows no links, wildcards match no file of macOS.

    Args:
        folder: folder to search.
        pattern: glob relative to the folder.
        enter: called with every link to a folder, and every `..`, before its content is examined; raises if
            it must not be entered.
        folders: whether folders are returned too.
        hidden: whether wildcards match names that begin with a dot.

    Raises:
        SurveyFileError: there are too many files and folders to search.
        ValueError: the pattern is not a relative glob.
    """
    parts = parts_of_glob(pattern)
    matches: set[Path] = set()
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
                        matches.add(child)
            elif last:
                if folders or not is_folder:
                    matches.add(child)
            elif is_folder:
                if child.is_symlink() or part == "..":
                    enter(child)
                waiting.append((child, k + 1))
    return sorted(matches)


def parts_of_glob(pattern: str) -> list[str]:
    """Return the parts of a glob between slashes, several `**` in a row as one.

    Raises:
        ValueError: the pattern is not a relative glob.
    """
    given = Path(pattern)
    parts = [
        part for k, part in enumerate(given.parts) if given.parts[k - 1 : k] != (BELOW,) or part != BELOW
    ]
    if not parts or given.anchor or any(BELOW in part and part != BELOW for part in parts):
        raise ValueError("not a relative glob")
    return parts


def name_of_glob(pattern: str) -> str | None:
    """Return the name that a glob without wildcards stands for, None for a glob with wildcards.

    A wildcard in brackets, as `glob.escape` writes it, stands for itself.
    """
    return None if has_magic(_BRACKETED.sub("", pattern)) else _BRACKETED.sub(r"\1", pattern)


def _entries(path: Path, part: str, *, hidden: bool) -> Iterator[tuple[Path, bool]]:
    """Yield the entries of a folder, and whether they match a part of a glob."""
    name = name_of_glob(part)
    if name is not None:
        child = path / name
        if child.exists():
            yield child, True
        return
    matches = re.compile(fnmatch.translate(os.path.normcase("*" if part == BELOW else part))).match
    try:
        with os.scandir(path) as entries:
            for entry in entries:
                shown = hidden or not entry.name.startswith(".") or part.startswith(".")
                shown = shown and not entry.name.startswith(COMPANION)
                yield path / entry.name, shown and matches(os.path.normcase(entry.name)) is not None
    except PermissionError:  # ignored, as in globs of pathlib and the shell
        return
