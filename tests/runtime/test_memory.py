"""Memory that a process has taken, may take, and can still take."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sfm.runtime import memory

TAKES = """
import numpy
from sfm.runtime.memory import peak_bytes
before = peak_bytes()
taken = numpy.ones(20_000_000)
most = peak_bytes()
del taken
print(before, most, peak_bytes())
"""


@pytest.mark.skipif(not memory.STATUS.exists(), reason="the system does not state it")
def test_the_peak_is_that_of_the_process_itself() -> None:
    """Not of the one that started it, as the kernel's resource usage of a process is."""
    of_parent = np.ones(60_000_000)
    done = subprocess.run([sys.executable, "-c", TAKES], capture_output=True, text=True, check=True)
    before, most, after = map(float, done.stdout.split())
    assert 150e6 < most - before < 200e6 and most < of_parent.nbytes
    assert after == pytest.approx(most, abs=2e6)  # the kernel counts in pages of several kinds


def test_memory_is_what_the_system_and_its_groups_leave(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    meminfo, status, group = tmp_path / "meminfo", tmp_path / "status", tmp_path / "groups" / "job" / "step"
    monkeypatch.setattr(memory, "MEMINFO", meminfo)
    monkeypatch.setattr(memory, "STATUS", status)
    monkeypatch.setattr(memory, "GROUPS", tmp_path / "groups")
    monkeypatch.setattr(memory, "OF_PROCESS", tmp_path / "cgroup")
    whole = memory.limit_bytes()
    assert 1e8 < whole < 1e15 and memory.within_bytes() == whole and memory.peak_bytes() == 0.0
    meminfo.write_text("MemTotal: 16000 kB\nMemAvailable:   8000 kB\nSwapFree:  1000 kB\n")
    status.write_text("Name:\tpython\nVmHWM:\t  600 kB\nVmRSS:\t  500 kB\n")
    assert memory.within_bytes() == 9500 * 1024 and memory.peak_bytes() == 600 * 1024
    group.mkdir(parents=True)
    (tmp_path / "cgroup").write_text("0::/job/step\n")
    (group.parent / "memory.max").write_text("max\n")
    assert memory.within_bytes() == 9500 * 1024 and memory.limit_bytes() == whole
    (group.parent / "memory.max").write_text("3000000\n")
    (group.parent / "memory.current").write_text("2900000\n")
    assert memory.limit_bytes() == 3e6 and memory.within_bytes() == 1e5 + 500 * 1024
    (group.parent / "memory.stat").write_text("anon 1\ninactive_file 1000000\nactive_file 700000\n")
    assert memory.within_bytes() == 1.8e6 + 500 * 1024  # copies of files make room


def test_a_system_that_states_nothing_has_no_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MEMINFO", "STATUS", "GROUPS", "OF_PROCESS"):
        monkeypatch.setattr(memory, name, tmp_path / "none")
    monkeypatch.setattr(memory, "resource", None)
    monkeypatch.delattr(memory.os, "sysconf")
    assert memory.limit_bytes() == memory.within_bytes() == math.inf and memory.peak_bytes() == 0.0
