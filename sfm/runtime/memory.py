"""Memory that a stage has freed, given back to the system.

The C library keeps freed memory for the next request of a like size. After photographs have been worked on in
several threads that is most of it: 0.7 of 1.1 GB with 25 photographs of 6 megapixels.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache


def give_back_memory() -> None:
    """Give freed memory back where the C library can be asked to (glibc)."""
    trim = _trim()
    if trim is not None:
        trim(0)


@cache
def _trim() -> Callable[[int], int] | None:
    if sys.platform != "linux":
        return None
    found: Callable[[int], int] | None = getattr(ctypes.CDLL(None), "malloc_trim", None)
    return found
