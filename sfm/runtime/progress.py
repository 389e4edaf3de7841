"""Progress: how a long run reports its stage and its share done.

Functions deep in a stage that know what they do, and of how many parts how many are done, call `report_step`.
Whoever watches the stage is found by the context that `StageClock` sets, so that no call in between passes it
on; without a stage, as where a function is used by itself, the report is ignored.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Protocol, TypeVar

from sfm.kernels.threads import give_back_memory, share_freed_memory
from sfm.runtime.faults import working_on

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
