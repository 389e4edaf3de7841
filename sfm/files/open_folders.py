"""Folders that are opened part for part and through no link, and files in them.

A folder that comes from somebody else may hold links at every path that is written. So no part of such a path
may be a link but those of the system in its root folder (as /tmp of macOS). A folder is opened before
something is made, opened or moved in it, so that nothing can be put in its place meanwhile; Windows cannot
open files by such a handle, there its path is checked only.

Source: POSIX.1-2008, openat() and O_NOFOLLOW.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sfm.errors import OutputError, SurveyFileError

HAS_HANDLES = {os.open, os.mkdir, os.rename, os.stat} <= os.supports_dir_fd and hasattr(os, "O_NOFOLLOW")
# Linux opens folders that one may pass but not list by O_PATH.
_FOLDER = getattr(os, "O_PATH", os.O_RDONLY) | getattr(os, "O_DIRECTORY", 0) | getattr(os, "O_CLOEXEC", 0)
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
_PLAIN_FILE = _NO_LINK | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


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
