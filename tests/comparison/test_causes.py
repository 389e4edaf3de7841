"""Causes of differences: named where they are one, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.comparison import causes
from sfm.comparison.causes import PointPairs, Row, find_cause, find_pattern, is_unrelated
from sfm.comparison.comparison_remarks import remarks_of_cause, verdict_of_comparison
from sfm.comparison.pairing import ROUNDING
from sfm.comparison.significance import compare_results
from sfm.model.conventions import UNITS, rotation_from_vector
from sfm.model.remarks.remark import kinds_of
from sfm.model.similarity import Similarity
from tests.comparison.causes import EXPECTED, compared, epochs, expected, pair, transformed
from tests.synthetic import make_network, observed_anew, seed_of, stored_of

CAUSES = {kind for kinds in EXPECTED.values() for kind in kinds} - {"points_differ"}


@pytest.mark.parametrize("number", [100, pytest.param(101, marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", [case for case in EXPECTED if case != "nothing"])
def test_each_cause_is_named_by_comparison_and_epochs(case: str, number: int) -> None:
    for by in (compared, epochs):
        assert set(by(case, number)) in expected(case, by)


def test_right_pairs_have_no_cause() -> None:
    for number in range(100, 110):
        assert not CAUSES & set(compared("nothing", number)), number


def test_a_scale_is_named_with_its_standard_deviation() -> None:
    errors = []
    for number in range(110, 120):
        (said,) = verdict_of_comparison(compare_results(*pair("scale 1.0005", number))).remarks
        assert said.kind == "lengths_differ" and said.number("sigma") < 1e-4
        errors.append((said.number("lengths") - 1.0005) / said.number("sigma"))
    assert 0.4 < float(np.mean(np.square(errors))) < 2.1  # chi-square with 10 degrees of freedom at 1 %


def test_names_are_those_that_were_exchanged() -> None:
    first, second = pair("nothing", 120)
    order = np.arange(len(first.network.points))
    order[[3, 8]] = order[[8, 3]]
    found = compare_results(first, transformed(second, np.eye(3), np.zeros(3), order))
    names = first.network.points
    assert found.cause is not None and found.cause.row == Row(names=True)
    assert found.cause.renamed == ((names[3], names[8]), (names[8], names[3]))


@pytest.mark.parametrize(("same", "named"), [(16, True), (14, False)])
def test_names_are_exchanged_where_half_of_the_points_are_the_same(same: int, named: bool) -> None:
    a, rng = pairs_of(1.0), seed_of("half the same")
    b = np.concatenate([np.roll(a.b[:same], 1, axis=0), rng.uniform(-1, 1, (30 - same, 3))])
    found = find_cause(replace(a, b=b))
    assert found is not None and found.row.names is named


def pairs_of(scale: float, size: float = 1.0, sigma: float = 1e-5, n: int = 30) -> PointPairs:
    """Return made-up points with independent coordinates of equal precision."""
    rng = seed_of("pairs of points")
    a = size * rng.uniform(-1, 1, (n, 3))
    noise = size * sigma * rng.standard_normal((2, n, 3))
    Q = (size * sigma) ** 2 * np.eye(3 * n)
    names = tuple(f"P{k}" for k in range(n))
    return PointPairs(names, a + noise[0], scale * (a + noise[1]), Q, scale**2 * Q, None, 1.0, 500)


@pytest.mark.parametrize("factor", [*UNITS, *(1 / factor for factor in UNITS)])
def test_every_unit_is_known(factor: float) -> None:
    found = find_cause(pairs_of(factor))
    assert found is not None and found.row == Row(scale=True) and not found.rest
    assert found.unit is not None and found.unit.factor == pytest.approx(factor)


def test_a_scale_beside_a_unit_is_reported_beside_it() -> None:
    """Millimetres for metres, and an object that expanded: 1000.5 was a wrong bar, or warmth."""
    cause = find_cause(pairs_of(1000.5))
    assert cause is not None and cause.rest
    assert abs(cause.lengths - 1000.5) < 4 * cause.lengths_sigma
    (said,) = remarks_of_cause(cause, "a", "b", 30, (1.0, "m"))
    assert (said.kind, said.number("factor")) == ("unit_differs", 1000.0)
    assert said.number("lengths") == cause.lengths and said.number("sigma") < 1e-5
    assert abs(said.number("rest") - 1.0005) < 4 * said.number("sigma")
    assert [said.names(name) for name in ("finer", "coarser")] == [("mm",), ("m",)]


@pytest.mark.parametrize(("factor", "unit"), [(2.5, None), (2.54 * 1.003, None), (2.54 * 1.001, 2.54)])
def test_a_scale_that_no_unit_explains_is_none_of_a_unit(factor: float, unit: float | None) -> None:
    """2.5 was 2.54 times, and then 0.984 +- 0.000003 times; a print may be one or two permille larger."""
    cause = find_cause(pairs_of(factor))
    assert cause is not None and cause.row == Row(scale=True) and cause.rest
    (said,) = remarks_of_cause(cause, "a", "b", 30, (1.0, "m"))
    assert said.kind == ("unit_differs" if unit else "lengths_differ")
    assert said.number("lengths") == pytest.approx(factor, rel=1e-4)
    assert not unit or said.number("factor") == unit


def test_a_strain_beside_a_unit_is_that_of_lengths_in_one_unit() -> None:
    a = pairs_of(1000.0)
    cause = find_cause(replace(a, b=a.b * [1.001, 1.0, 1.0]))
    assert cause is not None and cause.row == Row(strain=True)
    unit, strain = remarks_of_cause(cause, "a", "b", 30, (1.0, "m"))
    assert (unit.kind, unit.number("factor")) == ("unit_differs", 1000.0)
    assert strain.kind == "strained" and abs(strain.number("lengths") - 1.001) < 1e-4
    assert strain.number("factor") == 1000.0


def test_what_a_unit_explains_is_tested() -> None:
    """Beside the cause, the covariance of coordinates 1000 times as large was called singular."""
    network, truth = make_network(seed_of("cmp"), images=10, points=40)
    first, second = (
        stored_of(name, adjust(observed_anew(network, truth, 0.1, seed_of(name)), truth, datum=Datum("free")))
        for name in ("first", "second")
    )
    grown = transformed(second, 1000.3 * np.eye(3), np.zeros(3), np.arange(40))
    kinds = kinds_of(verdict_of_comparison(compare_results(first, grown)).remarks)
    assert kinds[0] == "unit_differs" and not {"lengths_differ", "untestable"} & set(kinds)


def test_results_that_differ_by_rounding_do_not_differ() -> None:
    """Noise-free observations leave standard deviations of rounding, which no difference is measured by."""
    first, second = pair("nothing", 121)
    tiny = 1e-24
    assert first.covariance is not None and first.point_covariance is not None
    for times, changed in ((0.5, False), (20.0, True)):
        rng = seed_of("rounding")
        size = np.sqrt(((first.estimate.points - first.estimate.points.mean(0)) ** 2).sum(1).mean())
        points = first.estimate.points + times * ROUNDING * size * rng.standard_normal(
            (len(first.network.points), 3)
        )
        exact = [
            replace(one, covariance=tiny * first.covariance, point_covariance=tiny * first.point_covariance)
            for one in (first, replace(second, estimate=replace(first.estimate, points=points)))
        ]
        assert compare_results(*exact).changed is changed, times


def test_the_rule_needs_the_stated_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scale of five standard deviations is named, one of three is not; no level of 1 changes that."""
    a = pairs_of(1.0)
    found = find_cause(replace(a, b=a.b * 1.0005))
    assert found is not None
    sigma = found.lengths_sigma
    own = found.lengths - 1.0005  # the noise of this case
    for sigmas, named in ((3.0, False), (7.0, True)):
        one = find_cause(replace(a, b=a.b * (1 - own + sigmas * sigma)), changed=False)
        assert (one is not None) is named, sigmas


