"""Files and folders that appear whole or not at all: written beside their place, put there by one rename."""

from __future__ import annotations

import glob
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sfm.errors import KolinearError, OutputError

ROOM_BYTES = 1 << 20  # what is written on trial to learn why a library could not write


@contextmanager
def whole_folder(out: Path, what: str = "") -> Iterator[Path]:
    """Give a folder to write into, which takes the place of `out` when everything is in it.

    Args:
        out: the folder; an earlier one is replaced, and kept until the new one is there.
        what: what is written, for the message, if the path alone does not say it.

    Yields:
        An empty folder beside `out`.

    Raises:
        OutputError: the folder cannot be written; nothing is left of it then.
    """
    folder = _beside(out, what)
    try:
        with _told_of(out, folder, what):
            folder.chmod(0o755)  # mkdtemp makes it for the owner alone
            yield folder
            for path in (*folder.rglob("*"), folder):
                _sync(path)
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


def remove_leftovers(out: Path) -> None:
    """Remove what killed runs have left beside a place, and put back there what they had moved away.

    Only for who knows that nobody is writing there, by a lock.
    """
    name = glob.escape(out.name)
    for old in out.parent.glob(f".{name}.*.old"):
        if (old / "result").is_dir() and not out.exists():
            with suppress(OSError):
                (old / "result").rename(out)
        shutil.rmtree(old, ignore_errors=True)
    for part in out.parent.glob(f".{name}.*.part"):
        shutil.rmtree(part, ignore_errors=True)


def refuse_full(folder: Path) -> None:
    """Raise the OSError that a megabyte more in a folder meets, if any: full disk, limit of size or quota.

    Libraries tell that they could not write, but not why.
    """
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(ROOM_BYTES))
        file.flush()
        os.fsync(file.fileno())


def _beside(out: Path, what: str) -> Path:
    """Make an empty folder beside a place that is to be written, and what is above it."""
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
