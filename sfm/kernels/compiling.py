"""How functions are compiled with numba, and from which sources kept results were made.

Compiled functions are kept in `__pycache__` of this folder, those of each module in a folder named by the
hash of all sources that it depends on: numba itself would go on using a function whose inlined parts changed.

The sources that a module depends on: itself and those of every module of the package that it imports.

Expensive results on disk, compiled kernels and measurements of photographs, are kept
for these sources. Numba itself looks at the file of a kernel only, not at those of the functions compiled
into it.

Whether kernels are being compiled, which takes a minute that a person wants to know of.

Numba itself reports when it begins to compile, and reports nothing when it takes a form that it has kept.

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
    "kernels are compiled first, a minute or more, once (ahead of it: python -m sfm.warm_up, which takes "
    "the common ones)"
)
ROOT = Path(__file__).resolve().parents[2]
IMPORT = re.compile(r"^\s*from (sfm[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)
P = ParamSpec("P")
R = TypeVar("R")
KEPT = Path(__file__).resolve().parent / "__pycache__"
HASH_DIGITS = 16


def _compiled(function: Callable[P, R], **options: Any) -> Callable[P, R]:
    """Return a function compiled with these options, kept for the sources that it depends on."""
    before = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    numba.config.CACHE_DIR = before or cache_folder(function.__module__)  # type: ignore[attr-defined]
    try:
        compiled_function: Callable[P, R] = numba.njit(cache=True, error_model="numpy", **options)(function)
    finally:
        numba.config.CACHE_DIR = before  # type: ignore[attr-defined]
    return compiled_function


@cache
def cache_folder(module: str) -> str:
    """Return where the compiled functions of a module are kept; elsewhere by numba if none can write here."""
    sources = source_hash(module)
    if sources is None or not os.access(KEPT.parent, os.W_OK):
        return ""
    folder = KEPT / f"{module}-{sources[:HASH_DIGITS]}"
    if not folder.exists():
        for old in KEPT.glob(f"{module}-*"):
            shutil.rmtree(old, ignore_errors=True)
    return str(folder)


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function compiled for loops over arrays that it is given; it can make none itself.

    numba counts references of every array that a loop touches; at a few dozen operations for an image point
    the counting would take twice the time of the formula (213 against 47 ns for the collinearity
    equations). All arrays belong to the caller here, so nothing has to be counted.
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
    """Return a function that is compiled into its callers, as the formula of one observation is."""
    return _compiled(function, inline="always")


def inlined_fast(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function as by `inlined`, for callers compiled by `compiled_fast`."""
    return _compiled(function, nogil=True, inline="always", fastmath=True)


def sources_of(*modules: str) -> dict[str, str]:
    """Return the source of modules and of all that they import of this package, by name."""
    found: dict[str, str] = {}
    left = list(modules)
    while left:
        name = left.pop()
        source = None if name in found else _source(name)
        if source is not None:
            found[name] = source
            left += _imported(name)
    return found


@cache
def source_hash(module: str) -> str | None:
    """Return the SHA-256 of a module and of all that it imports of this package; None for other modules."""
    if _source(module) is None:
        return None
    digest = hashlib.sha256()
    for _, source in sorted(sources_of(module).items()):
        digest.update(source.encode())
    return digest.hexdigest()


@cache
def _source(name: str) -> str | None:
    """Return the source of a module or package; None if no file is one."""
    path = ROOT.joinpath(*name.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            return file.read_text(encoding="utf-8")
    return None


@cache
def _imported(name: str) -> tuple[str, ...]:
    """Return what a module imports of this package: modules, and names in them that may be modules too."""
    found = []
    for module, names in IMPORT.findall(_source(name) or ""):
        found.append(module)
        found += [f"{module}.{word}" for word in re.findall(r"\w+", names)]
    return tuple(found)


@contextmanager
def when_compiling(send: Callable[[], None]) -> Iterator[None]:
    """Call `send` when the first kernel of this program is compiled, in any thread of this process."""
    with install_listener("numba:compile", _First(send)):
        yield


class _First(Listener):
    """Hears of every kernel, reports the first."""

    def __init__(self, send: Callable[[], None]) -> None:
        self._send: Callable[[], None] | None = send

    def on_start(self, event: Event) -> None:
        """A function is compiled; those of numba and other libraries do not count."""
        module = event.data["dispatcher"].py_func.__module__ or ""  # none for what numba itself writes
        if self._send is not None and module.startswith("sfm."):
            send, self._send = self._send, None
            send()

    def on_end(self, event: Event) -> None:
        """The end is not reported."""
