"""Safe access to folders: nothing is written through a link, locks, and the list of written files.

A folder from somebody else may contain links at every path that is written. Therefore no part of such a path
may be a link, except for links of the system in its root folder (such as /tmp of macOS). The path is checked
before it is written; that somebody changes it meanwhile is not prevented.

A lock lets only one run at a time write into a folder, and shows everybody its owner. The operating system
holds the lock, and releases it when the process ends for any reason. A lock file that is not locked is
therefore stale, and no process number has to be trusted. The file is beside the locked folder, where runs on
other computers with the same disk see it.

The list of the files that Kolinear wrote into a folder, manifest.json, has their hashes, and identifies them
later. A folder or file that may be replaced has such a list. It is only replaced while it is unchanged. Files
that a person added, edited or linked are reported and left alone.
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

from sfm.model.display import listed
from sfm.model.errors import FolderInUseError, OutputError, SurveyFileError

MANIFEST = "manifest.json"
WRITER = "kolinear"
MAX_MANIFEST_BYTES = 20_000_000  # about 100,000 files
LITTER = (".DS_Store", "Thumbs.db")  # systems leave these in every folder that is viewed
NAMED = 3  # files that an error message lists
MAX_OWNER_BYTES = 10_000  # of the text in a lock file
TEXT_AT = 1  # Windows does not let others read the locked byte, which is the first
_PLAIN_FILE = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


@contextmanager
def disk_errors(message: str) -> Iterator[None]:
    """Turn disk errors into messages: the given message, a colon, and the reason of the system.

    Args:
        message: beginning of the error message.

    Raises:
        OutputError: replaces every OSError.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(f"{message}: {error.strerror or error}") from error


def open_regular_file(path: Path, flags: int) -> int:
    """Open a regular file with only one name, without following links, and return its handle.

    Args:
        path: the file.
        flags: flags of os.open; if they create or write, the caller has checked that the file is new or
            written by the program.

    Raises:
        OutputError: the path contains a link, or is not a regular file with one name.
        OSError: the file cannot be opened.
    """
    refuse_links(path)
    handle = os.open(path, flags | _PLAIN_FILE, 0o644)
    status = os.fstat(handle)
    if stat.S_ISREG(status.st_mode) and status.st_nlink <= 1:  # 0: its owner has just removed it
        return handle
    os.close(handle)
    raise OutputError(f"{path}: is not a regular file with one name, and is left alone")


def path_inside(folder: Path, name: str, where: str, *, allow_outside: bool = False) -> Path:
    """Return the path of a file in a folder; symbolic links are followed for the check.

    Args:
        folder: the folder.
        name: path relative to the folder.
        where: file that states the path, for error messages.
        allow_outside: whether the path may leave the folder.

    Raises:
        SurveyFileError: the path leaves the folder, or is not a valid path.
    """
    try:
        path = folder / name
        path.is_file()  # raises if a name is too long for the disk
        left = not path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError) as error:  # circular links, a null byte
        raise SurveyFileError(f"{where}: {name!r:.100} is not the path of a file") from error
    if left and not allow_outside:
        raise SurveyFileError(
            f"{where}: {name!r:.100} leaves the survey's folder; --allow-outside allows that, "
            "for survey files that you trust"
        )
    return path


def is_home_file(path: Path) -> bool:
    """Return whether a link leads to a file in the user's home folder outside hidden folders.

    People use links to collect photographs in a folder, so these links are not an attack.

    Args:
        path: path of the link.
    """
    try:
        target, home = path.resolve(), Path.home().resolve()
    except (OSError, RuntimeError):
        return False
    if not (target.is_file() and target.is_relative_to(home)):
        return False
    return not any(part.startswith(".") for part in target.relative_to(home).parts)


def make_folder(path: Path) -> None:
    """Make a folder and the folders above it, if they do not exist.

    Raises:
        OutputError: the path contains a link.
        OSError: the folder cannot be made.
    """
    refuse_links(path)
    path.mkdir(parents=True, exist_ok=True)


