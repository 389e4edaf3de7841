"""Helmert blocks in the workers of a Dask cluster: the same to the last bit, whatever dies meanwhile."""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import distributed.system
import numpy as np
import pytest

import sfm
from adapters.dask_cluster import DaskEngine, local_engine, remote_engine
from sfm.adjustment.engine.solvers import choice
from sfm.adjustment.engine.solvers.helmert import HelmertSolver
from sfm.adjustment.result import Adjustment
from sfm.model.conventions import FloatArray
from sfm.model.errors import BackendError, KolinearError
from sfm.products.batch.job import SurveyRow
from sfm.products.batch.run import run_batch
from sfm.runtime.executor import Blocking, Call, Keeper, KeptHere, in_blocks
from tests.commands import kolinear, refused
from tests.engines import ALONE, HERE, Notes, points_of
from tests.places import ROOT
from tests.surveys import observed_text, write_image_points, write_observed_survey
from tests.synthetic_blocks import aerial, run, spoiled, unordered

OF_LENS = """\
name = "A"
size_px = [2000, 1500]
pixel_mm = [0.005, 0.005]
c_mm = 10.0
fixed = {K1 = -1e-4}
"""
THIRD = 3  # factor at which something dies: amid the iteration


@pytest.fixture(scope="module")
def two_workers() -> Iterator[DaskEngine]:
    with local_engine(2) as engine:
        yield engine


def adjusted(keeper: Keeper, blocks: int) -> Adjustment:
    network, truth = aerial("on dask", 6, 14, 1200)
    with in_blocks(Blocking(keeper, blocks)):
        return run(network, spoiled(truth, "on dask", 0.02))


def bits(a: Adjustment) -> tuple[bytes, ...]:
    return a.estimate.points.tobytes(), a.covariance.points.tobytes(), a.covariance.exterior.tobytes()


def at_third_factor(patch: pytest.MonkeyPatch, happens: Callable[[], None]) -> None:
    """Let something happen when the normal equations are formed and not yet reduced."""
    factor, count = HelmertSolver._factor_with, 0

    def factor_with(solver: HelmertSolver, *arguments: Any) -> object:
        nonlocal count
        count += 1
        if count == THIRD:
            happens()
        return factor(solver, *arguments)

    patch.setattr(HelmertSolver, "_factor_with", factor_with)


