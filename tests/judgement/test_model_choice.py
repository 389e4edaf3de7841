"""Choices of model: candidates are solved, and the likeliest is taken."""

from __future__ import annotations

import math

import pytest

from sfm.judgement.model_choice import Choice, choose, solve_likeliest
from sfm.model.errors import GeometryError


def solve(model: float) -> float:
    if model < 0:
        raise GeometryError("no solution")
    return model


def gained(before: float, after: float) -> float:
    return after - before


@pytest.mark.parametrize(("alternatives", "behind"), [(1, 1), (3, 1), (3, 20)])
def test_further_parameters_and_the_search_have_a_price(alternatives: int, behind: int) -> None:
    """Two parameters of 50 image points: ln 100; a wrong choice in 1 of 100: ln 100 and the alternatives."""
    price = 2 * math.log(100.0) + math.log(alternatives * behind)

    def taken(gain: float, false_alarm: float = 0.05) -> bool:
        models = [gain, *[0.0] * (alternatives - 1)]
        row = Choice[float, float](lambda _: models, gained, lambda _, __: [(2, 50)], behind=behind)
        return choose(0.0, [row], solve, false_alarm=false_alarm) == gain

    assert taken(price + 0.1) and not taken(price - 0.1)
    assert not taken(price + 0.1, false_alarm=0.005)


def test_the_better_solution_of_the_same_model_has_no_price() -> None:
    row = Choice[float, float](lambda _: [1.0, 3.0, 2.0], gained)
    assert choose(2.9, [row], solve) == 3.0 and choose(3.1, [row], solve) == 3.1


def test_another_model_is_taken_where_the_usual_one_has_no_solution() -> None:
    row = Choice[float, float | None](
        lambda before: [2.0] if before is None else [], lambda before, _: float(before is None)
    )
    assert solve_likeliest(-1.0, [row], solve) == 2.0 and solve_likeliest(1.0, [row], solve) == 1.0
    with pytest.raises(GeometryError, match="no solution"):
        solve_likeliest(-1.0, [Choice[float, float | None](lambda _: [-2.0], lambda _, __: 1.0)], solve)


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


@pytest.mark.parametrize(("onward", "taken"), [(True, 3.0), (False, 0.0)])
def test_a_solution_that_is_not_taken_may_suggest_the_next_model(onward: bool, taken: float) -> None:
    """From 0 over 1 and 2, which do not fit, to 3, which does."""
    row: Choice[float, float] = Choice(
        lambda present: [present + 1] if present < 5 else [],
        lambda _, after: math.inf if after == 3 else -math.inf,
        onward=onward,
    )
    assert choose(0.0, [row], solve) == taken
