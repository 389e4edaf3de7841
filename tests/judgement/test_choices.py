"""Choices of model: candidates are solved, and the likeliest is taken."""

from __future__ import annotations

import pytest

from sfm.errors import GeometryError
from sfm.judgement.choices import Choice, choose


def solve(model: float) -> float:
    if model < 0:
        raise GeometryError("no solution")
    return model


def test_the_model_with_most_evidence_is_taken_if_it_pays_its_price() -> None:
    def choice(price: float) -> Choice[float, float]:
        return Choice(lambda _: [1.0, 3.0, 2.0], lambda before, after: after - before - price)

    assert choose(0.5, [choice(2.0)], solve) == 3.0
    assert choose(0.5, [choice(3.0)], solve) == 0.5


def test_a_choice_begins_with_what_the_one_before_took() -> None:
    seen: list[float] = []

    def doubled(present: float) -> list[float]:
        seen.append(present)
        return [2 * present]

    row: Choice[float, float] = Choice(doubled, report=lambda before, chosen: chosen + before / 10)
    assert choose(1.0, [row, row], solve) == pytest.approx(4.41)
    assert seen == [1.0, pytest.approx(2.1)]


def test_what_suffices_ends_the_search() -> None:
    tried: list[float] = []

    def counted(model: float) -> float:
        tried.append(model)
        return model

    row: Choice[float, float] = Choice(
        lambda _: [1.0, 2.0, 3.0], lambda before, after: after - before, suffices=lambda it: it >= 2
    )
    assert choose(0.0, [row], counted) == 2.0 and tried == [1.0, 2.0]


def test_a_model_without_solution_is_passed_over_unless_a_test_has_decided_on_it() -> None:
    open_row: Choice[float, float] = Choice(lambda _: [-1.0, 1.0], lambda before, after: after - before)
    assert choose(0.0, [open_row], solve) == 1.0
    with pytest.raises(GeometryError, match="no solution"):
        choose(0.0, [Choice(lambda _: [-1.0])], solve)
