"""The first second of a command, and Ctrl-C at any moment.

The first command of an installation, which compiles the kernels, all cores at it.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType

FAILED = 1  # exit code where a result is not dependable, or a check fails
INTERRUPTED = 130  # exit code after Ctrl-C, as a shell expects it
INTERRUPTED_TEXT = "kolinear: interrupted, nothing half-done is left (batch --resume goes on)"
AT_ONCE_TEXT = "kolinear: ended at once; the next run into the same folder clears what is half-done"
SAME_PRESS_SECONDS = 1.0  # `timeout` sends the signal of one Ctrl-C twice
_running = ExitStack()
"""what lasts as long as the command"""
_listening: list[bool] = []
"""not empty once somebody listens for compiling"""


@contextmanager
def loading() -> Iterator[None]:
    """Import what a command needs, which takes a second.

    Ctrl-C ends the program right there, since nothing is begun that could be left half-done: an exception
    would be swallowed by the machinery of imports, or leave it as an ImportError. From here on the
    compiling of kernels is announced.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _end)
    try:
        yield
        _announce_compiling()
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def stopped_once() -> Iterator[None]:
    """Let the first Ctrl-C be a KeyboardInterrupt, and none break the tidying up that follows.

    Who presses again, a second later or more, ends the program at once.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:  # as of jobs in the background
        signal.signal(signal.SIGINT, _stop)
    try:
        with _running:
            yield
    finally:
        _listening.clear()
        if signal.getsignal(signal.SIGINT) is _stop:
            signal.signal(signal.SIGINT, before)
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)  # what is done is done


def _stop(number: int, frame: FrameType | None) -> None:
    pressed = time.monotonic()

    def again(number: int, frame: FrameType | None) -> None:
        if time.monotonic() - pressed > SAME_PRESS_SECONDS:
            _end(number, frame, text=AT_ONCE_TEXT)

    signal.signal(signal.SIGINT, again)
    raise KeyboardInterrupt


def _end(number: int, frame: FrameType | None, *, text: str = INTERRUPTED_TEXT) -> None:
    """End without looking back: no threads are waited for, nothing is cleared away."""
    os.write(2, f"{text}\n".encode())
    os._exit(INTERRUPTED)


def _announce_compiling() -> None:
    """Say on stderr when kernels are compiled, for as long as the command runs; numba is loaded."""
    if "numba" in sys.modules and not _listening:
        from sfm.kernels.compiling import COMPILING, when_compiling

        _listening.append(True)
        _running.enter_context(
            when_compiling(lambda: print(f"kolinear: the {COMPILING}", file=sys.stderr, flush=True))
        )


def compile_first() -> None:
    """Compile the kernels of a survey unless it was done for these sources, and report it on stderr."""
    from sfm.kernels.compiling import is_warm

    if is_warm():
        return
    from sfm import warm_up
    from sfm.runtime.progress_bar import drawn_progress

    print("kolinear: compiling the kernels, once, a minute or two", file=sys.stderr, flush=True)
    with drawn_progress() as drawn:
        warm_up.main(drawn)
