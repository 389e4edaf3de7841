"""Folders opened part for part and through no link, their lock, and the list of files written.

A folder that comes from somebody else may hold links at every path that is written. So no part of such a path
may be a link but those of the system in its root folder (as /tmp of macOS). A folder is opened before
something is made, opened or moved in it, so that nothing can be put in its place meanwhile; Windows cannot
open files by such a handle, there its path is checked only.

The lock of a folder: one run at a time writes into it, and everybody can read who. The operating system keeps
the lock and releases it when the process ends, however it ends. So a lock file that is free is stale by that
alone, and no process number has to be trusted. It lies beside what it locks, where the runs of other
computers on the same disk see it.

The list of the files that Kolinear wrote into a folder, with their hashes: by it they are known again.

A folder or file that may be replaced has such a list, manifest.json. It is replaced only while it is as it
was written: files that were added, edited or linked by a person are named, and left alone.

Source: POSIX.1-2008, openat() and O_NOFOLLOW.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from filelock import lock_descriptor, unlock_descriptor

from sfm.display import listed
from sfm.errors import FolderInUseError, OutputError, SurveyFileError

MANIFEST = "manifest.json"
WRITER = "kolinear"
MAX_MANIFEST_BYTES = 20_000_000  # some 100,000 files
LITTER = (".DS_Store", "Thumbs.db")  # which systems leave in every folder that is looked at
NAMED = 3  # files that a message names
MAX_OWNER_BYTES = 10_000  # of the text in a lock file
TEXT_AT = 1  # Windows keeps others from reading the locked byte, the first
HAS_HANDLES = {os.open, os.mkdir, os.rename, os.stat} <= os.supports_dir_fd and hasattr(os, "O_NOFOLLOW")
# Linux opens folders that one may pass but not list by O_PATH.
_FOLDER = getattr(os, "O_PATH", os.O_RDONLY) | getattr(os, "O_DIRECTORY", 0) | getattr(os, "O_CLOEXEC", 0)
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
_PLAIN_FILE = _NO_LINK | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


@contextmanager
def disk_errors(message: str) -> Iterator[None]:
    """Say what went wrong where the disk refuses: the message, a colon and the reason of the system.

    Raises:
        OutputError: in place of every OSError.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(f"{message}: {error.strerror or error}") from error


@contextmanager
def open_folder(path: Path, *, make: bool = False) -> Iterator[int | None]:
    """Open a folder for what is done in it by `dir_fd`; its handle is None where the system has none.

    Args:
        path: the folder.
        make: whether it is made, with what is above it, if it is not there.

    Raises:
        OutputError: a link is in the path.
        OSError: it is no folder, or cannot be opened or made.
    """
    refuse_links(path)
    if not HAS_HANDLES:
        if make:
            path.mkdir(parents=True, exist_ok=True)
        yield None
        return
    handle = _walk(Path.cwd() / path, make=make)
    try:
        yield handle
    finally:
        os.close(handle)


def _walk(path: Path, *, make: bool) -> int:
    """Open a folder, each part of its absolute path in the one before."""
    handle = os.open(path.anchor, _FOLDER)
    flags = _FOLDER  # links in the root folder are the system's
    for part in path.parts[1:]:
        try:
            if make and not _is_there(part, handle):
                with suppress(FileExistsError):  # another run has just made it
                    os.mkdir(part, dir_fd=handle)
            inner = os.open(part, flags, dir_fd=handle)
        finally:
            os.close(handle)
        handle, flags = inner, _FOLDER | _NO_LINK
    return handle


def _is_there(name: str, folder: int) -> bool:
    try:
        os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        return False
    return True


def open_new_folder(path: Path, beside: int | None) -> int | None:
    """Make and open a folder that was not there, for this user alone.

    Args:
        path: the folder.
        beside: handle of the folder that it is made in.

    Raises:
        OSError: it is there, or cannot be made.
    """
    if beside is None:
        path.mkdir(0o700)
        return None
    os.mkdir(path.name, 0o700, dir_fd=beside)
    return os.open(path.name, _FOLDER | _NO_LINK, dir_fd=beside)


