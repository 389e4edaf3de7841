"""Given values against a free network: what is wrong of them is identified, or all are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.quality.statistics import non_centrality
from sfm.judgement.given import points as given_points
from sfm.judgement.given import values as given_values
from sfm.judgement.given.points import PlacedPoints
from sfm.judgement.given.scales import Scales, scale_of_points, scales_of_lengths
from sfm.judgement.given.values import GivenModel, Judgement, judge_values
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.distributions import LEVEL
from sfm.model.network import ScaleBars
from sfm.model.similarity import Similarity
from tests.given_figures import Figure, judge
from tests.survey.mistyped import BOX, PYRAMID
from tests.synthetic import seed_of

SIGMA = 1e-3
FRAME = Similarity(0.4, rotation_from_vector(np.array([0.3, -0.2, 1.1])), np.array([5.0, -2.0, 1.0]))


def bars(*errors: float, sigma: float = SIGMA, network: float = 1e-5) -> GivenModel:
    """Return the model of bars of unit length with these errors."""
    n = len(errors)
    stated, free = sigma**2 * np.eye(n), network**2 * np.eye(n)
    return GivenModel(np.array(errors), free, stated, np.ones((n, 1)), np.arange(n), 500)


def points(n: int, name: str, *, noise: float = SIGMA, network: float = 2e-4) -> Figure:
    """Return points of a cube given with noise, and of a free network in another frame."""
    rng = seed_of(name)
    X = rng.uniform(-1, 1, (n, 3))
    given = X + noise * rng.standard_normal((n, 3))
    free = FRAME.apply(X) + 0.4 * network * rng.standard_normal((n, 3))
    stated = np.tile(SIGMA**2 * np.eye(3), (n, 1, 1))
    return Figure(given, stated, free, (0.4 * network) ** 2 * np.eye(3 * n), 500)


def moved(one: Figure, k: int, by: FloatArray) -> Figure:
    given = one.given.copy()
    given[k] += by
    return replace(one, given=given)


def test_right_values_fit_at_the_level() -> None:
    rng = seed_of("level of bars")
    low = [
        judge_values(bars(*(SIGMA * rng.standard_normal(5))), LEVEL).probability < 0.05 for _ in range(400)
    ]
    assert 2 <= sum(low) <= 36  # 20 expected, fewer as three tests share the level
    found = [judge(points(6, f"level {k}"), 0.05) for k in range(100)]
    assert sum(not one.judgement.fits for one in found if one is not None) <= 12


@pytest.mark.parametrize("error", [6 * SIGMA, 0.01, 1.0, -2.0])
def test_of_two_neither_is_believed(error: float) -> None:
    assert judge_values(bars(0.0, error), LEVEL).doubtful == (0, 1)


@pytest.mark.parametrize("error", [9 * SIGMA, 0.1, 7.0])
def test_of_three_the_wrong_one_is_identified(error: float) -> None:
    assert judge_values(bars(0.0, error, SIGMA), LEVEL).wrong == (1,)


def test_two_of_five_are_identified_and_two_against_two_are_not() -> None:
    assert judge_values(bars(0.0, 0.3, 0.0, -0.2, SIGMA), LEVEL).wrong == (1, 3)
    assert judge_values(bars(0.0, 0.0, 0.3, 0.3), LEVEL).doubtful == (0, 1, 2, 3)


@pytest.mark.parametrize(("apart", "named"), [(3.9, False), (4.1, True)])
def test_two_that_agree_with_each_other_may_have_one_cause(apart: float, named: bool) -> None:
    """Of seven: chi-square of the two, apart^2 / 2, against MARGIN less 3 ln 7, as five check more."""
    found = judge_values(bars(*[0.0] * 5, 1.0, 1.0 + apart * SIGMA), LEVEL)
    assert found.wrong == ((5, 6) if named else ()) and bool(found.doubtful) != named


def test_the_margin_decides_whether_one_is_reported_from_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Removing either of two of three heals; chi-square differs by 8.2, and 13.8 are needed."""
    model = bars(-2.2 * SIGMA, 0.0, 4.6 * SIGMA)
    fall = sorted(model.kept((k,)).chi2 for k in range(3))
    assert fall[1] - fall[0] == pytest.approx(8.2, abs=0.3)
    level = 0.02
    assert judge_values(model, level).doubtful == (0, 2)
    monkeypatch.setattr(given_values, "MARGIN", given_values.MARGIN / 2)
    assert judge_values(model, level).wrong == (2,)


