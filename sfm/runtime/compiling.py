"""Compile functions with numba, and keep the compiled code for the sources from which it was made.

Compiled functions are kept in `__pycache__` of this folder. Each module has a folder there, named by the hash
of all sources on which the module depends: itself and every module of the package that it imports.
Numba itself checks only the file of a kernel. It would continue to use a function after the functions
compiled into it have changed. Measurements of photographs on disk are kept by the same hash.

Compilation takes a minute, and the user should know of it. Numba reports when it begins to compile, and
reports nothing when it uses kept code, so `when_compiling` listens for its first report.

Source: numba, developer manual, "Notes on the event API", event numba:compile.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba
from numba.core.event import Event, Listener, install_listener

COMPILING = (
    "kernels are compiled first; this takes a minute or more, once (to do it in advance: "
    "python -m sfm.cli.warm_up, which compiles the common ones)"
)
ROOT = Path(__file__).resolve().parents[2]
IMPORT = re.compile(r"^\s*from (sfm[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)
P = ParamSpec("P")
R = TypeVar("R")
KEPT = Path(__file__).resolve().parent / "__pycache__"
HASH_DIGITS = 16


def _compiled(function: Callable[P, R], **options: Any) -> Callable[P, R]:
    """Return a function compiled with these options, kept for the sources on which it depends."""
    before = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    numba.config.CACHE_DIR = before or cache_folder(function.__module__)  # type: ignore[attr-defined]
    try:
        compiled_function: Callable[P, R] = numba.njit(cache=True, error_model="numpy", **options)(function)
    finally:
        numba.config.CACHE_DIR = before  # type: ignore[attr-defined]
    return compiled_function


@cache
def cache_folder(module: str) -> str:
    """Return the folder for the compiled functions of a module; empty (numba chooses) if not writable."""
    sources = source_hash(module)
    if sources is None or not os.access(KEPT.parent, os.W_OK):
        return ""
    folder = KEPT / f"{module}-{sources[:HASH_DIGITS]}"
    if not folder.exists():
        for old in KEPT.glob(f"{module}-*"):
            shutil.rmtree(old, ignore_errors=True)
    return str(folder)


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function compiled for loops over arrays of the caller; it cannot create arrays itself.

    numba counts the references of every array that a loop uses. With a few dozen operations per image point,
    counting would take longer than the formula itself (213 against 47 ns for the collinearity equations).
    Here all arrays belong to the caller, so nothing has to be counted.
    """
    return _compiled(function, fastmath={"contract"}, nogil=True, _nrt=False)


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function compiled as written; a division by zero gives infinity or NaN."""
    return _compiled(function, nogil=True)


def compiled_fused(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function compiled with products and sums fused (fewer roundings, the same order)."""
    return _compiled(function, nogil=True, fastmath={"contract"})


def compiled_fast(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function compiled for sums in any order; it must neither meet nor test for NaN or infinity."""
    return _compiled(function, nogil=True, fastmath=True)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function that is compiled into its callers, such as the formula of one observation."""
    return _compiled(function, inline="always")


def inlined_fast(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function like `inlined`, for callers compiled by `compiled_fast`."""
    return _compiled(function, nogil=True, inline="always", fastmath=True)


def sources_of(*modules: str) -> dict[str, str]:
    """Return the sources of modules and of all modules of this package that they import, by name."""
    sources: dict[str, str] = {}
    left = list(modules)
    while left:
        name = left.pop()
        source = None if name in sources else _source(name)
        if source is not None:
            sources[name] = source
            left += _imported(name)
    return sources


@cache
def code_version(libraries: str, *modules: str) -> str:
    """Return a fingerprint of the versions of libraries, of modules, and of all that these import."""
    return _hash_of(*modules, libraries=libraries)


@cache
def source_hash(module: str) -> str | None:
    """Return the SHA-256 of a module and all that it imports from this package; None for other modules."""
    return None if _source(module) is None else _hash_of(module)


def _hash_of(*modules: str, libraries: str = "") -> str:
    """Return the SHA-256 of modules and all that they import, after the versions of libraries."""
    digest = hashlib.sha256(libraries.encode())
    for _, source in sorted(sources_of(*modules).items()):
        digest.update(source.encode())
    return digest.hexdigest()


@cache
def _source(name: str) -> str | None:
    """Return the source of a module or package; None if it has no file."""
    path = ROOT.joinpath(*name.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            return file.read_text(encoding="utf-8")
    return None


@cache
def _imported(name: str) -> tuple[str, ...]:
    """Return the modules of this package that a module imports, and names in them that may be modules too."""
    imported = []
    for module, names in IMPORT.findall(_source(name) or ""):
        imported.append(module)
        imported += [f"{module}.{word}" for word in re.findall(r"\w+", names)]
    return tuple(imported)


@contextmanager
def when_compiling(send: Callable[[], None]) -> Iterator[None]:
    """Call `send` when the first kernel of this program is compiled, in any thread of this process."""
    with install_listener("numba:compile", _First(send)):
        yield


class _First(Listener):
    """A listener that is called for every kernel and reports the first."""

    def __init__(self, send: Callable[[], None]) -> None:
        self._send: Callable[[], None] | None = send

    def on_start(self, event: Event) -> None:
        """Handle the start of a compilation; functions of numba and other libraries do not count."""
        module = event.data["dispatcher"].py_func.__module__ or ""  # None for code that numba itself writes
        if self._send is not None and module.startswith("sfm."):
            send, self._send = self._send, None
            send()

    def on_end(self, event: Event) -> None:
        """The end is not reported."""
