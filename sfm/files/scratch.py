"""Folders in the temporary folder for what a run sets aside; those that a killed run left are removed."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sfm.errors import OutputError
from sfm.files.folder_lock import locked
from sfm.files.user_cache import WRITING_SECONDS

PREFIX = "kolinear-scratch-"
LOCK = ".lock"


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