def test_the_level_and_the_noncentrality_are_those_of_baarda() -> None:
    from sfm.model.distributions import normal_ppf

    assert LEVEL == 0.001 and pytest.approx(2 * np.log(1 / LEVEL)) == given_values.MARGIN
    delta = normal_ppf(1 - LEVEL / 2) + normal_ppf(0.8)
    assert pytest.approx(delta, abs=0.01) == non_centrality()


def test_a_weak_value_does_not_check_a_strong_one() -> None:
    model = replace(bars(0.0, 0.0), stated=np.diag([SIGMA**2, (10 * SIGMA) ** 2]))
    reach = model.external()
    assert reach[0] == pytest.approx(4.13 * 10, rel=0.02)  # sqrt((1 - r) / r) with r = 1 / 101
    assert reach[1] == pytest.approx(0.413, rel=0.02)
    assert np.isinf(bars(0.0).external()).all()


@pytest.mark.parametrize("by", [12 * SIGMA, 0.1, 100.0])
def test_one_wrong_point_is_identified(by: float) -> None:
    one = moved(points(6, "one wrong"), 2, by * np.array([0.0, 0.6, 0.8]))
    found = judge(one, LEVEL)
    assert found is not None and found.judgement.wrong == (2,)
    placed = found.placing.apply(FRAME.apply(np.eye(3)))
    np.testing.assert_allclose(placed, np.eye(3), atol=5e-3)


def test_a_very_wrong_point_hides_nothing_of_the_others() -> None:
    """Ten times the error costs 2 ln 10 for each coordinate, and the others misfit as before."""
    near, far = (judge(moved(points(8, "huge"), 4, np.array([0.0, 0.0, by])), LEVEL) for by in (1e3, 1e4))
    assert near is not None and far is not None
    assert far.misfit - near.misfit == pytest.approx(3 * 2 * np.log(10), abs=1e-3)


def test_many_wrong_points_of_many_are_identified() -> None:
    one, rng = points(60, "many wrong"), seed_of("which are wrong")
    wrong = sorted(rng.permutation(60)[:20].tolist())
    given = one.given.copy()
    given[wrong] += 0.05 * rng.standard_normal((20, 3))
    found = judge(replace(one, given=given), LEVEL)
    assert found is not None and found.judgement.wrong == tuple(wrong)


def test_of_three_points_none_is_identified() -> None:
    found = judge(moved(points(3, "three"), 0, np.array([0.05, 0.05, 0.0])), LEVEL)
    assert found is not None and found.judgement.doubtful == (0, 1, 2)


def test_of_four_points_none_is_left_out() -> None:
    """Two degrees of freedom of three that remain are too few to confirm them."""
    for k in range(5):
        found = judge(moved(points(4, f"one of four {k}"), 1, 50 * SIGMA * np.eye(3)[k % 3]), LEVEL)
        assert found is not None and found.judgement.wrong == () and 1 in found.judgement.doubtful
        assert not found.judgement.one_wrong


def test_one_of_two_is_wrong_that_the_others_confirm() -> None:
    """Two points side by side, far from four that are right, and a distance that is wrong."""
    one = pair_far_from_others("far pair")
    found = judge(one, LEVEL)
    assert found is not None and found.judgement.doubtful == (4, 5) and found.judgement.one_wrong
    few = judge(one.select(np.array([0, 1, 4, 5])), LEVEL)
    assert few is not None and few.judgement.doubtful and not few.judgement.one_wrong


def pair_far_from_others(name: str) -> Figure:
    X = np.concatenate([0.02 * PYRAMID[[0, 1, 2, 4]], [[1.0, 0, 0], [1.02, 0, 0]]])
    return moved(figure(X, list(range(6)), name), 5, 9 * SIGMA * np.eye(3)[0])


