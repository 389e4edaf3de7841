"""Folders that only this user writes, and temporary folders for what a run sets aside.

They may be removed at any time.
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from platformdirs import user_cache_path

from sfm.errors import OutputError
from sfm.files.open_folders import locked

PREFIX = "kolinear-scratch-"
LOCK = ".lock"
KEPT_SECONDS = 90 * 86400  # entries not asked for are removed then
WRITING_SECONDS = 86400  # what is half-written for longer was left by a killed run


def user_folder(name: str, what: str) -> Path:
    """Return a folder in the user's cache folder (XDG_CACHE_HOME); it need not be there yet.

    Args:
        name: of the folder.
        what: is kept in it, for the message.

    Raises:
        OutputError: others can write into it.
    """
    folder = user_cache_path("kolinear", appauthor=False).resolve() / name
    with suppress(OSError):  # there is none
        status = folder.lstat()
        if hasattr(os, "geteuid") and (
            not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & 0o077
        ):
            raise OutputError(
                f"{folder}: {what} are kept here, but others may write here; remove it, or set "
                "XDG_CACHE_HOME to another folder"
            )
    return folder


def make_user_folder(folder: Path) -> None:
    """Make such a folder for the user alone, if it is not there.

    Raises:
        OSError: it cannot be made.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)


def remove_unused(folder: Path) -> None:
    """Remove entries not asked for in months, and what a killed run left half-written."""
    now = time.time()
    for path in folder.glob("*/*"):
        with suppress(OSError):
            age = now - path.lstat().st_mtime
            if path.is_dir() and not path.is_symlink():
                if age > WRITING_SECONDS:
                    shutil.rmtree(path)
            elif age > KEPT_SECONDS:
                path.unlink()


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Make an empty folder of this user alone, which is gone afterwards; after a kill, when the next begins.

    Yields:
        Path of the folder.

    Raises:
        OSError: it cannot be made.
    """
    remove_abandoned()
    folder = Path(tempfile.mkdtemp(prefix=PREFIX)).resolve()
    try:
        with locked(folder / LOCK):
            (folder / "files").mkdir()
            yield folder / "files"
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def remove_abandoned() -> None:
    """Remove this user's scratch folders whose run has ended: their lock is free."""
    for folder in Path(tempfile.gettempdir()).resolve().glob(f"{PREFIX}*"):
        with suppress(OSError, OutputError):  # another user's, or at work
            status = folder.lstat()
            if not stat.S_ISDIR(status.st_mode) or (hasattr(os, "geteuid") and status.st_uid != os.geteuid()):
                continue
            if (folder / LOCK).exists():
                with locked(folder / LOCK):
                    shutil.rmtree(folder / "files", ignore_errors=True)
            elif time.time() - status.st_mtime < WRITING_SECONDS:  # a run is just making it
                continue
            shutil.rmtree(folder, ignore_errors=True)
