"""The live table of a batch, as it is seen."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from sfm.batch.job import SurveyRow
from sfm.batch.table import BatchTable


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Seconds that time.monotonic tells."""
    now = [100.0]
    monkeypatch.setattr("sfm.batch.table.time.monotonic", lambda: now[0])
    return now


def seen(table: BatchTable) -> str:
    """Return the table as it is drawn now."""
    console = Console(file=io.StringIO(), width=110)
    console.print(table._render())
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_stage_photographs_and_time_left_are_seen(clock: list[float]) -> None:
    table = BatchTable(Console(file=io.StringIO(), force_terminal=True))
    table.planned(["a", "b"])
    assert "0 of 2 surveys" in seen(table) and "left" not in seen(table)
    table.received("a", {"photographs": 4})
    clock[0] += 5  # no worker has time for it, and its own has not begun
    line = next(line for line in seen(table).splitlines() if line.startswith("a "))
    assert line.split() == ["a", "waiting", "0", "of", "4"]
    clock[0] -= 5
    table.received("a", {"photograph": "1.jpg"})
    assert "targets" in seen(table)
    table.received("a", {"photograph": "2.jpg"})
    clock[0] += 10
    # Half of its photographs are a quarter of one survey of two: an eighth of the batch took 10 s.
    assert "about 1 min 10 s left" in seen(table)
    table.received("a", {"stage": "adjustment"})
    line = next(line for line in seen(table).splitlines() if line.startswith("a "))
    assert line.split() == ["a", "adjustment", "2", "of", "4", "10"]
    table.finished("a", SurveyRow("plate", "a.toml", "a", "done", "good", 0.05, 0.04, 4, 4, 9), kept=False)
    assert "1 of 2 surveys, about 10 s left" in seen(table)
    assert seen(table).splitlines()[1].startswith("a ")  # by the name that it had while it ran
    table.finished("b", SurveyRow("plate", "b.toml", "b", "failed", reason="no"), kept=False)
    assert "2 of 2 surveys, 1 failed" in seen(table) and "left" not in seen(table)


def test_compiling_is_reported_once(clock: list[float]) -> None:
    file = io.StringIO()
    table = BatchTable(Console(file=file, width=200))
    table.planned(["a", "b"])
    for name in ("a", "b"):
        table.received(name, {"compiling": True})
    assert file.getvalue().count("kernels are compiled first") == 1
