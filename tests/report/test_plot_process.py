"""Plots drawn by a separate process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.font_manager import findfont
from matplotlib.ft2font import FT2Font

import sfm.report.figures.plot_process as drawing
from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import IntArray
from sfm.report.figures import plots
from sfm.report.figures.plot_data import PlotData
from sfm.report.figures.plot_process import PlotProcess, draw_plots, plot_process
from sfm.report.output import plot_data
from tests.findings import findings_of
from tests.places import ROOT
from tests.synthetic import make_network, seed_of

pytestmark = pytest.mark.usefixtures("plots")


class Unsendable(str):
    """A text that is too much for the memory when it is copied."""

    def __reduce__(self) -> str:
        raise MemoryError


@pytest.fixture(scope="module")
def shown() -> PlotData:
    network, truth = make_network(seed_of("plot process"), images=4, points=20)
    a = adjust(network, truth, datum=Datum("free"))
    return plot_data(findings_of(SurveyResult("plots", "m", 4, (), a, np.full(20, -1), None)))


@pytest.fixture
def process(capfd: pytest.CaptureFixture[str]) -> Iterator[PlotProcess]:
    """A process of which nothing is heard on the terminal, whatever happens."""
    with plot_process(2) as found:
        assert found is not None
        yield found
    assert found._process.returncode is not None
    assert capfd.readouterr().err == ""


def test_powers_of_ten_in_units_are_drawn_and_missing_characters_are_not() -> None:
    """Before, an axis was labelled "sigma [× 10?? network units]"."""
    glyphs = FT2Font(findfont("DejaVu Sans")).get_charmap()
    unit = "× 10⁻⁶ network units, 10⁻¹²³⁴⁵⁷⁸⁹⁰"
    assert plots._plain(unit) == unit and {ord(c) for c in unit} <= set(glyphs)
    assert plots._plain("面 $x$") == r"? \$x\$"


def test_points_that_others_cover_are_not_drawn(shown: PlotData, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = seed_of("covered points")
    crowd = replace(shown, points=rng.uniform(-1, 1, (60_000, 3)), sigma=rng.lognormal(size=60_000))
    places = crowd.points[:, :2]
    kept = plots._uncovered(places)
    assert len(np.unique(kept)) == len(kept) < 40_000 and (np.diff(kept) > 0).all()
    assert len(plots._uncovered(places[:300])) > 295 and len(plots._uncovered(places[:0])) == 0

    def picture() -> IntArray:
        canvas = FigureCanvasAgg(plots.precision_figure(crowd))
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[:, :, :3].astype(int)

    few = picture()
    monkeypatch.setattr(plots, "_uncovered", lambda xy: np.arange(len(xy)))
    change = np.abs(few - picture()).max(axis=2)
    assert (change > 40).mean() < 0.01 < (few.min(axis=2) < 250).mean()


def test_plots_are_drawn_elsewhere_and_the_same(
    shown: PlotData, process: PlotProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = draw_plots(shown)
    monkeypatch.setattr(drawing, "draw_plots", lambda _: pytest.fail("drawn here"))
    for _ in range(2):
        process.begin(shown)
        assert process.plots() == here


def test_plots_of_a_process_that_was_ended_are_drawn_here(shown: PlotData, process: PlotProcess) -> None:
    process._process.kill()
    process._process.wait()
    process.begin(shown)
    assert process.plots() == draw_plots(shown)


def test_what_cannot_be_sent_is_drawn_here(shown: PlotData, process: PlotProcess) -> None:
    unsendable = replace(shown, unit=Unsendable("m"))
    process.begin(unsendable)
    assert process.plots() == draw_plots(unsendable)


def test_where_no_thread_can_send_plots_are_drawn_here(
    shown: PlotData, process: PlotProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(drawing.Thread, "start", refuse)
    process.begin(shown)
    assert process.plots() == draw_plots(shown)


def test_what_cannot_be_drawn_is_reported_by_this_process(shown: PlotData, process: PlotProcess) -> None:
    process.begin(replace(shown, points=np.zeros((4, 7))))
    with pytest.raises(ValueError, match=r"shape|match"):
        process.plots()


@pytest.mark.skipif(os.name == "nt", reason="Windows does not stop processes")
def test_a_survey_may_end_before_its_plots_are_sent(shown: PlotData, process: PlotProcess) -> None:
    """Its process stands still, and the pipe is full."""
    process._process.send_signal(signal.SIGSTOP)
    process.begin(replace(shown, residuals=np.zeros((2_000_000, 2))))
    time.sleep(0.2)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no sessions")
def test_an_interrupt_of_the_terminal_is_for_who_began_the_process(process: PlotProcess) -> None:
    """From the first moment: a process that is still starting would print a traceback."""
    assert os.getsid(process._process.pid) == process._process.pid != os.getsid(0)


def test_where_no_process_can_be_started_plots_are_drawn_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(drawing.subprocess, "Popen", refuse)
    with plot_process(2) as process:
        assert process is None


def test_one_job_does_everything() -> None:
    with plot_process(1) as process:
        assert process is None


@pytest.mark.skipif(not os.path.isdir("/proc"), reason="no /proc here")
def test_the_process_ends_with_the_one_that_began_it() -> None:
    """Even where that is killed and can tidy up nothing."""
    script = (
        "import sys\n"
        "from sfm.report.figures.plot_process import PlotProcess\n"
        "print(PlotProcess()._process.pid, flush=True)\n"
        "sys.stdin.read(1)\n"
    )
    begun = subprocess.Popen(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert begun.stdout is not None
    drawn_by = int(begun.stdout.readline())
    begun.kill()
    begun.communicate()
    until = time.monotonic() + 30
    while _runs(drawn_by):
        assert time.monotonic() < until, "it goes on"
        time.sleep(0.05)


def _runs(pid: int) -> bool:
    """Whether a process has not ended; one that nobody has waited for has."""
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.sweep(0)
@pytest.mark.parametrize("given", [None, "/nowhere:"])
def test_nothing_of_the_current_folder_is_imported(
    given: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, process: PlotProcess
) -> None:
    """An empty entry of PYTHONPATH is the current folder."""
    for module in ("pickle", "sfm", "matplotlib", "site", "sitecustomize", "encodings"):
        (tmp_path / f"{module}.py").write_text(f"open({str(tmp_path / 'owned')!r}, 'w').close()\n")
    monkeypatch.chdir(tmp_path)
    if given is not None:
        monkeypatch.setenv("PYTHONPATH", given)
    with plot_process(2) as started_here:
        assert started_here is not None and started_here._process.stdin is not None
        started_here._process.stdin.close()
        assert started_here._process.wait(60) == 0
    assert not (tmp_path / "owned").exists()


def test_little_is_imported_to_draw() -> None:
    """Else the process takes the time of the survey that it is to save."""
    script = (
        "import sys, sfm.report.figures.plot_process, sfm.report.figures.plots\n"
        "print(sorted({'numba', 'scipy', 'cv2', 'pydantic', 'sfm.model.network'} & set(sys.modules)))"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert run.stdout == "[]\n"
