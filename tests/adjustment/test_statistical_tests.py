"""Tests and reliability of a finished adjustment on numbers done by hand."""

from __future__ import annotations

from inspect import unwrap
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sfm.adjustment.quality import statistics
from sfm.adjustment.quality import statistics as numbers
from sfm.adjustment.quality.statistics import (
    CoordinateTest,
    component_tests,
    correlations,
    global_test,
    more_than_chance,
    non_centrality,
    reliability,
    robust_test,
    significance,
    tau_test,
    w_test,
)
from sfm.adjustment.quality.variance_components import IMAGE_POINTS
from sfm.model.distributions import Levels, level_of_single
from tests.synthetic import make_network, seed_of


def stub(**parts: Any) -> Any:
    return SimpleNamespace(**parts)


def test_far_more_than_expected_is_twice_and_not_by_chance() -> None:
    def far(beyond: int, tested: int) -> bool:
        return CoordinateTest(0.001, 3.29, np.zeros((0, 2)), tested, beyond).far_more

    assert CoordinateTest(0.01, 3.29, np.zeros((0, 2)), 500, 3).expected == pytest.approx(5.0)
    assert not far(4, 1000) and not far(5, 1000)  # of 1 expected 5 come in 1 of 270 cases
    assert far(6, 1000)  # 1 of 1700
    assert not far(200, 100_000) and far(201, 100_000)


def test_groups_with_more_events_than_chance_makes() -> None:
    """The others have a share of (8 + 1) / (80 + 2); each of five is tested at a fifth of the level."""
    trials = np.full(5, 20)
    events = np.array([9, 2, 2, 2, 2])
    p = stats.binom.sf(8, 20, 9 / 82)
    assert more_than_chance(events, trials, 5.1 * p).tolist() == [True, False, False, False, False]
    assert not more_than_chance(events, trials, 4.9 * p).any()
    assert not more_than_chance(np.zeros(5, dtype=int), trials, 0.99).any()


@pytest.mark.parametrize("stated", [0.2, 1.0, 5.0])
def test_the_robust_test_needs_no_stated_standard_deviation(stated: float) -> None:
    w = np.random.default_rng(5).standard_normal((2000, 2))
    w[:100] += 50.0
    a = stub(standardised=stated * w, redundancy_numbers=np.ones((2000, 2)), is_exact=False, levels=Levels())
    found = robust_test(a)
    assert found.tested == 4000 and 200 <= found.beyond <= 210  # 3.8 by chance
    a.is_exact = True  # residuals are rounding
    assert robust_test(a).beyond == 0


def test_the_robust_test_takes_its_scale_from_coordinates_that_have_a_check() -> None:
    """Along the epipolar lines of a pair nothing is redundant: of 60 points, 116 coordinates were beyond."""
    w = np.random.default_rng(5).standard_normal((60, 2))
    w[:, 0] *= 1e-2
    r = np.tile([1e-7, 0.5], (60, 1))
    a = stub(standardised=w, redundancy_numbers=r, is_exact=False, levels=Levels())
    found = robust_test(a)
    assert (found.tested, found.beyond) == (60, 0)


def test_the_global_test_is_by_chi_square() -> None:
    found = global_test(stub(sigma0=1.1, redundancy=50, false_alarm=0.05, reweighted=False))
    assert found.statistic == pytest.approx(60.5) and found.passed
    assert (found.lower, found.upper) == pytest.approx(tuple(stats.chi2.ppf([0.025, 0.975], 50)))
    for sigma0, passed in ((0.80, False), (0.81, True), (1.19, True), (1.20, False)):
        assert (
            global_test(stub(sigma0=sigma0, redundancy=50, false_alarm=0.05, reweighted=False)).passed
            == passed
        )
    assert global_test(stub(sigma0=1.1, redundancy=50, false_alarm=0.05, reweighted=True)).passed is None
    components = stub(
        names=(IMAGE_POINTS, "scale bars"), sigma0=np.array([1.1, 2.0]), redundancy=np.array([50.0, 3.0])
    )
    plain, bars = component_tests(components)
    assert plain.passed and bars.passed is False and bars.statistic == pytest.approx(12.0)
    robust, bars = component_tests(components, reweighted=True)
    assert robust.passed is None and robust.untested == "reweighted" and bars.passed is False


