"""Photographs in grey, as many at a time as there is place for: each is needed with many others."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from threading import Lock

from sfm.conventions import AnyArray
from sfm.matching.radiometry import Grey, grey_of

MEMORY_BYTES = 250_000_000  # of photographs at a time, as single precision


class GreyPhotographs:
    """Photographs that are read when they are needed; the oldest are forgotten. Threads may share it."""

    def __init__(self, read: Callable[[int], AnyArray], *, memory_bytes: int = MEMORY_BYTES) -> None:
        """Begin with none.

        Args:
            read: returns a photograph, (H, W) or (H, W, 3), 8 or 16 bit or float.
            memory_bytes: of all that are kept; the last two are, whatever their size.
        """
        self._read = read
        self._memory = memory_bytes
        self._kept: OrderedDict[int, Grey] = OrderedDict()
        self._bytes = 0  # of these
        self._lock = Lock()

    def __getitem__(self, i: int) -> Grey:
        """Return one photograph."""
        with self._lock:
            if i in self._kept:
                self._kept.move_to_end(i)
                return self._kept[i]
        grey = Grey(grey_of(self._read(i)))
        with self._lock:
            if i not in self._kept:  # another thread may have been quicker
                self._kept[i] = grey
                self._bytes += grey.pixels.nbytes
            while len(self._kept) > 2 and self._bytes > self._memory:
                self._bytes -= self._kept.popitem(last=False)[1].pixels.nbytes
            return grey
