"""The command `doctor`, which checks an installation."""

from __future__ import annotations

import math
import platform
import shutil
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from sfm.model.display import counted
from sfm.model.errors import KolinearError, MissingLibraryError

if TYPE_CHECKING:
    from sfm.adjustment.result import Adjustment
    from sfm.model.estimate import Estimate

from sfm.cli.process import FAILED, compile_first, loading

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

    from sfm.model.remarks.row import WRONG_SIGMAS

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
    from sfm.library.surveys import programs_of

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


def doctor() -> None:
    """Check this installation by a short measurement.

    Also prints versions, cores and folders. Exit code 1 if a check fails; its line states the remedy.
    """
    with loading():
        from rich.console import Console
        from rich.table import Table

        from sfm.files.user_cache import user_folder
        from sfm.runtime.compiling import KEPT
        from sfm.runtime.memory import limit_bytes
        from sfm.runtime.threads import cores
        from sfm.runtime.warmed import is_warm

    console = Console(highlight=False)
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_row("python", f"{platform.python_version()}, {platform.system()} {platform.machine()}")
    for name in LIBRARIES:
        table.add_row(name, _version(name))
    table.add_row("cores", str(cores()))
    memory = limit_bytes()
    table.add_row("memory", f"{memory / 2**30:.1f} GiB" if math.isfinite(memory) else "unknown")
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


def _version(name: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
