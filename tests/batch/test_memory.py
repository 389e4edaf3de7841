"""Memory left by a batch: objects and blocks that Python keeps, counted, not estimated."""

from __future__ import annotations

import gc
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from adapters.dask_cluster import DaskEngine, local_engine
from sfm.batch.job import SurveyJob, reconstruct
from sfm.runtime.executor import Call, Done, Send, Work
from sfm.runtime.progress import SILENT, StageClock
from tests.engines import ALONE
from tests.surveys import write_observed_survey


def _own_objects() -> Counter[str]:
    """Count the objects of our own types and numpy's; libraries keep blocks of their own as they like."""
    gc.collect()
    types = [type(one) for one in gc.get_objects()]
    return Counter(
        f"{one.__module__}.{one.__qualname__}"
        for one in types
        if str(one.__module__).partition(".")[0] in ("adapters", "numpy", "sfm")
    )


def test_surveys_leave_nothing_behind(tmp_path: Path, plots: None) -> None:
    """After the first, which fills the caches, every survey ends with the objects it began with."""
    held = []
    for k in range(3):
        file = write_observed_survey(tmp_path / f"s{k}", f"s{k}")
        job = SurveyJob(file, tmp_path / "out", f"s{k}", "inputs", allow_outside=False, owner=None)
        assert reconstruct(job, ALONE, [], send=lambda _: None).status == "done"
        held.append(_own_objects())
    assert held[2] - held[1] == Counter()


def _wander(parts: list[object], *, send: Send) -> int:
    """Work for a quarter of a second at ever new depths; return the blocks of memory that Python holds."""

    def deeper(left: int) -> None:
        if left:
            deeper(left - 1)
        else:
            time.sleep(0.002)

    rng = np.random.default_rng()
    begun = time.monotonic()
    while time.monotonic() - begun < 0.25:
        deeper(int(rng.integers(20, 200)))
    gc.collect()
    return sys.getallocatedblocks()


def _nothing(parts: list[object], *, send: Send) -> None:
    """Return at once."""


@pytest.fixture(scope="module")
def one_worker() -> Iterator[DaskEngine]:
    with local_engine(1) as engine:
        yield engine


def test_workers_do_not_remember_what_they_did(one_worker: DaskEngine) -> None:
    works = [Work(str(k), (), Call(_wander, ())) for k in range(12)]
    blocks = [event.value for event in one_worker.run(works, at_a_time=2) if isinstance(event, Done)]
    # 30,000 more with samples of the stacks, 1500 without
    assert max(blocks[-3:]) - min(blocks[3:6]) < 10_000


def test_the_scheduler_does_not_remember_surveys(one_worker: DaskEngine) -> None:
    """Names of letters alone are those that it took for kinds of work of their own, and kept."""
    for name in ("hall", "roof", "wall"):
        list(one_worker.run([Work(name, (), Call(_nothing, ()))], at_a_time=1))
    kinds = one_worker.client.run_on_scheduler(lambda dask_scheduler: list(dask_scheduler.task_prefixes))
    assert kinds == ["whole"]


@pytest.mark.skipif(sys.platform != "linux", reason="only glibc can be asked")
def test_what_a_stage_has_freed_is_given_back() -> None:
    def resident() -> int:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf(
            "SC_PAGE_SIZE"
        )

    with StageClock(SILENT).stage("some"):
        pieces = [b"x" * (100_000 + k) for k in range(1000)]
        kept = pieces[-1]  # behind all others, so that the heap cannot shrink by itself
        full = resident()
        del pieces
    assert resident() < full - 80_000_000
    assert len(kept) == 100_999
