"""Warming up works on problems that the stages solve, else it would compile half of the kernels."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from sfm import warm_up
from sfm.targets.detect import find_targets
from tests.places import ROOT
from tests.surveys import write_observed_survey, write_photograph_survey

AFTERWARDS = """
import sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from sfm import warm_up
import sfm.report.output
from sfm.batch.run import run_batch
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
