"""The process of a command: imports, Ctrl-C, the first compilation, and guarded output.

Printing is guarded too: a code page may lack characters, a disk may be full, and a reader may exit early.
"""

from __future__ import annotations

import atexit
import io
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Any, TextIO

READER_GONE = 141  # exit code 128 + SIGPIPE, as a shell reports it for other programs
FAILED = 1  # exit code if a result is not dependable or a check fails
INTERRUPTED = 130  # exit code after Ctrl-C, as a shell expects it
INTERRUPTED_TEXT = "kolinear: interrupted, no partial output is left (batch --resume continues)"
AT_ONCE_TEXT = "kolinear: stopped at once; the next run into the same folder removes partial output"
SAME_PRESS_SECONDS = 1.0  # `timeout` sends the signal of one Ctrl-C twice
_running = ExitStack()
"""Contexts that last as long as the command."""
_listening: list[bool] = []
"""Not empty once compiling is announced."""


@contextmanager
def loading() -> Iterator[None]:
    """Run the imports of a command, which take a second, so that Ctrl-C ends the program at once.

    No output is begun yet that could be left incomplete. An exception would be swallowed by Python's import
    system, or would leave it as an ImportError. After the imports, compiling of kernels is announced as
    long as the command runs, if numba is loaded.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _end)
    try:
        yield
        if "numba" in sys.modules and not _listening:
            from sfm.runtime.compiling import COMPILING, when_compiling

            _listening.append(True)
            _running.enter_context(
                when_compiling(lambda: print(f"kolinear: the {COMPILING}", file=sys.stderr, flush=True))
            )
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def stopped_once() -> Iterator[None]:
    """Turn the first Ctrl-C into a KeyboardInterrupt, and protect the clean-up that follows from others.

    A second Ctrl-C, more than a second later, ends the program at once.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:  # background jobs ignore it
        signal.signal(signal.SIGINT, _stop)
    try:
        with _running:
            yield
    finally:
        _listening.clear()
        if signal.getsignal(signal.SIGINT) is _stop:
            signal.signal(signal.SIGINT, before)
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)  # the work is finished


def _stop(number: int, frame: FrameType | None) -> None:
    pressed = time.monotonic()

    def again(number: int, frame: FrameType | None) -> None:
        if time.monotonic() - pressed > SAME_PRESS_SECONDS:
            _end(number, frame, text=AT_ONCE_TEXT)

    signal.signal(signal.SIGINT, again)
    raise KeyboardInterrupt


def _end(number: int, frame: FrameType | None, *, text: str = INTERRUPTED_TEXT) -> None:
    """Exit at once, without waiting for threads or cleaning up."""
    os.write(2, f"{text}\n".encode())
    os._exit(INTERRUPTED)


def compile_first() -> None:
    """Compile the kernels of a survey unless they are compiled for these sources, and report it on stderr."""
    from sfm.runtime.warmed import is_warm

    if is_warm():
        return
    from sfm.cli import warm_up
    from sfm.runtime.progress_bar import drawn_progress

    print("kolinear: compiling the kernels, once, a minute or two", file=sys.stderr, flush=True)
    with drawn_progress() as drawn:
        warm_up.main(drawn)


def guard_streams() -> None:
    """Make stdout and stderr tolerate readers that exit and names that they cannot encode.

    If the reader of stdout exits, as `head` does, the program exits quietly. If the reader of stderr exits,
    the program goes on. Where both streams go to one file or pipe, their lines keep their order.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):  # its code page may lack letters of a name
        sys.stdout.reconfigure(errors="backslashreplace")
    if sys.stdout is sys.__stdout__:
        sys.stdout = _guard_stream(sys.stdout, ends_program=True)
    if sys.stderr is sys.__stderr__:
        sys.stderr = _guard_stream(sys.stderr, ends_program=False)


def _guard_stream(outlet: TextIO | None, *, ends_program: bool) -> TextIO | None:
    """Return a guarded stream to the same file, pipe or socket; terminals and absent streams are returned."""
    if not isinstance(outlet, io.TextIOWrapper) or outlet.isatty():
        return outlet
    outlet.flush()
    return io.TextIOWrapper(
        io.BufferedWriter(_Outlet(outlet.fileno(), ends_program=ends_program)),
        encoding=outlet.encoding,
        errors="backslashreplace",
        line_buffering=outlet.line_buffering or not ends_program,
    )


class _Outlet(io.FileIO):
    """An open file to which nothing more is written after the first failure.

    Python would try again at exit, and typer and rich exit with code 1 if the reader has exited.
    """

    def __init__(self, number: int, *, ends_program: bool) -> None:
        super().__init__(number, "wb", closefd=False)
        self._ends_program = ends_program

    def write(self, data: Any) -> int:
        if not self._ends_program and sys.stdout is not None and not sys.stdout.closed:
            sys.stdout.flush()  # lines printed earlier
        try:
            return super().write(data) or 0
        except OSError as error:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            if not isinstance(error, BrokenPipeError):
                raise
            if self._ends_program:
                raise SystemExit(READER_GONE) from None
            return len(data)
