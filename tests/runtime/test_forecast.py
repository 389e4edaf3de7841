"""How long a survey takes: earlier runs, their scale, and what is left while it runs."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import pytest
from rich.console import Console

from sfm.model.errors import KolinearError
from sfm.runtime.forecast import (
    KEPT_RUNS,
    PROGRAM_MB,
    TYPICAL,
    BatchCountdown,
    Countdown,
    Run,
    RunHistory,
    Work,
    forecast,
    slowness,
)
from sfm.runtime.progress_bar import drawn_progress
from sfm.survey.inputs.measurements import NO_PHOTOGRAPHS, find_photographs, work_of
from sfm.survey.inputs.survey import read_survey
from tests.surveys import write_photograph_survey

SMALL = Run(Work(("targets",), 10, 1.0), {"targets": 5.0, "orientation": 1.0, "adjustment": 2.0})
LARGE = Run(Work(("targets",), 100, 1.0), {"targets": 40.0, "orientation": 30.0, "adjustment": 50.0}, 900.0)


def test_the_nearest_run_of_the_same_sources_is_scaled() -> None:
    work = Work(("targets",), 20, 2.0)
    expected = forecast(work, [LARGE, SMALL]).seconds
    assert expected == pytest.approx({"targets": 20.0, "orientation": 2.0, "adjustment": 2 * 2.0})
    assert forecast(Work(("targets",), 80, 1.0), [LARGE, SMALL]).seconds["targets"] == pytest.approx(32.0)
    assert forecast(SMALL.work, [SMALL]).seconds == SMALL.seconds
    assert "adjustment" not in forecast(SMALL.work, [SMALL], without=("adjustment",)).seconds
    again = Run(SMALL.work, {"targets": 7.0})
    assert forecast(SMALL.work, [SMALL, again]).seconds == again.seconds  # of equals the last


def test_without_a_run_of_ones_own_a_typical_one_of_its_sources_stands_in() -> None:
    for run in TYPICAL:
        assert forecast(run.work, []).seconds == pytest.approx(run.seconds)
    elsewhere = Run(Work(("texture",), 11, 6.29), {"tie points": 1.0})
    assert forecast(SMALL.work, [elsewhere]).seconds["targets"] > 0
    assert forecast(Work(("unheard of",), 3), [SMALL]).seconds == {}
    assert Work(("given",), 3).distance(Work(("given",), 3, 2.0)) == math.inf  # one of them reads photographs


def test_what_is_left_follows_the_stages_that_are_finished() -> None:
    countdown = Countdown({"targets": 10.0, "orientation": 4.0, "adjustment": 6.0})
    assert countdown.left("targets", 0.0) == pytest.approx(20.0)
    assert countdown.left("targets", 12.0) == pytest.approx(10.0)  # later than expected
    # half as fast, and the expectation of a whole of 20 s has the weight of 5 s
    half = {part: 2.0 ** (part / (part + 5.0)) for part in (10.0, 14.0)}
    assert countdown.left("targets", 5.0, 100, 400) == pytest.approx(15.0 + 10.0 * half[10.0], rel=1e-3)
    first = countdown.left("targets", 5.0, 1, 4)  # the others may be nearly finished
    assert first is not None and 15.0 < first < 20.0
    countdown.finish("targets", 20.0)
    assert countdown.left("orientation", 1.0) == pytest.approx(10.0 * half[10.0] - 1.0)
    countdown.finish("orientation", 8.0)
    assert countdown.left("adjustment", 0.0) == pytest.approx(6.0 * half[14.0])
    assert 0.8 * 12.0 < 6.0 * half[14.0] < 12.0  # nearly as on a computer that is half as fast
    assert countdown.left("report", 3.0) == pytest.approx(
        6.0 * half[14.0]
    )  # not expected: nothing is known of it
    assert Countdown().left("targets", 1.0) is None


def test_the_end_is_not_before_that_of_the_present_work() -> None:
    countdown = Countdown({"adjustment": 4.0, "report": 6.0})
    assert countdown.left("adjustment", 9.0, at_least=7.0) == pytest.approx(7.0 + 6.0)
    assert countdown.left("adjustment", 1.0, at_least=2.0) == pytest.approx(3.0 + 6.0)


def test_stages_that_read_an_earlier_measurement_say_nothing_of_the_others() -> None:
    countdown = Countdown({"targets": 10.0, "orientation": 4.0, "adjustment": 6.0})
    countdown.finish("targets", 0.1)
    assert countdown.left("orientation", 0.0) == pytest.approx(10.0)


def test_runs_are_kept_and_damaged_lines_are_passed_over(tmp_path: Path) -> None:
    history = RunHistory(tmp_path / "runs" / "runs.jsonl")
    assert history.read() == []
    history.add(SMALL)
    history.add(LARGE)
    assert history.read() == [SMALL, LARGE]
    good = history.path.read_text("utf-8")
    for line in ("", "{", "7", "[]", '{"sources": 3}', good.splitlines()[0].replace("5.0", '"x"')):
        history.path.write_text(f"{line}\n{good}", "utf-8")
        assert history.read() == [SMALL, LARGE]
    for number in ("NaN", "Infinity", "-1.0"):
        history.path.write_text(good.replace("5.0", number), "utf-8")
        assert history.read() == [LARGE]
    hostile = (
        *("[" * 100_000, good.replace("5.0", "1" + 400 * "0"), good.replace("5.0", "1e300")),
        *(good.replace(": 10,", f": {number},") for number in ("1" + 400 * "0", "1e400", "0")),
        *(good.replace('"megapixels": 1.0', f'"megapixels": {number}') for number in ("5e-324", "1e300")),
    )
    for text in hostile:
        history.path.write_text(f"{text.splitlines()[0]}\n{good.splitlines()[1]}", "utf-8")
        assert history.read() == [LARGE]
    history.path.write_bytes(b"\xff\xfe")
    assert history.read() == []
    for _ in range(3):
        history.path.write_text(good * KEPT_RUNS, "utf-8")
        history.add(SMALL)
        assert len(history.read()) == KEPT_RUNS and history.read()[-1] == SMALL
    history.path.unlink()
    history.path.mkdir()
    history.add(SMALL)  # it cannot be kept, which is no fault of the run
    assert history.read() == []


def test_a_folder_that_others_may_write_keeps_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    kept = RunHistory.of_user()
    kept.add(SMALL)
    assert RunHistory.of_user().read() == [SMALL]
    kept.path.parent.chmod(0o777)
    before = kept.path.read_bytes()
    RunHistory.of_user().add(LARGE)
    assert RunHistory.of_user().read() == [] and kept.path.read_bytes() == before


def test_surveys_of_given_image_points_are_scaled_by_these() -> None:
    few = Run(Work(("given",), 10, 0.0, 100), {"adjustment": 1.0, "orientation": 2.0})
    many = Run(Work(("given",), 10, 0.0, 100_000), {"adjustment": 1000.0, "orientation": 20.0})
    expected = forecast(Work(("given",), 40, 0.0, 50_000), [many, few]).seconds
    assert expected == pytest.approx({"adjustment": 1000.0 * 0.5**0.6, "orientation": 20.0 * 0.5**0.6})


def test_memory_grows_with_the_work_beyond_that_of_the_program() -> None:
    few = Run(Work(("given",), 10, 0.0, 1000), {"adjustment": 1.0}, PROGRAM_MB + 10.0)
    many = Run(Work(("given",), 10, 0.0, 100_000), {"adjustment": 9.0}, PROGRAM_MB + 800.0)
    later = Run(Work(("given",), 10, 0.0, 100_000), {"adjustment": 9.0})  # of an earlier version
    runs = [few, many, later]
    assert forecast(many.work, runs).memory_mb == many.memory_mb
    assert forecast(Work(("given",), 10, 0.0, 50_000), runs).memory_mb == pytest.approx(PROGRAM_MB + 400.0)
    assert forecast(Work(("given",), 10, 0.0, 1500), runs).memory_mb == pytest.approx(PROGRAM_MB + 15.0)
    assert forecast(Work(("unheard of",), 10), runs).memory_mb == 0.0
    texture = Run(Work(("texture",), 20, 4.0), {"tie points": 1.0}, PROGRAM_MB + 500.0)
    assert forecast(Work(("texture",), 20, 4.0), [texture]).memory_mb == texture.memory_mb
    larger = forecast(Work(("texture",), 40, 4.0), [texture]).memory_mb
    assert texture.memory_mb < larger < PROGRAM_MB + 1000.0
    for run in TYPICAL:
        assert forecast(run.work, []).memory_mb == pytest.approx(run.memory_mb)


def test_a_long_survey_is_announced_and_one_without_room_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert forecast(SMALL.work, [SMALL]).announced() == ""
    assert forecast(Work(("unheard of",), 10), [SMALL]).announced() == ""
    long = Run(Work(("targets",), 500, 1.0), {"targets": 0.4, "adjustment": 7000.0, "report": 130.0}, 6600.0)
    expected = "expected: 2.0 h (adjustment 1.9 h, report 2 min) and 6.6 GB of memory"
    monkeypatch.setattr("sfm.runtime.forecast.within_bytes", lambda: 7e9)
    assert forecast(long.work, [long]).announced() == expected
    unknown = Run(Work(("other",), 500), long.seconds)  # of an earlier version
    assert forecast(unknown.work, [unknown]).announced() == "expected: 2.0 h (adjustment 1.9 h, report 2 min)"
    monkeypatch.setattr("sfm.runtime.forecast.within_bytes", lambda: 6e9)
    assert forecast(long.work, [long]).announced() == f"{expected}, of which 6.0 GB are there"
    monkeypatch.setattr("sfm.runtime.forecast.within_bytes", lambda: 5e9)
    assert forecast(long.work, [long]).announced() == f"{expected}, of which 5.0 GB are there"
    with pytest.raises(
        KolinearError, match=r"needs about 6\.6 GB of memory, at least 5\.4 GB, and 5\.0 GB are"
    ):
        forecast(long.work, [long]).refuse()
    with pytest.raises(KolinearError, match=r"are there for it: do something$"):
        forecast(long.work, [long]).refuse(remedy="do something")
    forecast(long.work, [long]).refuse(there_bytes=6e9)
    forecast(unknown.work, [unknown]).refuse(there_bytes=1e6)  # nothing is known of its memory


def test_the_lower_bound_of_memory_is_the_lower_the_less_alike_a_run_was() -> None:
    run = Run(Work(("texture",), 250, 0.31), {"tie points": 46.0}, 2200.0)
    by_size = [forecast(Work(("texture",), count, 0.31), [run]) for count in (250, 1_000, 10_000, 100_000)]
    shares = [each.least_memory_mb / each.memory_mb for each in by_size]
    assert shares == sorted(shares, reverse=True) and 0.75 < shares[0] < 0.9
    # the one of 10,000 photographs is refused on 16 GB, and one of 1,000 on none that it can fit
    with pytest.raises(KolinearError, match="needs about 42"):
        by_size[2].refuse(there_bytes=16e9)
    measured_mb = 7800.0  # where 6.5 GB were expected from 250
    assert by_size[1].least_memory_mb < measured_mb < by_size[1].memory_mb ** 2 / by_size[1].least_memory_mb
    by_size[1].refuse(there_bytes=6e9)
    few = forecast(Work(("texture",), 2, 0.31), [run])  # smaller ones are scaled as far
    assert few.least_memory_mb / few.memory_mb < shares[1]


def test_a_stage_that_finds_more_to_do_says_nothing_of_the_others() -> None:
    assert slowness([(20.0, 10.0), (1.0, 0.5)]) == pytest.approx(2.0)
    assert 2.0 < slowness([(20.0, 10.0), (1.0, 0.5), (60.0, 1.0)]) < 3.0
    assert slowness([]) == slowness([(1.0, 0.0)]) == slowness([(0.0, 1.0)]) == 1.0
    countdown = Countdown({"targets": 10.0, "adjustment": 1.0, "report": 3.0})
    countdown.finish("targets", 10.0)
    countdown.finish("adjustment", 40.0)  # causes were tried
    left = countdown.left("report", 1.0)
    assert left is not None and 2.0 < left < 4.0


def batch_of(count: int, *, workers: int = 1, runs: tuple[Run, ...] = (SMALL,)) -> BatchCountdown:
    """Return the countdown of a batch of surveys as `SMALL`, whose photographs one thread measured."""
    works = {f"s{k}": SMALL.work for k in range(count)}
    return BatchCountdown(works, runs, workers=workers, threads=1)


def run_one(batch: BatchCountdown, name: str, now: float, slower: float) -> float:
    """Run a survey as `SMALL` in a batch, and return the time when it ends."""
    for _ in range(10):
        batch.measured(name, slower * 0.5, 10, stored=False)
    before = 0.0
    for stage, seconds in list(SMALL.seconds.items())[1:]:
        batch.begin(name, stage, now, before)
        before = slower * seconds
    batch.finish(name, slower * 8.0, dependable=True)
    return now + slower * 8.0


def test_the_time_to_the_end_of_a_batch_is_that_of_its_surveys() -> None:
    whole = sum(SMALL.seconds.values())
    assert batch_of(5).left(0.0) == pytest.approx(5 * whole)
    assert batch_of(5, workers=4).left(0.0) == pytest.approx(5 * whole / 4)
    assert batch_of(2, workers=4).left(0.0) == pytest.approx(whole)  # one worker runs a survey to its end
    assert BatchCountdown({"a": None}, [], workers=1, threads=1).left(0.0) is None
    half = BatchCountdown({"a": SMALL.work, "b": None}, [SMALL], workers=1, threads=1)
    assert half.left(0.0) == pytest.approx(2 * whole)  # the one without a forecast is as long as the other
    threads = BatchCountdown({"a": SMALL.work}, [SMALL], workers=1, threads=2)
    assert threads.left(0.0) == pytest.approx(whole + SMALL.seconds["targets"])


@pytest.mark.parametrize("slower", [0.4, 1.0, 3.0])
def test_finished_surveys_of_a_batch_forecast_the_others(slower: float) -> None:
    batch, whole = batch_of(4), slower * sum(SMALL.seconds.values())
    now = run_one(batch, "s0", 0.0, slower)
    assert batch.left(now) == pytest.approx(3 * whole)
    for _ in range(5):
        batch.measured("s1", slower * 0.5, 10, stored=False)
    assert batch.left(now) == pytest.approx(3 * whole - slower * 2.5, rel=0.02)
    batch.finish("s1", slower, dependable=False)
    assert batch.left(now) == pytest.approx(2 * whole)


def test_surveys_kept_or_read_from_an_earlier_run_forecast_no_others() -> None:
    batch, whole = batch_of(3), sum(SMALL.seconds.values())
    batch.finish("s0", 0.0, dependable=False)  # kept
    assert batch.left(0.0) == pytest.approx(2 * whole)
    for _ in range(10):
        batch.measured("s1", 0.001, 10, stored=True)
    batch.begin("s1", "orientation", 0.0, 0.0)
    batch.finish("s1", 3.0, dependable=True)
    assert batch.left(0.0) == pytest.approx(whole)


def test_stages_that_took_no_time_forecast_none() -> None:
    countdown = Countdown({"targets": 0.0, "orientation": 4.0})
    countdown.finish("targets", 0.02)
    assert countdown.left("orientation", 1.0) == pytest.approx(3.0)


def test_the_time_to_the_end_is_drawn_and_the_stages_are_kept() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=160, color_system=None)
    with drawn_progress(console) as progress:
        progress.countdown.expected = {"targets": 100.0, "report": 3600.0}
        progress.stage("targets", 10)
        progress._bar.refresh()
        assert "1:01:40 to the end" in console.file.getvalue()  # type: ignore[attr-defined]
        progress.stage("report")
        assert progress.finished().keys() == {"targets", "report"}
        assert progress.finished().keys() == {"targets", "report"}


def test_names_are_drawn_as_they_are_and_each_video_is_counted() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=160, color_system=None)
    with drawn_progress(console) as progress:
        for total in (3, 2):
            progress.stage("frames", total)
            progress.advance("a[/b].jpg")
            progress._bar.refresh()
            drawn = console.file.getvalue()  # type: ignore[attr-defined]
            assert f"1/{total}" in drawn and "a[/b].jpg" in drawn


def test_a_run_is_kept_once_measured_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sfm.cli.survey_runs import RunOptions, run_survey_file

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = write_photograph_survey(tmp_path / "survey", "kept")
    survey = read_survey(path)
    work = work_of(survey, find_photographs(survey))
    assert work.sources == ("targets",) and work.photographs > 3 and work.megapixels > 0
    assert work_of(survey, NO_PHOTOGRAPHS) == Work(("targets",), 0)
    for _ in range(2):
        run_survey_file(path, RunOptions(overwrite=True))
        (run,) = RunHistory.of_user().read()  # the second read what the first measured
        assert run.work == work and {"targets", "adjustment", "report"} <= run.seconds.keys()
    assert json.loads(RunHistory.of_user().path.read_text("utf-8"))["photographs"] == work.photographs


def test_a_run_from_python_is_forecast_without_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sfm
    from sfm.runtime import progress_bar

    drawn = []
    draw = progress_bar.DrawnProgress.finished
    monkeypatch.setattr(
        progress_bar.DrawnProgress, "finished", lambda bar: drawn.append(bar.countdown) or draw(bar)
    )
    path = write_photograph_survey(tmp_path / "survey", "python")
    sfm.run_survey(path, compare_with="none", progress=True)
    expected = drawn[0].expected
    assert {"targets", "orientation", "adjustment"} <= expected.keys() and "report" not in expected
    assert drawn[0].taken.keys() >= {"targets", "adjustment"}