@pytest.mark.sweep(1, 2)
@pytest.mark.parametrize(("factor", "axis"), [(0.99, 0), (1.01, 1), (1.5, 2), (0.99, 2)])
def test_stretched_points_are_named(factor: float, axis: int) -> None:
    for n in (6, 12):
        one = points(n, f"stretched {n}")
        by = np.where(np.arange(3) == axis, factor, 1.0)
        found = judge(replace(one, given=by * one.given), LEVEL)
        assert found is not None and found.judgement.doubtful == tuple(range(n)) and not found.judgement.wrong
        if n == 12:
            assert found.strain is not None and found.strain.axis == "XYZ"[axis]
            assert found.strain.elongation == pytest.approx(factor - 1, abs=4 * SIGMA)


def test_a_strain_costs_its_parameters_and_their_choice() -> None:
    one = points(12, "stretched 12")
    stretched = replace(one, given=(1.01, 1, 1) * one.given)
    plain = given_points._placed(stretched.points, LEVEL, None, False)
    assert plain is not None
    found = given_points._strained(stretched.points, LEVEL, plain, False)
    assert found is not None and found.judgement.dof == plain.judgement.dof - 1
    fall = plain.judgement.statistic - found.judgement.statistic
    # of 36 differences: ln of their number, 1 + ln of the chi-square, and twice ln of 4 kinds of strain
    assert found.cost_of_strain == pytest.approx(np.log(36) + 1 + np.log(fall) + 2 * np.log(4))


def test_an_affinity_is_a_strain_of_no_axis() -> None:
    one = points(12, "affinity")
    F = np.array([[1.02, 0.01, 0], [0.01, 0.99, 0], [0, 0, 1]])
    found = judge(replace(one, given=one.given @ F.T), LEVEL)
    assert found is not None and found.strain is not None and found.strain.axis is None
    d = np.linalg.svd(F, compute_uv=False)
    assert found.strain.elongation == pytest.approx(d[0] / d[2] - 1, abs=4 * SIGMA)
    assert found.strain.chi2 < 60 < found.judgement.statistic  # 24 degrees of freedom


def test_five_stretched_points_are_not_one_wrong() -> None:
    for k in range(4):
        one = points(5, f"five stretched {k}")
        found = judge(replace(one, given=one.given * (1.05, 1, 1)), LEVEL)
        assert found is not None and found.judgement.wrong == ()
        assert found.judgement.doubtful == (0, 1, 2, 3, 4) and found.judgement.factor == 1.0


def test_a_wrong_point_is_no_strain() -> None:
    for k in range(3):
        one = points(5, f"no strain {k}")
        found = judge(moved(one, 2, 30 * SIGMA * np.eye(3)[k % 3]), LEVEL)
        assert found is not None and found.judgement.wrong == (2,) and found.strain is None


def test_exchanged_names_are_identified() -> None:
    one = points(5, "exchanged")
    given = one.given[[0, 3, 2, 1, 4]]
    found = judge(replace(one, given=given), LEVEL)
    assert found is not None and found.judgement.fits and found.renamed == (1, 3)


@pytest.mark.sweep(0)
@pytest.mark.parametrize("count", [3, 8])
def test_coordinates_of_the_next_row_are_reassigned(count: int) -> None:
    for k in range(2):
        one = points(8, f"next rows {count} {k}")
        given = np.concatenate([np.roll(one.given[:count], 1, axis=0), one.given[count:]])
        found = judge(replace(one, given=given), LEVEL)
        assert found is not None and found.judgement.fits and found.renamed == tuple(range(count))
        assert found.order == (*np.roll(range(count), -1).tolist(), *range(count, 8))


def test_coordinates_of_a_point_that_is_not_in_the_list_are_left_out() -> None:
    one = points(9, "next row")
    shifted = replace(one.select(np.arange(8)), given=one.given[1:])
    found = judge(shifted, LEVEL)
    assert found is not None and found.judgement.wrong == (0,) and found.renamed == tuple(range(1, 8))
    np.testing.assert_allclose(found.placing.apply(one.free)[1:8], one.given[1:8], atol=0.02)


def test_names_that_symmetry_leaves_open_are_not_reassigned() -> None:
    """Of a square either pair of opposite sides may be exchanged."""
    one = points(4, "square")
    X = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    square = replace(one, free=FRAME.apply(X), given=X[[1, 0, 2, 3]])
    found = judge(square, LEVEL)
    assert found is not None and not found.order and found.judgement.doubtful == (0, 1, 2, 3)


