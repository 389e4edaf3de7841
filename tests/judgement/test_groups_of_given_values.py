"""Given values beside one another: sets that may be wrong, their costs, and scales."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sfm.conventions import FloatArray
from sfm.judgement.given import values as given_values
from sfm.judgement.given.scales import Scales, common_scale
from sfm.judgement.given.values import GivenModel, Judgement, judge_values, misfit_of
from sfm.similarity import Similarity
from tests.synthetic import seed_of


def bars(*v: float, stated: float = 1.0, network: float = 0.0) -> GivenModel:
    """Return the model of bars with these differences, of variances stated and network."""
    n = len(v)
    free = network * np.eye(n)
    return GivenModel(np.array(v), free, stated * np.eye(n), np.ones((n, 1)), np.arange(n), 500)


@pytest.mark.parametrize(("n", "every"), [(55, True), (75, False)])
def test_all_pairs_of_some_dozen_values_are_tried(n: int, every: bool) -> None:
    """1,485 pairs are, of 2,775 only those that differ in one value from the pair that was found."""
    model = bars(*seed_of("all pairs").normal(size=n))
    sets = [some for some, _ in given_values._misfits_like(model, (1, 2))]
    assert len(set(sets)) == (n * (n - 1) // 2 if every else 2 * (n - 2) + 1)


def test_the_best_pair_of_many_replaces_one_that_was_found_value_by_value() -> None:
    """Of 12 bars: two that hide one another; the pair with the least misfit is the pair."""
    one = bars(*(30.0, -30.0), *seed_of("hidden pair").normal(size=10))
    sets = given_values._sets(one, np.log(12))
    chi2 = {some: one.kept(some).chi2 for some in combinations(range(12), 2)}
    assert sets[1].values == min(chi2, key=lambda some: chi2[some]) == (0, 1)


def test_the_misfit_of_a_judgement_counts_its_errors() -> None:
    """Of wrong values chi-square of the others, with the cost of each error and of their choice."""
    one = bars(0.0, 300.0, 0.5, -200.0, 1.0, -0.5)
    found = judge_values(one, 1e-3)
    assert found.wrong == (1, 3)
    rest = np.array([0.0, 0.5, 1.0, -0.5])
    chi2 = ((rest - rest.mean()) ** 2).sum()
    fall = one.kept().chi2 - chi2
    cost = np.log(6) + 2 * (1 + np.log(fall / 2)) + 2 * np.log(15)
    assert misfit_of(one, found) == pytest.approx(chi2 + cost)
    right = Judgement(7.0, 5, 0.2, score=-3.0)
    assert misfit_of(one, right) == right.misfit == 4.0
    unknown = replace(one, estimated=True, extent=100.0)
    worst = (given_values.MAX_FACTOR * given_values.UNSTATED_FRACTION * 100.0) ** 2
    v = one.v - one.v.mean()
    assert misfit_of(unknown, right) == pytest.approx((v**2).sum() / worst)


def test_costs_of_parameters_and_of_scatter() -> None:
    assert given_values.cost_of_parameter(1) == given_values.cost_of_parameter(2) == pytest.approx(np.log(2))
    assert given_values.cost_of_parameter(9) == pytest.approx(np.log(9))
    assert given_values.cost_of_scatter(3, 30.0, 9) == pytest.approx(np.log(9) + 3 * (1 + np.log(10)))
    assert given_values.cost_of_scatter(3, 2.0, 9) == pytest.approx(np.log(9) + 3)
    assert given_values.cost_of_scatter(0, 0.0, 9) == pytest.approx(np.log(9))


def test_a_judgement_is_explained_by_errors_or_a_factor() -> None:
    plain = Judgement(9.0, 3, 0.02)
    assert plain.explained and not replace(plain, doubtful=(1,)).explained
    assert replace(plain, doubtful=(1,), score=-1.0).explained
    some = replace(plain, wrong=(1,), factor=3.0, score=-4.0, one_wrong=True).contradicted((0, 2))
    assert (some.wrong, some.factor, some.score, some.doubtful, some.one_wrong) == (
        (),
        1.0,
        0.0,
        (0, 2),
        False,
    )
    assert (some.statistic, some.dof) == (9.0, 3)


def test_a_part_that_may_fit_is_not_excluded_by_the_test_of_all() -> None:
    """Three tests share the level: chi-square of four degrees of freedom at a third of it."""
    one = bars(0.0, 1.0, -1.0, 2.0, -2.0, 9.0).kept()
    limit = stats.chi2.isf(1e-3 / 3, 4)
    assert one.may_fit(1e-3, one.chi2 - 0.999 * limit, 1) and not one.may_fit(
        1e-3, one.chi2 - 1.01 * limit, 1
    )
    assert one.may_fit(1e-3, 2 * one.chi2, 1)
    unknown = replace(one, model=replace(one.model, estimated=True))
    assert unknown.may_fit(1e-3, 0.0, 1)


def test_as_many_wrong_as_right_values_are_not_told_apart() -> None:
    """Others that are confirmed count among those who agree."""
    two = bars(0.0, 0.0, 50.0, 90.0)
    assert judge_values(two, 1e-3).wrong == ()
    found = given_values._wrong_values(replace(two, confirmed=1), 1e-3, np.log(4))
    assert found is not None and found.values == (2, 3)
    assert given_values._wrong_values(two, 1e-3, np.log(4)) is None


@pytest.mark.parametrize(("scatter", "fits"), [(0.1, True), (1.3, True), (4.0, False)])
def test_unknown_standard_deviations_are_at_most_2_percent_of_the_extent(scatter: float, fits: bool) -> None:
    """Ten times the swelling of paper, whatever single values say of one another."""
    v = scatter * seed_of("unknown scatter").normal(size=12)
    model = replace(bars(*v, network=1e-6), stated=np.zeros((12, 12)), estimated=True, extent=100.0)
    assert model.fits(1e-3) == fits


def test_the_factor_is_bounded_by_an_order_of_magnitude() -> None:
    """And not that of two values, one of which may be wrong."""
    rng = seed_of("order of magnitude")
    few, many = (judge_values(bars(*(f * rng.normal(size=40))), 1e-3) for f in (6.0, 30.0))
    assert few.factor == pytest.approx(6.0, rel=0.3) and not few.doubtful
    assert many.factor == 1.0 and len(many.doubtful) == 40


def scaled(kinds: list[Any], by_scale: list[float], v: list[float]) -> Scales | None:
    """Return the common scale of observations that depend on it as stated."""
    n = len(v)
    A = np.zeros((n, 7))
    A[:, 6] = by_scale
    model = GivenModel(np.array(v), np.zeros((n, n)), np.eye(n), A, np.arange(n), 100)
    weights: list[FloatArray] = []

    def compare(*_: object) -> Any:
        return SimpleNamespace(size=2.0)

    reference: Any = SimpleNamespace(differences=lambda *_: (model, None), compare=compare)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "sfm.judgement.given.scales.scales_of", lambda _, __, ___, by: weights.append(by) or "scale"
        )
        found = common_scale(reference, kinds, Similarity(1.0, np.eye(3), np.zeros(3)), without=(2,))
    if found is not None:
        A_kept = A[[0, 1]] if n > 2 else A
        np.testing.assert_allclose((weights[0] * 2.0)[0, : len(A_kept)] @ A_kept[:, 6], 1.0)
        assert n < 3 or weights[0][0, 2] == 0
    return found


def test_observations_without_a_scale_give_none() -> None:
    assert scaled([], [1.0], [0.0]) is None
    assert scaled(["angles"], [0.0, 0.0], [0.1, 0.2]) is None
    assert scaled(["distances"], [1.0, 2.0], [0.1, 0.2]) == "scale"
    assert scaled(["distances"], [1.0, 2.0, 5.0], [0.1, 0.2, 9.0]) == "scale"
    assert scaled(["one distance, left out"], [0.0, 0.0, 5.0], [0.1, 0.2, 9.0]) is None
