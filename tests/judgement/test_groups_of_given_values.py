"""Given values beside one another: sets that may be wrong, their costs, and scales."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.sparse import csr_matrix

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.statistics import non_centrality
from sfm.judgement.given import judge as given
from sfm.judgement.given import values as given_values
from sfm.judgement.given.groups import GivenSettings, Group, contradiction_of, remarks_on_unchecked
from sfm.judgement.given.points import STRAINS, GivenPoints, Strain, judge_points
from sfm.judgement.given.scales import Comparison, Scales, Source, common_scale
from sfm.judgement.given.values import GivenModel, Judgement, judge_values, misfit_of
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.network import ObjectPoints, ScaleBars
from sfm.model.remarks.remark import kinds_of
from sfm.model.similarity import Similarity
from tests.given_figures import Figure
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


FRAME = Similarity(0.4, rotation_from_vector(np.array([0.3, -0.2, 1.1])), np.array([5.0, -2.0, 1.0]))
SIGMA = 1e-3


def two_groups(by: FloatArray, name: str) -> tuple[Any, list[Group], FloatArray]:
    """Return 12 points of one network, six of which are given as control and six as others, shifted."""
    rng = seed_of(name)
    X = rng.uniform(-1, 1, (12, 3))
    given = X + SIGMA * rng.standard_normal((12, 3))
    given[6:] += by
    stated = np.tile(SIGMA**2 * np.eye(3), (12, 1, 1))
    figure = Figure(given, stated, FRAME.apply(X), (0.1 * SIGMA) ** 2 * np.eye(36), 500)
    groups = []
    for of, some in (("control", np.arange(6)), ("centres", np.arange(6, 12))):
        kind = ObjectPoints(some, given[some], stated[some])
        placed = judge_points(GivenPoints(kind, figure.reference), 1e-3)
        assert placed is not None and placed.judgement.fits
        groups.append(Group(of, np.arange(6), tuple(f"{of} {k}" for k in range(6)), placed))
    settings = GivenSettings(Datum("control"), "mm")
    task: Any = SimpleNamespace(reference=figure.reference, settings=settings, level=1e-3)
    return task, groups, given


@pytest.mark.parametrize(("sigmas", "said"), [(0.0, False), (1.5, False), (5.0, True), (50.0, True)])
def test_control_and_centres_must_place_the_network_alike(sigmas: float, said: bool) -> None:
    """A shift by t standard deviations of a coordinate, of which the mean of six is known to 0.6."""
    by = sigmas * SIGMA * np.array([0.6, 0.0, 0.8])
    task, groups, _ = two_groups(by, "placed alike")
    found = contradiction_of(task, groups)
    assert (found is not None) == said and contradiction_of(task, groups[:1]) is None
    if found is not None:
        assert found.names("given") == ("control", "centres") and found.number("dof") == 7
        assert found.number("distance") == pytest.approx(sigmas * SIGMA, abs=3 * SIGMA)
        assert found.number("chi2") == pytest.approx(3 * sigmas**2, rel=0.5)


def test_points_that_take_part_are_those_that_fit_with_the_precision_that_they_have() -> None:
    _, groups, given = two_groups(np.zeros(3), "take part")
    one, covariance = groups[0], np.tile(SIGMA**2 * np.eye(3), (6, 1, 1))
    kind = ObjectPoints(np.arange(6), given[:6], covariance)
    assert len(one.taking_part(rescale=True).given) == 6 and one.dependable and one.judgement.wrong == ()
    assert (one.test.what, one.test.dof) == ("control", 3 * 6 - 7)
    found = one.placed.judgement
    out = replace(one, placed=replace(one.placed, judgement=replace(found, wrong=(2,))))
    assert out.taking_part(rescale=True).given.tolist() == np.delete(given[:6], 2, axis=0).tolist()
    assert out.as_judged(kind, rescale=True, used=True).point.tolist() == [0, 1, 3, 4, 5]
    assert len(out.as_judged(kind, rescale=True, used=False)) == 0
    doubt = replace(one, placed=replace(one.placed, judgement=replace(found, doubtful=(2,))))
    assert not doubt.dependable
    factor = one.placed.model.factor()[0]
    np.testing.assert_allclose(doubt.taking_part(rescale=True).stated, factor**2 * covariance)
    np.testing.assert_allclose(doubt.taking_part(rescale=False).stated, covariance)
    small = replace(one, placed=replace(one.placed, judgement=replace(found, factor=3.0)))
    np.testing.assert_allclose(small.as_judged(kind, rescale=True, used=True).covariance, 9 * covariance)
    np.testing.assert_allclose(small.as_judged(kind, rescale=False, used=True).covariance, covariance)
    exchanged = replace(one, placed=replace(one.placed, order=(1, 0, 2, 3, 4, 5)))
    np.testing.assert_allclose(
        exchanged.as_judged(kind, rescale=True, used=True).xyz, given[[1, 0, 2, 3, 4, 5]]
    )


def test_fixed_points_that_scatter_have_their_scatter() -> None:
    _, groups, given = two_groups(np.zeros(3), "scatter of fixed")
    fixed = np.zeros((6, 3, 3))
    fixed[1, 2, 2] = np.inf
    points = ObjectPoints(np.arange(6), given[:6], fixed)
    scattering = replace(groups[0], scatter=2e-3)
    found = scattering.as_judged(points, rescale=True, used=True).covariance
    assert np.isinf(found[1, 2, 2]) and found[0, 0, 0] == pytest.approx(SIGMA**2)
    unchanged = scattering.as_judged(points, rescale=False, used=True).covariance
    np.testing.assert_array_equal(unchanged, fixed)


@pytest.mark.parametrize(("ratio", "weak"), [(1.15, False), (1.3, True)])
def test_values_whose_errors_shift_the_result_by_five_sigma_are_weakly_checked(
    ratio: float, weak: bool
) -> None:
    """Of two bars the redundancy number of the better is 1 / (1 + q^2): 4.13 q standard deviations."""
    model = replace(bars(0.0, 0.0), stated=np.diag([1.0, ratio**2]))
    found = list(remarks_on_unchecked("lengths", ["A", "B"], model, (), 1e-3))
    assert kinds_of(found) == (("given_weakly_checked",) if weak else ())
    for one in found:
        assert one.names("given") == ("A",) and one.names("of") == ("lengths",)
        assert one.number("sigmas") == pytest.approx(4.13 * ratio, rel=0.01)


def test_values_that_nothing_checks_are_named_and_those_checked_in_part() -> None:
    """A point beside another one in X; Y and Z of both give the datum."""
    A = np.zeros((6, 5))
    A[[0, 3], 0] = 1.0  # X of both, in common
    A[[1, 2, 4, 5], [1, 2, 3, 4]] = 1.0
    model = GivenModel(np.zeros(6), np.zeros((6, 6)), np.eye(6), A, np.repeat([0, 1], 3), 100)
    (one,) = remarks_on_unchecked("control", ["A", "B"], model, (), 1e-3)
    assert one.kind == "given_partly_checked" and one.names("given") == ("A", "B")
    found = list(remarks_on_unchecked("control", ["A", "B"], model, (1,), 1e-3))
    assert kinds_of(found) == ("given_unchecked",) and found[0].names("given") == ("A",)


def test_the_mean_of_scales_is_that_of_independent_lengths() -> None:
    J = csr_matrix(np.array([[1.0, 0.0], [0.0, 3.0], [2.0, 0.0]]))
    scales = Scales(np.array([0.1, 0.2, 0.6]), J, np.array([1.0, 4.0, 4.0]))
    assert scales.mean.log.tolist() == [pytest.approx(0.3)] and scales.mean.variance.tolist() == [1.0]
    np.testing.assert_allclose(scales.mean.J.toarray(), [[1.0, 1.0]])
    np.testing.assert_allclose(scales.looser(2.0).variance, [5.0, 8.0, 8.0])
    both = Scales.joined([scales, scales.mean])
    assert both.log.tolist() == [*scales.log, *scales.mean.log] and both.J.shape == (4, 2)


def table_of(*off: float, table: int = 1, is_plate: bool = False) -> Comparison:
    """Return rows of a table whose logarithms of scale are so many standard deviations off."""
    sigma = 1e-4
    rows = [
        Source(
            f"row {k}", Scales(np.array([one * sigma]), csr_matrix((1, 1)), np.array([sigma**2])), (k,), table
        )
        for k, one in enumerate(off)
    ]
    rows = [row._replace(is_plate=is_plate) for row in rows]
    reference: Any = SimpleNamespace(
        C=np.zeros((1, 1)), marginal=SimpleNamespace(adjustment=SimpleNamespace(redundancy=500))
    )
    return Comparison.of(SimpleNamespace(reference=reference, level=1e-3), rows)  # type: ignore[arg-type]


def test_rows_of_a_table_that_scatter_are_one_scale_of_less_precision() -> None:
    """Where nothing shows which of them are wrong; bars that are no table have no common precision."""
    off = (28.0, 28.0, 0.0, 0.0)
    rows, apart = table_of(*off), table_of(*off, table=0)
    assert rows.judgement.doubtful and rows.scatters and not apart.scatters
    assert rows.factor == pytest.approx(28 / np.sqrt(3), rel=0.2) and apart.factor == 1.0
    one = rows.as_one("the table")
    assert one.name == "the table" and one.is_table and one.bars == (0, 1, 2, 3)
    np.testing.assert_allclose(one.scales.variance, rows.factor**2 * 1e-8)
    far = table_of(2800.0, 2800.0, 0.0, 0.0)  # beyond an order of magnitude of error
    assert not far.scatters
    clear = table_of(0.0, 0.5, -0.5, 0.2, 400.0)
    assert clear.judgement.wrong == (4,) and not clear.scatters and clear.factor == 1.0
    assert clear.as_one("the table").bars == (0, 1, 2, 3)


def test_lengths_of_the_same_ends_are_no_better_together() -> None:
    one = table_of(0.0, 0.5, -0.5, table=0).as_one("pair")
    assert one.name == "row 0" and not one.is_table
    np.testing.assert_allclose(one.scales.mean.variance, 1e-8)
    plate = table_of(0.0, 0.5, -0.5, table=0, is_plate=True).as_one("plate")
    np.testing.assert_allclose(plate.scales.variance, 1e-8)
    alone = table_of(0.0).as_one("the table")
    assert alone.name == "row 0" and not alone.is_table


def test_sources_of_one_name_are_told_apart_by_their_lengths() -> None:
    compared = table_of(0.0, 9.0, 1.0)
    named = compared._replace(
        sources=[row._replace(name=name) for row, name in zip(compared.sources, "AAB", strict=True)]
    )
    lengths = ScaleBars(np.zeros(3, dtype=int), np.ones(3, dtype=int), np.array([1.5, 2.5, 3.5]), np.ones(3))
    assert [one.name for one in named.with_lengths(lengths, "m")] == ["A (1.50 m)", "A (2.50 m)", "B"]


def test_points_that_carry_the_datum_are_not_outvoted() -> None:
    """Bars, which may share a wrong unit, leave open which is wrong where all points are."""
    compared = table_of(0.0, 0.5, 90.0)
    of_points = compared._replace(
        sources=[row._replace(points="control" if k == 2 else "") for k, row in enumerate(compared.sources)]
    )
    assert compared.judgement.wrong == (2,) and not compared.is_open(on_points=True)
    assert of_points.is_open(on_points=True) and not of_points.is_open(on_points=False)
    off, sigma = compared.difference(2)
    assert off == pytest.approx((90.0 - 0.25) * 1e-4)
    assert sigma == pytest.approx(1e-4 * np.sqrt(1.5), rel=0.02)


def judged_group(name: str, **found: Any) -> tuple[Any, Group]:
    """Return a group of six points of which something was found, and what it is judged with."""
    task, groups, _ = two_groups(np.zeros(3), name)
    placed = groups[0].placed
    return task, replace(groups[0], placed=replace(placed, judgement=replace(placed.judgement, **found)))


@pytest.mark.parametrize("rescale", [True, False])
def test_the_shift_by_doubtful_points_is_that_of_the_weights_that_they_get(rescale: bool) -> None:
    """Where one of them is wrong; with standard deviations from their differences, if these are replaced."""
    task, group = judged_group("doubtful shift", doubtful=(1, 4), one_wrong=True)
    task.settings = replace(task.settings, rescale=rescale)
    said = given._doubtful(task, group)
    model = group.placed.model
    effects = np.sqrt(model.kept().decreases()[0]) * model.external() / non_centrality()
    shift = effects[[1, 4]].max() / (model.factor()[0] if rescale else 1.0)
    assert said.kind == "given_contradicted" and said.names("given") == ("control 1", "control 4")
    assert said.number("shift") == pytest.approx(shift)
    fixed = replace(
        group, placed=replace(group.placed, points=group.placed.points.with_stated(np.zeros((6, 3, 3))))
    )
    assert given._doubtful(task, fixed).number("shift") == pytest.approx(effects[[1, 4]].max())
    _, several = judged_group("doubtful shift", doubtful=(1, 4))
    assert "shift" not in given._doubtful(task, several).numbers


def test_strained_points_name_the_axis() -> None:
    task, group = judged_group("strained group", doubtful=(0, 1, 2, 3, 4, 5))
    strain = Strain(STRAINS[1], np.diag([1.0, 1.02, 1.0]), "Y", 30.0)
    said = given._doubtful(task, replace(group, placed=replace(group.placed, strain=strain)))
    assert said.kind == "given_strained" and said.names("axis") == ("Y",)
    assert said.number("elongation") == pytest.approx(2.0) and said.number("fitting") == 30.0


def test_points_that_are_left_out_state_their_distance_from_the_others() -> None:
    """Of each without the other ones that are left out; the farthest counts."""
    task, group = judged_group("left out", wrong=(1, 4))
    said = given._left_out(task, group)
    model = group.placed.model
    pairs = [(model.kept((b,)).difference(a)) for a, b in ((1, 4), (4, 1))]
    d, covariance = max(pairs, key=lambda pair: float(np.linalg.norm(pair[0])))
    length = float(np.linalg.norm(d))
    assert said.number("distance") == pytest.approx(length)
    along = d / length
    assert said.number("sigmas") == pytest.approx(length / np.sqrt(along @ covariance @ along))
    assert said.names("given") == ("control 1", "control 4")