def figure(X: FloatArray, order: list[int], name: str) -> Figure:
    """Return given points of a figure, with the coordinates of others."""
    one = points(len(X), name)
    noise = SIGMA * seed_of(f"noise of {name}").standard_normal(X.shape)
    return replace(one, free=FRAME.apply(X), given=(X + noise)[order])


def test_two_names_of_a_pyramid_may_be_exchanged_in_several_ways() -> None:
    """Three right names agree upon the base turned over; four orders place it as well."""
    for k in range(3):
        found = judge(figure(PYRAMID, [1, 0, 2, 3, 4], f"pyramid {k}"), LEVEL)
        assert found is not None and not found.order and found.judgement.wrong == ()
        assert found.judgement.doubtful == found.exchangeable == (0, 1, 2, 3)


def test_a_pyramid_as_named_is_right_and_one_wrong_point_is_identified() -> None:
    for k in range(3):
        one = figure(PYRAMID, list(range(5)), f"right pyramid {k}")
        right, wrong = judge(one, LEVEL), judge(moved(one, 1, np.array([0.05, 0, 0])), LEVEL)
        assert right is not None and right.judgement.fits and not right.exchangeable
        assert wrong is not None and wrong.judgement.wrong == (1,) and not wrong.order


@pytest.mark.parametrize(
    ("X", "order", "names"),
    [(PYRAMID, [2, 1, 0, 3, 4], (0, 1, 2, 3)), (BOX, [4, 5, 6, 7, 0, 1, 2, 3], tuple(range(8)))],
)
def test_names_whose_exchange_mirrors_a_figure_are_named(
    X: FloatArray, order: list[int], names: tuple[int, ...]
) -> None:
    for k in range(2):
        found = judge(figure(X, order, f"mirrored figure {k}"), LEVEL)
        assert found is not None and found.mirrored and set(found.exchangeable) == set(names)


def test_points_most_of_which_are_wrong_diverge_to_no_infinite_scale() -> None:
    for k in range(2):
        one = points(20, f"half of twenty {k}")
        given = one.given.copy()
        given[:11] += 0.6 * seed_of(f"wrong half {k}").standard_normal((11, 3))
        found = judge(replace(one, given=given), LEVEL)
        assert found is not None and len(found.judgement.doubtful) == 20


@pytest.mark.parametrize("n", [4, 5])
def test_few_left_handed_points_are_mirrored(n: int) -> None:
    """Three that remain lie in a plane and fit either way."""
    for k in range(2):
        one = points(n, f"left-handed {n} {k}")
        found = judge(replace(one, given=one.given[:, [1, 0, 2]]), LEVEL)
        assert found is not None and found.mirrored and found.judgement.fits


def test_three_of_eight_points_are_identified() -> None:
    for k in range(2):
        one = points(8, f"three of eight {k}")
        given = one.given.copy()
        given[[0, 3, 5]] += 0.3 * seed_of(f"three wrong {k}").standard_normal((3, 3))
        found = judge(replace(one, given=given), LEVEL)
        assert found is not None and found.judgement.wrong == (0, 3, 5)


@pytest.mark.parametrize(("factor", "believed"), [(7.0, True), (17.0, False)])
def test_standard_deviations_may_be_too_small_by_an_order_of_magnitude(factor: float, believed: bool) -> None:
    one = points(20, f"order {factor}", noise=factor * SIGMA)
    found = judge(one, LEVEL)
    assert found is not None and found.judgement.doubtful == (() if believed else tuple(range(20)))
    assert (found.judgement.factor == pytest.approx(factor, rel=0.3)) is believed


def test_the_factor_that_fits_best_may_exceed_what_must_explain_the_differences() -> None:
    """Of few points: 10 times the stated standard deviations do not contradict a scatter of 13 times."""
    found = [judge(points(8, f"thirteen {k}", noise=13 * SIGMA), LEVEL) for k in range(6)]
    factors = [one.judgement.factor for one in found if one is not None]
    assert max(factors) > 10 and sum(one > 1 for one in factors) >= 4


@pytest.mark.parametrize(
    ("noise", "estimated", "believed"),
    [(0.03, False, True), (0.075, False, False), (0.03, True, True), (0.2, True, False)],
)
def test_unstated_standard_deviations_are_two_percent_at_most(
    noise: float, estimated: bool, believed: bool
) -> None:
    one = points(20, "unstated limit", noise=noise)
    found = judge(replace(one, stated=0 * one.stated), LEVEL, estimated=estimated)
    assert found is not None and not found.mirrored and not found.renamed
    assert found.judgement.doubtful == (() if believed else tuple(range(20)))
    assert found.judgement.factor == (pytest.approx(noise, rel=0.2) if believed and not estimated else 1.0)
    assert not believed or not found.judgement.wrong


