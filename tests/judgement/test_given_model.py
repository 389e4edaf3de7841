"""Given values against the free network, by hand: chi-square, probability, factor, the choice of a cause."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy import stats
from scipy.sparse import csr_matrix

from sfm.judgement.given import free_network
from sfm.judgement.given import mistakes as given_names
from sfm.judgement.given import points as given_points
from sfm.judgement.given import values as given_values
from sfm.judgement.given.scales import Scales, scales_of_lengths
from sfm.judgement.given.values import GivenModel, Judgement, judge_values
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.network import ScaleBars
from sfm.model.similarity import Similarity, fit_similarity
from tests.given_figures import Figure, judge
from tests.synthetic import seed_of

FRAME = Similarity(0.4, rotation_from_vector(np.array([0.3, -0.2, 1.1])), np.array([5.0, -2.0, 1.0]))


def bars(*v: float, stated: float = 1.0, network: float = 0.0, redundancy: int = 500) -> GivenModel:
    """Return the model of bars with these differences, of variances stated and network."""
    n = len(v)
    free = network * np.eye(n)
    return GivenModel(np.array(v), free, stated * np.eye(n), np.ones((n, 1)), np.arange(n), redundancy)


def of_points(name: str, items: int = 5) -> GivenModel:
    """Return a model of values with three rows each, all correlated."""
    rng = seed_of(name)
    m = 3 * items
    network, stated = rng.normal(size=(2, m, m))
    v, A, item = rng.normal(size=m), rng.normal(size=(m, 4)), np.repeat(np.arange(items), 3)
    return GivenModel(v, network @ network.T / m, stated @ stated.T / m + np.eye(m), A, item, 40)


def misfit(model: GivenModel, *out: int) -> tuple[float, int]:
    """Return chi-square and its degrees of freedom without some values."""
    kept = model.kept(out)
    return kept.chi2, kept.dof


def without(model: GivenModel, k: int) -> GivenModel:
    """Return the model without its last value."""
    kept = np.flatnonzero(model.item != k)
    assert k == model.items - 1
    both = np.ix_(kept, kept)
    network, stated, item = model.network[both], model.stated[both], model.item[kept]
    return replace(model, v=model.v[kept], network=network, stated=stated, A=model.A[kept], item=item)


def test_chi_square_is_of_what_the_parameters_leave() -> None:
    one = bars(1.0, 2.0, 6.0, stated=2.0, network=2.0)
    assert misfit(one) == (pytest.approx(14 / 4), 2)
    assert misfit(one, 2) == (pytest.approx(0.5 / 4), 1)
    fall, rank = one.kept().decreases()
    assert (fall[2], rank[2]) == (pytest.approx(13.5 / 4), 1)
    fall, rank = one.kept((0,)).decreases()
    assert (fall[0], rank[0]) == (0.0, 0) and (fall[2], rank[2]) == (pytest.approx(misfit(one, 0)[0]), 1)
    assert misfit(one, 0, 1) == (pytest.approx(0.0), 0) and one.kept((0, 1)).probability() == 1.0
    assert one.share == pytest.approx(0.5) and one.items == 3
    many = of_points("chi-square")
    S = many.network + many.stated
    P = np.linalg.inv(S)
    left = P - P @ many.A @ np.linalg.solve(many.A.T @ P @ many.A, many.A.T @ P)
    np.testing.assert_allclose(many.precision, left, atol=1e-9)
    assert misfit(many) == (pytest.approx(many.v @ left @ many.v), 11)
    few = without(many, 4)
    assert misfit(many, 4) == (pytest.approx(few.kept().chi2), 8) == misfit(few)
    fall, rank = many.kept((4, 0)).decreases()
    for k in (1, 2, 3):
        assert misfit(many, 0, 4, k) == (pytest.approx(misfit(many, 4, 0)[0] - fall[k]), 5 - rank[k])
    assert many.blocks[0].tolist() == [[3 * k, 3 * k + 1, 3 * k + 2] for k in range(5)]


def test_a_difference_is_from_where_the_others_have_it() -> None:
    one = bars(1.0, 2.0, 6.0, stated=2.0, network=2.0)
    d, covariance = one.kept().difference(2)
    assert d == pytest.approx([4.5]) and covariance == pytest.approx(np.array([[4 + 4 / 2]]))
    d, covariance = one.kept((0,)).difference(2)
    assert d == pytest.approx([4.0]) and covariance == pytest.approx(np.array([[8.0]]))


def test_parameters_that_are_not_determined_leave_more() -> None:
    one = replace(bars(1.0, 2.0, 6.0), A=np.zeros((3, 1)))
    assert misfit(one) == (pytest.approx(41.0), 3)
    assert misfit(bars(1.0)) == (0.0, 0) and bars(1.0).kept().probability() == 1.0 and bars(1.0).share == 0.0


def test_the_probability_shares_the_level_among_three_tests() -> None:
    one = bars(0.0, 1.0, -1.0, 4.0, network=1.0, redundancy=20)  # share 1 / 2: 80 degrees of freedom
    T = ((one.v - 1) ** 2).sum() / 2
    largest = (9 / 2) * 4 / 3  # of v of 3, redundancy number 3 / 4
    single, together = 12 * stats.f.sf(largest, 1, 80), 3 * stats.f.sf(T / 3, 3, 80)
    assert one.kept().probability() == pytest.approx(min(single, together)) and single < together
    spread = bars(3.0, -3.0, 3.0, -3.0, network=1.0, redundancy=20)
    assert spread.kept().probability() == pytest.approx(3 * stats.f.sf(18 / 3, 3, 80))
    assert bars(0.1, 0.0, 0.0).kept().probability() == 1.0
    # one coordinate of a value of three; the stated part has no degrees of freedom to lose
    point = GivenModel(
        np.array([5.0, 0, 0, 0, 0, 0]),
        np.zeros((6, 6)),
        np.eye(6),
        np.zeros((6, 1)),
        np.repeat([0, 1], 3),
        20,
    )
    assert point.kept().probability() == pytest.approx(18 * stats.chi2.sf(25, 1), rel=1e-4)
    other = replace(point, v=np.array([3.0, 3, 3, 0, 0, 0]))
    assert other.kept().probability() == pytest.approx(6 * stats.chi2.sf(27, 3), rel=1e-4)


@pytest.mark.parametrize("estimated", [False, True])
def test_values_none_of_which_is_checked_alone_contradict_nothing(
    estimated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(given_values, "MIN_REDUNDANCY", 1.1)  # beyond every redundancy number
    one = replace(bars(0.0, 0.1, -0.1), estimated=estimated)
    assert one.kept().dof == 2 and one.kept().probability() == 1.0


def test_the_probability_without_a_value_is_that_of_the_others() -> None:
    many = replace(of_points("without"), network=np.zeros((15, 15)))
    many = replace(many, v=3 * many.v)
    assert 0 < many.kept((4,)).probability() < 1
    assert many.kept((4,)).probability() == pytest.approx(without(many, 4).kept().probability())


def test_unknown_standard_deviations_come_from_the_others() -> None:
    """And from the network, which scatters as its covariance has it at least."""
    one = replace(bars(0.0, 100.0, -100.0, 800.0, 50.0), estimated=True)
    rest = one.kept((3,)).chi2 / 3
    fall = one.kept().chi2 - 3 * rest
    assert one.kept().probability() == pytest.approx(5 * stats.f.sf(fall / rest, 1, 3))
    near = replace(bars(0.0, 0.1, -0.1, 3.0, 0.05), estimated=True)
    fall = near.kept().decreases()[0][3]
    assert near.kept().probability() == pytest.approx(5 * stats.f.sf(fall, 1, 3))
    assert replace(bars(0.0, 9.0), estimated=True).kept().probability() == 1.0
    assert replace(bars(0.0, 1.0, 900.0), estimated=True).kept().probability() < 4e-3
    assert replace(bars(0.0, 1.0, 0.5), estimated=True).kept().probability() > 0.99


def test_external_reliability_is_by_the_redundancy_number() -> None:
    one = bars(0.0, 0.0, 0.0, 0.0, network=1.0)
    assert one.external() == pytest.approx(np.full(4, 4.1321 * np.sqrt((1 / 4) / (3 / 4))), rel=1e-4)
    found = one.external((1,))
    assert np.isnan(found[1]) and found[[0, 2, 3]] == pytest.approx(
        np.full(3, 4.1321 * np.sqrt(1 / 2)), rel=1e-4
    )
    weights = np.array([1.0, 2.0, 5.0])
    uneven = replace(bars(0.0, 0.0, 0.0), stated=np.diag(1 / weights))
    r = 1 - weights / weights.sum()
    assert uneven.external() == pytest.approx(4.1321 * np.sqrt((1 - r) / r), rel=1e-4)
    # where nothing is stated, by the geometry alone
    for geometry in (
        replace(uneven, stated=np.zeros((3, 3)), network=np.diag(weights)),
        replace(uneven, estimated=True),
    ):
        assert geometry.external() == pytest.approx(np.full(3, 4.1321 * np.sqrt(1 / 2)), rel=1e-4)
    assert np.isinf(bars(0.0, 0.0).external((1,))[0])


def test_the_factor_on_standard_deviations() -> None:
    one = bars(0.0, 3.0, -4.0, 12.0, -11.0)
    T = 290.0
    factor, gain = one.factor()
    assert factor == pytest.approx(np.sqrt(T / 4), rel=0.03)
    assert gain == pytest.approx(T - 4 * (1 + np.log(T / 4)), rel=1e-2)
    # beside the network: d + f^2 is the mean square
    factor, gain = bars(0.0, 3.0, -4.0, 12.0, -11.0, network=20.0).factor()
    assert factor == pytest.approx(np.sqrt(T / 4 - 20), rel=0.03)
    assert gain == pytest.approx(T / 21 - 4 * (1 + np.log(T / 4 / 21)), rel=1e-2)
    # of values without standard deviations their standard deviation itself
    factor, gain = bars(0.0, 3.0, -4.0, 12.0, -11.0, stated=0.0, network=20.0).factor()
    assert factor == pytest.approx(np.sqrt(T / 4 - 20), rel=0.03)
    assert gain == pytest.approx(T / 20 - 4 * (1 + np.log(T / 4 / 20)), rel=1e-2)
    assert replace(one, stated=np.diag([1.0, 0.0, 0.0, 1.0, 1.0])).factor() == (1.0, 0.0)
    assert bars(0.0, 0.1, 0.0).factor()[0] == 1.0


@pytest.mark.parametrize(("r", "rank"), [(4e-5, 1), (2e-5, 0)])
def test_a_value_is_tested_where_the_others_check_it(r: float, rank: int) -> None:
    """Of a weak value and a strong one: the redundancy number of the strong one is r."""
    one = replace(bars(0.0, 1.0), stated=np.diag([(1 - r) / r, 1.0]))
    assert one.kept().decreases()[1].tolist() == [1, rank]
    assert one.kept((1,)).dof == 1 - rank


def test_a_judgement_fits_where_nothing_is_wrong() -> None:
    fits = Judgement(1.0, 2, 0.5)
    assert fits.fits
    for wrong in ({"wrong": (1,)}, {"doubtful": (1,)}, {"factor": 2.0}):
        assert not replace(fits, **wrong).fits  # type: ignore[arg-type]


def test_sets_of_as_many_values(monkeypatch: pytest.MonkeyPatch) -> None:
    one = bars(*seed_of("sets").normal(size=6))
    every = dict(given_values._misfits_like(one, (1, 2)))
    assert set(every) == set(combinations(range(6), 2))
    for some, chi2 in every.items():
        assert chi2 == pytest.approx(one.kept(some).chi2)
    monkeypatch.setattr(given_values, "MAX_SETS", 15)
    assert set(dict(given_values._misfits_like(one, (1, 2)))) == set(every)
    monkeypatch.setattr(given_values, "MAX_SETS", 14)
    few = set(dict(given_values._misfits_like(one, (1, 2))))
    assert few == {one for one in every if {1, 2} & set(one)} and len(few) == 9


def test_the_score_of_wrong_values() -> None:
    one = bars(0.0, 300.0, 0.0, -200.0, 1.0)
    cost = np.log(5)
    found = given_values._wrong_values(one, 0.001, cost)
    assert found is not None
    assert found.values == (1, 3) and found.rivals == ()
    T = one.kept().chi2
    fall = T - one.kept((1, 3)).chi2
    of_scatter = cost + 2 * (1 + np.log(fall / 2)) + 2 * np.log(10)
    assert found.score == pytest.approx(of_scatter - fall, rel=1e-9)
    by_each = given_values._score(one, (1, 3), one.kept((1, 3)), scatter=False)
    assert by_each == pytest.approx(2 * cost + 2 * np.log(10) - fall, rel=1e-9)
    assert one.kept((1, 3)).chi2 == pytest.approx(2 / 3)
    assert given_values._wrong_values(bars(0.0, 300.0), 0.001, cost) is None
    assert given_values._wrong_values(bars(0.0, 0.0, 300.0, 300.0), 0.001, cost) is None
    # either of two of three heals: 8 less than the margin apart
    found = given_values._wrong_values(bars(-2.2, 0.0, 4.6), 0.02, np.log(3))
    assert found is not None and (found.values, found.rivals) == ((2,), (0,))


def test_the_best_sets_of_wrong_values_of_each_size() -> None:
    """Up to half, where those left check one another: of four bars two, of three one, of two none."""
    one = bars(0.0, 20.0, 1.0, -15.0)
    cost = np.log(4)
    found = given_values._sets(one, cost)
    assert [len(some.values) for some in found] == [1, 2] and found[1].values == (1, 3)
    F = one.kept().chi2 - 0.5
    assert found[1].score == pytest.approx(2 * (1 + np.log(F / 2)) - F + cost + 2 * np.log(6))
    assert [some.values for some in given_values._sets(bars(0.0, 9.0, 1.0), cost)] == [(1,)]
    assert given_values._sets(bars(0.0, 9.0), cost) == ()
    assert given_values._sets(bars(0.0, 50.0, 0.0, -20.0, 90.0), cost)[-1].values == (1, 3, 4)
    many = bars(*(30 * seed_of("many sets").normal(size=20)))
    assert [len(some.values) for some in given_values._sets(many, cost)] == list(range(1, 11))


def test_a_factor_must_beat_wrong_values_by_the_margin(monkeypatch: pytest.MonkeyPatch) -> None:
    one = bars(*(5 * seed_of("factor or wrong").normal(size=30)))
    factor, gain = one.factor()
    ahead = min(some.score for some in given_values._sets(one, np.log(30))) - (np.log(30) - gain)
    assert ahead > 2 * np.log(100) == pytest.approx(2 * given_values.MIN_LEAD)
    monkeypatch.setattr(given_values, "MIN_LEAD", 0.99 * ahead / 2)
    assert judge_values(one, 0.001).factor == factor
    monkeypatch.setattr(given_values, "MIN_LEAD", 1.01 * ahead / 2)
    assert judge_values(one, 0.001).doubtful == tuple(range(30))


@pytest.mark.parametrize(("apart", "rivals"), [(4.8, (0, 3, 4)), (5.1, ())])
def test_those_left_out_may_be_the_right_ones(apart: float, rivals: tuple[int, ...]) -> None:
    """Two of five bars agree: then three are wrong. Chi-square must differ by 2 ln 1000 - ln 5 = 12.2."""
    one = bars(0.0, 20.0, 20.0 + apart, 0.0, 0.0)
    found = given_values._wrong_values(one, 0.001, np.log(5))
    assert found is not None and found.values == (1, 2)
    assert found.rivals == rivals


def test_suspects_are_those_without_which_the_others_fit() -> None:
    assert given_values._suspects(bars(-1.9, 0.0, 3.8), 0.02) == (0, 2)
    assert given_values._suspects(bars(0.0, 0.0, 9.0), 0.02) == (0, 1, 2)  # one alone is no doubt
    assert given_values._suspects(bars(0.0, 9.0), 0.02) == (0, 1)


def exact(n: int, name: str, sigma: float = 1e-3) -> Figure:
    """Return points of a cube and of a free network in another frame, both without noise."""
    X = seed_of(name).uniform(-1, 1, (n, 3))
    stated = np.tile(sigma**2 * np.eye(3), (n, 1, 1))
    return Figure(X, stated, FRAME.apply(X), (0.1 * sigma) ** 2 * np.eye(3 * n), 500)


def test_the_mirror_is_excluded_by_the_likelihood_of_a_variance_that_is_not_known() -> None:
    """Of points in a plane but one of height h; mirrored ones differ by 2 h in what a similarity leaves."""
    plane = exact(8, "mirror")

    def judged(height: float) -> given_points.PlacedPoints:
        X = plane.given * (1, 1, 0) + height * np.eye(8)[0][:, None] * (0, 0, 1)
        points = replace(plane, given=X, free=FRAME.apply(X))
        found = judge(points, 0.001)
        assert found is not None and found.judgement.fits
        return found

    n, flat = 3 * 8 - 7, judged(0.0).model
    limit = n * np.exp(given_values.MARGIN / n)  # chi-square of the mirrored ones
    h = float(np.sqrt(limit / flat.precision[2, 2])) / 2
    assert not given_points.excludes_mirror(judged(0.0))
    assert not given_points.excludes_mirror(judged(0.95 * h))
    assert given_points.excludes_mirror(judged(1.05 * h))


def test_points_are_mirrored_with_their_covariance() -> None:
    rng = seed_of("select")
    half = rng.normal(size=(4, 3, 3))
    one = replace(exact(4, "select"), stated=half @ np.swapaxes(half, 1, 2))
    turned, flip = one.points.mirrored(), np.diag([-1.0, 1, 1])
    np.testing.assert_array_equal(turned.given, one.given * (-1, 1, 1))
    np.testing.assert_allclose(turned.stated, flip @ one.stated @ flip)
    given = one.given.copy()
    given[1, 2] = np.nan
    some = replace(one, given=given).points
    assert some.complete.tolist() == [0, 2, 3] and some.select(np.array([1, 3])).complete.tolist() == [1]


def test_the_model_of_points_is_in_the_given_frame() -> None:
    rng = seed_of("model of points")
    joint = rng.normal(size=(12, 12))
    one = replace(exact(4, "model of points"), joint=joint @ joint.T)
    given = one.given.copy()
    given[2, 1] = np.nan
    given[3] += (0.1, 0.2, 0.3)
    placing = FRAME.inverse()
    model = replace(one, given=given).points.model(placing, estimated=True)
    rows = np.delete(np.arange(12), 7)
    right = np.zeros(12)
    right[9:] = (0.1, 0.2, 0.3)
    np.testing.assert_allclose(model.v, right[rows], atol=1e-12)
    turn = placing.scale * np.kron(np.eye(4), placing.rotation)
    np.testing.assert_allclose(model.network, (turn @ one.joint @ turn.T)[np.ix_(rows, rows)])
    np.testing.assert_allclose(model.stated, 1e-6 * np.eye(11))
    assert model.item.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 3, 3, 3]
    assert model.estimated and model.redundancy == 500 and model.A.shape == (11, 7)


@pytest.mark.parametrize("kind", ["stated", "fixed", "estimated", "free only"])
def test_a_similarity_is_moved_to_the_best_one(kind: str) -> None:
    one = exact(6, "moved similarity")
    if kind in ("fixed", "free only"):
        one = replace(one, stated=np.zeros((6, 3, 3)))
    if kind == "fixed":
        one = replace(one, joint=np.zeros((18, 18)))
    given = one.given.copy()
    given[4] += 0.3  # left out
    one = replace(one, given=given)
    right = FRAME.inverse()
    placing = Similarity(
        right.scale * 1.02,
        rotation_from_vector(np.array([0.01, -0.02, 0.015])) @ right.rotation,
        right.translation + np.array([0.02, 0.01, -0.03]),
    )
    for _ in range(4):
        model = one.points.model(placing, estimated=kind == "estimated")
        placing = one.points.moved(placing, model, (4,))
    assert placing.scale == pytest.approx(right.scale, rel=1e-7)
    np.testing.assert_allclose(placing.rotation, right.rotation, atol=1e-7)
    np.testing.assert_allclose(placing.translation, right.translation, atol=1e-6)


def test_better_values_decide_where_a_similarity_is() -> None:
    """Of two groups of points that differ by a shift, the weights by the stated variances."""
    one = exact(8, "weights of points")
    given = one.given + np.where(np.arange(8)[:, None] < 4, 0.0, (1e-3, 0, 0))
    strong = np.where(np.arange(8) < 4, 1e-10, 1.0)
    one = replace(one, given=given, stated=strong[:, None, None] * np.eye(3), joint=1e-14 * np.eye(24))
    placing = FRAME.inverse()
    placing = one.points.moved(placing, one.points.model(placing, estimated=False), ())
    np.testing.assert_allclose(placing.apply(one.free)[:4], given[:4], atol=1e-8)
    np.testing.assert_allclose(placing.apply(one.free)[4:], given[4:] - (1e-3, 0, 0), atol=1e-7)


def test_the_start_is_the_similarity_that_most_agree_upon(monkeypatch: pytest.MonkeyPatch) -> None:
    one = exact(7, "start")
    given = one.given.copy()
    given[[1, 5]] += ((3.0, 0, 1), (0, 4.0, 0))
    spoiled = replace(one, given=given)
    for most in (given_points.MAX_TRIPLES, 34):  # all 35, or as many at random
        monkeypatch.setattr(given_points, "MAX_TRIPLES", most)
        of_all, found = given_points._starts(spoiled.points, None)
        assert np.linalg.norm(of_all.apply(one.free) - given, axis=1).min() > 0.1
        assert found.scale == pytest.approx(2.5)
        np.testing.assert_allclose(found.apply(one.free)[[0, 2, 3]], one.given[[0, 2, 3]], atol=1e-9)
    three = one.select(np.arange(3))
    assert [one.scale for one in given_points._starts(three.points, FRAME)] == pytest.approx([2.5])
    assert list(given_points._starts(one.select(np.arange(2)).points, FRAME)) == [FRAME]
    assert list(given_points._starts(one.select(np.arange(2)).points, None)) == []
    line = replace(three, free=np.outer(np.arange(3), np.ones(3)), given=np.outer(np.arange(3), np.ones(3)))
    assert list(given_points._starts(line.points, FRAME)) == [FRAME]


@pytest.mark.parametrize(("n", "h"), [(4, 3), (5, 3), (6, 4), (7, 4), (8, 5)])
def test_the_start_minimises_the_distance_of_more_than_half(n: int, h: int) -> None:
    one = exact(n, f"quantile {n}")
    one = replace(one, given=one.given + 0.05 * seed_of(f"quantile {n}").normal(size=(n, 3)))
    found = list(given_points._starts(one.points, None))[-1]

    def distance(by: Similarity) -> float:
        return float(np.sort(np.linalg.norm(by.apply(one.free) - one.given, axis=1))[h - 1])

    triples = [list(some) for some in combinations(range(n), 3)]
    every = [distance(fit_similarity(one.free[some], one.given[some])) for some in triples]
    assert distance(found) == pytest.approx(min(every))


def test_centre_and_size() -> None:
    centre, size = free_network.centre_and_size(np.array([[0.0, 0, 0], [2, 0, 8]]))
    assert centre.tolist() == [1, 0, 4] and size == 4


def test_scales_of_lengths_are_compared_with_their_covariance() -> None:
    free: FloatArray = np.array([[0.0, 0, 0], [3, 4, 0], [0, 0, 2]])
    reference = Figure(free, np.zeros((3, 3, 3)), free, 1e-4 * np.eye(9), 77).reference
    sigma = np.array([0.02, 0.02])
    found = scales_of_lengths(
        ScaleBars(np.array([0, 0]), np.array([1, 2]), np.array([10.0, 4.1]), sigma), reference
    )
    np.testing.assert_allclose(found.log, np.log([2, 2.05]))
    np.testing.assert_allclose(np.sqrt(found.variance), sigma / [10, 4.1])
    by_first = [3 / 25, 4 / 25, 0, -3 / 25, -4 / 25, 0, 0, 0, 0]
    assert found.J.toarray()[0].tolist() == pytest.approx(by_first)
    model = found.model(reference)
    np.testing.assert_allclose(model.v, [np.log(2), np.log(2.05)])
    np.testing.assert_allclose(model.network, 1e-4 * np.array([[2 / 25, 0], [0, 0.5]]), atol=1e-18)
    np.testing.assert_allclose(model.stated, np.diag([4e-6, (0.02 / 4.1) ** 2]), rtol=0.03)
    assert model.A.tolist() == [[1], [1]] and model.item.tolist() == [0, 1] and model.redundancy == 77


@pytest.mark.parametrize("factor", [1e-3, 0.5, 1.0, 30.0])
def test_a_mistyped_length_is_as_many_standard_deviations_off_as_its_logarithm(factor: float) -> None:
    """By the length that the others predict; by itself, a short bar would have little weight."""
    scale = np.array([2.0, 2.0 * factor, 2.0])
    one = exact(1, "mistyped length")
    model = Scales(np.log(scale), csr_matrix((3, 3)), (1e-4 / scale) ** 2).model(one.reference)
    sigma = np.sqrt(np.diagonal(model.stated))
    np.testing.assert_allclose(sigma[[0, 2]], 1e-4 / 2)
    off = model.v[1] - model.v[0]
    assert off / sigma[1] == pytest.approx(2 * (factor - 1) / 1e-4) and sigma[1] > 0


def test_mirrored_points_state_what_was_wrong_as_given() -> None:
    one = exact(6, "mirror by hand")
    found = judge(replace(one, given=one.given * (1, 1, -1)), 0.001)
    assert found is not None and found.mirrored and found.judgement.fits
    assert found.unmirrored is not None and found.unmirrored > 1e3
    right = judge(one, 0.001)
    assert right is not None and not right.mirrored and right.judgement.fits
    np.testing.assert_allclose(right.placing.apply(one.free), one.given, atol=1e-9)
    assert judge(one.select(np.arange(2)), 0.001) is None


@pytest.mark.parametrize("estimated", [False, True])
@pytest.mark.parametrize("far", [0.0, 1e6])
def test_points_without_noise_fit(estimated: bool, far: float) -> None:
    """Differences of 1e-16 and covariances of a network whose residuals are 1e-13 px: ratios of rounding."""
    one = exact(7, "without noise")
    one = replace(one, given=one.given + far, stated=np.zeros((7, 3, 3)), joint=1e-30 * np.eye(21))
    found = judge(one, 0.001, estimated=estimated)
    assert found is not None and found.judgement.fits and found.judgement.statistic < 14  # on average
    given = one.given.copy()
    given[3, 1] += 1e-6 if far == 0 else 1e-2
    wrong = judge(replace(one, given=given), 0.001, estimated=estimated)
    assert wrong is not None and wrong.judgement.wrong == (3,)


def test_coordinates_have_the_rounding_of_the_largest() -> None:
    one = exact(4, "rounding")
    one = replace(one, given=one.given + 1e3, joint=np.zeros((12, 12)))
    placing = replace(FRAME.inverse(), translation=FRAME.inverse().translation + 1e3)
    largest = float(np.abs(one.given).max())
    sigma = np.sqrt(np.diagonal(one.points.model(placing, estimated=False).network))
    np.testing.assert_allclose(sigma, 16 * 2.0**-52 * largest)


def test_a_bias_explains_what_parameters_more_would() -> None:
    """Its chi-square is the fall between two models, its parameters those of least squares."""
    model = of_points("bias")
    second = (model.item > 2)[:, None] * model.A
    found, each = model.kept().bias(second), replace(model, A=np.hstack([model.A, second]))
    before, after = misfit(model), misfit(each)
    assert found.dof == before[1] - after[1] == 4
    assert found.statistic == pytest.approx(before[0] - after[0])
    S = np.linalg.inv(model.network + model.stated)
    x = np.linalg.solve(each.A.T @ S @ each.A, each.A.T @ S @ model.v)
    np.testing.assert_allclose(found.parameters, x[4:], rtol=1e-9)
    none = model.kept().bias(model.A)
    assert (none.dof, none.statistic, none.probability) == (0, 0.0, 1.0)


@pytest.mark.parametrize("shared", [False, True])
def test_a_bias_is_tested_by_all_its_parameters_and_by_each(shared: bool) -> None:
    """Half of the level each, that of single ones divided by their number."""
    n = 4
    model = replace(bars(*np.zeros(2 * n), redundancy=10**9), A=np.tile(np.eye(n), (2, 1)))
    v = np.full(n, 3.0) if shared else 6.0 * np.eye(n)[0]  # differences of variance 2
    model = replace(model, v=np.concatenate([np.zeros(n), v]))
    found = model.kept().bias(np.concatenate([np.zeros((n, n)), np.eye(n)]))
    assert found.statistic == pytest.approx(18.0) and found.dof == n
    together = stats.chi2.sf(18.0, n)
    single = n * stats.chi2.sf(4.5 if shared else 18.0, 1)
    assert (together < single) == shared
    assert found.probability == pytest.approx(2 * min(together, single), rel=1e-3)


def test_few_values_do_not_confirm_one_another() -> None:
    """A value must be checked in all its rows: three points leave two degrees of freedom, bars one of two."""
    five, four = exact(5, "five confirm"), exact(4, "four do not")
    placing = FRAME.inverse()
    assert five.points.model(placing, estimated=False).confirms_rest((1,))
    assert not four.points.model(placing, estimated=False).confirms_rest((1,))
    assert bars(0.0, 1.0, 2.0).confirms_rest((1,)) and not bars(0.0, 1.0).confirms_rest((1,))
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [1, 1, 1]])
    near = replace(five, given=line, free=FRAME.apply(line)).points.model(placing, estimated=False)
    assert near.confirms_rest((4,)) and not near.kept((0,)).dof < 3 and not near.confirms_rest((0,))


@pytest.mark.parametrize(
    ("n", "agreed", "assigned"), [(3, 0, 0), (4, 0, 1), (40, 0, 1), (41, 0, 0), (41, 21, 1)]
)
def test_names_of_four_to_forty_points_are_assigned(n: int, agreed: int, assigned: int) -> None:
    """Three have similar triangles by chance; of more than 40 those that disagree with the others."""
    one = exact(n, f"assigned {n}")
    given = np.concatenate([one.given[:agreed], np.roll(one.given[agreed:], 1, axis=0)])
    placing = FRAME.inverse() if agreed else None
    found = list(given_names.assignments(one.free, given, one.points.variances, placing))[:1]
    right = (*range(agreed), *np.roll(range(agreed, n), -1).tolist())
    assert found == [right] * assigned


def test_only_strains_that_points_show_are_looked_for() -> None:
    """Before: a plane grid with points 0.02 mm off was "stretched by +442 %", along its normal."""
    rng = seed_of("strains")
    space, plane = rng.uniform(-1, 1, (9, 3)), rng.uniform(-1, 1, (9, 3)) * (1, 1, 0)
    assert [len(one) for one in given_points._determined_strains(space)] == [1, 1, 1, 5]
    shown = given_points._determined_strains(plane)
    assert [len(one) for one in shown] == [1, 1, 2]
    for one in shown:
        assert np.abs(one[:, 2]).max() < 1e-9 and np.abs(one[:, :, 2]).max() < 1e-9
    assert np.abs(np.trace(shown[2], axis1=1, axis2=2)).max() < 1e-9  # the scale is no strain


@pytest.mark.parametrize("wrong", [0, 30])
def test_the_effort_of_a_judgement_grows_slowly_with_the_values(
    wrong: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each set of wrong values was updated from the beginning: the square of their number."""
    count = 0
    update = given_values.Kept.without

    def counted(self: given_values.Kept, one: int) -> given_values.Kept:
        nonlocal count
        count += 1
        return update(self, one)

    monkeypatch.setattr(given_values.Kept, "without", counted)
    rng = seed_of("many values")
    v = rng.normal(size=160) * (1.5 if wrong == 0 else 1.0)
    v[:wrong] += 30.0 * rng.choice([-1, 1], wrong)
    judged = judge_values(bars(*v), 0.001)
    assert judged.wrong == tuple(range(wrong)) if wrong else judged.factor > 1.2
    assert count < 1000  # the square of 80 or of 30 is more


