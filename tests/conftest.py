"""What all tests share: a cache folder, reports without plots, and where public data are, if they are."""

from __future__ import annotations

import atexit
import gc
import io
import os
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Generator
from contextlib import nullcontext, suppress
from math import prod
from pathlib import Path

# Before numpy is loaded: the tests run in a process for each core, and threads of BLAS beyond the first spin.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import matplotlib
import pytest
from PIL import Image

from tests.places import ROOT, SHARED

SHARED = SHARED / "data"
Image.new("L", (1, 1), 255).save(_empty := io.BytesIO(), "PNG")
EMPTY = _empty.getvalue()  # a picture

os.environ.setdefault("MPLCONFIGDIR", matplotlib.get_cachedir())  # its list of fonts takes long
CACHES = tempfile.mkdtemp(prefix="kolinear-tests-")
os.environ["XDG_CACHE_HOME"] = CACHES  # never that of the user
atexit.register(shutil.rmtree, CACHES, ignore_errors=True)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels before the first test, which would wait for it and read that it is done."""
    from sfm.runtime.warmed import is_warm

    if not hasattr(session.config, "workerinput") and not is_warm():
        from sfm.cli.warm_up import main

        main()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Leave what is collected out of garbage collection, which took as long as the collection itself.

    It all lives to the end: modules, compiled functions and 7,000 tests.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Function]) -> None:
    """Leave to the study what `sweep` does not list, by its place among the cases of a test.

    Cases that are asked for by their names are run.
    """
    cases = defaultdict[tuple[object, str, tuple[int, ...]], list[pytest.Function]](list)
    for item in items:
        sweep = item.get_closest_marker("sweep")
        if sweep is not None:
            cases[item.parent, item.originalname, sweep.args].append(item)
    for (_, name, listed), of_test in cases.items():
        count = prod(len(list(one.args[1])) for one in of_test[0].iter_markers("parametrize"))
        if max(listed) >= count > 1:
            raise pytest.UsageError(f"{name}: sweep lists place {max(listed)} of {count} cases")
        for place, item in enumerate(of_test if len(of_test) >= count else ()):
            if place not in listed:
                item.add_marker("slow")


@pytest.fixture(autouse=True)
def cache(monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder for each test, so that none finds what others have measured.

    Not numbered by pytest, which lists all the folders of earlier tests for each (20 s of the suite).
    """
    folder = Path(tempfile.mkdtemp(dir=CACHES))
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    monkeypatch.setenv("PYTHONSAFEPATH", "")  # commands set it for their processes: not beyond a test
    return folder


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the public reference data; the test is skipped where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("the public reference data ../shared/data are absent")
    return SHARED


@pytest.fixture(scope="session")
def demo_photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the rendered photographs of the demo with their truth, of all processes: not to change."""
    from sfm.products.rendering.render import write_photographs
    from sfm.products.rendering.scene_file import read_scene

    own = tmp_path_factory.getbasetemp()
    shared = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "demo-photographs"
    if not shared.exists():
        rendered = own / "rendered"
        write_photographs(read_scene(ROOT / "datasets" / "demo" / "scene.toml"), rendered)
        with suppress(OSError):  # another process was faster
            rendered.rename(shared)
    return shared


@pytest.fixture
def plots() -> None:
    """Asked for by a test whose reports shall have their plots, drawn as for users."""


@pytest.fixture(autouse=True)
def no_plots(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the plots, which take as long as a small survey, and the process that draws them.

    The figures of a calibration are made, and remain empty.
    """
    from sfm.report.figures.plot_data import Plot

    if "plots" not in request.fixturenames:
        monkeypatch.setattr(
            "sfm.products.calibration.page.plot",
            lambda stem, caption, _: Plot(stem, caption, EMPTY, (EMPTY,)),
        )
        monkeypatch.setattr("sfm.report.figures.plot_process.plot_process", lambda _: nullcontext())
        monkeypatch.setattr("sfm.report.output.draw_plots", lambda _: [])


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run batches in this process: for tests of what they write, not of workers, which take 5 s to start."""
    from tests.engines import HERE

    monkeypatch.setattr("adapters.dask_cluster.local_engine", lambda *_, **__: HERE)
