"""Files and folders that appear whole or not at all, and never by way of a link that somebody has laid there.

New files are made under unpredictable names and moved to their place by one rename, which
follows no link. Existing files are replaced only where it is known to be written by the program.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from sfm.errors import KolinearError, OutputError
from sfm.files.open_folders import (
    MANIFEST,
    disk_errors,
    manifest_text,
    move,
    names_below,
    open_folder,
    open_new_folder,
    read_manifest,
    refuse_foreign_files,
    refuse_foreign_folder,
    refuse_links,
    sha256_of,
)

SYNCED = 8  # files that are brought to the disk at a time
ROOM_BYTES = 1 << 20  # what is written on trial to learn why a library could not write
RANDOM = r"\.[a-z0-9_]{8}\."  # in the name of what is being written


@contextmanager
def whole_folder(out: Path, what: str = "", *, replaceable: bool = False) -> Iterator[Path]:
    """Give a folder to write into, which takes the place of `out` when everything is in it.

    Args:
        out: the folder; absent, empty, or an unchanged earlier one, which is kept until the new one is there.
        what: what is written, for the message, if the path alone does not show it.
        replaceable: whether it gets a list of its files, by which a later one may take its place.

    Yields:
        An empty folder beside `out`.

    Raises:
        OutputError: the folder cannot be written; nothing is left of it then.
    """
    refuse_foreign_folder(out)
    with _new_folder(out, what) as part, _naming_disk_errors(out, part.path, what):
        part.path.chmod(0o755)  # it was made for the user alone
        yield part.path
        if replaceable:
            write_manifest(part.path, {n: [sha256_of(part.path / n)] for n in names_below(part.path)})
        _sync_all(list(part.path.rglob("*")))
        _sync(part.path)
        refuse_foreign_folder(out)  # as it is now
        _put_in_place(part, out)


@contextmanager
def whole_file(path: Path, what: str = "", *, replaces: bool = False) -> Iterator[Path]:
    """Give a file to write, which is at `path` when it is finished.

    It lies in a separate folder, so that what a library leaves beside its file goes with it.

    Args:
        path: the file.
        what: what is written, for the message, if the path alone does not show it.
        replaces: whether the caller knows an earlier file to be written by the program, which is replaced.

    Yields:
        Path of the file to write.

    Raises:
        OutputError: the file cannot be written, or another is there; nothing is left of it then.
    """
    if not replaces:
        refuse_existing(path)
    with _new_folder(path, what) as part, _naming_disk_errors(path, part.path / path.name, what):
        yield part.path / path.name
        _sync(part.path / path.name)
        if not replaces:
            refuse_existing(path)  # as it is now
        part.refuse_exchanged()
        move(part.path / path.name, part.handle, path, part.beside)
        _sync(path.parent)


@contextmanager
def whole_files(folder: Path, what: str = "") -> Iterator[Path]:
    """Give a folder to write files into, which then go into `folder`, beside files of other names.

    Args:
        folder: it gets a list of them, by which later ones may take their place.
        what: what is written, for the message, if the path alone does not show it.

    Yields:
        An empty folder; what is made in it is files.

    Raises:
        OutputError: they cannot be written, or files of these names are there that Kolinear has not written.
    """
    with _new_folder(folder / MANIFEST, what) as part, _naming_disk_errors(folder, part.path, what):
        yield part.path
        names = names_below(part.path)
        refuse_foreign_files(folder, names)
        hashes = read_manifest(folder)
        hashes.pop(MANIFEST, None)
        _sync_all([part.path / name for name in names])
        for name in names:
            # Listed before they are there, beside those that are: whatever ends the run, they are known.
            there = [sha256_of(folder / name)] if name in hashes and (folder / name).exists() else []
            hashes[name] = [*there, sha256_of(part.path / name)]
        write_manifest(folder, hashes)
        part.refuse_exchanged()
        for name in names:
            move(part.path / name, part.handle, folder / name, part.beside)
        _sync(folder)


def refuse_existing(path: Path) -> None:
    """Raise OutputError if something is where a new file is to be written."""
    refuse_links(path)
    if os.path.lexists(path):
        raise OutputError(f"{path}: is there already and is left alone, a new name is needed")


def refuse_unwritable(path: Path) -> None:
    """Raise OutputError unless something new can be written to a place, before it takes time to make it.

    A folder is made on trial in the nearest one above it that is there, and goes again.
    """
    refuse_existing(path)
    above = next(part for part in (Path.cwd() / path).parents if os.path.lexists(part))
    with disk_errors(f"{path}: cannot be written here"), tempfile.TemporaryDirectory(dir=above):
        pass


def write_manifest(folder: Path, hashes: dict[str, list[str]]) -> None:
    """List files of a folder with the SHA-256 that each may have."""
    with whole_file(folder / MANIFEST, replaces=True) as part:
        part.write_text(manifest_text(hashes), encoding="utf-8")


def remove_leftovers(out: Path) -> None:
    """Remove what killed runs have left beside a place, and restore what they had moved away.

    Only for a caller whose lock shows that no one is writing there.
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

    Libraries report that they could not write, but not why.
    """
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(ROOM_BYTES))
        file.flush()
        os.fsync(file.fileno())


@dataclass(frozen=True)
class _Part:
    """A new folder under a name that cannot be known before, and the folder it lies in."""

    path: Path
    handle: int | None  # of it; None where the system has none
    beside: int | None  # of the folder it lies in

    def refuse_exchanged(self) -> None:
        """Raise OutputError if another folder is now where libraries have written by its path."""
        if self.handle is not None and not os.path.samestat(os.fstat(self.handle), os.stat(self.path)):
            raise OutputError(f"{self.path}: was exchanged while it was written")


@contextmanager
def _new_folder(out: Path, what: str, ending: str = "part") -> Iterator[_Part]:
    """Make an empty folder beside a place that is to be written, and what is above it; it goes afterwards."""
    refuse_links(out)
    path = out.parent / f".{out.name}.{secrets.token_hex(4)}.{ending}"
    with ExitStack() as stack:
        with disk_errors(f"{out}: {_subject(what)}cannot be written here"):
            beside = stack.enter_context(open_folder(out.parent, make=True))
            handle = open_new_folder(path, beside)
        stack.callback(shutil.rmtree, path, ignore_errors=True)
        if handle is not None:
            stack.callback(os.close, handle)
        yield _Part(path, handle, beside)


@contextmanager
def _naming_disk_errors(out: Path, part: Path, what: str) -> Iterator[None]:
    """Let errors speak of `out`, not of a part of it that will not be found."""
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


def _sync_all(paths: Sequence[Path]) -> None:
    """Have files on the disk, which takes several at a time."""
    with ThreadPoolExecutor(SYNCED) as pool:
        for _ in pool.map(_sync, paths):
            pass


def _put_in_place(part: _Part, out: Path) -> None:
    """Rename the finished folder to its place; an earlier one is kept until the new one is there."""
    part.refuse_exchanged()
    if not out.exists():
        move(part.path, part.beside, out, part.beside)
        _sync(out.parent)
        return
    with _new_folder(out, "", "old") as old:
        move(out, part.beside, old.path / "result", old.handle)
        try:
            move(part.path, part.beside, out, part.beside)
        except OSError:
            move(old.path / "result", old.handle, out, part.beside)
            raise
        _sync(out.parent)
