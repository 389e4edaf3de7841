"""Which results were finished by batches of this user: what `--resume` may keep.

A result that lies in the folder of a batch may have come with the survey, with a log and a manifest that fit.
So whoever finishes a result notes it in the user's cache folder, by its path and the hash of its manifest,
which has the hashes of its files.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path

from sfm.errors import OutputError
from sfm.files.manifest import MANIFEST, sha256_of
from sfm.files.user_cache import make_user_folder, remove_unused, user_folder
from sfm.files.whole_files import whole_file


def note_finished(folder: Path) -> None:
    """Note that a result is by this user; where there is no room it is computed again at `--resume`."""
    with suppress(OSError, OutputError):
        entry = _entry(folder)
        make_user_folder(entry.parents[1])
        with whole_file(entry, replaces=True) as part:
            part.touch()


def was_finished(folder: Path) -> bool:
    """Whether a result was noted, and has the same manifest as then.

    Raises:
        OutputError: others can write where results are noted.
    """
    try:
        os.utime(_entry(folder))  # asked for now
    except OSError:
        return False
    return True


def remove_old_notes() -> None:
    """Remove notes not asked for in months.

    Raises:
        OutputError: others can write where results are noted.
    """
    remove_unused(_notes())


def _notes() -> Path:
    return user_folder("finished", "notes on finished results")


def _entry(folder: Path) -> Path:
    """Return the file that notes a result as it is now."""
    key = hashlib.sha256(os.fsencode(f"{folder.absolute()}\0{sha256_of(folder / MANIFEST)}")).hexdigest()
    return _notes() / key[:2] / key
