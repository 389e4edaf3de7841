"""A process that draws the plots of a report while the survey is measured and adjusted.

Importing matplotlib and drawing with it takes a second of Python time. Threads share that time, a process
does not.
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

# The process imports nothing from the current folder, the environment or a user's packages before it has the
# paths of this process. multiprocessing would import them, and would run the program of this process again.
BEGIN = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from sfm.report.figures.plot_process import serve; serve()"
)


def draw_plots(shown: PlotData) -> tuple[Plot, ...]:
    """Draw every plot of a report in the current process."""
    from sfm.report.figures.plots import all_plots

    return all_plots(shown)


class PlotProcess:
    """A separate process that draws the plots of one report.

    It ends when its parent process ends for any reason, as no other process has the ends of its pipes.
    Ctrl-C does not reach it, as it runs in a separate session.

    Raises:
        OSError: it cannot be started, for example because of a limit on processes.
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
        """Start drawing, from a thread: the process may still be importing, and its pipe buffers little."""
        self._shown = shown
        sender = Thread(target=self._send, args=(shown,), daemon=True)
        try:
            sender.start()
        except RuntimeError:  # a limit on threads
            self._process.kill()
        else:
            self._sender = sender

    def plots(self) -> tuple[Plot, ...]:
        """Return the plots begun before; draw them here if the process has ended.

        The system may end it for lack of memory. A fault in drawing then shows in this process.
        """
        assert self._shown is not None and self._process.stdout is not None, "begin first"
        try:
            plots: tuple[Plot, ...] = pickle.load(self._process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError):
            return draw_plots(self._shown)
        return plots

    def close(self) -> None:
        """End the process, which leaves nothing half-done."""
        self._process.kill()
        self._process.wait()
        if self._sender is not None:
            self._sender.join()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with suppress(OSError):  # data not yet sent is lost
                pipe.close()

    def _send(self, what: object) -> None:
        """Send an object, or end the process, for which `plots` would otherwise wait."""
        assert self._process.stdin is not None
        try:
            pickle.dump(what, self._process.stdin)
            self._process.stdin.flush()
        except Exception:
            self._process.kill()


@contextmanager
def plot_process(jobs: int) -> Iterator[PlotProcess | None]:
    """Yield a process that draws plots; None with a single job, or if none can be started.

    Args:
        jobs: number of tasks that may run at the same time.
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
    """Draw the plot data from stdin and write plots to stdout, until the reader is gone or a fault occurs."""
    # what a library prints must not mix with the plots
    given, drawn, sys.stdout = sys.stdin.buffer, sys.stdout.buffer, sys.stderr
    with suppress(Exception):
        import sfm.report.figures.plots  # noqa: F401  # while the survey is measured

        while True:
            pickle.dump(draw_plots(pickle.load(given)), drawn)
            drawn.flush()
    os._exit(0)  # there is nothing left to write, and no reader