def move(source: Path, source_folder: int | None, target: Path, target_folder: int | None) -> None:
    """Rename a file or folder, which replaces a file or an empty folder and follows no link.

    Args:
        source: its path.
        source_folder: handle of the folder that it is in.
        target: its path afterwards.
        target_folder: handle of the folder that this is in.

    Raises:
        OSError: it cannot be moved.
    """
    if source_folder is None or target_folder is None:
        source.replace(target)
    else:
        os.rename(source.name, target.name, src_dir_fd=source_folder, dst_dir_fd=target_folder)


def open_regular_file(path: Path, flags: int) -> int:
    """Open a regular file that has no second name, following no link, and return its handle.

    Args:
        path: the file.
        flags: of os.open; what they create is new or written by the program, by the caller's check.

    Raises:
        OutputError: a link is in the path, or it is no such file.
        OSError: it cannot be opened.
    """
    refuse_links(path)
    with open_folder(path.parent) as folder:
        name = path if folder is None else path.name
        handle = os.open(name, flags | _PLAIN_FILE, 0o644, dir_fd=folder)
    status = os.fstat(handle)
    if stat.S_ISREG(status.st_mode) and status.st_nlink <= 1:  # 0: its owner has just removed it
        return handle
    os.close(handle)
    raise OutputError(f"{path}: is not a regular file with one name, and is left alone")


def make_folder(path: Path) -> None:
    """Make a folder and what is above it, if they are not there.

    Raises:
        OutputError: a link is in the path.
        OSError: it cannot be made.
    """
    with open_folder(path, make=True):
        pass


def refuse_links(path: Path) -> None:
    """Raise OutputError if a part of a path that is to be written is a symbolic link or a junction."""
    absolute = Path.cwd() / path
    for part in (*reversed(absolute.parents), absolute):
        link = part.is_symlink() or getattr(os.path, "isjunction", lambda _: False)(part)
        if link and part.parent != Path(part.anchor):
            leads = os.fsdecode(os.readlink(part))
            raise OutputError(
                f"{path}: '{part.name}' is a link to '{leads}', and nothing is written through links; "
                "name the folder itself"
            )


def refuse_links_out(folder: Path, *below: str) -> None:
    """Raise SurveyFileError if a file in a folder of somebody else is a link that leaves the folder.

    A folder that is not there is for its reader to refuse.

    Args:
        folder: the folder.
        below: files in folders of it that are read, too.
    """
    try:
        there = os.scandir(folder) if folder.is_dir() else ()
        links = [Path(entry.path) for entry in there if entry.is_symlink() and not entry.is_dir()]
        read = (*links, *(folder / name for name in below))
        leaving = [path for path in read if not path.resolve().is_relative_to(folder.resolve())]
    except (OSError, RuntimeError) as error:  # a circle of links
        raise SurveyFileError(f"{folder}: the folder cannot be read ({error.__class__.__name__})") from error
    for path in sorted(leaving):
        raise SurveyFileError(f"{path}: a link that leaves its folder; the file itself is needed there")


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
    with disk_errors(f"{path}: the lock cannot be written"):
        make_folder(path.parent)
        handle = _open_and_lock(path, folder or path.parent)
    ours = False
    try:
        with disk_errors(f"{path}: the lock cannot be written"):
            before = _owner(handle)
            if before is None and os.fstat(handle).st_size:
                raise OutputError(f"{path}: is no lock of Kolinear, and is left alone; remove it")
            ours = True
            _write_owner(handle)
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
    with disk_errors(f"{out}: the folder cannot be read"):
        foreign = _foreign(out, names_below(out))
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
    with disk_errors(f"{folder}: the folder cannot be read"):
        foreign = _foreign(folder, [name for name in wanted if os.path.lexists(folder / name)])
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
