"""Record whether the kernels of a survey are compiled for the current sources and version of numba."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from functools import cache
from pathlib import Path

import numba

from sfm.files.user_cache import make_user_folder, user_folder
from sfm.runtime.compiling import KEPT, source_hash, sources_of

WARM_UP = "sfm.cli.warm_up"  # imports all that a survey needs
DECORATORS = "sfm.runtime.compiling"


def is_warm() -> bool:
    """Return whether `sfm.cli.warm_up` has finished for the current kernels."""
    return (_folder() / _mark()).is_file()


def set_warm() -> None:
    """Record that it has finished and delete earlier records; a folder that is not writable is ignored."""
    folder = _folder()
    with suppress(OSError):
        if folder == KEPT:
            folder.mkdir(exist_ok=True)
        else:
            make_user_folder(folder)
        for old in folder.glob("warm-*"):
            old.unlink()
        (folder / _mark()).touch()


def _folder() -> Path:
    """Return the folder of numba's compiled code, or the user's cache if that is not writable."""
    return KEPT if os.access(KEPT.parent, os.W_OK) else user_folder("kernels", "notes of compiled kernels")


@cache
def _mark() -> str:
    """Return the name of the file that represents the sources of all kernels."""
    digest = hashlib.sha256(numba.__version__.encode())
    for module, source in sorted(sources_of(WARM_UP).items()):
        if DECORATORS in source:
            digest.update((source_hash(module) or "").encode())
    return f"warm-{digest.hexdigest()[:16]}"
