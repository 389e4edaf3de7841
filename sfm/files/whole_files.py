"""Files and folders that appear whole or not at all, and never by way of a link that somebody has laid there.

A folder that comes from somebody else may hold links at every path that is written. So no part of such a path
may be a link but those of the system in its root folder (as /tmp of macOS); what is new is made under names
that nobody can know before, and moved to its place by one rename, which follows no link.

A folder that may be replaced has a list of its files with their hashes, manifest.json. It is replaced only
while it holds these files, unchanged, and nothing else: files that were added, edited or linked by a person
are named, and left alone.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sfm.errors import KolinearError, OutputError

MANIFEST = "manifest.json"  # lists the files of a folder
MAX_MANIFEST_BYTES = 20_000_000  # some 100,000 files
LITTER = (".DS_Store", "Thumbs.db")  # which systems leave in every folder that is looked at
NAMED = 3  # files that a message names
ROOM_BYTES = 1 << 20  # what is written on trial to learn why a library could not write
RANDOM = r"\.[a-z0-9_]{8}\."  # of mkdtemp, in the name of what is being written


@contextmanager
def whole_folder(out: Path, what: str = "", *, replaceable: bool = False) -> Iterator[Path]:
    """Give a folder to write into, which takes the place of `out` when everything is in it.

    Args:
        out: the folder; absent, empty, or an unchanged earlier one, which is kept until the new one is there.
        what: what is written, for the message, if the path alone does not say it.
        replaceable: whether it gets a list of its files, by which a later one may take its place.

    Yields:
        An empty folder beside `out`.

    Raises:
        OutputError: the folder cannot be written; nothing is left of it then.
    """
    refuse_foreign_folder(out)
    folder = _beside(out, what)
    try:
        with _told_of(out, folder, what):
            folder.chmod(0o755)  # mkdtemp makes it for the owner alone
            yield folder
            if replaceable:
                write_manifest(folder, {name: [sha256_of(folder / name)] for name in _names(folder)})
            for path in (*folder.rglob("*"), folder):
                _sync(path)
            refuse_foreign_folder(out)  # as it is now
            _put_in_place(folder, out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def whole_file(path: Path, what: str = "") -> Iterator[Path]:
    """Give a file to write, which takes the place of `path` when it is finished.

    It lies in a folder of its own, so that what a library leaves beside its file goes with it.

    Args:
        path: the file; an earlier one is replaced.
        what: what is written, for the message, if the path alone does not say it.

    Yields:
        Path of the file to write.

    Raises:
        OutputError: the file cannot be written; nothing is left of it then.
    """
    folder = _beside(path, what)
    try:
        with _told_of(path, folder / path.name, what):
            yield folder / path.name
            _sync(folder / path.name)
            (folder / path.name).replace(path)
            _sync(path.parent)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def open_own(path: Path, flags: int) -> int:
    """Open a regular file that has no second name, following no link, and return its handle.

    Args:
        path: the file.
        flags: of os.open; what they create is new or the program's own, by the caller's check.

    Raises:
        OutputError: a link is in the path, or it is no such file.
        OSError: it cannot be opened.
    """
    refuse_links(path)
    flags |= getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    handle = os.open(path, flags, 0o644)
    status = os.fstat(handle)
    if stat.S_ISREG(status.st_mode) and status.st_nlink <= 1:  # 0: its owner has just removed it
        return handle
    os.close(handle)
    raise OutputError(f"{path}: is not a regular file with one name, and is left alone")


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


def refuse_foreign_folder(out: Path) -> None:
    """Raise OutputError unless a folder is absent, empty, or as Kolinear wrote it, by its manifest.

    It is called before the work starts, too, so that nobody waits for a result that has no place.
    """
    refuse_links(out)
    try:
        mode = out.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):  # which is told where it is to be made
        return
    if not stat.S_ISDIR(mode):
        raise OutputError(f"{out}: a file is in the way, --out needs a folder")
    try:
        known, foreign = read_manifest(out), []
        for name in _names(out):
            if name not in known:
                foreign.append(f"'{name}'")
            elif sha256_of(out / name) not in known[name]:
                foreign.append(f"'{name}', changed since Kolinear wrote it")
    except OSError as error:
        raise OutputError(f"{out}: the folder cannot be read: {error.strerror}") from error
    if foreign:
        more = f" and {len(foreign) - NAMED} more" if len(foreign) > NAMED else ""
        raise OutputError(
            f"{out}: the folder holds {'; '.join(foreign[:NAMED])}{more}; --out needs a new or empty folder "
            "or an unchanged earlier result"
        )


def write_manifest(folder: Path, hashes: dict[str, list[str]]) -> None:
    """List files of a folder with the SHA-256 that each may have."""
    text = json.dumps({"written_by": "kolinear", "files": hashes}, indent=1, ensure_ascii=True)
    with whole_file(folder / MANIFEST) as part:
        part.write_text(text + "\n", encoding="utf-8")


def read_manifest(folder: Path) -> dict[str, list[str]]:
    """Return the hashes that files of a folder may have, by name; none without a list that can be read."""
    try:
        handle = open_own(folder / MANIFEST, os.O_RDONLY)
        with os.fdopen(handle, "rb") as file:
            found: Any = json.loads(file.read(MAX_MANIFEST_BYTES))["files"]
        if all(isinstance(hashes, list) for hashes in found.values()):
            return {**found, MANIFEST: [sha256_of(folder / MANIFEST)]}  # it is ours if it can be read
    except (OSError, OutputError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        pass
    return {}


def remove_leftovers(out: Path) -> None:
    """Remove what killed runs have left beside a place, and put back there what they had moved away.

    Only for who knows that nobody is writing there, by a lock.
    """
    ours = re.compile(rf"\.{re.escape(out.name)}{RANDOM}(old|part)")
    if not out.parent.is_dir():
        return
    for left in [path for path in out.parent.iterdir() if ours.fullmatch(path.name)]:
        if left.is_symlink():
            continue
        result = left / "result"
        if left.suffix == ".old" and result.is_dir() and not (result.is_symlink() or os.path.lexists(out)):
            with suppress(OSError):
                result.rename(out)
        shutil.rmtree(left, ignore_errors=True)


def refuse_full(folder: Path) -> None:
    """Raise the OSError that a megabyte more in a folder meets, if any: full disk, limit of size or quota.

    Libraries tell that they could not write, but not why.
    """
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(ROOM_BYTES))
        file.flush()
        os.fsync(file.fileno())


def make_folder(path: Path) -> None:
    """Make a folder and what is above it, if they are not there.

    Raises:
        OutputError: a link is in the path.
        OSError: it cannot be made.
    """
    refuse_links(path)
    path.mkdir(parents=True, exist_ok=True)


def _names(folder: Path) -> list[str]:
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


def _beside(out: Path, what: str) -> Path:
    """Make an empty folder beside a place that is to be written, and what is above it."""
    refuse_links(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".part", dir=out.parent))
    except OSError as error:
        raise OutputError(
            f"{out}: {_subject(what)}cannot be written here: {error.strerror or error}"
        ) from error


@contextmanager
def _told_of(out: Path, part: Path, what: str) -> Iterator[None]:
    """Let errors speak of `out`, not of a part of it that nobody will find."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{out}: {_subject(what)}cannot be written: {error.strerror or error}") from error
    except KolinearError as error:
        if str(part) not in str(error):
            raise
        raise type(error)(str(error).replace(str(part), str(out))) from error


def _subject(what: str) -> str:
    return f"{what} " if what else ""


def _sync(path: Path) -> None:
    """Have a file on the disk before it has its name, so that a power cut leaves none empty."""
    if path.is_dir() and os.name == "nt":
        return  # Windows knows no handles of folders
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _put_in_place(folder: Path, out: Path) -> None:
    """Rename the finished folder to its place; an earlier one is kept until the new one is there."""
    if not out.exists():
        folder.rename(out)
        _sync(out.parent)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".old", dir=out.parent))
    try:
        out.rename(old / "result")
        try:
            folder.rename(out)
        except OSError:
            (old / "result").rename(out)
            raise
        _sync(out.parent)
    finally:
        shutil.rmtree(old, ignore_errors=True)
