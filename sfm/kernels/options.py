"""How functions are compiled: the one place that names the options of numba, typed as the functions are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numba

P = ParamSpec("P")
R = TypeVar("R")
_njit: Any = numba.njit  # whose own types forget those of the function


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function compiled for loops over arrays that it is given; it can make none of its own.

    numba counts references of every array that a loop touches; at a few dozen operations for an image point
    the counting would take twice the time of the formula (213 against 47 ns for the collinearity
    equations). All arrays belong to the caller here, so nothing has to be counted.
    """
    compiled_function: Callable[P, R] = _njit(
        cache=True, error_model="numpy", fastmath={"contract"}, nogil=True, _nrt=False
    )(function)
    return compiled_function


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function compiled as written; a division by zero gives infinity or NaN."""
    compiled_function: Callable[P, R] = _njit(cache=True, nogil=True, error_model="numpy")(function)
    return compiled_function


def compiled_fused(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function compiled with products and sums fused (fewer roundings, the same order)."""
    compiled_function: Callable[P, R] = _njit(
        cache=True, nogil=True, error_model="numpy", fastmath={"contract"}
    )(function)
    return compiled_function


def compiled_fast(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function compiled for sums in any order; it must neither meet nor test for NaN or infinity."""
    compiled_function: Callable[P, R] = _njit(cache=True, nogil=True, error_model="numpy", fastmath=True)(
        function
    )
    return compiled_function


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function that is compiled into its callers, as the formula of one observation is."""
    compiled_function: Callable[P, R] = _njit(cache=True, inline="always", error_model="numpy")(function)
    return compiled_function


def inlined_fast(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function as by `inlined`, for callers compiled by `compiled_fast`."""
    compiled_function: Callable[P, R] = _njit(
        cache=True, nogil=True, inline="always", error_model="numpy", fastmath=True
    )(function)
    return compiled_function
