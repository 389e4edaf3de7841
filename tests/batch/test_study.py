"""Long studies of batches: throughput, memory that does not grow, and the largest photographs."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest

from adapters.dask_cluster import local_engine
from sfm.batch.run import run_batch
from tests.engines import ALONE, Notes, points_of
from tests.places import ROOT
from tests.surveys import write_observed_survey, write_photograph_survey

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
