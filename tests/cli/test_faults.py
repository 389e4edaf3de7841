"""Faults from outside: kill -9, full disks, read-only folders, locks left behind, damaged stores."""

from __future__ import annotations

import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import fields
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sfm.files.open_folders import locked, owner_of
from sfm.files.whole_files import remove_leftovers
from sfm.model.errors import FolderInUseError, OutputError
from sfm.report.output import SurveyLog, read_log
from sfm.survey.inputs.settings import TargetSettings
from sfm.survey.measuring.measured_store import TARGETS, TEXTURE, MeasuredStore, measured_key
from sfm.survey.measuring.targets import target_settings
from sfm.targets.codes.plates import code_family
from sfm.targets.detect import Targets, find_targets
from tests.engines import PLOTLESS, points_of
from tests.places import ROOT
from tests.surveys import pictures, write_observed_survey, write_photograph_survey

KOLINEAR = [sys.executable, "-c", "from sfm.cli import main; main()"]
SMALL_FILE_BYTES = 30_000  # largest file of the tests with a full disk


def kolinear(*arguments: object, limit: int | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command; with a limit no file can become larger, which is how a full disk shows."""

    def full_disk() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return subprocess.run(
        [sys.executable, "-c", PLOTLESS, *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=900,
        preexec_fn=full_disk,
        check=False,
    )


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.exists() else set()


def kill_and_resume(surveys: list[Path], out: Path, *, kills: int, seed: int) -> int:
    """Run a batch, kill its whole process group at random moments, resume until done; return the kills.

    Checks after every kill that no survey's folder is half there, and that what was finished stays untouched.
    """
    rng = random.Random(seed)
    command = [*KOLINEAR, "batch", *map(str, surveys), "--out", str(out), "--resume", "--jobs", "2"]
    finished: dict[str, int] = {}
    killed = 0
    while True:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            start_new_session=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            if killed < kills:
                # Early and late moments alike: while workers start, while they measure, while they write.
                moment = rng.uniform(1.0, 9.0)
                process.wait(timeout=moment)
            else:
                process.wait(timeout=600)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            killed += 1
        _, told = process.communicate()
        for path in out.glob("*/points.csv"):
            folder = path.parent
            if folder.name.startswith("."):
                continue
            assert {"report.html", "summary.json", "log.jsonl", "points.ply"} <= names_in(folder)
            assert json.loads((folder / "summary.json").read_text(encoding="utf-8"))["converged"]
            number = finished.setdefault(folder.name, folder.stat().st_ino)
            assert folder.stat().st_ino == number, f"{folder.name} was done twice"
        if process.returncode >= 0:
            assert process.returncode == 0, told
            if killed >= kills or len(finished) == len(surveys):
                return killed


@pytest.mark.slow
def test_killed_batch_ends_with_the_same_results(tmp_path: Path) -> None:
    surveys = [write_observed_survey(tmp_path / f"s{k}", f"s{k}") for k in range(2)]
    surveys.append(write_photograph_survey(tmp_path / "s2", "s2"))
    undisturbed, disturbed = tmp_path / "undisturbed", tmp_path / "disturbed"
    assert kolinear("batch", *surveys, "--out", undisturbed, "--jobs", 2).returncode == 0
    kill_and_resume(surveys, disturbed, kills=1, seed=1)
    assert points_of(disturbed) == points_of(undisturbed)
    assert names_in(disturbed) == names_in(undisturbed)


@pytest.mark.slow
def test_batch_of_ten_survives_twenty_kills(tmp_path: Path) -> None:
    surveys = [write_photograph_survey(tmp_path / f"s{k}", f"s{k}", backend="colmap") for k in range(10)]
    undisturbed, disturbed = tmp_path / "undisturbed", tmp_path / "disturbed"
    assert kolinear("batch", *surveys, "--out", undisturbed, "--jobs", 2).returncode == 0
    killed, rounds = 0, 0
    while killed < 20:  # all ten may be finished before the last kill: then another ten begin
        shutil.rmtree(disturbed, ignore_errors=True)
        killed += kill_and_resume(surveys, disturbed, kills=20 - killed, seed=rounds)
        rounds += 1
        assert points_of(disturbed) == points_of(undisturbed)
        assert names_in(disturbed) == names_in(undisturbed)
        assert names_in(disturbed / "logs") == set()
    print(f"{killed} kills in {rounds} rounds")


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "batch"])
def test_after_a_full_disk_there_is_room_again_and_the_result_is_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """What the first run measured and could keep is read again."""
    survey = write_photograph_survey(tmp_path / "s", "s")

    def run(out: str, cache: str, *options: object, limit: int | None = None) -> int:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / cache))
        folder = tmp_path / out / "s" if command == "run" else tmp_path / out
        return kolinear(command, survey, "--out", folder, "--jobs", 1, *options, limit=limit).returncode

    assert run("undisturbed", "cache") == 0
    assert run("disturbed", "other", limit=SMALL_FILE_BYTES) == 2
    assert points_of(tmp_path / "disturbed") == {}
    assert run("disturbed", "other", *(["--resume"] if command == "batch" else [])) == 0
    assert points_of(tmp_path / "disturbed") == points_of(tmp_path / "undisturbed") != {}
    assert names_in(tmp_path / "disturbed") == names_in(tmp_path / "undisturbed")


@pytest.mark.parametrize(
    ("command", "left"),
    [
        (("adjust", "--out", "out/s"), set()),
        pytest.param(("batch", "--jobs", 1, "--out", "out"), {"logs"}, marks=pytest.mark.slow),
    ],
)
def test_full_disk_is_one_line_and_leaves_nothing(
    tmp_path: Path, command: tuple[object, ...], left: set[str]
) -> None:
    survey = write_observed_survey(tmp_path / "s", "s", backend="colmap")
    *options, out = command
    run = kolinear(*options, tmp_path / str(out), survey, limit=SMALL_FILE_BYTES)
    assert run.returncode == 2, run.stderr
    assert re.fullmatch(r"kolinear: .*(cannot be written|File too large).*\n", run.stderr)
    assert run.stdout == ""
    assert names_in(tmp_path / "out") == left
    for log in (tmp_path / "out").glob("logs/*"):
        assert read_log(log)[-1]["event"] == "failed"


def test_read_only_folder_is_one_line(tmp_path: Path) -> None:
    survey = write_observed_survey(tmp_path / "s", "s")
    out = tmp_path / "out"
    out.mkdir(mode=0o555)
    command = [sys.executable, "-c", PLOTLESS, "adjust", str(survey), "--out", str(out / "s")]
    if os.geteuid() == 0:  # for whom folders are writable all the same
        setpriv = shutil.which("setpriv")
        if setpriv is None:
            pytest.skip("run by root, and there is no setpriv to give up the right to write everywhere")
        command = [setpriv, "--bounding-set=-dac_override", *command]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900, check=False)
    assert run.returncode == 2, run.stderr
    assert run.stderr.count("\n") == 1, run.stderr
    assert "Permission denied" in run.stderr
    assert names_in(out) == set()


def test_lock_tells_its_owner_and_is_free_after_death(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "lock"
    hold = (
        "import sys, time; from pathlib import Path; from sfm.files.open_folders import locked\n"
        f"with locked(Path({str(path)!r})): print('held', flush=True); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", hold], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    with (
        pytest.raises(
            OutputError, match=f"another run is writing into this folder .process {process.pid} on"
        ),
        locked(path),
    ):
        pass
    process.kill()
    process.communicate()
    assert path.exists()  # left behind, and recognised as such:
    with locked(path) as before:
        assert before is not None
        assert before.process == process.pid
    assert not path.exists()
    path.touch()  # as where an open file cannot be removed
    with locked(path) as before:
        assert before is None
    (tmp_path / "file").touch()
    assert owner_of(path) is None
    with locked(path, tmp_path / "out"):
        held = owner_of(path)
        assert held is not None
        assert held.process == os.getpid()
        with (
            pytest.raises(FolderInUseError, match=f"^{tmp_path / 'out'}: another run"),
            locked(path, tmp_path / "out"),
        ):
            pass
    with pytest.raises(OutputError, match="the lock cannot be written"), locked(tmp_path / "file" / "lock"):
        pass


def test_leftovers_are_removed_and_an_earlier_result_comes_back(tmp_path: Path) -> None:
    out = tmp_path / "name[1]"
    old = tmp_path / ".name[1].abcdefgh.old"
    (old / "result").mkdir(parents=True)
    (old / "result" / "summary.json").write_text("{}", encoding="utf-8")
    (tmp_path / ".name[1].rst_vw01.part" / "plots").mkdir(parents=True)
    (tmp_path / ".other.rst_vw01.part").mkdir()
    remove_leftovers(out)
    assert names_in(tmp_path) == {"name[1]", ".other.rst_vw01.part"}
    assert names_in(out) == {"summary.json"}


@pytest.fixture(scope="module")
def targets() -> Targets:
    return find_targets(np.rint(pictures()[0]).astype(np.uint8), polarity="dark", codes="ring14")


def test_store_gives_back_what_it_was_given(tmp_path: Path, targets: Targets) -> None:
    store = MeasuredStore(tmp_path / "store")
    assert store.load("a" * 64, TARGETS) is None
    store.save("a" * 64, targets)
    back = store.load("a" * 64, TARGETS)
    assert back is not None
    for field in fields(Targets):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(targets, field.name))
        assert getattr(back, field.name).dtype == getattr(targets, field.name).dtype
    (entry,) = (tmp_path / "store").rglob("*.npz")
    part, young = entry.parent / ".x.npz.abcdefgh.part", entry.parent / ".y.npz.abcdefgh.part"
    for folder in (part, young):
        folder.mkdir()
    other = entry.with_name("other.npz")
    other.touch()
    long_ago = time.time() - 100 * 86400
    for path in (part, entry, other):
        os.utime(path, (long_ago, long_ago))
    assert store.load("a" * 64, TARGETS) is not None  # which is asked for again by that
    store.remove_old()
    assert names_in(entry.parent) == {entry.name, young.name}


def test_damaged_store_is_measured_again(tmp_path: Path, targets: Targets) -> None:
    store = MeasuredStore(tmp_path)
    store.save("b" * 64, targets)
    (entry,) = tmp_path.rglob("*.npz")
    whole = entry.read_bytes()
    for damaged in (
        whole[:-100],
        whole[:200],
        b"",
        b"PK" + bytes(1000),
        whole[:60] + b"\xff" * 40 + whole[100:],
    ):
        entry.write_bytes(damaged)
        assert store.load("b" * 64, TARGETS) is None
    packed = {f.name: getattr(targets, f.name) for f in fields(Targets)}
    np.savez_compressed(entry, allow_pickle=False, **{**packed, "xy": np.zeros((10**6, 2))})
    assert store.load("b" * 64, TARGETS) is None  # a packed entry is not ours
    np.savez(entry, allow_pickle=False, **{**packed, "xy": np.zeros((3, 2))})
    assert store.load("b" * 64, TARGETS) is None
    np.savez(entry, allow_pickle=False, **{**packed, "xy": np.float64(1.0)})
    assert store.load("b" * 64, TARGETS) is None
    np.savez(entry, allow_pickle=True, **{**packed, "xy": np.array([print], dtype=object)})
    assert store.load("b" * 64, TARGETS) is None  # nothing is unpickled


def test_store_that_cannot_be_written_is_no_error(tmp_path: Path, targets: Targets) -> None:
    (tmp_path / "file").touch()
    MeasuredStore(tmp_path / "file").save("c" * 64, targets)
    assert MeasuredStore(tmp_path / "file").load("c" * 64, TARGETS) is None


def test_key_depends_on_content_settings_and_codes(tmp_path: Path) -> None:
    for name, data in (("a.png", b"1"), ("b.png", b"1"), ("c.png", b"2")):
        (tmp_path / name).write_bytes(data)
    plain, light = TargetSettings(), TargetSettings(polarity="bright")
    ring, arcs = code_family("ring14"), code_family("arcs")
    settings = [target_settings(*of) for of in ((plain, ring), (light, ring), (plain, arcs), (plain, None))]
    keys = [measured_key(tmp_path / "a.png", TARGETS, one) for one in settings]
    keys.append(measured_key(tmp_path / "c.png", TARGETS, settings[0]))
    keys.append(measured_key(tmp_path / "a.png", TEXTURE, settings[0]))
    assert len(set(keys)) == len(keys)
    assert measured_key(tmp_path / "b.png", TARGETS, settings[0]) == keys[0]


def test_a_full_disk_is_reported_by_the_log_with_its_name(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("this system has no disk that is always full")
    path = tmp_path / "log.jsonl"
    with (
        pytest.raises(OutputError, match=f"^{path}: the log cannot be written: No space left"),
        SurveyLog(path, append=True) as log,
        open("/dev/full", "w") as full,
    ):
        os.dup2(full.fileno(), log._file.fileno())
        log.note("start")


def test_log_of_a_killed_run_can_be_read(tmp_path: Path) -> None:
    with SurveyLog(tmp_path / "log.jsonl") as log:
        log.stage("targets", 2)
        log.advance("a")
        log.advance("b")
        log.stage("targets", 2)
        log.stage("orientation")
        log.end_stage()
    text = (tmp_path / "log.jsonl").read_text(encoding="utf-8")
    (tmp_path / "log.jsonl").write_text(text + '{"time": "2026', encoding="utf-8")
    entries = read_log(tmp_path / "log.jsonl")
    assert [(entry["stage"], entry.get("steps")) for entry in entries] == [
        ("targets", 2),
        ("orientation", None),
    ]


def test_interrupted_batch_stops_cleanly(tmp_path: Path) -> None:
    surveys = [write_photograph_survey(tmp_path / f"s{k}", f"s{k}") for k in range(2)]
    out = tmp_path / "out"
    process = subprocess.Popen(
        [*KOLINEAR, "batch", *map(str, surveys), "--out", str(out), "--jobs", "2"],
        cwd=ROOT,
        start_new_session=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # else ignored in the background
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    until = time.monotonic() + 300
    while not list((out / "logs").glob("*.jsonl")) and time.monotonic() < until:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # as Ctrl-C does: every process of the group gets it
    told, errors = process.communicate(timeout=300)
    assert process.returncode == 130, errors
    assert errors.splitlines()[-1].startswith("kolinear: interrupted")
    assert "Traceback" not in errors
    assert told == ""
    assert not [name for name in names_in(out) if name.endswith((".part", ".old"))]
