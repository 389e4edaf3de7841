"""Memory that a process has taken and that the system can give it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from sfm.runtime import memory


def test_the_peak_covers_what_was_taken() -> None:
    taken = np.ones(25_000_000)
    assert memory.peak_mb() > taken.nbytes / 1e6
    before = memory.peak_mb()
    del taken
    assert memory.peak_mb() >= before


def test_memory_is_what_the_system_or_its_group_leaves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    meminfo = tmp_path / "meminfo"
    monkeypatch.setattr(memory, "MEMINFO", meminfo)
    monkeypatch.setattr(memory, "CGROUP", tmp_path)
    assert memory.available_mb() == math.inf
    meminfo.write_text("MemTotal: 16000000 kB\nMemAvailable:   8000000 kB\nSwapFree:  1000000 kB\n")
    assert memory.available_mb() == pytest.approx(9216.0)
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text("1000000000\n")
    assert memory.available_mb() == pytest.approx(9216.0)
    (tmp_path / "memory.max").write_text("3000000000\n")
    assert memory.available_mb() == pytest.approx(2000.0)
    meminfo.write_text("MemTotal: 1 kB\n\n")
    assert memory.available_mb() == pytest.approx(2000.0)
