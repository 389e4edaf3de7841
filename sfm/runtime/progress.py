"""Progress of a run, by its stages and their steps; and freed memory, returned between stages.

Functions deep inside a stage call `report_step` with their step, and with the number of parts done if they
know it. The context that `StageClock` sets finds the observer, so that no function in between has to pass it
on. Without a stage, for example if a function is used by itself, the report is ignored.

The C library keeps freed memory for later requests of similar size, separately in each thread, so that no
other thread can use it. After several threads have processed photographs, this is most of the memory: 0.7 of
1.1 GB with 25 photographs of 6 megapixels. Therefore freed memory is returned to the system after a stage.
Between the steps of a stage it is kept. By default the C library does not keep arrays of several MB, and the
system clears them again at every step, which takes a fifth of the time of 60 photographs.
"""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Protocol, TypeVar

from sfm.runtime.faults import working_on

ARENA_MAX = -8  # M_ARENA_MAX in malloc.h
LARGEST_KEPT = 31 << 20  # bytes; glibc's limit is 32 MiB, M_MMAP_THRESHOLD in mallopt(3)
T = TypeVar("T")


class Progress(Protocol):
    """Interface that a run reports its progress to; implementations draw it, count it or ignore it."""

    def stage(self, name: str, total: int | None = None) -> None:
        """Begin a stage with `total` steps, None if unknown."""

    def advance(self, step: str = "") -> None:
        """Finish one step of the stage, such as a photograph of that name."""

    def step(self, name: str, done: int | None = None, total: int | None = None) -> None:
        """Announce the present work of the stage, with its finished and total parts, if known."""


class Silent:
    """Progress that is not shown."""

    def stage(self, name: str, total: int | None = None) -> None:
        """Ignore the stage."""

    def advance(self, step: str = "") -> None:
        """Ignore the step."""

    def step(self, name: str, done: int | None = None, total: int | None = None) -> None:
        """Ignore the work."""


SILENT: Progress = Silent()
_watching: ContextVar[Progress] = ContextVar("watching", default=SILENT)


def report_step(name: str, done: int | None = None, total: int | None = None) -> None:
    """Report the present work of the stage.

    Args:
        name: name of the work.
        done: number of finished parts, if known.
        total: number of all parts, if known.
    """
    _watching.get().step(name, done, total)


def reported(name: str, items: Iterator[T] | Collection[T], total: int) -> Iterator[T]:
    """Yield items, and report each as done when the next one is requested.

    Args:
        name: name of the work.
        items: the items.
        total: number of items.
    """
    if total:
        report_step(name, 0, total)
    for k, item in enumerate(items):
        yield item
        report_step(name, k + 1, total)


class StageClock:
    """Clock that announces stages and measures their times."""

    def __init__(self, progress: Progress) -> None:
        share_freed_memory()
        self.progress = progress
        self.seconds: list[tuple[str, float]] = []
        self.last = ""  # name of the stage that was begun last

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[None]:
        """Announce a stage and measure its time; at its end, freed memory is returned to the system.

        Args:
            name: name of the stage.
            total: number of its steps, if known.
        """
        self.progress.stage(name, total)
        self.last = name
        begun = time.perf_counter()
        watching = _watching.set(self.progress)
        try:
            with working_on(f"stage {name}"):
                yield
        finally:
            _watching.reset(watching)
        give_back_memory()
        self.seconds.append((name, time.perf_counter() - begun))


def give_back_memory() -> None:
    """Return freed memory to the system, if the C library supports it (glibc)."""
    trim = _libc_function("malloc_trim")
    if trim is not None:
        trim(0)


@cache
def share_freed_memory() -> None:
    """Let threads that start later share one pool of freed memory, if the C library supports it (glibc)."""
    option = _libc_function("mallopt")
    if option is not None:
        option(ARENA_MAX, 1)


@cache
def keep_freed_memory() -> None:
    """Let the C library keep freed memory at the end of its heap, up to twice `LARGEST_KEPT`.

    glibc chooses this limit by the largest block freed so far. The block here is never written to, and takes
    no memory. The first freed photograph has the same effect. If the environment sets MALLOC_TRIM_THRESHOLD_,
    as for the workers of a batch, that value applies.
    """
    bytes(LARGEST_KEPT)


@cache
def _libc_function(function: str) -> Callable[..., int] | None:
    """Return a function of the C library, or None if it does not exist."""
    if sys.platform != "linux":
        return None
    entry: Callable[..., int] | None = getattr(ctypes.CDLL(None), function, None)
    return entry