def test_coordinates_are_tested_that_have_a_check() -> None:
    r = np.array([[0.5, 2e-6], [0.7e-6, np.nan], [1.5e-6, 0.3]])
    w = np.array([[3.4, -3.3], [9.0, 9.0], [3.2, -3.1]])
    found = unwrap(w_test)(stub(redundancy_numbers=r, standardised=w, levels=Levels()))
    assert (found.tested, found.beyond) == (4, 2)
    assert found.critical == pytest.approx(stats.norm.ppf(1 - 0.0005))
    np.testing.assert_array_equal(found.statistic, [[3.4, -3.3], [9.0, np.nan], [3.2, -3.1]])
    found = unwrap(tau_test)(stub(redundancy_numbers=r, tau=w, redundancy=10), alpha=0.05)
    t = stats.t.ppf(0.975, 9)
    assert found.critical == pytest.approx(t * np.sqrt(10) / np.sqrt(9 + t**2)) and found.beyond == 4


def test_non_centrality_of_few_degrees_of_freedom() -> None:
    assert non_centrality(0.05, 0.8, 1) == np.inf
    for r in (2, 3, 10):
        delta = non_centrality(0.05, 0.8, r)
        t = stats.t.ppf(0.975, r - 1)
        assert stats.nct.sf(t, r - 1, delta) == pytest.approx(0.8, abs=2e-3)
    assert non_centrality(0.05, 0.9) == pytest.approx(stats.norm.ppf(0.975) + stats.norm.ppf(0.9))


def test_reliability_by_hand() -> None:
    P = np.array([[4.0, 1.0], [1.0, 2.0]])
    C = np.array([[1.0, 0.5], [3.9e-6, 2.5e-6], [np.nan, np.nan]])
    a = stub(
        test_alpha=0.001, redundancy=1000, sigma0=1.5, residual_weights=C,
        image_covariance=np.tile(np.linalg.inv(P), (3, 1, 1)),
    )  # fmt: skip
    found = reliability(a)
    delta = found.delta0
    assert delta == pytest.approx(4.13, abs=0.03) and found.critical == pytest.approx(3.29, abs=0.02)
    assert found.minimal_bias[0] == pytest.approx([delta * 1.5, delta * 1.5 / np.sqrt(0.5)])
    assert found.external[0] == pytest.approx([delta * np.sqrt(3), delta * np.sqrt(3)])
    assert found.minimal_bias[1, 0] == found.external[1, 0] == np.inf
    assert np.isfinite(found.minimal_bias[1, 1]) and np.isnan(found.external[2]).all()
    assert reliability(a, alpha=0.05).critical < 2.0 and reliability(a, power=0.9).delta0 > delta


def test_significance_is_students_t_against_none() -> None:
    _, truth = make_network(seed_of("t"), images=2, points=8, free=("c", "x0", "K1", "b1", "b2"))
    camera = truth.cameras[0]
    Q = np.diag([1e-6, (0.03 / 2.3) ** 2, (8e-4 / 1.9) ** 2, (2e-4 / 2.0) ** 2, 0.0])
    a = stub(
        estimate=stub(cameras=(camera,)), covariance=stub(interior=(Q,)), redundancy=20, false_alarm=0.05,
    )  # fmt: skip
    found = {one.parameter: one for one in significance(a)}
    assert set(found) == {"x0", "K1", "b1"}  # c has none, b2 is not determined
    assert found["x0"].t == pytest.approx(2.3) and found["x0"].value == pytest.approx(0.03)
    assert (
        found["x0"].probability == pytest.approx(2 * stats.t.sf(2.3, 20)) and found["x0"].camera == "camera 1"
    )
    # 2.086 is the limit of 5 %
    assert [found[name].significant for name in ("x0", "K1", "b1")] == [True, False, False]
    # a camera that took no part has no covariance
    none = stub(
        estimate=stub(cameras=(camera,)),
        covariance=stub(interior=(np.zeros((0, 0)),)),
        redundancy=20,
        false_alarm=0.05,
    )
    assert significance(none) == ()