def test_two_workers_give_the_bits_of_this_process(
    two_workers: DaskEngine, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Also if one of them is killed amid the iteration, which a line says."""
    here = bits(adjusted(KeptHere(), 2))
    assert bits(adjusted(two_workers, 2)) == here
    assert capfd.readouterr().err == ""
    pids: dict[str, int] = two_workers.client.run(os.getpid)
    victim = min(pids)
    at_third_factor(monkeypatch, lambda: os.kill(pids[victim], signal.SIGKILL))
    assert bits(adjusted(two_workers, 2)) == here
    said = capfd.readouterr().err.splitlines()
    assert said == [f"worker {victim} was lost; the others do its work again"]


def test_an_error_in_a_block_is_raised_here(two_workers: DaskEngine) -> None:
    with pytest.raises(ZeroDivisionError):
        two_workers.fetch([Call(divmod, (1, 0))])
    (kept,) = two_workers.keep([Call(divmod, (7, 2))])
    assert two_workers.fetch([Call(sum, (kept,))]) == [4]


def test_workers_of_this_computer_share_its_memory() -> None:
    """Fewer of them have more each."""
    with local_engine(1) as engine:
        assert engine.call_bytes == distributed.system.MEMORY_LIMIT


def test_blocks_that_cannot_be_are_refused() -> None:
    with pytest.raises(KolinearError, match="helmert_blocks: neither blocks, cluster nor workers"):
        sfm.helmert_blocks()
    with pytest.raises(KolinearError, match="blocks 0, expected at least 1"):
        sfm.helmert_blocks(0)
    with pytest.raises(KolinearError, match="workers are processes on this computer"):
        sfm.helmert_blocks(workers=2, cluster="tcp://127.0.0.1:1")


def test_a_cluster_is_asked_from_a_notebook_and_named_as_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """The cells of a notebook run within an event loop."""
    monkeypatch.setattr("adapters.dask_cluster.CONNECT_SECONDS", 0.5)

    async def cell() -> None:
        with sfm.helmert_blocks(cluster="tcp://127.0.0.1:1"):
            pass

    with pytest.raises(
        BackendError, match=r"^helmert_blocks: cluster tcp://127\.0\.0\.1:1: no Dask scheduler"
    ):
        asyncio.run(cell())


@pytest.mark.parametrize(
    ("network", "blocks", "messages_seconds", "how"),
    [
        ("aerial", None, choice.MESSAGES_SECONDS, "here, since its steps take less time than the messages"),
        ("aerial", None, 0.0, "in 2 Helmert blocks"),
        ("aerial", 1, 0.0, "here, since one block is the whole network"),
        ("around", None, 0.0, "here, since it has no small separator"),
    ],
)
def test_a_line_says_how_the_largest_network_was_adjusted(
    two_workers: DaskEngine,
    network: str,
    blocks: int | None,
    messages_seconds: float,
    how: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(choice, "MESSAGES_SECONDS", messages_seconds)
    monkeypatch.setattr("adapters.dask_cluster.local_engine", lambda _: nullcontext(two_workers))
    small, of_small = aerial("small", 2, 3, 60)
    observed, truth = (
        aerial("on dask", 6, 14, 1200) if network == "aerial" else unordered("no separator", 70, 300, 20)
    )
    with sfm.helmert_blocks(blocks, workers=2):
        run(observed, truth, covariance=False)
        run(small, of_small, covariance=False)
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"the network of {len(observed.images)} photographs is adjusted {how}")


@pytest.mark.slow
def test_a_script_that_starts_workers_while_it_is_imported_is_told_why(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text("import sfm\nwith sfm.helmert_blocks(workers=1):\n    pass\n", encoding="utf-8")
    ended = subprocess.run(
        [sys.executable, str(script)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ended.returncode != 0
    assert 'a script must start them under if __name__ == "__main__":' in ended.stderr


@pytest.mark.slow
def test_a_cluster_that_does_not_answer_is_one_line_and_leaves_no_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    survey = write_observed_survey(tmp_path / "survey", "survey")
    out = tmp_path / "out"
    line = refused(capsys, "adjust", survey, "--out", out, "--cluster", "tcp://127.0.0.1:1")
    assert "--cluster tcp://127.0.0.1:1: no Dask scheduler answers" in line
    assert not out.exists()


@pytest.mark.slow
def test_four_workers_give_the_bits_of_this_process() -> None:
    here = bits(adjusted(KeptHere(), 4))
    with local_engine(4) as engine:
        assert bits(adjusted(engine, 4)) == here


@pytest.mark.slow
def test_a_survey_may_be_given_a_cluster(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is divided among the workers if it is large enough, and a line says which."""
    network, _ = aerial("given a cluster", 4, 12, 800, tilt=0.2, hills=20.0)
    survey = tmp_path / "survey" / "survey.toml"
    survey.parent.mkdir()
    survey.write_text(observed_text("survey", "m", OF_LENS), encoding="utf-8")
    write_image_points(network, survey.parent / "image_points.csv")
    with scheduler_and_workers(tmp_path) as (address, _), remote_engine(address, "--cluster") as engine:
        engine.client.wait_for_workers(2, timeout=60)
        said = {}
        for name, seconds in (("here", choice.MESSAGES_SECONDS), ("there", 0.0)):
            monkeypatch.setattr(choice, "MESSAGES_SECONDS", seconds)
            capsys.readouterr()
            kolinear("adjust", survey, "--out", tmp_path / name, "--cluster", address)
            lines = capsys.readouterr().err.splitlines()
            (said[name],) = (line for line in lines if line.startswith("the network of"))
    assert "is adjusted here, since its steps take less time than the messages of blocks" in said["here"]
    assert said["there"] == "the network of 48 photographs is adjusted in 2 Helmert blocks"
    points = [read_points(tmp_path / folder / "points.csv") for folder in ("here", "there")]
    assert np.allclose(*points, rtol=0, atol=1e-5)  # m; the last digits written


def read_points(file: Path) -> FloatArray:
    """Return the coordinates of a table of object points."""
    table = np.genfromtxt(file, delimiter=",", names=True, usecols=("X", "Y", "Z"))
    return np.stack([table[name] for name in ("X", "Y", "Z")], axis=1)


@contextmanager
def scheduler_and_workers(folder: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A scheduler and two workers in processes of their own; yield its address and process."""
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)

    def start(module: str, *options: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{module}", *options]
        return subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)

    no_pages = "--no-dashboard"
    running = [
        start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", no_pages, "--scheduler-file", str(file))
    ]
    try:
        while not file.exists():
            time.sleep(0.1)
        address = json.loads(file.read_text(encoding="utf-8"))["address"]
        local = "--local-directory", str(folder)
        running.append(start("dask_worker", address, "--nworkers", "2", "--nthreads", "1", no_pages, *local))
        yield address, running[0]
    finally:
        for process in reversed(running):
            process.kill() if process is running[0] else process.terminate()
            process.wait(timeout=20)


@pytest.mark.slow
def test_a_scheduler_that_is_killed_is_one_line_and_starting_again_gives_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = bits(adjusted(KeptHere(), 2))
    with (
        scheduler_and_workers(tmp_path) as (address, scheduler),
        remote_engine(address, "--cluster") as engine,
    ):
        engine.client.wait_for_workers(2, timeout=60)
        at_third_factor(monkeypatch, scheduler.kill)
        with pytest.raises(BackendError) as error:
            adjusted(engine, 2)
    assert "\n" not in str(error.value)
    assert "the Dask scheduler is gone" in str(error.value)
    assert "run again, the result will be the same" in str(error.value)
    with scheduler_and_workers(tmp_path) as (address, _), remote_engine(address, "--cluster") as engine:
        engine.client.wait_for_workers(2, timeout=60)
        assert bits(adjusted(engine, 2)) == here


@pytest.mark.slow
def test_a_worker_that_dies_of_a_block_again_and_again_is_one_line(two_workers: DaskEngine) -> None:
    with pytest.raises(BackendError, match="worker processes died, out of memory or by a fault"):
        two_workers.fetch([Call(signal.raise_signal, (signal.SIGKILL,))])


@pytest.mark.slow
def test_after_the_scheduler_of_a_batch_is_killed_a_resumed_batch_ends_with_the_same_results(
    tmp_path: Path,
) -> None:
    surveys = [write_observed_survey(tmp_path / f"s{k}", f"s{k}") for k in range(3)]
    run_batch(surveys, tmp_path / "undisturbed", HERE, ALONE, Notes())
    out = tmp_path / "out"

    class Killing(Notes):
        """Kills the scheduler once the first survey is finished."""

        def finished(self, name: str, row: SurveyRow, *, kept: bool) -> None:
            super().finished(name, row, kept=kept)
            scheduler.kill()

    with (
        scheduler_and_workers(tmp_path) as (address, scheduler),
        remote_engine(address, "--cluster") as engine,
    ):
        engine.client.wait_for_workers(2, timeout=60)
        with pytest.raises(
            BackendError, match=r"the Dask scheduler is gone; run again with --resume|dropped"
        ):
            run_batch(surveys, out, nullcontext(engine), ALONE, Killing())
    assert 1 <= len(points_of(out)) < 3
    again = Notes()
    with scheduler_and_workers(tmp_path) as (address, _), remote_engine(address, "--cluster") as engine:
        engine.client.wait_for_workers(2, timeout=60)
        rows = run_batch(surveys, out, nullcontext(engine), ALONE, again, resume=True)
    assert [row.status for row in rows] == ["done"] * 3
    assert {kept for _, kept in again.finished_rows} == {False, True}
    assert points_of(out) == points_of(tmp_path / "undisturbed")


class Scheduler:
    """What a client says of its workers: their status, and whether they have work."""

    def __init__(self, workers: dict[str, str], busy: set[str], status: str = "running") -> None:
        self.workers, self.busy, self.status = workers, busy, status

    def scheduler_info(self, *, n_workers: int) -> dict[str, Any]:
        assert n_workers == -1  # of all workers, not of the first five
        return {"workers": {address: {"status": status} for address, status in self.workers.items()}}

    def processing(self) -> dict[str, tuple[str, ...]]:
        return {address: ("call",) if address in self.busy else () for address in self.workers}


@pytest.mark.parametrize(
    ("workers", "busy", "message"),
    [
        ({"a": "paused", "b": "running"}, {"b"}, ""),
        ({"a": "paused", "b": "paused"}, {"a", "b"}, "their memory is full, and nothing more can be moved"),
        ({"a": "paused", "b": "running"}, {"a"}, "no worker of the cluster has worked for 60 s"),
        ({}, set(), "has had no worker for 60 s"),
    ],
)
def test_workers_that_are_full_are_waited_for_a_minute(
    monkeypatch: pytest.MonkeyPatch, workers: dict[str, str], busy: set[str], message: str
) -> None:
    """A worker whose memory and disk are full is paused: it keeps its work, and does not begin it."""
    now = 100.0
    monkeypatch.setattr("adapters.dask_cluster.time.monotonic", lambda: now)
    engine = DaskEngine(Scheduler(workers, busy))  # type: ignore[arg-type]
    works = not message
    assert engine._last_seen(now - 59.0, "again") == (now if works else now - 59.0)
    if works:
        assert engine._last_seen(now - 61.0, "again") == now
        return
    with pytest.raises(BackendError, match=message):
        engine._last_seen(now - 61.0, "again")


def test_a_call_may_take_the_memory_of_the_largest_worker() -> None:
    scheduler = Scheduler({}, set())
    engine = DaskEngine(scheduler)  # type: ignore[arg-type]
    limits: list[int | None] = []
    scheduler.scheduler_info = lambda n_workers: {  # type: ignore[method-assign, misc, assignment]
        "workers": {str(k): {"memory_limit": limit} for k, limit in enumerate(limits)}
    }
    for limits[:], expected in (([], math.inf), ([2, 3], 3.0), ([2, 0], math.inf), ([2, None], math.inf)):
        assert engine.call_bytes == expected


def test_a_scheduler_that_does_not_answer_is_gone_at_once() -> None:
    closed = DaskEngine(Scheduler({"a": "running"}, {"a"}, "closed"))  # type: ignore[arg-type]
    with pytest.raises(BackendError, match="the Dask scheduler is gone; run it again"):
        closed._last_seen(time.monotonic(), "run it again")
    silent = Scheduler({"a": "running"}, {"a"})
    silent.processing = lambda: (_ for _ in ()).throw(OSError())  # type: ignore[method-assign]
    with pytest.raises(BackendError, match="the Dask scheduler is gone; run it again"):
        DaskEngine(silent)._last_seen(time.monotonic(), "run it again")  # type: ignore[arg-type]
