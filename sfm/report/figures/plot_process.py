"""A process that draws the plots of a report while others measure and adjust.

Importing matplotlib and drawing with it takes a second of Python, and threads take turns in Python.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from threading import Thread

from sfm.report.figures.plot_data import Plot, PlotData
from sfm.runtime.cores import cores


def draw_plots(shown: PlotData) -> tuple[Plot, ...]:
    """Draw every plot of a report in this process."""
    from sfm.report.figures.plots import all_plots

    return all_plots(shown)


class PlotProcess:
    """Draws the plots of one report.

    It ends with the process that began it, whatever ends that: its end of the pipe is the only one left.
    """

    def __init__(self) -> None:
        context = get_context("spawn")  # a fork would inherit the threads of others without their work
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_draw, args=(theirs,), daemon=True)
        with _without_interrupts():
            self._process.start()
        theirs.close()
        self._shown: PlotData | None = None

    def begin(self, shown: PlotData) -> None:
        """Begin to draw; the process may still be importing, and a pipe holds little."""
        self._shown = shown
        Thread(target=self._send, args=(shown,), daemon=True).start()

    def plots(self) -> tuple[Plot, ...]:
        """Return what was begun; drawn here if the process has ended, so that a fault is one of this process.

        Others may end it for want of memory.
        """
        assert self._shown is not None, "begin first"
        try:
            plots: tuple[Plot, ...] = self._pipe.recv()
        except (EOFError, OSError):
            return draw_plots(self._shown)
        return plots

    def close(self) -> None:
        """End the process, which holds nothing that could be left half-done."""
        self._pipe.close()
        self._process.kill()
        self._process.join()

    def _send(self, shown: PlotData) -> None:
        try:
            self._pipe.send(shown)
        except OSError:  # it has ended, which `plots` finds too
            return


@contextmanager
def plot_process() -> Iterator[PlotProcess | None]:
    """Give a process that draws plots; None where one core has to do everything, or none can be started."""
    process = None
    if cores() > 1:
        with suppress(OSError):  # as with a limit on processes
            process = PlotProcess()
    try:
        yield process
    finally:
        if process is not None:
            process.close()


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Keep Ctrl-C from what is started here, from its first moment; on Windows from when it ignores it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _draw(pipe: Connection) -> None:
    """Draw plots as long as somebody asks for them; Ctrl-C and faults are for who began this process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(Exception):
        import sfm.report.figures.plots  # noqa: F401  # while the survey is measured

        while True:
            pipe.send(draw_plots(pipe.recv()))
