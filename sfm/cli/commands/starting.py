"""Start of the program: the first compilation, Ctrl-C, and `doctor`, which checks an installation.

Printing is guarded too: a code page may lack characters, a disk may be full, and a reader may exit early.
"""

from __future__ import annotations

import atexit
import io
import os
import platform
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, TextIO

from sfm.model.display import counted
from sfm.model.errors import KolinearError, MissingLibraryError

if TYPE_CHECKING:
    from sfm.adjustment.result import Adjustment
    from sfm.model.estimate import Estimate

READER_GONE = 141  # exit code 128 + SIGPIPE, as a shell reports it for other programs
LIBRARIES = (
    "kolinear",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "numba",
    "pycolmap",
    "distributed",
)
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "firefox", "safari", "msedge")
MIN_FREE_GB = 1.0
CENTRE_PX = 0.1  # largest accepted error of the centre of a drawn dot
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
    system, or would leave it as an ImportError. After the imports, compiling of kernels is announced.
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


def _announce_compiling() -> None:
    """Report compiling of kernels on stderr while the command runs, if numba is loaded."""
    if "numba" in sys.modules and not _listening:
        from sfm.runtime.compiling import COMPILING, when_compiling

        _listening.append(True)
        _running.enter_context(
            when_compiling(lambda: print(f"kolinear: the {COMPILING}", file=sys.stderr, flush=True))
        )


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


def doctor() -> None:
    """Check this installation with a short measurement and adjustment.

    Also prints versions, cores and folders. Exit code 1 if a check fails; its line states the remedy.
    """
    with loading():
        from rich.console import Console
        from rich.table import Table

        from sfm.files.user_cache import user_folder
        from sfm.runtime.compiling import KEPT
        from sfm.runtime.threads import cores
        from sfm.runtime.warmed import is_warm

    console = Console(highlight=False)
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_row("python", f"{platform.python_version()}, {platform.system()} {platform.machine()}")
    for name in LIBRARIES:
        table.add_row(name, _version(name))
    table.add_row("cores", str(cores()))
    table.add_row("memory", _memory())
    table.add_row(
        "browser", next((name for name in BROWSERS if shutil.which(name)), "none found by its name")
    )
    table.add_row("kernels", f"{KEPT}, {'compiled' if is_warm() else 'not yet compiled'}")
    store = user_folder("measured", "measured points")
    size = sum(path.stat().st_size for path in store.rglob("*") if path.is_file())
    table.add_row("measured points", f"{store}, {size / 1e6:.0f} MB")
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    table.add_row("free space", f"{free:.1f} GB in {Path.cwd()}")
    console.print(table)
    failed = [] if free > MIN_FREE_GB else [f"only {free:.1f} GB are free here; results need more space"]
    compile_first()
    begun = time.perf_counter()
    for name, check in CHECKS:
        try:
            console.print(f"{name}: {check()}")
        except MissingLibraryError as error:  # a library of an extra, which is optional
            console.print(f"{name}: no comparison, {error}", markup=False)
        except KolinearError as error:
            failed.append(f"{name}: {error}")
    console.print(f"self-test: {time.perf_counter() - begun:.1f} s")
    for line in failed:
        console.print(f"! {line}", style="red")
    if failed:
        raise SystemExit(FAILED)
    console.print("This installation works.", style="green")


def _check_targets() -> str:
    """Measure four drawn dots of known positions."""
    import numpy as np

    from sfm.cli.warm_up import DOTS, drawn_photograph
    from sfm.targets.detect import find_targets

    dots = find_targets(drawn_photograph(False), polarity="dark", codes="ring14")
    if len(dots) != len(DOTS):
        raise KolinearError(f"{len(dots)} of {len(DOTS)} dots found")
    centres = np.array(DOTS)
    error = np.linalg.norm(dots.xy[:, None] - centres, axis=2).min(axis=1).max()
    if error > CENTRE_PX:
        raise KolinearError(f"a dot is {error:.3f} px off, expected {CENTRE_PX} px at most")
    return f"{counted(len(dots), 'dot')} measured, {error:.4f} px off at most"


@cache
def _tested_network() -> tuple[Adjustment, Estimate]:
    """Return the adjustment of a synthetic network, and its true values."""
    from sfm.adjustment.datum import Datum
    from sfm.adjustment.solve import adjust
    from sfm.cli.warm_up import made_up_network

    network, truth = made_up_network()
    return adjust(network, truth, datum=Datum("free")), truth


def _check_adjustment() -> str:
    """Compare the adjustment of a synthetic network with the true values."""
    import numpy as np

    from sfm.model.remarks.remark import WRONG_SIGMAS

    adjusted, truth = _tested_network()
    if not adjusted.converged:
        raise KolinearError("the adjustment did not converge")
    moved = np.linalg.norm(adjusted.estimate.points - truth.points, axis=1)
    sigma = np.sqrt(np.trace(adjusted.covariance.points, axis1=1, axis2=2))
    worst = float((moved / sigma).max())
    if worst > WRONG_SIGMAS:
        raise KolinearError(f"a point is {worst:.1f} standard deviations off")
    return f"{counted(len(truth.points), 'point')}, worst {worst:.1f} standard deviations off"


def _check_colmap() -> str:
    """Adjust the same network with COLMAP and compare."""
    from sfm.comparison.two_adjusters.adjusters import compare_adjusters
    from sfm.products.public_functions import programs_of

    adjuster = programs_of("colmap", "none").adjuster
    assert adjuster is not None
    if not compare_adjusters(_tested_network()[0], adjuster).agree:
        raise KolinearError("its adjustment of a synthetic network differs from Kolinear's")
    return f"version {_version('pycolmap')} agrees on the same network"


CHECKS: tuple[tuple[str, Callable[[], str]], ...] = (
    ("targets", _check_targets),
    ("adjustment", _check_adjustment),
    ("colmap", _check_colmap),
)


def _version(name: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _memory() -> str:
    if not hasattr(os, "sysconf") or "SC_PHYS_PAGES" not in os.sysconf_names:
        return "unknown"
    return f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB"


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
