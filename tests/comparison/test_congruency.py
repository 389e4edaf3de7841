"""Congruency of two results: one datum for both, points that moved, nothing lost to the datum of either."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import combinations_with_replacement

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.comparison.congruency import congruency, motions
from sfm.comparison.findings import verdict_of_comparison
from sfm.comparison.significance import ResultComparison, compare_results
from sfm.conventions import FloatArray
from sfm.distortion.models import Role
from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.remarks.remark import Remark, kinds_of, remark
from sfm.report.differences import describe_scale
from sfm.solution import Solution
from tests.synthetic import make_network, observed_anew, seed_of, stored_of

DATUMS = ("free", "minimal", "control")
PAIRS = tuple(combinations_with_replacement(DATUMS, 2))
CONTROL = ("1", "10", "20", "30", "40", "50")
MOVED = [5, 17, 22, 41, 58]


@cache
def scene() -> tuple[Network, Estimate]:
    return make_network(seed_of("congruency"), images=8, points=60, model="opencv", noise_px=0.0)


def epoch(seed: int, datum: str, shift: FloatArray | None = None, *, bar: float = 1.0) -> Solution:
    """One epoch, adjusted in a datum; its scale bar is `bar` times as long as stated."""
    network, truth = scene()
    rng = np.random.default_rng(seed)
    moved = truth if shift is None else replace(truth, points=truth.points + shift)
    network = observed_anew(network, moved, 0.1, rng)
    length = float(np.linalg.norm(moved.points[3] - moved.points[43])) * bar
    network = network.with_scale_bar("4", "44", length + 1e-4 * rng.standard_normal(), 1e-4)
    kind = Datum(datum, points=[["1", "2", "3"], ["7", "15", "33"]][seed % 2] if datum == "minimal" else None)
    if datum == "control":
        given = moved.points[[int(name) - 1 for name in CONTROL]] + 0.001 * rng.standard_normal((6, 3))
        network = network.with_control(CONTROL, given, 0.001)
    a = adjust(network, moved, datum=kind, sigma_px=0.1, reject="none")
    return stored_of(f"{datum} {seed}", a)


def sampled(result: Solution, points: np.ndarray) -> Solution:
    """The same with the covariance of some points only."""
    assert result.covariance is not None
    rows = (3 * points[:, None] + np.arange(3)).ravel()
    return replace(result, covariance=result.covariance[np.ix_(rows, rows)], covariance_points=points)


def remarks(found: ResultComparison) -> tuple[Remark, ...]:
    return verdict_of_comparison(found).remarks


def compared(first: str, second: str, shift: FloatArray | None = None) -> ResultComparison:
    return compare_results(epoch(4, first), epoch(5, second, shift))


def test_the_statistic_does_not_depend_on_the_datum() -> None:
    """Free and minimal are S-transformations of one another; weak control adds observations of its own."""
    statistics = {pair: compared(*pair).global_statistic for pair in combinations_with_replacement(DATUMS, 2)}
    free = statistics["free", "free"]
    assert statistics["free", "minimal"] == pytest.approx(free, rel=1e-4)
    assert statistics["minimal", "minimal"] == pytest.approx(free, rel=1e-4)
    for statistic in statistics.values():  # 174 degrees of freedom: a standard deviation of 0.11
        assert abs(statistic - 1) < 0.4


@pytest.mark.parametrize("datums", PAIRS)
def test_points_that_moved_are_found_and_no_others(datums: tuple[str, str]) -> None:
    shift = np.zeros((60, 3))
    shift[MOVED] = [0.004, -0.002, 0.003]
    found = compared(*datums, shift)
    assert found.changed is True and found.majority
    assert list(np.flatnonzero(found.significant)) == MOVED
    assert found.point_difference[MOVED] == pytest.approx(shift[MOVED], abs=1.5e-3)
    still = np.setdiff1d(np.arange(60), MOVED)
    assert np.abs(found.point_difference[still] / found.point_sigma[still]).max() < 4.5
    (one,) = remarks(found)
    assert one.kind == "points_differ" and one.number("differing") == 5 and one.number("tested") == 60
    assert verdict_of_comparison(found).level == "bad"


def test_a_bending_of_the_whole_is_reported_from_points_that_move() -> None:
    xyz = scene()[1].points
    dome = np.zeros((60, 3))
    dome[:, 2] = 0.01 * (xyz[:, :2] ** 2).sum(axis=1)
    bent = compared("free", "control", dome)
    assert bent.changed is True and "bent" in kinds_of(remarks(bent))
    shift = np.zeros((60, 3))
    shift[MOVED] = [0.004, -0.002, 0.003]
    moved = compared("free", "minimal", shift)
    assert moved.changed is True and moved.cause is None and kinds_of(remarks(moved)) == ("points_differ",)
    assert remarks(compared("free", "free")) == ()


def test_another_interior_orientation_is_reported() -> None:
    first, second = epoch(4, "free"), epoch(5, "free", 0.01 * scene()[1].points[:, :1] ** 2 * [0.0, 0.0, 1.0])
    camera = second.estimate.cameras[0]
    other = camera.with_parameters(camera.parameters + 50.0 * camera.plays(Role.X0))
    second = replace(second, estimate=replace(second.estimate, cameras=(other,)))
    (one,) = [one for one in remarks(compare_results(first, second)) if one.kind == "interior_differs"]
    assert one.names("camera") == (camera.name,) and one.names("parameter") == ("cx",)


def test_where_a_sample_is_kept_the_points_of_both_samples_are_tested() -> None:
    shift = np.zeros((60, 3))
    shift[MOVED] = [0.004, -0.002, 0.003]
    first = sampled(epoch(4, "free"), np.arange(0, 45))
    second = sampled(epoch(5, "minimal", shift), np.arange(10, 60))
    found = compare_results(first, second)
    assert list(np.flatnonzero(np.isfinite(found.statistic))) == list(range(10, 45))
    assert list(np.flatnonzero(found.significant)) == [17, 22, 41]  # of 5, 17, 22, 41, 58
    assert found.point_difference[MOVED] == pytest.approx(shift[MOVED], abs=1.5e-3)
    untested = compare_results(sampled(epoch(4, "free"), np.arange(3)), second).untested
    assert untested is not None and untested.kind == "untestable"


def test_where_no_half_agrees_no_point_is_blamed() -> None:
    rng = seed_of("scattered")
    found = compared("free", "free", 0.02 * rng.standard_normal((60, 3)))
    assert found.changed is True and not found.majority
    assert not found.significant.any() and found.stable.all()
    assert kinds_of(remarks(found)) == ("no_majority_agrees",)


def test_a_change_of_size_is_a_change_where_both_have_a_scale() -> None:
    longer = epoch(3, "free", bar=1.01)
    found = compare_results(epoch(2, "free"), longer)
    assert found.changed is True and found.a_from_b.scale == 1.0
    assert describe_scale(found) == "scale kept: both results have one"
    unscaled = compare_results(epoch(2, "free"), replace(longer, unit=""))
    assert unscaled.changed is False and unscaled.scale_estimated
    assert unscaled.a_from_b.scale == pytest.approx(1 / 1.01, rel=1e-3)
    assert describe_scale(unscaled).startswith("scale estimated, 0.99")


def test_units_are_carried_over() -> None:
    metres = epoch(2, "free")
    thousand = replace(
        metres.estimate, points=1000 * metres.estimate.points, position=1000 * metres.estimate.position
    )
    assert metres.covariance is not None and metres.point_covariance is not None
    millimetres = replace(
        metres,
        estimate=thousand,
        unit="mm",
        point_covariance=1e6 * metres.point_covariance,
        covariance=1e6 * metres.covariance,
    )
    found = compare_results(metres, millimetres)
    assert found.a_from_b.scale == 1e-3
    assert np.abs(found.point_difference).max() < 1e-12


def test_without_a_common_datum_or_correlations_no_verdict_is_given() -> None:
    first, second = epoch(2, "minimal"), epoch(3, "minimal")
    assert compare_results(first, second, align="none").untested == remark("no_common_datum")
    found = compare_results(replace(first, covariance=None), replace(second, covariance=None))
    assert found.changed is None and kinds_of(remarks(found)) == ("no_joint_covariance",)
    approximate = compare_results(*(replace(epoch(k, "free"), covariance=None) for k in (2, 3)))
    assert approximate.approximate and approximate.changed is False
    held = compare_results(epoch(2, "control"), epoch(3, "control"), align="none")
    assert held.changed is False and held.statistic.shape == (60,)


def test_the_motion_of_the_whole_is_no_change() -> None:
    rng = seed_of("motions")
    xyz = rng.uniform(-1, 1, (12, 3))
    A = rng.standard_normal((36, 36))
    Q = A @ A.T
    G = motions(xyz)
    whole = (G @ rng.standard_normal(7)).reshape(12, 3)
    found = congruency(whole, Q, xyz, motion="similarity")
    assert found.first_test.statistic < 1e-20 and np.abs(found.difference).max() < 1e-12
    grown = G[:, 6].reshape(12, 3)
    assert congruency(100 * grown, Q, xyz, motion="rigid").first_test.statistic > 1


def test_the_drop_of_omega_is_that_of_leaving_the_point_out() -> None:
    rng = seed_of("drop")
    xyz = rng.uniform(-1, 1, (10, 3))
    A = rng.standard_normal((30, 30))
    Q, d = A @ A.T, rng.standard_normal((10, 3))
    whole = congruency(d, Q, xyz, alpha=1e-12)
    for k in range(10):
        rest = np.delete(np.arange(10), k)
        rows = (3 * rest[:, None] + np.arange(3)).ravel()
        part = congruency(d[rest], Q[np.ix_(rows, rows)], xyz[rest], alpha=1e-12)
        drop = whole.first_test.statistic * 24 - part.first_test.statistic * 21
        assert whole.statistic[k] * 3 == pytest.approx(drop, rel=1e-6)


def test_too_few_points_are_refused() -> None:
    with pytest.raises(GeometryError, match="congruency: 3 points of reference, expected 4 or more"):
        congruency(np.zeros((3, 3)), np.eye(9), np.eye(3))


@pytest.mark.slow
@pytest.mark.parametrize("datums", PAIRS)
def test_false_alarms_are_as_rare_as_stated(datums: tuple[str, str]) -> None:
    """200 pairs of epochs without a change: 10 alarms expected, with a standard deviation of 3.1."""
    alarms = sum(
        bool(compare_results(epoch(2 * r, datums[0]), epoch(2 * r + 1, datums[1])).changed)
        for r in range(10, 210)
    )
    assert 1 <= alarms <= 20
