"""Progress as a bar on the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn
from rich.text import Text

from sfm.runtime.forecast import Countdown

LONGEST_S = 1e9  # that is shown


@contextmanager
def drawn_progress(console: Console | None = None) -> Iterator[DrawnProgress]:
    """Show a progress bar if stderr is a terminal, to which only errors are written otherwise.

    Args:
        console: console in place of stderr.
    """
    console = console or Console(stderr=True)
    countdown = Countdown()
    with Progress(
        TextColumn("{task.description:12}", markup=False),
        BarColumn(),
        _Counted(),
        _Times(countdown),
        TextColumn("{task.fields[step]}", style="dim", markup=False),
        console=console,
        disable=not console.is_terminal,
    ) as bar:
        drawn = DrawnProgress(bar, countdown)
        yield drawn
        drawn.finished()


class DrawnProgress:
    """Progress as a bar on the terminal: the stage, its present work, and the finished photographs."""

    def __init__(self, bar: Progress, countdown: Countdown) -> None:
        self._bar = bar
        self.countdown = countdown
        self._task: TaskID | None = None

    def stage(self, name: str, total: int | None = None) -> None:
        """Begin a line for the stage; a second call for the same stage gives its total, and counts anew."""
        if self._task is not None:
            task = self._bar.tasks[-1]
            if task.description == name:
                self._bar.update(self._task, total=total, completed=0, parts=total)
                return
            self._bar.update(self._task, total=task.total or 1, completed=task.total or 1, step="")
            self._bar.stop_task(self._task)
            self.countdown.finish(task.description, task.elapsed or 0.0)
        self._task = self._bar.add_task(name, total=total, step="", part="", parts=total)

    def finished(self) -> dict[str, float]:
        """End the last stage, and return the time of each, s."""
        if self._task is not None:
            self.stage("done", 1)
            self._bar.remove_task(self._bar.task_ids[-1])
            self._task = None
        return self.countdown.taken

    def advance(self, step: str = "") -> None:
        """Count one step and name it."""
        if self._task is not None:
            self._bar.update(self._task, advance=1, step=step)

    def step(self, name: str, done: int | None = None, total: int | None = None) -> None:
        """Show the present work of the stage and count its parts; new work restarts the count."""
        if self._task is None:
            return
        task = self._bar.tasks[-1]
        if name != task.fields["part"] or total != task.total or (done or 0) < task.completed:
            # only the parts of this work estimate the remaining time; the time of the stage continues
            begun, task.total = task.start_time, total
            fields = task.fields | {"step": name, "part": name}
            self._bar.reset(self._task, total=total, completed=done or 0, **fields)
            task.start_time = begun
        else:
            self._bar.update(self._task, completed=done or 0, step=name)


class _Counted(ProgressColumn):
    """Finished and total parts; empty if the total is unknown."""

    def render(self, task: Task) -> Text:
        """Return the text of the column."""
        known = task.total is not None and (task.fields["parts"] or task.stop_time is None)
        return Text(f"{int(task.completed)}/{int(task.total or 0)}" if known else "", "progress.download")


class _Times(ProgressColumn):
    """Time since the stage began, and estimates of what is left of it and of all stages."""

    max_refresh = 0.5  # s

    def __init__(self, countdown: Countdown) -> None:
        super().__init__()
        self._countdown = countdown

    def render(self, task: Task) -> Text:
        """Return the text of the column."""
        text = Text(clock_time(task.elapsed or 0.0), "progress.elapsed")
        left = task.time_remaining
        if left and not task.finished:
            text.append(f", about {clock_time(left)} left", "progress.remaining")
        if task.stop_time is None:
            parts = task.fields["parts"]
            counts_all = bool(parts) and task.total == parts
            done = int(task.completed) if counts_all else 0
            of_work = 0.0 if counts_all else left or 0.0
            of_all = self._countdown.left(
                task.description, task.elapsed or 0.0, done, parts or 0, at_least=of_work
            )
            if of_all is not None:
                text.append(f", {clock_time(of_all)} to the end", "progress.remaining")
        return text


def clock_time(seconds: float) -> str:
    """Return a time as hours, minutes and seconds."""
    return str(timedelta(seconds=round(min(max(seconds, 0.0), LONGEST_S))))
