"""Batches: which surveys, what is kept and what is run again, the tables, and how it ends on Dask."""

from __future__ import annotations

import gc
import io
import json
import logging
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import replace
from http.client import HTTPException
from pathlib import Path
from urllib.request import urlopen

import dask
import psutil
import pytest
from dask.distributed import Client, KilledWorker
from rich.console import Console
from threadpoolctl import threadpool_info, threadpool_limits

from adapters.dask_cluster import DaskEngine, _event, _OneThread, fitting_workers, local_engine, remote_engine
from sfm.cli.commands.batch import InProcess
from sfm.files.open_folders import MANIFEST, Owner, locked, sha256_of
from sfm.files.whole_files import write_manifest
from sfm.model.errors import BackendError, OutputError, SurveyFileError
from sfm.model.remarks.remark import kinds_of
from sfm.products.batch.job import LOCK, SurveyJob, SurveyRow, note_finished, reconstruct
from sfm.products.batch.run import calls_of, find_surveys, memory_of, run_batch
from sfm.products.batch.table import BatchTable, batch_page, batch_remarks
from sfm.report.output import read_log
from sfm.report.pages import html
from sfm.runtime.executor import Call, Done, Lost, Work
from sfm.runtime.forecast import Run, RunHistory
from sfm.runtime.forecast import Work as Extent
from sfm.runtime.threads import cores
from tests.engines import ALONE, HERE, KILLER, Notes, points_of, raise_unforeseen, return_nothing
from tests.places import ROOT
from tests.surveys import write_observed_survey, write_photograph_survey
from tests.tables import rows_of


