"""Progress: stages, how much is done and left; memory that threads freed; a second thread."""

from __future__ import annotations

import io
import subprocess
import sys
import time
from pathlib import Path
from threading import get_ident

import pytest
from rich.console import Console
from threadpoolctl import threadpool_info

from sfm.pipeline import run_survey
from sfm.runtime.progress import Silent, StageClock, report_step, reported
from sfm.runtime.progress_bar import drawn_progress
from sfm.runtime.threads import at_once, own_threads
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.survey import read_survey
from tests.other_adjuster import in_house_adjuster
from tests.surveys import write_photograph_survey

PHOTOGRAPHS = 6


class Recorded(Silent):
    """Progress that is kept."""

    def __init__(self) -> None:
        self.at = ""
        self.stages: list[str] = []
        self.steps: list[tuple[str, str, int | None, int | None]] = []

    def stage(self, name: str, total: int | None = None) -> None:
        self.at = name
        self.stages.append(name)

    def step(self, name: str, done: int | None = None, total: int | None = None) -> None:
        self.steps.append((self.at, name, done, total))


def test_steps_reach_whoever_watches_the_stage_and_no_one_else() -> None:
    watching = Recorded()
    report_step("before")
    with StageClock(watching).stage("one"):
        assert list(reported("letters", "abc", 3)) == ["a", "b", "c"]
        assert list(reported("nothing", "", 0)) == []
        with StageClock(Silent()).stage("inner"):
            report_step("unheard")
    report_step("after")
    assert watching.steps == [("one", "letters", k, 3) for k in range(4)]


def drawn(console: Console) -> str:
    return console.file.getvalue()  # type: ignore[attr-defined,no-any-return]


def test_time_left_is_shown_where_the_total_is_known_and_no_question_mark_where_not() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=140, color_system=None)
    with drawn_progress(console) as progress:
        progress.stage("orientation")
        progress.step("looking around")
        time.sleep(0.15)
        progress._bar.refresh()
        unknown = drawn(console)
        assert "looking around" in unknown and "0:00:00" in unknown
        assert "/?" not in unknown and " left" not in unknown
        for done in range(3):
            progress.step("photographs oriented", done, 100)
            time.sleep(0.15)
        progress._bar.refresh()
        known = drawn(console)[len(unknown) :]
        assert "2/100" in known and "0:00:" in known and " left" in known
        seconds = progress._bar.tasks[-1].time_remaining
        assert seconds == pytest.approx(98 * 0.15, rel=0.5)
        began = progress._bar.tasks[-1].start_time
        progress.step("pairs", 0, 7)  # other work: its own count, the clock of the stage goes on
        assert progress._bar.tasks[-1].time_remaining is None
        assert progress._bar.tasks[-1].start_time == began


def test_every_stage_of_a_survey_reports_what_it_does(tmp_path: Path) -> None:
    survey = read_survey(write_photograph_survey(tmp_path / "small", "small", photographs=PHOTOGRAPHS))
    watching = Recorded()
    run_survey(survey, others=OtherPrograms(in_house_adjuster), progress=watching)
    told = {stage: [step for step in watching.steps if step[0] == stage] for stage in watching.stages}
    for stage in ("orientation", "matching", "adjustment", "comparison"):
        assert told[stage], stage
    oriented = [(done, total) for _, _, done, total in told["orientation"] if total == PHOTOGRAPHS]
    assert oriented[-1] == (PHOTOGRAPHS, PHOTOGRAPHS)
    for _, name, done, total in watching.steps:
        assert name and (total is None or 0 <= (done or 0) <= total)


THREADS, ARRAYS, MB = 6, 8, 8
IN_TURN = f"""
from pathlib import Path
from threading import Event, Thread
import numpy as np
from sfm.runtime.progress import keep_freed_memory
from sfm.runtime.progress import SILENT, StageClock
StageClock(SILENT)
keep_freed_memory()
def taken_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) / 256
done, taken = Event(), [taken_mb()]
def work(ready):
    arrays = [np.ones({MB} << 17) for _ in range({ARRAYS})]
    taken.append(taken_mb())
    del arrays
    ready.set()
    done.wait()
for _ in range({THREADS}):
    ready = Event()
    Thread(target=work, args=[ready]).start()
    ready.wait()
done.set()
print(max(taken) - taken[0])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_threads_take_what_others_have_freed() -> None:
    """One after another they need no more than one; each in memory of its own they take 400 MB."""
    done = subprocess.run([sys.executable, "-c", IN_TURN], capture_output=True, text=True, check=True)
    assert ARRAYS * MB / 2 < float(done.stdout) < 2 * ARRAYS * MB


def _blas() -> list[int]:
    return [one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"]


def test_a_second_thread_is_at_hand_where_there_are_two() -> None:
    before = _blas()
    with own_threads(2):
        outer = at_once(get_ident, get_ident)
        with own_threads():  # of an adjustment, whose pools have one thread here
            assert set(_blas()) == {1}
            inner = at_once(get_ident, get_ident)
        after = at_once(get_ident, get_ident)
    assert outer == inner == after and outer[0] == get_ident() != outer[1]
    assert _blas() == before


def test_one_thread_alone() -> None:
    with own_threads(1), own_threads():
        assert at_once(get_ident, get_ident) == (get_ident(), get_ident())
    assert at_once(get_ident, get_ident) == (get_ident(), get_ident())