def refuse_links(path: Path) -> None:
    """Raise OutputError if any part of a path to write is a symbolic link or a junction."""
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

    A missing folder is not refused here, but by its reader.

    Args:
        folder: the folder.
        *below: files in its subfolders that are read too.
    """
    try:
        there = os.scandir(folder) if folder.is_dir() else ()
        links = [Path(entry.path) for entry in there if entry.is_symlink() and not entry.is_dir()]
        read = (*links, *(folder / name for name in below))
        leaving = [path for path in read if not path.resolve().is_relative_to(folder.resolve())]
    except (OSError, RuntimeError) as error:  # circular links
        raise SurveyFileError(f"{folder}: the folder cannot be read ({error.__class__.__name__})") from error
    for path in sorted(leaving):
        raise SurveyFileError(f"{path}: a link that leaves its folder; the file itself is needed there")


@dataclass(frozen=True)
class Owner:
    """The present owner of a lock, or the owner that left a stale lock."""

    process: int  # process number
    computer: str
    since: str  # date and time, UTC

    def __str__(self) -> str:
        return f"process {self.process} on {self.computer}, since {self.since}"


@contextmanager
def locked(path: Path, folder: Path | None = None) -> Iterator[Owner | None]:
    """Hold the lock file `path`, and remove it afterwards.

    Args:
        path: the lock file; its folder is made if it does not exist.
        folder: the locked folder, for error messages; the folder of the lock file if not given.

    Yields:
        The owner of a stale lock, which is a killed run; None if there was none.

    Raises:
        FolderInUseError: another run has the lock.
        OutputError: the file cannot be written, or is not a lock.
    """
    with disk_errors(f"{path}: the lock cannot be written"):
        make_folder(path.parent)
        handle = _open_and_lock(path, folder or path.parent)
    ours = False
    try:
        with disk_errors(f"{path}: the lock cannot be written"):
            before = _owner(handle)
            if before is None and os.fstat(handle).st_size:
                raise OutputError(f"{path}: is not a lock of Kolinear, and is left alone; remove it")
            ours = True
            now = datetime.now(UTC).isoformat(timespec="seconds")
            text = json.dumps(asdict(Owner(os.getpid(), platform.node(), now)))
            os.ftruncate(handle, 0)
            os.lseek(handle, 0, os.SEEK_SET)
            os.write(handle, b" " * TEXT_AT + text.encode())
            os.fsync(handle)
        yield before
    finally:
        if ours:
            os.ftruncate(handle, 0)  # without an owner, for systems that cannot remove an open file
            with suppress(OSError):
                path.unlink()  # while it is still locked: a waiting run then opens a new file
        unlock_descriptor(handle)
        os.close(handle)


def owner_of(path: Path) -> Owner | None:
    """Return the owner of the lock file `path`, or the owner that left it; None if it is not stated."""
    try:
        handle = open_regular_file(path, os.O_RDONLY)
    except (OSError, OutputError):
        return None
    try:
        return _owner(handle)
    finally:
        os.close(handle)


def _open_and_lock(path: Path, folder: Path) -> int:
    """Open and lock the file that is now at `path`, not a file that its owner has just removed."""
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


def _owner(handle: int) -> Owner | None:
    """Return the owner of a lock; None if it is not stated."""
    try:
        os.lseek(handle, TEXT_AT, os.SEEK_SET)
        stated = json.loads(os.read(handle, MAX_OWNER_BYTES))
        return Owner(int(stated["process"]), str(stated["computer"]), str(stated["since"]))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def refuse_foreign_folder(out: Path) -> None:
    """Raise OutputError unless a folder is absent, empty, or unchanged by its manifest since it was written.

    It is also called before the work starts, so that no one waits for a result that cannot be written.
    """
    refuse_links(out)
    try:
        mode = out.lstat().st_mode
    except FileNotFoundError:
        return
    except OSError as error:  # such as a file in place of a folder above it
        raise OutputError(f"{out}: cannot be written here: {error.strerror}") from error
    if not stat.S_ISDIR(mode):
        raise OutputError(f"{out}: a file has this name, --out needs a folder")
    with disk_errors(f"{out}: the folder cannot be read"):
        foreign = _describe_foreign(out, names_below(out))
    _refuse(out, foreign, "--out needs a new or empty folder or an unchanged earlier result")


def refuse_foreign_files(folder: Path, names: Iterable[str]) -> None:
    """Raise OutputError if a folder has files of some names that Kolinear did not write, or changed ones.

    Args:
        folder: folder to write into; it may contain files of other names.
        names: names of the files to write.
    """
    wanted = (*names, MANIFEST)
    for name in wanted:
        refuse_links(folder / name)
    with disk_errors(f"{folder}: the folder cannot be read"):
        foreign = _describe_foreign(folder, [name for name in wanted if os.path.lexists(folder / name)])
    _refuse(folder, foreign, "which would be replaced; another folder is needed")


def _describe_foreign(folder: Path, names: Iterable[str]) -> list[str]:
    """Return texts on the files of a folder that Kolinear did not write, or that were changed."""
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
    """Return the text of a manifest with the SHA-256 values that each file may have."""
    return json.dumps({"written_by": WRITER, "files": hashes}, indent=1, ensure_ascii=True) + "\n"


def read_manifest(folder: Path) -> dict[str, list[str]]:
    """Return the hashes that files of a folder may have, by name; empty without a readable manifest."""
    try:
        handle = open_regular_file(folder / MANIFEST, os.O_RDONLY)
        with os.fdopen(handle, "rb") as file:
            data = file.read(MAX_MANIFEST_BYTES)
        manifest: Any = json.loads(data)
        files = manifest["files"]
        if manifest["written_by"] == WRITER and all(isinstance(hashes, list) for hashes in files.values()):
            return {**files, MANIFEST: [hashlib.sha256(data).hexdigest()]}  # a readable manifest is ours
    except (OSError, OutputError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        pass
    return {}


def names_below(folder: Path) -> list[str]:
    """Return the names of all files in and below a folder; a link to a folder counts as a file.

    Raises:
        OSError: a folder cannot be read.
    """

    def fail(error: OSError) -> None:
        raise error

    names = []
    for where, below, files in os.walk(folder, onerror=fail):
        for name in (*below, *files):
            path = Path(where, name)
            if (path.is_symlink() or not path.is_dir()) and name not in LITTER:
                names.append(path.relative_to(folder).as_posix())
    return sorted(names)


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a regular file; for anything else, a random text that is not a hash."""
    if not stat.S_ISREG(path.lstat().st_mode):
        return f"no file {os.urandom(16).hex()}"  # no manifest can contain this
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