def test_correlations_beyond_the_limit_are_listed_once() -> None:
    rho = np.array([[1.0, -0.95, 0.2], [-0.95, 1.0, 0.85], [0.2, 0.85, 1.0]])
    sigma = np.array([2.0, 1e-3, 0.0])
    found = statistics._strong(rho * np.outer(sigma, sigma), ["a", "b", "c"], 0.9)
    assert [(one.first, one.second) for one in found] == [("a", "b")]
    assert found[0].value == pytest.approx(-0.95)
    _, truth = make_network(seed_of("rho"), images=2, points=8, free=("c", "x0", "y0"))
    Q = np.array([[1, 0.91, 0.1], [0.91, 1, -0.97], [0.1, -0.97, 1]])
    a = stub(
        estimate=stub(cameras=(truth.cameras[0],)),
        covariance=stub(
            interior=(Q,), exterior=(np.eye(6) + 0.92 * np.eye(6, k=3) + 0.92 * np.eye(6, k=-3),)
        ),
        network=stub(images=("7",)),
    )
    every = correlations(a)
    assert [one.value for one in every] == pytest.approx([-0.97, 0.92, 0.92, 0.92, 0.91])
    assert (every[0].first, every[0].second) == ("x0 of camera camera 1", "y0 of camera camera 1")
    assert (every[1].first, every[1].second) == ("X0 of photograph 7", "omega of photograph 7")
    assert len(correlations(a, limit=0.95)) == 1


def test_redundancy_numbers_and_standardised_residuals_by_hand() -> None:
    """F = (2 0; 1 3), R = F^-1 (I - A Q A') F."""
    whitening, complement = np.array([[2.0, 1.0, 3.0]]), np.array([[[0.5, 0.1], [0.1, 0.4]]])
    F = np.array([[2.0, 0.0], [1.0, 3.0]])
    np.testing.assert_array_equal(numbers.whitening_matrix(whitening), [F])
    R = np.linalg.inv(F) @ complement[0] @ F
    np.testing.assert_allclose(numbers.redundancy_numbers(complement, whitening), [np.diag(R)])
    C = F.T @ complement[0] @ F
    np.testing.assert_allclose(numbers.residual_weights(complement, whitening), [np.diag(C)])
    v = np.array([[0.3, -0.2]])
    w = (F.T @ F @ v[0]) / np.sqrt(np.diag(C))
    np.testing.assert_allclose(numbers.standardised_residuals(v, complement, whitening), [w])
    for r, checked in ((1.5e-6, True), (0.7e-6, False)):
        found = numbers.standardised_residuals(v, r * np.eye(2)[None], np.array([[1.0, 0.0, 1.0]]))
        assert found[0] == pytest.approx(v[0] / np.sqrt(r) if checked else [0.0, 0.0])


def test_given_unknowns_are_standardised_by_hand() -> None:
    P = np.array([[[4.0, 1.0], [1.0, 3.0]], [[2.0, 0.0], [0.0, 0.0]]])
    Q = np.array([[[0.1, 0.02], [0.02, 0.2]], [[0.5, 0.0], [0.0, 0.1]]])
    v = np.array([[0.3, -0.2], [1.0, 1.0]])
    w, r = numbers.standardised_of_given(v, P, Q)
    C = np.diag(P[0] - P[0] @ Q[0] @ P[0])
    np.testing.assert_allclose(w[0], P[0] @ v[0] / np.sqrt(C))
    np.testing.assert_allclose(r[0], 1 - np.diag(Q[0] @ P[0]))
    assert np.isnan(w[1]).all() and r[1, 0] == 0 and np.isnan(r[1, 1])
    for part, checked in ((1 - 1.5e-6, True), (1 - 0.7e-6, False)):
        w, _ = numbers.standardised_of_given(np.ones((1, 1)), np.ones((1, 1, 1)), np.full((1, 1, 1), part))
        assert np.isfinite(w[0, 0]) == checked


def test_the_level_of_single_tests_is_that_of_all() -> None:
    """Pope (1976) and Sidak (1967): 5 % that any of them rejects what is good."""
    assert level_of_single(0.05, 1) == pytest.approx(0.05)
    assert level_of_single(0.05, 1000) == pytest.approx(5.129e-5, rel=1e-4)


def test_tau_by_students_t() -> None:
    assert numbers.tau_critical(0.05, 1) == np.inf
    t = stats.t.ppf(0.975, 1)
    assert numbers.tau_critical(0.05, 2) == pytest.approx(t * np.sqrt(2) / np.sqrt(1 + t**2))