@pytest.mark.parametrize("axes", [(1, 0, 2), (0, 2, 1), (2, 1, 0)])
def test_left_handed_points_are_mirrored(axes: tuple[int, int, int]) -> None:
    one = points(6, "mirrored")
    found = judge(replace(one, given=one.given[:, list(axes)]), LEVEL)
    assert found is not None and found.mirrored and found.judgement.fits
    turned = judge(replace(one, given=one.given[:, [1, 2, 0]]), LEVEL)
    assert turned is not None and not turned.mirrored and turned.judgement.fits


def test_points_whose_similarity_does_not_converge_are_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Mirrored ones, which fit nothing."""
    one = points(8, "exchanged axes")
    monkeypatch.setattr(given_points, "MAX_STEPS", 1)
    found = judge(replace(one, given=one.given[:, [1, 0, 2]]), LEVEL)
    assert found is not None and found.mirrored


def test_one_wrong_point_of_four_is_not_a_mirror() -> None:
    for k in range(6):
        one = moved(points(4, f"four {k}"), 1, 50 * SIGMA * np.eye(3)[k % 3])
        found = judge(one, LEVEL)
        assert found is not None and not found.mirrored and not found.judgement.fits


@pytest.mark.parametrize("factor", [3.0, 10.0])
def test_standard_deviations_that_are_too_small_are_named(factor: float) -> None:
    one = points(20, f"too small {factor}", noise=factor * SIGMA)
    found = judge(one, LEVEL)
    assert found is not None and found.judgement.wrong == ()
    assert found.judgement.factor == pytest.approx(factor, rel=0.3)
    fixed = judge(replace(one, stated=0 * one.stated), LEVEL)
    assert fixed is not None and fixed.judgement.factor == pytest.approx(factor * SIGMA, rel=0.3)


@pytest.mark.parametrize(
    "errors", [(28, 28, 0, 0), (20, 0, -15, 1), (1000, -300, 0, 0), (400, -90, 30, 0, 0)]
)
def test_half_of_the_bars_wrong_are_no_imprecise_bars(errors: tuple[float, ...]) -> None:
    """Standard deviations 16 to 500 times too small would do, but so would two right bars."""
    found = judge_values(bars(*(SIGMA * np.array(errors))), LEVEL)
    assert found.factor == 1.0 and found.doubtful == tuple(range(len(errors)))


def test_twenty_bars_five_times_worse_than_stated_are_imprecise() -> None:
    found = judge_values(bars(*(5 * SIGMA * seed_of("twenty bars").standard_normal(20))), LEVEL)
    assert found.factor == pytest.approx(5, rel=0.4) and not found.doubtful


@pytest.mark.sweep(0, 2)
@pytest.mark.parametrize(("wrong", "told"), [(2, True), (3, False), (4, False), (5, True)])
def test_a_part_of_seven_points_is_right_where_it_is_clearly_the_larger(wrong: int, told: bool) -> None:
    """Some were shifted together; chi-square of three against four differs by less than the margin."""
    for k in range(3):
        one = points(7, f"parts {wrong} {k}")
        given = one.given.copy()
        given[:wrong, 2] += 40 * SIGMA
        found = judge(replace(one, given=given), LEVEL)
        assert found is not None
        smaller = tuple(range(wrong)) if wrong < 4 else tuple(range(wrong, 7))
        assert found.judgement.wrong == (smaller if told else ())
        assert found.judgement.doubtful == (() if told else tuple(range(7)))


def test_right_points_near_a_line_and_one_off_it_fit() -> None:
    """Threes on the line turn about it: what most agree upon by them is not what all fit."""
    for seed in range(60):
        rng = np.random.default_rng([6, 30, seed, 7])
        X = rng.uniform(-0.5, 0.5, (6, 3)) * (10, 0.02, 0.02)
        X[0] += [0, 1.0, 0.3]
        free = X + 2e-4 * rng.standard_normal(X.shape)
        given, stated = X + 3e-3 * rng.standard_normal(X.shape), np.tile(9e-6 * np.eye(3), (6, 1, 1))
        found = judge(Figure(given, stated, free, 4e-8 * np.eye(18), 500), LEVEL)
        assert found is not None and found.judgement.fits, seed


def test_a_wrong_point_without_stated_standard_deviations_is_identified() -> None:
    one = points(8, "unstated")
    unstated = replace(one, stated=0 * one.stated)
    right = judge(unstated, LEVEL, estimated=True)
    wrong = judge(moved(unstated, 4, np.array([0.0, 0.0, 0.05])), LEVEL, estimated=True)
    assert right is not None and right.judgement.fits
    assert wrong is not None and wrong.judgement.wrong == (4,)


@pytest.mark.parametrize(("complete", "start"), [(4, None), (2, FRAME.inverse())])
def test_single_heights_are_judged_too(complete: int, start: Similarity | None) -> None:
    """The distance of two complete points is not checked, and nothing places their mirror image."""
    one = points(7, "heights")
    given = one.given.copy()
    given[complete:, :2] = np.nan
    right = judge(replace(one, given=given), LEVEL, start=start)
    given[5, 2] += 0.05
    wrong = judge(replace(one, given=given), LEVEL, start=start)
    assert right is not None and right.judgement.fits and right.judgement.dof == 2 * complete
    assert wrong is not None and not wrong.mirrored
    assert (wrong.judgement.wrong == (5,)) if complete > 2 else 5 in wrong.judgement.doubtful


def scales_of(one: Figure, length: float) -> Scales:
    """Return the scales of a bar between the first two points and of all points."""
    found = judge(one, LEVEL)
    assert found is not None
    of_points = scale_of_points(found)
    assert of_points is not None
    bar = ScaleBars(np.array([0]), np.array([1]), np.array([length]), np.array([SIGMA]))
    return Scales.joined([scales_of_lengths(bar, one.reference), of_points])


def test_the_scale_of_points_and_of_a_bar_agree_within_their_covariance() -> None:
    squares = []
    for k in range(60):
        one = points(5, f"scale {k}")
        X = FRAME.inverse().apply(one.free)
        length = float(np.linalg.norm(X[1] - X[0]) + SIGMA * seed_of(f"bar {k}").standard_normal())
        scales = scales_of(one, length)
        assert np.exp(scales.log[1]) == pytest.approx(1 / 0.4, rel=5e-3)
        squares.append(scales.model(one.reference).kept().chi2)
    assert 0.5 < np.mean(squares) < 1.6  # chi-square of one


@pytest.mark.parametrize("n", [2, 5])
def test_derivatives_of_scales_by_the_free_network(n: int) -> None:
    one = points(5, "derivatives")
    if n == 2:
        one = replace(one, given=np.where(np.arange(5)[:, None] < 2, one.given, np.nan)).select(np.arange(2))
        placed = PlacedPoints(Judgement(0.0, 0, 1.0), FRAME.inverse(), bars(0.0), one.points)

        def scales(figure: Figure) -> Scales:
            found = scale_of_points(replace(placed, points=figure.points))
            assert found is not None
            return found
    else:

        def scales(figure: Figure) -> Scales:
            return scales_of(figure, 1.0)

    J, log = scales(one).J.toarray(), scales(one).log
    for k in range(3 * n):
        free = one.free.copy()
        free.flat[k] += 1e-6
        change = (scales(replace(one, free=free)).log - log) / 1e-6
        assert change == pytest.approx(J[:, k], abs=2e-3 * np.abs(J).max())


def test_two_points_have_a_scale_where_nothing_else_is_given() -> None:
    """With the heights of others their distance is not all that gives the scale, and is not judged."""
    one = points(7, "two complete")
    given = one.given.copy()
    given[2:, :2] = np.nan
    for count, there in ((2, True), (7, False)):
        placed = judge(replace(one, given=given).select(np.arange(count)), LEVEL, start=FRAME.inverse())
        assert placed is not None
        scale = scale_of_points(placed)
        assert (scale is not None) == there
        if scale is not None:
            apart = np.linalg.norm(one.given[1] - one.given[0]) / np.linalg.norm(one.free[1] - one.free[0])
            assert np.exp(scale.log) == pytest.approx([apart])
