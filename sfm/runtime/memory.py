"""Memory that has been freed: given back to the system after a stage, kept between the steps of one.

The C library keeps freed memory for the next request of a like size, in each thread by itself: what one has
freed no other one takes. After photographs have been worked on in several threads that is most of it: 0.7 of
1.1 GB with 25 photographs of 6 megapixels. Of arrays of some MB it keeps nothing at first, and the system
clears them anew at every step: a fifth of the time of 60 photographs.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache

ARENA_MAX = -8  # M_ARENA_MAX in malloc.h
LARGEST_KEPT = 31 << 20  # bytes; glibc's limit is 32 MiB, M_MMAP_THRESHOLD in mallopt(3)


def give_back_memory() -> None:
    """Give freed memory back where the C library can be asked to (glibc)."""
    trim = _asked("malloc_trim")
    if trim is not None:
        trim(0)


@cache
def share_freed_memory() -> None:
    """Have threads that begin from now on share one pool of freed memory, where glibc can be asked to."""
    option = _asked("mallopt")
    if option is not None:
        option(ARENA_MAX, 1)


@cache
def keep_freed_memory() -> None:
    """Have the C library keep what is freed at the end of its memory, up to twice `LARGEST_KEPT`.

    glibc decides so by the largest block that has been freed, up to that limit; this one is never written to
    and takes no memory. The first photograph that is freed has the same effect. Where the environment sets
    MALLOC_TRIM_THRESHOLD_, as for the workers of a batch, that applies.
    """
    bytes(LARGEST_KEPT)


@cache
def _asked(function: str) -> Callable[..., int] | None:
    """Return a function of the C library, None where it has no such function."""
    if sys.platform != "linux":
        return None
    found: Callable[..., int] | None = getattr(ctypes.CDLL(None), function, None)
    return found
