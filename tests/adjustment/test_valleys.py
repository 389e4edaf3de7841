"""When an iteration follows a bent valley, and when it trusts the reduced matrix of the step before."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.engine import iterate as iteration
from sfm.adjustment.engine.iterate import Move, iterate

PROBLEM: Any = SimpleNamespace(layout=None, solver=SimpleNamespace(has_coarse=False))
MOVE = Move(np.ones(2), np.zeros((1, 3)), 1.0, 1.0)


def taken(ratio: float) -> Any:
    """Return a step with |A dx| so many times |v|."""
    return SimpleNamespace(
        within=lambda share: ratio <= share,
        move=lambda: MOVE,
        reduced=MOVE.reduced,
        points=MOVE.points,
        factor="factor",
        motions=None,
        equations=SimpleNamespace(vPv=1.0),
    )


def patched(monkeypatch: pytest.MonkeyPatch, **parts: object) -> None:
    for name, part in {"step": lambda *_: None, "total": lambda *_: 1.0, **parts}.items():
        monkeypatch.setattr(iteration, name, part)


@pytest.mark.parametrize(("share", "followed"), [(0.2, True), (0.3, False)])
def test_a_valley_is_bent_where_a_quarter_of_a_step_is_too_long(
    share: float, followed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, along = iter([taken(1.0), None, taken(0.0)]), []
    patched(
        monkeypatch,
        _solve=lambda *_, **__: next(steps),
        _line_search=lambda *_: (None, share),
        _along_valley=lambda *_: along.append(True),
    )
    iterate(PROBLEM, None, np.ones(1))  # type: ignore[arg-type]
    assert bool(along) == followed


@pytest.mark.parametrize(("ratio", "tried"), [(0.7, True), (0.95, False)])
def test_a_factor_is_used_again_once_steps_become_shorter(
    ratio: float, tried: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, last = iter([taken(ratio), taken(0.0)]), []

    def solve(*_: object, **parts: object) -> object:
        last.append(parts["last"])
        return next(steps)

    patched(monkeypatch, _solve=solve)
    iterate(PROBLEM, None, np.ones(1), exact=False)  # type: ignore[arg-type]
    assert (last[1] == "factor") == tried


def test_the_bottom_of_a_valley_is_reached_in_three_steps_or_not(monkeypatch: pytest.MonkeyPatch) -> None:
    heights = []

    def solve(*_: object) -> object:
        heights.append(0.1 ** len(heights))
        return SimpleNamespace(
            vPv=heights[-1],
            factor=SimpleNamespace(solve=lambda along: along),
            motions=SimpleNamespace(transform=lambda z, Z: (z, Z)),
            equations=SimpleNamespace(point_step=lambda _: np.zeros((1, 3))),
            reduced=np.ones(2),
            points=np.zeros((1, 3)),
        )

    patched(monkeypatch, _solve=solve, total=lambda *_: float("inf"))
    assert iteration._along_valley(PROBLEM, None, np.ones(1), MOVE, 0.1) is None  # type: ignore[arg-type]
    assert len(heights) == 3
