"""Freed memory: what a thread has freed is taken by the others."""

from __future__ import annotations

import subprocess
import sys

import pytest

THREADS, ARRAYS, MB = 6, 8, 8
IN_TURN = f"""
from pathlib import Path
from threading import Event, Thread
import numpy as np
from sfm.kernels.threads import keep_freed_memory
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
