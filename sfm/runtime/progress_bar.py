"""Progress as a bar on the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn


@contextmanager
def drawn_progress() -> Iterator[Drawn]:
    """Show a progress bar on stderr while it is a terminal; nothing else ever goes there but an error."""
    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description:12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[step]}", style="dim"),
        console=console,
        disable=not console.is_terminal,
    ) as bar:
        drawn = Drawn(bar)
        yield drawn
        drawn.stage("done", 1)
        bar.remove_task(bar.task_ids[-1])


class Drawn:
    """Progress as a bar on the terminal: the stage, and the photographs done."""

    def __init__(self, bar: Progress) -> None:
        self._bar = bar
        self._task: TaskID | None = None

    def stage(self, name: str, total: int | None = None) -> None:
        """Begin a line for the stage; a second call for the same stage tells its total."""
        if self._task is not None:
            task = self._bar.tasks[-1]
            if task.description == name:
                self._bar.update(self._task, total=total)
                return
            self._bar.update(self._task, total=task.total or 1, completed=task.total or 1, step="")
            self._bar.stop_task(self._task)
        self._task = self._bar.add_task(name, total=total, step="")

    def advance(self, step: str = "") -> None:
        """Count one step and name it."""
        if self._task is not None:
            self._bar.update(self._task, advance=1, step=step)
