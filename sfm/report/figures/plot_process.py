"""A process that draws the plots of a report while others measure and adjust.

Importing matplotlib and drawing with it takes a second of Python, and threads take turns in Python.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Thread

from sfm.report.figures.plot_data import Plot, PlotData

# Nothing of the current folder, the environment or a user's packages is imported before the paths of this
# process are known; multiprocessing would, and would run the program of this process again.
BEGIN = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from sfm.report.figures.plot_process import serve; serve()"
)


def draw_plots(shown: PlotData) -> tuple[Plot, ...]:
    """Draw every plot of a report in this process."""
    from sfm.report.figures.plots import all_plots

    return all_plots(shown)


class PlotProcess:
    """Draws the plots of one report.

    It ends with the process that began it, whatever ends that: no other process has the ends of its pipes.
    Ctrl-C does not reach it, as it is in a separate session.

    Raises:
        OSError: it cannot be started, as with a limit on processes.
    """

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-c", BEGIN],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )
        self._sender: Thread | None = None
        self._shown: PlotData | None = None
        self._send(list(sys.path))

    def begin(self, shown: PlotData) -> None:
        """Begin to draw; the process may still be importing, and a pipe takes little."""
        self._shown = shown
        sender = Thread(target=self._send, args=(shown,), daemon=True)
        try:
            sender.start()
        except RuntimeError:  # a limit on threads
            self._process.kill()
        else:
            self._sender = sender

    def plots(self) -> tuple[Plot, ...]:
        """Return what was begun; drawn here if the process has ended, so that a fault is one of this process.

        Others may end it for want of memory.
        """
        assert self._shown is not None and self._process.stdout is not None, "begin first"
        try:
            plots: tuple[Plot, ...] = pickle.load(self._process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError):
            return draw_plots(self._shown)
        return plots

    def close(self) -> None:
        """End the process, which has nothing that could be left half-done."""
        self._process.kill()
        self._process.wait()
        if self._sender is not None:
            self._sender.join()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with suppress(OSError):  # what was not sent has nowhere to go
                pipe.close()

    def _send(self, what: object) -> None:
        """Send something, or end the process: `plots` waits for it otherwise."""
        assert self._process.stdin is not None
        try:
            pickle.dump(what, self._process.stdin)
            self._process.stdin.flush()
        except Exception:
            self._process.kill()


@contextmanager
def plot_process(jobs: int) -> Iterator[PlotProcess | None]:
    """Give a process that draws plots; None where one has to do everything, or none can be started.

    Args:
        jobs: how much may be worked on at a time.
    """
    process = None
    if jobs > 1 and sys.executable and not getattr(sys, "frozen", False):
        with suppress(OSError):
            process = PlotProcess()
    try:
        yield process
    finally:
        if process is not None:
            process.close()


def serve() -> None:
    """Draw what comes in by stdin, out to stdout, until its reader is gone; faults are for who began this."""
    # what a library prints must not come between
    given, drawn, sys.stdout = sys.stdin.buffer, sys.stdout.buffer, sys.stderr
    with suppress(Exception):
        import sfm.report.figures.plots  # noqa: F401  # while the survey is measured

        while True:
            pickle.dump(draw_plots(pickle.load(given)), drawn)
            drawn.flush()
    os._exit(0)  # nothing is left to write, and no one to write it to
