"""Photographs in grey, as many at a time as there is place for: each is needed with many others.

Where all are needed in turn, again and again, the oldest one is needed next: of more photographs than there
is place for, forgetting it would read every one every time. So one by chance is forgotten.
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from threading import Lock

from sfm.conventions import AnyArray
from sfm.matching.radiometry import Grey, grey_of

MEMORY_BYTES = 200_000_000  # of photographs at a time, as they were read: 16 of 12 megapixels of 8 bit
GREY_BYTES = 100_000_000  # of these in single precision


class GreyPhotographs:
    """Photographs that are read when they are needed; others are forgotten. Threads may share it.

    More are kept as they were read, which takes a quarter of the memory, than in single precision.
    """

    def __init__(
        self,
        read: Callable[[int], AnyArray],
        *,
        memory_bytes: int = MEMORY_BYTES,
        grey_bytes: int = GREY_BYTES,
    ) -> None:
        """Begin with none.

        Args:
            read: returns a photograph, (H, W) or (H, W, 3), 8 or 16 bit or float.
            memory_bytes: of all that are kept as they were read.
            grey_bytes: of all that are kept in single precision; the last two are, whatever their size.
        """
        self._read = read
        self._stored: dict[int, AnyArray] = {}
        self._grey: dict[int, AnyArray] = {}
        self._most = memory_bytes, grey_bytes
        self._chance = Random(0)
        self._lock = Lock()

    def __getitem__(self, i: int) -> Grey:
        """Return one photograph."""
        with self._lock:
            grey, stored = self._grey.get(i), self._stored.get(i)
            if grey is not None:
                self._use(i, grey)
        if grey is None:
            if stored is None:
                stored = self._read(i)
            grey = grey_of(stored)
            with self._lock:
                self._use(i, grey)
                self._stored[i] = stored
                while _bytes(self._stored) > self._most[0]:
                    del self._stored[self._chance.choice(list(self._stored))]
                while len(self._grey) > 2 and _bytes(self._grey) > self._most[1]:
                    del self._grey[next(iter(self._grey))]
        return Grey(grey)

    def _use(self, i: int, grey: AnyArray) -> None:
        """Keep a photograph as the one that was needed last."""
        self._grey.pop(i, None)
        self._grey[i] = grey


def _bytes(kept: dict[int, AnyArray]) -> int:
    return sum(one.nbytes for one in kept.values())