@pytest.mark.parametrize("scale", [1.0, None])
def test_a_strain_is_named_with_its_axis(scale: float | None) -> None:
    """Relative to the middle one where the scale is unknown, of which both results then have another."""
    a = pairs_of(1.0)
    axis = np.array([0.6, 0.0, 0.8])
    grown = (a.b + 1e-3 * np.outer(a.b @ axis, axis)) * (1.0 if scale else 3.0)
    found = find_cause(replace(a, b=grown, Q_b=a.Q_b * (1.0 if scale else 9.0), scale=scale))
    assert found is not None and found.row == Row(strain=True) and not found.moved
    (one,) = found.stretches
    assert abs(one.axis @ axis) > 0.999 and one.sigma < 2e-5
    assert abs(one.lengths - 1.001) < 4 * one.sigma
    other = pairs_of(1.0)
    two = find_cause(replace(other, b=other.b * [1.001, 1.0, 0.999]))
    assert two is not None and [round(1e3 * (one.lengths - 1)) for one in two.stretches] in ([1, -1], [-1, 1])


def test_points_that_are_left_out_are_paid_for() -> None:
    """No scale with moved points besides wins over a strain that leaves none."""
    a = pairs_of(1.0)
    b = a.b * [1.0003, 1.0, 1.0]
    found = find_cause(replace(a, b=b))
    assert found is not None and found.row == Row(strain=True) and not found.moved
    b = a.b * 1.0005
    b[:10] += 0.01
    found = find_cause(replace(a, b=b))
    assert found is not None and found.row == Row(scale=True) and len(found.moved) == 10