def test_a_value_is_suspected_where_its_update_would_let_the_others_fit() -> None:
    """What the test of all together excludes needs no update; the values found are the same."""
    model = bars(0.0, 0.2, -0.1, 9.0, 0.1, 0.0)
    fit = tuple(k for k in range(6) if model.fits(0.001, (k,)))
    assert fit == (3,)
    every = model.kept()
    fall, rank = every.decreases()
    assert [k for k in range(6) if every.may_fit(0.001, float(fall[k]), int(rank[k]))] == [3]


@pytest.mark.parametrize("fixed", [False, True])
def test_values_that_are_right_predict_the_others_as_they_would_together(fixed: bool) -> None:
    """Chi-square of all values is that of the right ones, plus that of the others beside them."""
    rng = np.random.default_rng(5)
    C = rng.standard_normal((9, 9))
    A = rng.standard_normal((9, 3))
    A[:6, 2] = 0.0  # a parameter that only the other values have
    stated = np.diag(np.where(np.arange(9) < 4, 0.0 if fixed else 0.1, 0.3))
    model = GivenModel(rng.standard_normal(9), C @ C.T, stated, A, np.arange(9) // 2, 50)
    right = np.arange(9) < 6
    beside = model.beside(right)
    assert beside.items == 2 and beside.confirmed == 3
    both = model.part(right).kept().chi2 + beside.kept().chi2
    assert both == pytest.approx(model.kept().chi2, rel=1e-8)
    assert beside.kept().dof + model.part(right).kept().dof == model.kept().dof
    without = beside.kept((0,)).chi2 + model.part(right).kept().chi2
    assert without == pytest.approx(model.kept((3,)).chi2, rel=1e-8)
    assert model.beside(np.zeros(9, dtype=bool)) is model


def test_a_coordinate_without_error_leaves_the_reliability_of_its_point() -> None:
    """One of two coordinates is exact, of the network and as given: the covariance is singular."""
    A = np.tile(np.eye(2), (4, 1))
    stated = np.diag([1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    model = GivenModel(np.zeros(8), np.zeros((8, 8)), stated, A, np.repeat(np.arange(4), 2), 100)
    reach = model.external()
    assert np.isfinite(reach[1:]).all() and reach[1] == pytest.approx(reach[2]) and reach[0] > 0
