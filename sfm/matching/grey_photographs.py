"""Photographs in grey, as many at a time as there is place for: each is needed with many others."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from threading import Lock

from sfm.conventions import AnyArray
from sfm.matching.radiometry import Grey, grey_of

MEMORY_BYTES = 200_000_000  # of photographs at a time, as they were read: 16 of 12 megapixels of 8 bit
GREY_BYTES = 100_000_000  # of these in single precision


class GreyPhotographs:
    """Photographs that are read when they are needed; the oldest are forgotten. Threads may share it.

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
        self._stored: OrderedDict[int, AnyArray] = OrderedDict()
        self._grey: OrderedDict[int, AnyArray] = OrderedDict()
        self._most = memory_bytes, grey_bytes
        self._lock = Lock()

    def __getitem__(self, i: int) -> Grey:
        """Return one photograph."""
        with self._lock:
            grey, stored = _latest(self._grey, i), _latest(self._stored, i)
        if grey is None:
            if stored is None:
                stored = self._read(i)
            grey = grey_of(stored)
            with self._lock:
                _keep(self._stored, i, stored, self._most[0], least=0)
                _keep(self._grey, i, grey, self._most[1], least=2)
        return Grey(grey)


def _latest(kept: OrderedDict[int, AnyArray], i: int) -> AnyArray | None:
    """Return a photograph that is kept, from now on as the latest one, or None."""
    if i in kept:
        kept.move_to_end(i)
    return kept.get(i)


def _keep(kept: OrderedDict[int, AnyArray], i: int, photograph: AnyArray, most: int, *, least: int) -> None:
    """Keep a photograph and forget the oldest of more bytes than `most`, but for the last ones."""
    kept[i] = photograph
    kept.move_to_end(i)
    while len(kept) > least and sum(one.nbytes for one in kept.values()) > most:
        kept.popitem(last=False)