def test_shuffled_names_are_unrelated_and_deformed_points_are_not() -> None:
    rng = seed_of("unrelated")
    a = rng.uniform(-1, 1, (20, 3))
    assert sum(is_unrelated(a, a[rng.permutation(20)]) for _ in range(20)) == 20
    assert not any(is_unrelated(a, a + 0.2 * rng.standard_normal(a.shape)) for _ in range(20))
    assert not is_unrelated(a[:6], a[5::-1])  # too few to say


def test_a_pattern_is_found_whatever_the_names() -> None:
    rng = seed_of("pattern")
    truth = Similarity(3.0, rotation_from_vector(np.array([0.3, -1.0, 2.0])), np.array([4.0, 5.0, 6.0]))
    for n in (8, 40, 300):
        b = rng.uniform(-1, 1, (n, 3))
        a = truth.apply(b)[rng.permutation(n)] + 1e-4 * rng.standard_normal((n, 3))
        for scale in (None, 3.0):
            found = find_pattern(a, b, scale=scale)
            assert found is not None and np.abs(found.rotation - truth.rotation).max() < 1e-3
        mirrored = find_pattern(a * [1, 1, -1], b, mirrored=True)
        assert mirrored is not None and np.linalg.det(mirrored.rotation) < 0
    assert find_pattern(a[:3], b[:3]) is None


def test_every_parameter_of_a_cause_has_the_price_of_bic() -> None:
    """Of equal points nothing is left to gain; a scale that is known already costs one parameter."""
    a = seed_of("price").uniform(-1, 1, (20, 3))
    Q = 1e-8 * np.eye(60)
    pairs = PointPairs(tuple(map(str, range(20))), a, a, Q, Q, None, 1.0, None)
    fits = [causes._fitted(pairs, row, np.ones(20, dtype=bool), 5.0) for row in (Row(), Row(scale=True))]
    plain, scaled = (one.L for one in fits)
    assert plain == pytest.approx(0.0, abs=1e-6)
    assert scaled == pytest.approx(-np.log(60) / 2, abs=1e-6)
