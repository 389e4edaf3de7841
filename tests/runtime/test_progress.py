"""Progress: stages with what they do, how much of it is done, and what is left where that is known."""

from __future__ import annotations

import io
import time
from pathlib import Path

import pytest
from rich.console import Console

from sfm.pipeline import run_survey
from sfm.runtime.progress import Silent, StageClock, report_step, reported
from sfm.runtime.progress_bar import drawn_progress
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
