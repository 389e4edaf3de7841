"""The lock of a folder: one run at a time writes into it, and everybody can read who.

The operating system keeps the lock and releases it when the process ends, however it ends. So a lock file
that is free is stale by that alone, and no process number has to be trusted. It lies beside what it
locks, where the runs of other computers on the same disk see it.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from filelock import lock_descriptor, unlock_descriptor

from sfm.errors import FolderInUseError, OutputError
from sfm.files.open_folders import make_folder, open_regular_file

MAX_OWNER_BYTES = 10_000  # of the text in a lock file
TEXT_AT = 1  # Windows keeps others from reading the locked byte, the first


@dataclass(frozen=True)
class Owner:
    """The owner of a lock, or the one that left it behind."""

    process: int  # number of the process
    computer: str
    since: str  # date and time, UTC

    def __str__(self) -> str:
        return f"process {self.process} on {self.computer}, since {self.since}"


@contextmanager
def locked(path: Path, folder: Path | None = None) -> Iterator[Owner | None]:
    """Hold the lock file `path`, which is gone afterwards.

    Args:
        path: the lock file; its folder is made if it is not there.
        folder: what it locks, for the message; else the folder that it is in.

    Yields:
        The owner of a stale lock that was taken over, a run that was killed; None if there was none.

    Raises:
        FolderInUseError: another run has the lock.
        OutputError: the file cannot be written, or is no lock.
    """
    try:
        make_folder(path.parent)
        handle = _open_and_lock(path, folder or path.parent)
    except OSError as error:
        raise OutputError(f"{path}: the lock cannot be written: {error.strerror or error}") from error
    ours = False
    try:
        try:
            before = _owner(handle)
            if before is None and os.fstat(handle).st_size:
                raise OutputError(f"{path}: is no lock of Kolinear, and is left alone; remove it")
            ours = True
            _write_owner(handle)
        except OSError as error:
            raise OutputError(f"{path}: the lock cannot be written: {error.strerror or error}") from error
        yield before
    finally:
        if ours:
            os.ftruncate(handle, 0)  # an empty one has no owner, where an open file cannot be removed
            with suppress(OSError):
                path.unlink()  # while it is still held: whoever waits for it opens a new one
        unlock_descriptor(handle)
        os.close(handle)


def owner_of(path: Path) -> Owner | None:
    """Read who owns the lock file `path`, or has left it behind; None if that is not stated."""
    try:
        handle = open_regular_file(path, os.O_RDONLY)
    except (OSError, OutputError):
        return None
    try:
        return _owner(handle)
    finally:
        os.close(handle)


def _open_and_lock(path: Path, folder: Path) -> int:
    """Open and lock the file that is at `path` now, not one that its owner has just removed."""
    while True:
        handle = open_regular_file(path, os.O_RDWR | os.O_CREAT)
        if not lock_descriptor(handle, blocking=False):
            owner = _owner(handle)
            os.close(handle)
            who = f" ({owner})" if owner else ""
            raise FolderInUseError(f"{folder}: another run is writing into this folder{who}; wait or end it")
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), os.stat(path)):
                return handle
        os.close(handle)


def _write_owner(handle: int) -> None:
    now = datetime.now(UTC).isoformat(timespec="seconds")
    text = json.dumps(asdict(Owner(os.getpid(), platform.node(), now)))
    os.ftruncate(handle, 0)
    os.lseek(handle, 0, os.SEEK_SET)
    os.write(handle, b" " * TEXT_AT + text.encode())
    os.fsync(handle)


def _owner(handle: int) -> Owner | None:
    """Read who owns a lock; None if that is not stated."""
    try:
        os.lseek(handle, TEXT_AT, os.SEEK_SET)
        found = json.loads(os.read(handle, MAX_OWNER_BYTES))
        return Owner(int(found["process"]), str(found["computer"]), str(found["since"]))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