@pytest.fixture(scope="module")
def surveys(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """Two surveys of photographs and one of image points."""
    folder = tmp_path_factory.mktemp("surveys")
    return (
        write_photograph_survey(folder / "a", "first"),
        write_photograph_survey(folder / "b", "second"),
        write_observed_survey(folder / "c", "third"),
    )


@pytest.fixture(scope="module")
def finished(surveys: tuple[Path, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A batch of them, run in this process."""
    out = tmp_path_factory.mktemp("batch") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sfm.report.output.draw_plots", lambda *_: [])
        rows = run_batch(surveys, out, HERE, ALONE, Notes())
    assert [row.status for row in rows] == ["done"] * 3
    return out


@pytest.fixture(scope="module")
def two_workers() -> Iterator[DaskEngine]:
    with local_engine(2) as engine:
        yield engine


def test_surveys_are_found_by_file_folder_and_glob(tmp_path: Path) -> None:
    for name in ("a/survey.toml", "b/c/survey.toml", "b/other.toml", "d/one.toml", "d/two.toml", "e/x.csv"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()

    def names(*given: str) -> list[str]:
        found = find_surveys([str(tmp_path / one) for one in given])
        return [path.relative_to(tmp_path.resolve()).as_posix() for path in found]

    assert names("a/survey.toml", "a") == ["a/survey.toml"]
    assert names("b", "d") == ["b/c/survey.toml", "d/one.toml", "d/two.toml"]
    assert names("d/*.toml", "[ab]") == ["d/one.toml", "d/two.toml", "a/survey.toml", "b/c/survey.toml"]
    assert names("none.toml") == ["none.toml"]  # it fails as a survey, the others go on
    with pytest.raises(SurveyFileError, match=r"no survey\.toml in or below"):
        names("e")
    with pytest.raises(SurveyFileError, match="no file matches"):
        names("*.none")
    with pytest.raises(SurveyFileError, match="an empty name stands for no survey"):
        find_surveys([""])


def test_batch_gives_folders_tables_and_logs(finished: Path) -> None:
    table = rows_of(finished / "batch.csv")
    data = json.loads((finished / "batch.json").read_text(encoding="utf-8"))
    assert [row["survey"] for row in table] == ["first", "second", "third"]
    assert [row["survey"] for row in data["surveys"]] == ["first", "second", "third"]
    assert data["totals"] == {"surveys": 3, "done": 3, "failed": 0, "set aside": 0, "not dependable": 0}
    page = (finished / "index.html").read_text(encoding="utf-8")
    for row in table:
        folder = finished / row["folder"]
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        assert float(row["sigma0_px"]) == summary["sigma0_px"]
        assert float(row["rms_px"]) == summary["rms_px"]
        assert int(row["photographs"]) == int(row["photographs_total"]) == summary["images"]["used"] == 6
        assert int(row["points"]) == summary["points"]["total"] == 20
        assert f'href="{row["folder"]}/report.html"' in page
        log = read_log(folder / "log.jsonl")
        assert log[0]["event"] == "start"
        assert log[-1]["event"] == "result"
        stages = [entry["stage"] for entry in log if entry["event"] == "stage"]
        assert stages[-2:] == ["adjustment", "report"]
        photographs = [entry for entry in log if entry["event"] == "photograph"]
        assert len(photographs) == (0 if row["survey"] == "third" else 6)
        assert all(entry["targets"] >= 10 and not entry["stored"] for entry in photographs)
    assert sorted(p.name for p in finished.iterdir()) == [
        *("batch.csv", "batch.json", "first", "index.html", "manifest.json", "second", "third"),
    ]


def test_resume_keeps_what_is_finished_and_runs_what_has_changed(
    surveys: tuple[Path, ...], tmp_path: Path
) -> None:
    own = [write_photograph_survey(tmp_path / "a", "one", backend="none"), surveys[2]]
    out = tmp_path / "out"
    run_batch(own, out, HERE, ALONE, Notes())
    before = {folder: os.stat(out / folder).st_ino for folder in ("one", "third")}
    again = Notes()
    run_batch(own, out, HERE, ALONE, again, resume=True)
    assert [kept for _, kept in again.finished_rows] == [True, True]
    assert {folder: os.stat(out / folder).st_ino for folder in before} == before

    own[0].write_text(own[0].read_text(encoding="utf-8").replace('"c"', '"c", "K1"'), encoding="utf-8")
    changed = Notes()
    rows = run_batch(own, out, HERE, ALONE, changed, resume=True)
    assert [kept for _, kept in changed.finished_rows] == [False, True]
    assert [row.survey for row in rows] == ["one", "third"]
    log = read_log(out / "one" / "log.jsonl")
    assert all(entry["stored"] for entry in log if entry["event"] == "photograph")  # only adjusted again


def test_photographs_are_measured_again_only_where_they_changed(tmp_path: Path) -> None:
    survey = write_photograph_survey(tmp_path / "a", "one")
    other = write_photograph_survey(tmp_path / "b", "two")
    out = tmp_path / "out"
    run_batch([survey], out, HERE, ALONE, Notes())
    measured = points_of(out)
    (tmp_path / "a" / "photo 2.png").write_bytes((tmp_path / "b" / "photo 2.png").read_bytes())
    (tmp_path / "a" / "photo 5.png").rename(tmp_path / "a" / "photo 7.png")
    run_batch([survey, other], out, HERE, ALONE, Notes())
    log = read_log(out / "one" / "log.jsonl")
    stored = {entry["image"]: entry["stored"] for entry in log if entry["event"] == "photograph"}
    assert stored == {f"photo {k}.png": k != 2 for k in (1, 2, 3, 4, 6, 7)}
    assert points_of(out)["one"] != measured["one"]


def test_failures_are_rows_and_the_others_go_on(surveys: tuple[Path, ...], tmp_path: Path) -> None:
    broken = write_photograph_survey(tmp_path / "broken", "<b>broken</b>")
    for photograph in broken.parent.glob("*.png"):
        photograph.write_bytes(photograph.read_bytes()[:5000])
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("[survey]\nname = 3\n", encoding="utf-8")
    taken = write_observed_survey(tmp_path / "taken", "taken")
    out = tmp_path / "out"
    (out / "taken").mkdir(parents=True)
    (out / "taken" / "letter.txt").touch()
    rows = run_batch([wrong, broken, taken, tmp_path / "no.toml", surveys[2]], out, HERE, ALONE, Notes())
    assert [row.status for row in rows] == ["failed", "failed", "failed", "failed", "done"]
    assert "survey.name: found 3" in rows[0].reason
    assert "0 readable photographs" in rows[1].reason
    assert all(f"photo {k}.png" in rows[1].reason for k in range(1, 6)) and "and 1 more" in rows[1].reason
    assert "letter.txt" in rows[2].reason
    assert "cannot be read" in rows[3].reason
    assert (out / "taken" / "letter.txt").exists()
    page = (out / "index.html").read_text(encoding="utf-8")
    assert "<b>broken" not in page
    assert "&lt;b&gt;broken&lt;/b&gt;" in page
    assert '<div class="banner bad"><strong>1 of 5 surveys has a dependable result.' in page
    assert page.count('<span class="mark bad">failed</span>') == 2 * 4
    assert f'<span class="mark {rows[4].verdict}">{rows[4].verdict}</span>' in page
    assert "<td class=n>6 / 6</td>" in page
    for row in rows[:4]:
        log = read_log(out / "logs" / f"{row.folder}.jsonl")
        assert log[-1]["event"] == "failed"
        assert log[-1]["reason"] == row.reason
    assert not [path for path in out.rglob("*.part")]


def test_a_survey_that_cannot_fit_does_not_start(
    surveys: tuple[Path, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    out = tmp_path / "out"
    assert 3e8 < memory_of(surveys) < 1e9
    with monkeypatch.context() as little:
        little.setattr(InProcess, "call_bytes", 1e8)
        notes = Notes()
        (row,) = run_batch(surveys[:1], out, HERE, ALONE, notes)
        assert row.status == "failed" and not notes.messages
        assert "the survey needs about 0.4 GB of memory" in row.reason and "0.1 GB are there" in row.reason
    (row,) = run_batch(surveys[:1], out, HERE, ALONE, Notes(), resume=True)
    assert row.status == "done"


def test_surveys_of_one_name_get_folders_of_their_own(tmp_path: Path) -> None:
    files = [write_observed_survey(tmp_path / folder, "same") for folder in ("a", "b")]
    files.append(write_observed_survey(tmp_path / "c", "logs"))
    notes = Notes()
    rows = run_batch(files, tmp_path / "out", HERE, ALONE, notes)
    assert len({row.folder for row in rows}) == 3
    assert all(row.folder.startswith(("same-", "logs-")) for row in rows)
    assert list(notes.names) == [row.folder for row in rows]
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    for file in files:  # two of one name are told apart by their files
        assert f"<td>{file.relative_to(tmp_path)}</td>" in page


def test_names_that_disks_and_tables_do_not_take_fail_alone(
    surveys: tuple[Path, ...], tmp_path: Path
) -> None:
    long = [
        write_observed_survey(tmp_path / folder, "\N{MATHEMATICAL SCRIPT CAPITAL A}" * 100) for folder in "ab"
    ]
    bad_folder = write_observed_survey(tmp_path / os.fsdecode(b"bad\xff"), "bad")
    bad_photograph = write_photograph_survey(tmp_path / "p", "p")
    (tmp_path / "p" / "photo 1.png").rename(tmp_path / "p" / os.fsdecode(b"photo\xff.png"))
    out = tmp_path / "out"
    rows = run_batch([*long, bad_folder, bad_photograph, surveys[2]], out, HERE, ALONE, Notes())
    assert [row.status for row in rows] == ["done", "done", "failed", "failed", "done"]
    assert rows[2].file == str(tmp_path / r"bad\xff" / "survey.toml")
    assert rows[2].reason.endswith("the path has control or invisible characters; rename the file or folder")
    assert r"'photo\xff.png' has control or invisible characters" in rows[3].reason
    assert "3 of 5 surveys" in (out / "index.html").read_text(encoding="utf-8")


def test_tables_that_cannot_be_read_are_reported_by_their_reader(tmp_path: Path) -> None:
    files = [write_observed_survey(tmp_path / name, name) for name in ("pipe", "folder", "none")]
    for file in files:
        (file.parent / "image_points.csv").unlink()
    os.mkfifo(tmp_path / "pipe" / "image_points.csv")  # whoever opens it waits for ever
    (tmp_path / "folder" / "image_points.csv").mkdir()
    rows = run_batch(files, tmp_path / "out", HERE, ALONE, Notes())
    tables = [file.parent / "image_points.csv" for file in files]
    assert [row.reason for row in rows] == [
        f"{tables[0]}: not a file, a CSV table is needed",
        f"{tables[1]}: not a file, a CSV table is needed",
        f"{tables[2]}: the table cannot be read: No such file or directory",
    ]


def test_photographs_that_are_no_files_are_reported_and_do_not_stop_the_others(tmp_path: Path) -> None:
    survey = write_photograph_survey(tmp_path / "a", "a")
    for number in (1, 2):
        (tmp_path / "a" / f"photo {number}.png").unlink()
    os.mkfifo(tmp_path / "a" / "photo 1.png")
    (tmp_path / "a" / "photo 2.png").symlink_to("nowhere.png")
    (row,) = run_batch([survey], tmp_path / "out", HERE, ALONE, Notes())
    assert (row.status, row.photographs, row.photographs_total) == ("done", 4, 4)
    log = read_log(tmp_path / "out" / "a" / "log.jsonl")
    failed = {one["image"]: one["reason"]["subjects"]["reason"][0] for one in log[-1]["failed_photographs"]}
    assert failed == {
        "photo 1.png": "not a file, a photograph is needed",
        "photo 2.png": f"no such file in {tmp_path / 'a'}",
    }


def test_a_page_that_no_batch_has_written_is_left_alone(surveys: tuple[Path, ...], tmp_path: Path) -> None:
    with pytest.raises(
        OutputError, match=r"a\\xff: the path has control or invisible characters; needed another --out"
    ):
        run_batch(surveys, tmp_path / os.fsdecode(b"a\xff"), HERE, ALONE, Notes())
    (tmp_path / "index.html").write_text("my own", encoding="utf-8")
    with pytest.raises(OutputError, match=r"contains 'index.html'; which would be replaced"):
        run_batch(surveys, tmp_path, HERE, ALONE, Notes())
    (tmp_path / "batch.json").write_text("[]", encoding="utf-8")
    with pytest.raises(OutputError, match=r"contains 'batch.json'; 'index.html'; which would"):
        run_batch(surveys, tmp_path, HERE, ALONE, Notes())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["batch.json", "index.html"]


def test_a_worker_whose_run_is_over_writes_nothing(
    surveys: tuple[Path, ...], finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a cluster, where workers work on when the run that asked was killed and another has begun."""
    out = tmp_path / "out"
    job = SurveyJob(surveys[2], out, "third", "", False, Owner(1, "elsewhere", "2026-01-01T00:00:00+00:00"))
    with (
        locked(out / LOCK),
        pytest.raises(OutputError, match="the run that asked for survey third is over"),
    ):
        reconstruct(job, ALONE, [], send=lambda _: None)
    assert not (out / "logs").exists()
    owners = iter([job.owner, None])  # it ends while the survey is computed
    monkeypatch.setattr("sfm.products.batch.job.owner_of", lambda _: next(owners))
    with pytest.raises(OutputError, match="the run that asked for survey third is over"):
        reconstruct(job, ALONE, [], send=lambda _: None)
    assert {path.name for path in out.iterdir()} == {"logs"}


def test_a_single_run_into_a_folder_of_the_batch_is_not_disturbed(
    surveys: tuple[Path, ...], finished: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    theirs = out / ".third.abcdefgh.part"
    theirs.mkdir(parents=True)
    with locked(out / ".third.lock"):  # as `kolinear adjust --out out/third` holds it
        rows = run_batch([surveys[2], surveys[0]], out, HERE, ALONE, Notes())
    assert [row.status for row in rows] == ["failed", "done"]
    assert rows[0].reason.startswith(f"{out / 'third'}: another run is writing into this folder")
    assert theirs.exists()
    rows = run_batch([surveys[2]], out, HERE, ALONE, Notes(), resume=True)
    assert rows[0].status == "done"
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize(
    ("key", "value", "as_it_was"),
    [
        *(("sigma0_px", float("nan"), False), ("verdict", "splendid", False), ("points", "20", False)),
        *(("survey", 3, False), ("seconds", "x", False), ("survey", "third", True)),
    ],
)
def test_resume_runs_again_what_has_a_log_of_somebody_else(
    surveys: tuple[Path, ...], finished: Path, tmp_path: Path, key: str, value: object, as_it_was: bool
) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished / "third", out / "third")
    log = out / "third" / "log.jsonl"
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    lines[-1][key] = value
    log.write_text("\n".join(json.dumps(line) for line in lines), encoding="utf-8")
    sign(out / "third")
    note_finished(out / "third")
    again = Notes()
    run_batch([surveys[2]], out, HERE, ALONE, again, resume=True)
    assert [(row.status, kept) for row, kept in again.finished_rows] == [("done", as_it_was)]


def sign(folder: Path) -> None:
    """Give a folder the manifest that whoever changed it would give it."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != MANIFEST]
    write_manifest(folder, {path.relative_to(folder).as_posix(): [sha256_of(path)] for path in files})


def test_resume_computes_again_what_came_with_the_survey(surveys: tuple[Path, ...], tmp_path: Path) -> None:
    """A result whose log, inputs and hashes fit, but which no run of this user has finished as it is now."""
    out = tmp_path / "out"
    run_batch([surveys[2]], out, HERE, ALONE, Notes())
    true = (out / "third" / "points.csv").read_bytes()
    (out / "third" / "points.csv").write_bytes(true.replace(b"0.", b"1."))
    sign(out / "third")
    (tmp_path / "moved").mkdir()
    shutil.copytree(out / "third", tmp_path / "moved" / "third")
    for given in (out, tmp_path / "moved"):
        again = Notes()
        run_batch([surveys[2]], given, HERE, ALONE, again, resume=True)
        assert [(row.status, kept) for row, kept in again.finished_rows] == [("done", False)]
        assert len(again.remarks) == 1
        assert again.remarks[0].startswith(f"{given / 'third'}: no run of yours is known to have finished")
        assert (given / "third" / "points.csv").read_bytes() == true
        kept_now = Notes()
        run_batch([surveys[2]], given, HERE, ALONE, kept_now, resume=True)
        assert [kept for _, kept in kept_now.finished_rows] == [True] and not kept_now.remarks


def test_resume_runs_again_what_another_version_has_finished(
    surveys: tuple[Path, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    run_batch([surveys[2]], out, HERE, ALONE, Notes())
    monkeypatch.setattr("sfm.products.batch.job.version", lambda _: "0.0.1")
    again = Notes()
    run_batch([surveys[2]], out, HERE, ALONE, again, resume=True)
    assert [kept for _, kept in again.finished_rows] == [False]


def test_resume_removes_the_log_of_a_run_killed_at_the_last_moment(
    surveys: tuple[Path, ...], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run_batch([surveys[2]], out, HERE, ALONE, Notes())
    (out / "logs").mkdir()
    (out / "logs" / "third.jsonl").write_text('{"time": "", "event": ""}\n', encoding="utf-8")
    run_batch([surveys[2]], out, HERE, ALONE, Notes(), resume=True)
    assert not (out / "logs").exists()


def test_as_many_workers_as_have_something_to_do(surveys: tuple[Path, ...], tmp_path: Path) -> None:
    assert calls_of(surveys) == 6 + 6 + 1
    assert calls_of([tmp_path / "none.toml"]) == 1
    assert 1 <= fitting_workers() <= (os.cpu_count() or 1)
    assert fitting_workers(1e15) == 1


def test_index_escapes_everything() -> None:
    nasty = "\"><script>alert('1')</script>&"
    row = SurveyRow(nasty, nasty, nasty, nasty, nasty, comparison=nasty, reason=nasty)
    for status in ("failed", "done"):
        page = html(batch_page([replace(row, status=status)], nasty))
        assert page.count("<script") == html(batch_page([], "")).count("<script")
        assert 'href="' + nasty not in page


def test_a_second_batch_in_the_same_folder_is_refused(finished: Path, surveys: tuple[Path, ...]) -> None:
    with (
        locked(finished / LOCK),
        pytest.raises(
            OutputError, match=f"another run is writing into this folder .process {os.getpid()} on"
        ),
    ):
        run_batch(surveys, finished, HERE, ALONE, Notes(), resume=True)


def test_a_fault_of_ours_is_a_row_with_a_trace(
    surveys: tuple[Path, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sfm.products.batch.job.run_survey", lambda *_, **__: [][0])
    (row,) = run_batch([surveys[2]], tmp_path / "out", HERE, ALONE, Notes())
    assert row.reason.startswith("a fault of Kolinear: IndexError")
    (log,) = (tmp_path / "out" / "logs").iterdir()
    assert "trace" in read_log(log)[-1]


def test_two_workers_give_the_same_bytes(
    two_workers: DaskEngine, surveys: tuple[Path, ...], finished: Path, tmp_path: Path
) -> None:
    notes = Notes()
    rows = run_batch(surveys, tmp_path / "out", nullcontext(two_workers), ALONE, notes)
    assert [row.status for row in rows] == ["done"] * 3
    assert points_of(tmp_path / "out") == points_of(finished)
    told = [message for name, message in notes.messages if name == "first"]
    assert {"photographs": 6} in told
    assert sum("photograph" in message for message in told) == 6
    assert "adjustment" in [message.get("stage") for message in told]


def test_a_survey_that_kills_workers_is_set_aside(
    two_workers: DaskEngine, surveys: tuple[Path, ...], finished: Path, tmp_path: Path
) -> None:
    killer = write_observed_survey(tmp_path / "killer", KILLER)
    out = tmp_path / "out"
    after = write_observed_survey(tmp_path / "after", "after")
    notes = Notes()
    rows = run_batch([surveys[2], killer, after], out, nullcontext(two_workers), ALONE, notes)
    assert [row.status for row in rows] == ["done", "set aside", "done"]
    assert len(notes.remarks) >= 2 and all(
        "was lost; the others do its work again" in line for line in notes.remarks
    )
    assert "worker processes died" in rows[1].reason and rows[1].fault
    points = points_of(out)
    assert points.keys() == {"third", "after"} and points["third"] == points_of(finished)["third"]
    assert not [path for path in out.iterdir() if path.name.endswith((".part", ".old"))]


def test_an_unforeseen_error_in_a_worker_ends_its_work_alone(two_workers: DaskEngine) -> None:
    works = [
        Work("faulty", (), Call(raise_unforeseen, ())),
        Work("part", (Call(raise_unforeseen, ()),), Call(return_nothing, ())),
        Work("sound", (), Call(return_nothing, ())),
    ]
    events = {event.key: event for event in two_workers.run(works, at_a_time=1)}
    assert events.pop("sound") == Done("sound", None)
    told = "it failed in its worker: ZeroDivisionError: nobody thought of it"
    assert events == {name: Lost(name, told) for name in ("faulty", "part")}


def test_a_result_that_is_lost_with_its_worker_is_tried_again_and_not_the_end_of_the_batch() -> None:
    class LostResult:
        status = "finished"

        def result(self) -> None:
            raise KilledWorker("whole-1", None, 2)

    event = _event("third", LostResult())
    assert isinstance(event, Lost) and event.key == "third" and "worker processes died" in event.reason


def test_a_batch_that_comes_to_nothing_leaves_no_folder(surveys: tuple[Path, ...], tmp_path: Path) -> None:
    @contextmanager
    def absent() -> Iterator[DaskEngine]:
        raise BackendError("nobody there")
        yield

    with pytest.raises(BackendError):
        run_batch(surveys, tmp_path / "out" / "batch", absent(), ALONE, Notes())
    assert not list(tmp_path.iterdir())


def test_a_disk_problem_ends_the_batch_with_one_line(surveys: tuple[Path, ...], tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "logs").write_text("in the way", encoding="utf-8")
    with pytest.raises(OutputError, match="the log cannot be written"):
        run_batch(surveys, tmp_path / "out", HERE, ALONE, Notes())


def test_workers_listen_to_this_computer_only_and_two_batches_do_not_meet(two_workers: DaskEngine) -> None:
    with local_engine(0) as other:
        assert other.client.scheduler.address != two_workers.client.scheduler.address
        own = psutil.Process()
        listening = {
            connection.laddr.ip
            for process in (own, *own.children(recursive=True))
            for connection in process.net_connections()
            if connection.status == psutil.CONN_LISTEN
        }
    assert listening == {"127.0.0.1"}


STRANGER = """
import asyncio, os, pickle, sys
from distributed.core import rpc
from distributed.security import Security

async def knock(address, security):
    server = rpc(address, timeout=10, connection_args=security.get_connection_args("client"))
    try:
        async with asyncio.timeout(20), server:
            print("in", address, (await server.identity())["type"])
            await server.run(function=pickle.dumps(os.getpid))
    except Exception as error:
        print("out", address, type(error).__name__)

async def knock_everywhere(ports):
    own = Security.temporary()
    await asyncio.gather(
        *(knock(f"tcp://127.0.0.1:{port}", Security()) for port in ports),
        *(knock(f"tls://127.0.0.1:{port}", own) for port in ports),
    )

asyncio.run(knock_everywhere(sys.argv[1:]))
"""


def listening_ports() -> set[int]:
    own = psutil.Process()
    return {
        connection.laddr.port
        for process in (own, *own.children(recursive=True))
        for connection in process.net_connections()
        if connection.status == psutil.CONN_LISTEN
    }


def test_a_stranger_on_this_computer_has_no_access_to_scheduler_and_workers(
    two_workers: DaskEngine,
) -> None:
    """Neither without credentials nor with those of another run; who gets in runs any function there."""
    two_workers.client.wait_for_workers(2, timeout=60)  # those that a test before has killed
    known = two_workers.client.scheduler_info()["workers"]
    servers = {two_workers.client.scheduler.address, *known, *(worker["nanny"] for worker in known.values())}
    ports = listening_ports()
    assert len(servers) == 5 and {int(address.rsplit(":", 1)[1]) for address in servers} <= ports
    assert two_workers.client.submit(os.getpid, pure=False).result(timeout=60) != os.getpid()
    stranger = subprocess.run(
        [sys.executable, "-c", STRANGER, *map(str, sorted(ports))],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    words = [line.split()[0] for line in stranger.stdout.splitlines()]
    assert words == ["out"] * (2 * len(ports)), stranger.stdout + stranger.stderr
    assert two_workers.client.submit(os.getpid, pure=False).result(timeout=60) != os.getpid()


def test_workers_show_no_pages_and_keep_their_files_to_this_user(two_workers: DaskEngine) -> None:
    shown = []
    two_workers.client.wait_for_workers(2, timeout=60)
    assert len(listening_ports()) == 5  # of the scheduler, two workers, and of who starts them again
    for port in listening_ports():
        for page in ("", "health", "metrics", "sitemap.json", "json/counts.json", "info/main/workers.html"):
            with suppress(OSError, HTTPException), urlopen(f"http://127.0.0.1:{port}/{page}", timeout=5):
                shown.append(f"{port}/{page}")
    assert not shown
    for folder in two_workers.client.run(lambda dask_worker: dask_worker.local_directory).values():
        above = next(path for path in Path(folder).parents if path.name.startswith("kolinear-"))
        assert above.stat().st_mode & 0o077 == 0


def test_dask_says_nothing_by_itself(two_workers: DaskEngine) -> None:
    """A scheduler that dies would be a traceback of its client, beside our own line."""
    own = [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]
    assert "distributed.client" in own
    assert not [name for name in own if logging.getLogger(name).isEnabledFor(logging.ERROR)]


def test_libraries_get_their_threads_back_from_the_last_call() -> None:
    def threads() -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    held = _OneThread()
    with threadpool_limits(2):
        with ExitStack() as first, ExitStack() as second:  # as two threads of one worker
            first.enter_context(held)
            second.enter_context(held)
            first.close()
            assert threads() == {1}
        assert threads() == {2}


@pytest.mark.parametrize(
    ("address", "told"),
    [("nonsense", "missing port number"), ("tcp://127.0.0.1:1", "within"), ("bar://x:1", "unknown address")],
)
def test_nobody_at_the_address_of_a_cluster_is_known_at_once(
    address: str, told: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("adapters.dask_cluster.CONNECT_SECONDS", 0.5)
    begun = time.perf_counter()
    with pytest.raises(BackendError, match=f"--cluster {address}: no Dask scheduler answers.*{told}"):
        remote_engine(address, "--cluster")
    gc.collect()  # what is not done with says so when it is thrown away
    assert time.perf_counter() - begun < 10  # it was 30 s and more
    assert capfd.readouterr().err == ""


def test_an_address_that_the_encryption_of_dask_refuses_is_one_line() -> None:
    address = "tcp://127.0.0.1:1"
    with (
        dask.config.set({"distributed.comm.require-encryption": True}),
        pytest.raises(
            BackendError, match=f"--cluster {address}: no Dask scheduler answers.*encryption required"
        ),
    ):
        remote_engine(address, "--cluster")


@pytest.mark.parametrize("written", [None, "no certificate"])
def test_a_certificate_that_cannot_be_read_is_named(written: str | None, tmp_path: Path) -> None:
    certificate = tmp_path / "cert.pem"
    if written is not None:
        certificate.write_text(written, encoding="utf-8")
    with (
        dask.config.set(
            {f"distributed.comm.tls.{key}": str(certificate) for key in ("ca-file", "client.cert")}
        ),
        pytest.raises(BackendError, match="a certificate of Dask's configuration cannot be read") as error,
    ):
        remote_engine("tls://127.0.0.1:1", "--cluster")
    assert str(certificate) in str(error.value)


@pytest.mark.parametrize("lacking", ["scheduler", "worker"])
def test_a_cluster_without_kolinear_is_one_line(lacking: str, tmp_path: Path) -> None:
    file = tmp_path / "scheduler.json"
    options = ["--no-dashboard", "--scheduler-file", str(file)]

    def start(part: str, *more: str) -> subprocess.Popen[bytes]:
        hidden = "sys.modules['adapters'] = None; " if part == lacking else ""
        program = f"import sys; {hidden}from distributed.cli.dask_{part} import main; main()"
        command = [sys.executable, "-c", program, "--host", "127.0.0.1", *options, *more]
        return subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)

    running = [start("scheduler", "--port", "0")]
    try:
        while not file.exists():
            assert running[0].poll() is None
            time.sleep(0.1)
        address = json.loads(file.read_text(encoding="utf-8"))["address"]
        if lacking == "worker":
            running.append(start("worker", "--no-nanny", "--nthreads", "1"))
            with Client(address, set_as_default=False) as client:
                client.wait_for_workers(1, timeout=60)
        with (
            pytest.raises(BackendError, match="scheduler and workers of a cluster need Kolinear") as error,
            remote_engine(address, "--cluster"),
        ):
            pass
        assert "\n" not in str(error.value) and "adapters" in str(error.value)
    finally:
        for process in reversed(running):
            process.terminate()
            process.wait(timeout=20)


@pytest.mark.slow
def test_a_scheduler_started_separately_gives_the_same_bytes(
    surveys: tuple[Path, ...], finished: Path, tmp_path: Path
) -> None:
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker"]
    address = tmp_path / "scheduler.json"
    running = [
        subprocess.Popen(
            [*dask, "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(address)],
            cwd=ROOT,
            stderr=subprocess.DEVNULL,
        )
    ]
    try:
        while not address.exists():
            time.sleep(0.1)
        scheduler = json.loads(address.read_text(encoding="utf-8"))["address"]
        running.append(
            subprocess.Popen(
                [*worker, scheduler, "--nworkers", "2", "--nthreads", "1", "--no-dashboard"],
                cwd=ROOT,
                stderr=subprocess.DEVNULL,
            )
        )
        with remote_engine(scheduler, "--cluster") as engine:
            engine.client.wait_for_workers(2, timeout=60)
            assert engine.workers == 2
            rows = run_batch(surveys, tmp_path / "out", nullcontext(engine), ALONE, Notes())
        assert [row.status for row in rows] == ["done"] * 3
        assert points_of(tmp_path / "out") == points_of(finished)
    finally:
        for process in reversed(running):
            process.terminate()
            process.wait(timeout=20)


def test_the_remarks_of_a_batch_name_its_surveys() -> None:
    def row(name: str, status: str = "done", **other: str) -> SurveyRow:
        return SurveyRow(name, f"{name}.toml", name, status, **other)  # type: ignore[arg-type]

    rows = [
        row("a", verdict="good"),
        row("b", verdict="fair", comparison="differs"),
        row("c", verdict="bad"),
        row("d", "failed"),
        row("e", "set aside"),
    ]
    remarks = batch_remarks(rows)
    assert [(one.kind, *one.names("how"), one.names("surveys")) for one in remarks] == [
        ("surveys_failed", "failed", ("d",)),
        ("surveys_failed", "set aside", ("e",)),
        ("surveys_not_dependable", ("c",)),
        ("surveys_with_warnings", ("b",)),
    ]
    assert kinds_of(batch_remarks(rows[:1])) == ()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Seconds that time.monotonic tells."""
    now = [100.0]
    monkeypatch.setattr("sfm.products.batch.table.time.monotonic", lambda: now[0])
    return now


def seen(table: BatchTable) -> str:
    """Return the table as it is drawn now."""
    console = Console(file=io.StringIO(), width=110)
    console.print(table._render())
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_stage_photographs_and_time_left_are_seen(clock: list[float]) -> None:
    expected = {"targets": 30.0, "adjustment": 40.0, "report": 30.0}
    work = Extent(("targets",), 4, 2.0)
    RunHistory.of_user().add(Run(work, {**expected, "targets": 30.0 / cores()}))
    table = BatchTable(Console(file=io.StringIO(), force_terminal=True))
    table.planned({"a": work, "b": work}, 1)
    assert "0 of 2 surveys, 0:03:20 to the end" in seen(table)
    table.received("a", {"photographs": 4})
    clock[0] += 5  # no worker has time for it, and its own has not begun
    line = next(line for line in seen(table).splitlines() if line.startswith("a "))
    assert line.split() == ["a", "waiting", "0", "of", "4"]
    clock[0] -= 5
    for k in range(4):  # as fast as expected
        table.received("a", {"photograph": f"{k}.jpg", "seconds": 7.5, "stored": False})
    assert "targets" in seen(table)
    clock[0] += 30
    assert "0:02:50 to the end" in seen(table)
    table.received("a", {"stage": "adjustment", "before": 0.0})
    clock[0] += 10
    line = next(line for line in seen(table).splitlines() if line.startswith("a "))
    assert line.split() == ["a", "adjustment", "4", "of", "4", "40"]
    assert "0:02:40 to the end" in seen(table)
    row = SurveyRow("plate", "a.toml", "a", "done", "good", 0.05, 0.04, 4, 4, 9, seconds=200.0)
    table.finished("a", row, kept=False)
    assert "1 of 2 surveys, 0:03:20 to the end" in seen(table)  # as long as the one that is finished
    assert seen(table).splitlines()[1].startswith("a ")  # by the name that it had while it ran
    table.finished("b", SurveyRow("plate", "b.toml", "b", "failed", reason="no"), kept=False)
    assert "2 of 2 surveys, 1 failed" in seen(table) and "to the end" not in seen(table)


def test_compiling_is_reported_once(clock: list[float]) -> None:
    file = io.StringIO()
    table = BatchTable(Console(file=file, width=200))
    table.planned({"a": None, "b": None}, 1)
    for name in ("a", "b"):
        table.received(name, {"compiling": True})
    assert file.getvalue().count("kernels are compiled first") == 1
