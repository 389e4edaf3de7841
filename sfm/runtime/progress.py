"""Progress: how a long run tells whoever watches which stage it is in and how far it got."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from sfm.runtime.faults import working_on
from sfm.runtime.memory import give_back_memory


class Progress(Protocol):
    """What a run calls while it works; implementations draw it, count it or ignore it."""

    def stage(self, name: str, total: int | None = None) -> None:
        """A stage of that name begins; `total` steps will be announced, None if nobody knows."""

    def advance(self, step: str = "") -> None:
        """One step of the stage, such as a photograph of that name, is done."""


class Silent:
    """Progress that nobody watches."""

    def stage(self, name: str, total: int | None = None) -> None:
        """Take note of nothing."""

    def advance(self, step: str = "") -> None:
        """Take note of nothing."""


SILENT: Progress = Silent()


class StageClock:
    """Announces stages and keeps how long each took."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.seconds: list[tuple[str, float]] = []

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[None]:
        """Announce a stage and how many steps it has, if that is known, and time what is done in it.

        What it has freed is given back to the system at its end.
        """
        self.progress.stage(name, total)
        begun = time.perf_counter()
        with working_on(f"stage {name}"):
            yield
        give_back_memory()
        self.seconds.append((name, time.perf_counter() - begun))
