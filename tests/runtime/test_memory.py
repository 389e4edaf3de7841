"""Memory that a process has taken, may take, and can still take."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from sfm.runtime import memory


def test_the_peak_covers_what_was_taken() -> None:
    taken = np.ones(25_000_000)
    assert memory.peak_bytes() > taken.nbytes
    before = memory.peak_bytes()
    del taken
    assert memory.peak_bytes() >= before


def test_memory_is_what_the_system_and_its_groups_leave(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    meminfo, most, used = (tmp_path / name for name in ("meminfo", "memory.max", "memory.current"))
    monkeypatch.setattr(memory, "MEMINFO", meminfo)
    monkeypatch.setattr(memory, "LIMITS", ((tmp_path / "none", tmp_path / "neither"), (most, used)))
    whole = memory.limit_bytes()
    assert 1e8 < whole < 1e15 and memory.left_bytes() == whole
    meminfo.write_text("MemTotal: 16000 kB\nMemAvailable:   8000 kB\nSwapFree:  1000 kB\n")
    assert memory.left_bytes() == 9000 * 1024
    most.write_text("max\n")
    used.write_text("1000000\n")
    assert memory.limit_bytes() == whole and memory.left_bytes() == 9000 * 1024
    most.write_text("3000000\n")
    assert memory.limit_bytes() == 3e6 and memory.left_bytes() == 2e6
    used.write_text("4000000\n")
    assert memory.left_bytes() == 0.0
    used.unlink()
    assert memory.left_bytes() == 3e6
    meminfo.write_text("MemTotal: 1 kB\n\n")
    assert memory.left_bytes() == 3e6


def test_a_system_that_states_nothing_has_no_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "LIMITS", ())
    monkeypatch.setattr(memory, "MEMINFO", tmp_path / "none")
    monkeypatch.setattr(memory, "resource", None)
    monkeypatch.delattr(memory.os, "sysconf")
    assert memory.limit_bytes() == memory.left_bytes() == math.inf and memory.peak_bytes() == 0.0
