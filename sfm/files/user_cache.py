"""Cache folders that only this user can write, and temporary folders of a run.

The cache folders may be removed at any time.
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

from sfm.files.open_folders import locked
from sfm.model.errors import OutputError

PREFIX = "kolinear-scratch-"
LOCK = ".lock"
KEPT_SECONDS = 90 * 86400  # unused entries are removed after this time
WRITING_SECONDS = 86400  # older half-written entries were left by a killed run


def user_folder(name: str, what: str) -> Path:
    """Return a folder in the user's cache folder (XDG_CACHE_HOME), which may not exist yet.

    Args:
        name: name of the folder.
        what: description of its content, for the error message.

    Raises:
        OutputError: other users can write into it.
    """
    folder = user_cache_path("kolinear", appauthor=False).resolve() / name
    with suppress(OSError):  # it does not exist
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
    """Make a folder that only the user can access, if it does not exist.

    Raises:
        OSError: the folder cannot be made.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)


def remove_unused(folder: Path) -> None:
    """Remove entries not used for months, and half-written entries of killed runs."""
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
    """Provide an empty folder that only this user can access, and remove it afterwards.

    If the run is killed, the next scratch folder removes it.

    Yields:
        Path of the folder.

    Raises:
        OSError: the folder cannot be made.
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
    """Remove this user's scratch folders whose run has ended, as their free lock shows."""
    for folder in Path(tempfile.gettempdir()).resolve().glob(f"{PREFIX}*"):
        with suppress(OSError, OutputError):  # of another user, or in use
            status = folder.lstat()
            if not stat.S_ISDIR(status.st_mode) or (hasattr(os, "geteuid") and status.st_uid != os.geteuid()):
                continue
            if (folder / LOCK).exists():
                with locked(folder / LOCK):
                    shutil.rmtree(folder / "files", ignore_errors=True)
            elif time.time() - status.st_mtime < WRITING_SECONDS:  # a run may just be making it
                continue
            shutil.rmtree(folder, ignore_errors=True)
