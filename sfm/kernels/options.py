"""How functions are compiled: the one place that names the options of numba, typed as the functions are.

Compiled functions are kept in `__pycache__` of this folder, those of each module in a folder named by the
hash of all sources that it depends on: numba itself would go on using a function whose inlined parts changed.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba

from sfm.kernels.sources import source_hash

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
