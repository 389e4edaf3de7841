"""The installation is checked, kernels compile once and are compiled by problems that the stages solve."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sfm.cli import warm_up
from sfm.cli.process import compile_first
from sfm.runtime import warmed
from sfm.targets.detect import find_targets
from tests.commands import kolinear
from tests.places import ROOT
from tests.surveys import write_observed_survey, write_photograph_survey


@pytest.fixture
def warm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warmed, "is_warm", lambda: True)


@pytest.mark.usefixtures("warm")
def test_an_installation_that_works(capsys: pytest.CaptureFixture[str]) -> None:
    assert kolinear("doctor") == 0
    told = capsys.readouterr().out
    assert "4 dots measured" in told and "agrees on the same network" in told
    assert "This installation works." in told
    for subject in ("python", "numpy", "pycolmap", "cores", "browser", "kernels", "free space"):
        assert f"\n{subject}" in f"\n{told}"


@pytest.mark.usefixtures("warm")
def test_one_that_measures_wrongly(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(warm_up, "DOTS", tuple((x + 0.5, y) for x, y in warm_up.DOTS))
    drawn = warm_up.drawn_photograph
    monkeypatch.setattr(warm_up, "drawn_photograph", lambda bright: drawn(bright)[:, ::-1].copy())
    assert kolinear("doctor") == 1
    assert "px off, expected 0.1 px at most" in capsys.readouterr().out


def test_kernels_are_compiled_once_for_their_sources(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    runs = []
    folder = tmp_path_factory.mktemp("kept") / "kernels"
    monkeypatch.setattr(warmed, "_folder", lambda: folder)
    monkeypatch.setattr(warmed, "make_user_folder", lambda path: path.mkdir(exist_ok=True))

    def compiled(progress: object) -> None:
        runs.append(progress)
        warmed.set_warm()

    monkeypatch.setattr(warm_up, "main", compiled)
    compile_first()
    compile_first()
    assert len(runs) == 1
    monkeypatch.setattr(warmed, "_mark", lambda: "warm-of-other-sources")
    compile_first()
    assert len(runs) == 2
    assert [path.name for path in folder.iterdir()] == ["warm-of-other-sources"]


AFTERWARDS = """
import sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from sfm.cli import warm_up
import sfm.report.output
from sfm.products.batch.run import run_batch
from tests.engines import ALONE, HERE, Notes

def compiled():
    return {
        (f"{module.__name__}.{name}", str(one))
        for module in list(sys.modules.values()) if getattr(module, "__name__", "").startswith("sfm.")
        for name, kernel in vars(module).items() if isinstance(kernel, Dispatcher)
        for one in kernel.signatures
    }

sfm.report.output.draw_plots = lambda _: []  # compiles nothing
for part in warm_up.PARTS:
    part()
before = compiled()
folder = Path(sys.argv[1])
surveys = [folder / name / "survey.toml" for name in "ab"]
rows = run_batch(surveys, folder / "out", HERE, ALONE, Notes())
assert [row.status for row in rows] == ["done", "done"], rows
print(*sorted(compiled() - before), sep="\\n")
"""


def test_drawn_photograph_has_four_dots_and_one_code() -> None:
    for bright in (False, True):
        found = find_targets(warm_up.drawn_photograph(bright), polarity="auto", codes="ring14")
        assert len(found) == 4
        assert sorted(found.code)[:3] == [-1, -1, -1]
        assert (found.polarity == (1 if bright else -1)).all()
        np.testing.assert_allclose(sorted(found.xy[:, 0]), [60.3, 60.4, 180.1, 180.6], atol=0.1)


def test_a_survey_compiles_nothing_afterwards(tmp_path: Path) -> None:
    """A kernel that one process compiles and another takes from disk may differ in the last bit.

    What they call is linked in another order then; results of a batch are the same bytes only if every
    worker takes all kernels from disk.
    """
    write_photograph_survey(tmp_path / "a", "a")
    write_observed_survey(tmp_path / "b", "b")
    run = subprocess.run(
        [sys.executable, "-c", AFTERWARDS, str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == ""
