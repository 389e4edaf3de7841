"""Long runs of batches: memory that they leave, throughput, the largest photographs."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest

from adapters.dask_cluster import DaskEngine, local_engine
from sfm.products.batch.job import SurveyJob, reconstruct
from sfm.products.batch.run import run_batch
from sfm.runtime.executor import Call, Done, Send, Work
from sfm.runtime.progress import SILENT, StageClock
from tests.engines import ALONE, Notes, points_of
from tests.places import ROOT
from tests.surveys import write_observed_survey, write_photograph_survey


def _own_objects() -> Counter[str]:
    """Count the objects of our own types and numpy's; libraries keep blocks of their own as they like."""
    gc.collect()
    types = [type(one) for one in gc.get_objects()]
    return Counter(
        f"{one.__module__}.{one.__qualname__}"
        for one in types
        if str(one.__module__).partition(".")[0] in ("adapters", "numpy", "sfm")
    )


@pytest.mark.slow
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


@pytest.mark.slow
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


MIB = 2**20
LIMIT_MIB = 1536  # for a photograph of 100 megapixels
SIDES = (11_600, 8_700)
MEASURE = """
import re, sys
from pathlib import Path
from sfm.targets.detect import find_targets
from sfm.photographs.exif import read_metadata
from sfm.photographs.reading import read_photograph
path = Path(sys.argv[1])
read_metadata(path)
found = find_targets(read_photograph(path), codes="ring14")
# The peak that getrusage tells begins with that of the process which started this one.
print(len(found), int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) // 1024)
"""


@contextmanager
def timed(seconds: list[float]) -> Iterator[None]:
    begun = time.perf_counter()
    yield
    seconds.append(time.perf_counter() - begun)


@pytest.mark.slow
def test_two_workers_do_at_least_one_and_a_half_times_the_work_of_one(tmp_path: Path) -> None:
    """50 surveys of 6 photographs; the time is that of the batch, without the start of the workers."""
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("two cores are needed")
    surveys = [write_photograph_survey(tmp_path / f"s{k}", f"s{k}", backend="colmap") for k in range(50)]
    seconds: list[float] = []
    for workers in (1, 2):
        with local_engine(workers) as engine:
            first = [surveys[0]]  # imports and kernels
            run_batch(first, tmp_path / f"warm{workers}", nullcontext(engine), ALONE, Notes())
            with timed(seconds):
                rows = run_batch(surveys, tmp_path / f"out{workers}", nullcontext(engine), ALONE, Notes())
        assert all(row.status == "done" for row in rows)
    print(f"{seconds[0]:.1f} s with one worker, {seconds[1]:.1f} s with two: {seconds[0] / seconds[1]:.2f}")
    assert points_of(tmp_path / "out1") == points_of(tmp_path / "out2")
    assert seconds[0] >= 1.6 * seconds[1]


class _Memory(Notes):
    """Remembers how much memory the workers and this process hold after each survey, MiB."""

    def __init__(self, workers: list[int]) -> None:
        super().__init__()
        self.workers = workers
        self.mib: list[float] = []

    def finished(self, name: str, row: object, *, kept: bool) -> None:
        processes = [psutil.Process(), *(psutil.Process(pid) for pid in self.workers)]
        self.mib.append(sum(process.memory_info().rss for process in processes) / MIB)


@pytest.mark.slow
def test_batch_of_500_does_not_grow(tmp_path: Path) -> None:
    surveys = [write_observed_survey(tmp_path / f"s{k}", f"s{k}") for k in range(500)]
    with local_engine(2) as engine:
        memory = _Memory(list(engine.client.run(os.getpid).values()))
        run_batch(surveys, tmp_path / "out", nullcontext(engine), ALONE, memory)
    early, late = np.median(memory.mib[50:100]), np.median(memory.mib[-50:])
    print(
        f"{early:.0f} MiB after 50 to 100 surveys, {late:.0f} MiB after 450 to 500, {max(memory.mib):.0f} top"
    )
    assert late - early < 30  # of three processes


@pytest.mark.slow
@pytest.mark.parametrize(("suffix", "bits"), [(".jpg", 8), (".tif", 16)])
@pytest.mark.parametrize("clutter", [False, True])
def test_100_megapixels_stay_under_one_and_a_half_gib(
    tmp_path: Path, suffix: str, bits: int, clutter: bool
) -> None:
    width, height = SIDES
    tile = np.full((300, 300), 200.0)
    cv2.circle(tile, (150, 150), 24, 40.0, -1, cv2.LINE_AA)
    rng = np.random.default_rng(1)
    if clutter:
        tile += cv2.GaussianBlur(rng.normal(0, 300, tile.shape), (0, 0), 2.0)
    picture = np.tile(tile, (height // 300, width // 300 + 1))[:, :width]
    for row in range(0, len(picture), 100):
        picture[row : row + 100] += rng.normal(0, 2, picture[row : row + 100].shape)
    grey = np.clip(picture, 0, 255)
    path = tmp_path / f"large{suffix}"
    cv2.imwrite(str(path), grey.astype(np.uint8) if bits == 8 else (grey * 200).astype(np.uint16))
    del picture, grey
    run = subprocess.run(
        [sys.executable, "-c", MEASURE, str(path)], cwd=ROOT, capture_output=True, text=True, check=True
    )
    count, mib = (int(word) for word in run.stdout.split())
    print(f"{suffix}, clutter {clutter}: {count} targets, {mib} MiB")
    assert clutter or count > 900
    assert mib < LIMIT_MIB
