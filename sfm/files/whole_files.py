"""Files and folders that appear completely or not at all, and are never written through a link.

New files are made under unpredictable names and moved to their final path by one rename, which follows no
link. An existing file is only replaced if the program is known to have written it.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

from sfm.files.open_folders import (
    MANIFEST,
    disk_errors,
    make_folder,
    manifest_text,
    names_below,
    read_manifest,
    refuse_foreign_files,
    refuse_foreign_folder,
    refuse_links,
    sha256_of,
)
from sfm.model.errors import KolinearError, OutputError

SYNCED = 8  # files that are flushed to the disk at a time
ROOM_BYTES = 1 << 20  # size of a trial file, which shows why a library could not write
RANDOM = r"\.[a-z0-9_]{8}\."  # in the names of unfinished files and folders


@contextmanager
def whole_folder(out: Path, what: str = "", *, replaceable: bool = False) -> Iterator[Path]:
    """Provide a folder to write into, which replaces `out` when it is complete.

    Args:
        out: final folder; it must be absent, empty, or an unchanged earlier folder, which is kept until the
            new one is complete.
        what: description of the content for error messages, if the path alone does not show it.
        replaceable: whether it gets a list of its files, which lets a later folder replace it.

    Yields:
        An empty folder beside `out`.

    Raises:
        OutputError: the folder cannot be written; nothing of it remains.
    """
    refuse_foreign_folder(out)
    with _new_folder(out, what) as part, _naming_disk_errors(out, part, what):
        part.chmod(0o755)  # it was made readable for this user only
        yield part
        if replaceable:
            write_manifest(part, {name: [sha256_of(part / name)] for name in names_below(part)})
        _sync_all(list(part.rglob("*")))
        _sync(part)
        refuse_foreign_folder(out)  # it may have changed since the first check
        _put_in_place(part, out)


@contextmanager
def whole_file(path: Path, what: str = "", *, replaces: bool = False) -> Iterator[Path]:
    """Provide a file to write, which is moved to `path` when it is finished.

    It is in a separate folder, so that other files that a library leaves beside it are removed.

    Args:
        path: final path of the file.
        what: description of the content for error messages, if the path alone does not show it.
        replaces: whether an earlier file is replaced, which the caller knows to be written by the program.

    Yields:
        Path of the file to write.

    Raises:
        OutputError: the file cannot be written, or another file exists; nothing of it remains.
    """
    if not replaces:
        refuse_existing(path)
    with _new_folder(path, what) as part, _naming_disk_errors(path, part / path.name, what):
        yield part / path.name
        _sync(part / path.name)
        if not replaces:
            refuse_existing(path)  # it may have appeared since the first check
        (part / path.name).replace(path)
        _sync(path.parent)


@contextmanager
def whole_files(folder: Path, what: str = "") -> Iterator[Path]:
    """Provide a folder to write files into, which are then moved into `folder`, beside files of other names.

    Args:
        folder: final folder; it gets a list of these files, which lets later files replace them.
        what: description of the content for error messages, if the path alone does not show it.

    Yields:
        An empty folder for files only.

    Raises:
        OutputError: the files cannot be written, or files of these names exist that Kolinear did not write.
    """
    with _new_folder(folder / MANIFEST, what) as part, _naming_disk_errors(folder, part, what):
        yield part
        names = names_below(part)
        refuse_foreign_files(folder, names)
        hashes = read_manifest(folder)
        hashes.pop(MANIFEST, None)
        _sync_all([part / name for name in names])
        for name in names:
            # New and existing hashes are listed before the files are moved, so both are known if the run
            # ends.
            there = [sha256_of(folder / name)] if name in hashes and (folder / name).exists() else []
            hashes[name] = [*there, sha256_of(part / name)]
        write_manifest(folder, hashes)
        for name in names:
            (part / name).replace(folder / name)
        _sync(folder)


def refuse_existing(path: Path) -> None:
    """Raise OutputError if the path of a new file exists already."""
    refuse_links(path)
    if os.path.lexists(path):
        raise OutputError(f"{path}: exists already and is left alone, a new name is needed")


def refuse_unwritable(path: Path) -> None:
    """Raise OutputError unless a new file or folder can be written to a path, before any work for it.

    As a trial, a temporary folder is made in the nearest existing folder above it.
    """
    refuse_existing(path)
    above = next(part for part in (Path.cwd() / path).parents if os.path.lexists(part))
    with disk_errors(f"{path}: cannot be written here"), tempfile.TemporaryDirectory(dir=above):
        pass


def write_manifest(folder: Path, hashes: dict[str, list[str]]) -> None:
    """Write the list of a folder's files with the SHA-256 values that each may have."""
    with whole_file(folder / MANIFEST, replaces=True) as part:
        part.write_text(manifest_text(hashes), encoding="utf-8")


def remove_leftovers(out: Path) -> None:
    """Remove leftovers of killed runs beside a path, and restore a folder that they had moved away.

    The caller must have a lock, which shows that no other run is writing there.

    Args:
        out: path of a file or folder.
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
    """Raise the OSError of writing one more megabyte into a folder, if any: full disk, size limit or quota.

    Libraries report that they could not write, but not why.
    """
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(ROOM_BYTES))
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def _new_folder(out: Path, what: str, ending: str = "part") -> Iterator[Path]:
    """Make a temporary empty folder beside the path to write, with all folders above it."""
    path = out.parent / f".{out.name}.{secrets.token_hex(4)}.{ending}"
    refuse_links(out)
    with disk_errors(f"{out}: {_subject(what)}cannot be written here"):
        make_folder(out.parent)
        path.mkdir(0o700)
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


@contextmanager
def _naming_disk_errors(out: Path, part: Path, what: str) -> Iterator[None]:
    """Let error messages name `out` instead of its temporary part."""
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
    """Flush a file to the disk before it gets its name, so that a power cut leaves no empty file."""
    if path.is_dir() and os.name == "nt":
        return  # Windows has no handles of folders
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _sync_all(paths: Sequence[Path]) -> None:
    """Flush files to the disk, several at a time."""
    with ThreadPoolExecutor(SYNCED) as pool:
        for _ in pool.map(_sync, paths):
            pass


def _put_in_place(part: Path, out: Path) -> None:
    """Rename the finished folder to its final path; an earlier folder is kept until then."""
    if not out.exists():
        part.replace(out)
        _sync(out.parent)
        return
    with _new_folder(out, "", "old") as old:
        out.replace(old / "result")
        try:
            part.replace(out)
        except OSError:
            (old / "result").replace(out)
            raise
        _sync(out.parent)
