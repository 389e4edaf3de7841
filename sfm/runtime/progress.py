"""Progress of a run: its stage and share done, and the memory given back between stages.

Functions deep in a stage that know what they do, and of how many parts how many are done, call `report_step`.
Whoever watches the stage is found by the context that `StageClock` sets, so that no call in between passes it
on; without a stage, as where a function is used by itself, the report is ignored.

Memory that has been freed: given back to the system after a stage, kept between the steps of one.

The C library keeps freed memory for the next request of a like size, in each thread by itself: what one has
freed no other one takes. After photographs have been worked on in several threads that is most of it: 0.7 of
1.1 GB with 25 photographs of 6 megapixels. Of arrays of some MB it keeps nothing at first, and the system
clears them anew at every step: a fifth of the time of 60 photographs.
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
        """A stage of that name begins; `total` steps will be announced, None if unknown."""

    def advance(self, step: str = "") -> None:
        """One step of the stage, such as a photograph of that name, is done."""

    def step(self, name: str, done: int | None = None, total: int | None = None) -> None:
        """Announce what the stage does now, and how many of how many parts of it are done, if known."""


class Silent:
    """Progress that is not shown."""

    def stage(self, name: str, total: int | None = None) -> None:
        """Take note of nothing."""

    def advance(self, step: str = "") -> None:
        """Take note of nothing."""

    def step(self, name: str, done: int | None = None, total: int | None = None) -> None:
        """Take note of nothing."""


SILENT: Progress = Silent()
_watching: ContextVar[Progress] = ContextVar("watching", default=SILENT)


def report_step(name: str, done: int | None = None, total: int | None = None) -> None:
    """Report what the present stage does, and how many of how many parts are done, if that is known."""
    _watching.get().step(name, done, total)


def reported(name: str, items: Iterator[T] | Collection[T], total: int) -> Iterator[T]:
    """Yield items and report each as done when the next one is asked for.

    Args:
        name: what is done with them.
        items: so many as `total`.
        total: how many they are.
    """
    if total:
        report_step(name, 0, total)
    for k, item in enumerate(items):
        yield item
        report_step(name, k + 1, total)


class StageClock:
    """Announces stages and keeps how long each took."""

    def __init__(self, progress: Progress) -> None:
        share_freed_memory()
        self.progress = progress
        self.seconds: list[tuple[str, float]] = []

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[None]:
        """Announce a stage and how many steps it has, if that is known, and time what is done in it.

        Memory that it has freed is given back to the system at its end.
        """
        self.progress.stage(name, total)
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
