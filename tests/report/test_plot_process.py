"""Plots drawn by a process of their own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

import sfm.report.figures.plot_process as drawing
from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.report.figures.plot_data import PlotData
from sfm.report.figures.plot_process import draw_plots, plot_process
from sfm.report.figures.plotted import plot_data
from sfm.report.findings.findings import findings_of
from sfm.result import SurveyResult
from tests.places import ROOT
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def shown() -> PlotData:
    network, truth = make_network(seed_of("plot process"), images=4, points=20)
    a = adjust(network, truth, datum=Datum("free"))
    return plot_data(findings_of(SurveyResult("plots", "m", 4, (), a, np.full(20, -1), None)))


def test_plots_are_those_of_this_process_whatever_happens_to_the_other(
    shown: PlotData, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drawing, "cores", lambda: 2)
    here = draw_plots(shown)
    with plot_process() as process:
        assert process is not None
        process.begin(shown)
        assert process.plots() == here
        process.begin(shown)
        process._process.kill()
        assert process.plots() == here
    assert not process._process.is_alive()


def test_what_cannot_be_drawn_is_told_by_this_process(
    shown: PlotData, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(drawing, "cores", lambda: 2)
    with plot_process() as process:
        assert process is not None
        process.begin(replace(shown, points=np.zeros((4, 7))))
        with pytest.raises(ValueError, match=r"shape|match"):
            process.plots()
    assert "Traceback" not in capfd.readouterr().err


def test_where_no_process_can_be_started_plots_are_drawn_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(drawing, "cores", lambda: 2)
    monkeypatch.setattr("multiprocessing.context.SpawnProcess.start", refuse)
    with plot_process() as process:
        assert process is None


@pytest.mark.skipif(os.name == "nt", reason="Windows has no mask of signals")
def test_an_interrupt_is_for_who_began_the_process(
    shown: PlotData, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """From the first moment: a process that is still starting would print a traceback."""
    monkeypatch.setattr(drawing, "cores", lambda: 2)
    with plot_process() as process:
        assert process is not None and process._process.pid is not None
        for _ in range(20):
            os.kill(process._process.pid, signal.SIGINT)
            time.sleep(0.02)
        process.begin(shown)
        assert process._pipe.poll(60)
        assert len(process.plots()) == 4 and process._process.is_alive()
    assert "Traceback" not in capfd.readouterr().err


def test_one_core_has_enough_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "cores", lambda: 1)
    with plot_process() as process:
        assert process is None


@pytest.mark.skipif(not os.path.isdir("/proc"), reason="no /proc here")
def test_the_process_ends_with_the_one_that_began_it() -> None:
    """Even where that is killed and can tidy up nothing."""
    script = (
        "import os, sys\n"
        "from sfm.report.figures.plot_process import PlotProcess\n"
        "if __name__ == '__main__':\n"
        "    print(PlotProcess()._process.pid, flush=True)\n"
        "    sys.stdin.read(1)\n"
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


def test_little_is_imported_to_draw() -> None:
    """Else the process takes the time of the survey that it is to save."""
    script = (
        "import sys, sfm.report.figures.plot_process, sfm.report.figures.plots\n"
        "print(sorted({'numba', 'scipy', 'cv2', 'pydantic', 'sfm.network'} & set(sys.modules)))"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert run.stdout == "[]\n"
