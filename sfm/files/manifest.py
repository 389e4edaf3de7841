"""The list of the files that Kolinear wrote into a folder, with their hashes: by it they are known again.

A folder or file that may be replaced has such a list, manifest.json. It is replaced only while it is as it
was written: files that were added, edited or linked by a person are named, and left alone.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sfm.display import listed
from sfm.errors import OutputError
from sfm.files.open_folders import open_regular_file, refuse_links

MANIFEST = "manifest.json"
WRITER = "kolinear"
MAX_MANIFEST_BYTES = 20_000_000  # some 100,000 files
LITTER = (".DS_Store", "Thumbs.db")  # which systems leave in every folder that is looked at
NAMED = 3  # files that a message names


def refuse_foreign_folder(out: Path) -> None:
    """Raise OutputError unless a folder is absent, empty, or as Kolinear wrote it, by its manifest.

    It is called before the work starts, too, so that no one waits for a result that has no place.
    """
    refuse_links(out)
    try:
        mode = out.lstat().st_mode
    except FileNotFoundError:
        return
    except OSError as error:  # a file is above it
        raise OutputError(f"{out}: cannot be written here: {error.strerror}") from error
    if not stat.S_ISDIR(mode):
        raise OutputError(f"{out}: a file has this name, --out needs a folder")
    try:
        foreign = _foreign(out, names_below(out))
    except OSError as error:
        raise OutputError(f"{out}: the folder cannot be read: {error.strerror}") from error
    _refuse(out, foreign, "--out needs a new or empty folder or an unchanged earlier result")


def refuse_foreign_files(folder: Path, names: Iterable[str]) -> None:
    """Raise OutputError where files of some names are in a folder, other than Kolinear wrote them.

    Args:
        folder: where they are to be written; it may hold files of other names.
        names: of the files.
    """
    wanted = (*names, MANIFEST)
    for name in wanted:
        refuse_links(folder / name)
    try:
        foreign = _foreign(folder, [name for name in wanted if os.path.lexists(folder / name)])
    except OSError as error:
        raise OutputError(f"{folder}: the folder cannot be read: {error.strerror}") from error
    _refuse(folder, foreign, "which would be replaced; another folder is needed")


def _foreign(folder: Path, names: Iterable[str]) -> list[str]:
    """Return what of a folder Kolinear has not written, or not as it is now, in words."""
    known, foreign = read_manifest(folder), []
    for name in names:
        if name not in known:
            foreign.append(f"'{name}'")
        elif sha256_of(folder / name) not in known[name]:
            foreign.append(f"'{name}', changed since Kolinear wrote it")
    return foreign


def _refuse(folder: Path, foreign: list[str], needed: str) -> None:
    if foreign:
        raise OutputError(
            f"{folder}: the folder contains {listed(foreign, most=NAMED, separator='; ')}; {needed}"
        )


def manifest_text(hashes: dict[str, list[str]]) -> str:
    """Return a manifest with the SHA-256 that each file may have."""
    return json.dumps({"written_by": WRITER, "files": hashes}, indent=1, ensure_ascii=True) + "\n"


def read_manifest(folder: Path) -> dict[str, list[str]]:
    """Return the hashes that files of a folder may have, by name; none without a list that can be read."""
    try:
        handle = open_regular_file(folder / MANIFEST, os.O_RDONLY)
        with os.fdopen(handle, "rb") as file:
            data = file.read(MAX_MANIFEST_BYTES)
        found: Any = json.loads(data)
        files = found["files"]
        if found["written_by"] == WRITER and all(isinstance(hashes, list) for hashes in files.values()):
            return {**files, MANIFEST: [hashlib.sha256(data).hexdigest()]}  # it is ours if it can be read
    except (OSError, OutputError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        pass
    return {}


def names_below(folder: Path) -> list[str]:
    """Return the names of all that is in and below a folder but folders; a link to one is none.

    Raises:
        OSError: a folder cannot be read.
    """

    def fail(error: OSError) -> None:
        raise error

    found = []
    for where, below, files in os.walk(folder, onerror=fail):
        for name in (*below, *files):
            path = Path(where, name)
            if (path.is_symlink() or not path.is_dir()) and name not in LITTER:
                found.append(path.relative_to(folder).as_posix())
    return sorted(found)


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file; of anything that is not a regular one, a text that is none."""
    if not stat.S_ISREG(path.lstat().st_mode):
        return f"no file {os.urandom(16).hex()}"  # which no list can hold
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
