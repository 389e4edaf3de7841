"""The adjustment with an alternative: how many rounds it takes, and what it changes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement.hypotheses import families
from sfm.judgement.hypotheses import refit as refitting
from sfm.judgement.hypotheses.families import Alternative
from sfm.judgement.hypotheses.refit import (
    Refit,
    precision_factor,
    readjusted,
    refit,
    shifts_of,
    spread_of_photographs,
)
from sfm.judgement.hypotheses.score import Gain, reduce_adjustment
from sfm.model.errors import GeometryError
from sfm.model.network import ObjectPoints
from tests.synthetic import make_network, observed_anew, seed_of


@pytest.fixture(scope="module")
def a() -> Adjustment:
    network, truth = make_network(seed_of("refitted"), images=6, points=14, free=("c",))
    return adjust(network, truth, datum=Datum("free"), reject="none")


def held(name: str, a: Adjustment) -> Alternative:
    """Return the alternative that a held parameter is wrong, with a step of one unit."""
    s = a.estimate.cameras[0].names.index(name)
    gain = Gain(9.0, 1, np.ones(1))
    every = np.ones(len(a.network.images))
    return Alternative(families.HELD, "all", every, gain, parameters=((0, s),))


def rounds(
    a: Adjustment,
    monkeypatch: pytest.MonkeyPatch,
    gains: list[float],
    most: int,
    adjustments: int = 1,
    asked: float = -np.inf,
) -> tuple[int, Refit | None]:
    """Return how many rounds a refit takes whose further steps gain so much of v'Pv, and the refit."""
    taken = []

    def stepped(*given: Any, **_: Any) -> tuple[Adjustment, Any, int]:
        taken.append(given)
        return a, given[3] + given[4], adjustments

    left = iter(gains)
    monkeypatch.setattr(refitting, "_stepped", stepped)
    monkeypatch.setattr(refitting, "gain_of", lambda *_: Gain(next(left), 1, np.full(1, 0.5)))
    found = refit(a, held("K1", a), a, asked=asked, most=most)
    return len(taken), found


def test_rounds_end_where_a_step_is_a_tenth_of_its_standard_deviation(
    a: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A parameter that is t standard deviations from its optimum gains t^2."""
    count, found = rounds(a, monkeypatch, [0.12**2, 0.08**2, 0.0], most=24)
    assert count == 2 and found is not None and found.finished
    assert found.beta.tolist() == [1.5]  # the first step, and half a unit


def test_rounds_that_do_not_end_are_few_and_those_of_a_search_fewer(
    a: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A far step needs four or five; where the work is limited, no further round begins."""
    count, found = rounds(a, monkeypatch, [9.0] * 99, most=10**6)
    assert 5 <= count <= 10 and found is not None and found.finished
    count, found = rounds(a, monkeypatch, [9.0] * 99, most=6, adjustments=3)
    assert count == 2 and found is not None and not found.finished
    assert found.beta.tolist() == [1.5]
    count, found = rounds(a, monkeypatch, [0.0] * 99, most=1, adjustments=3)
    assert count == 1 and found is not None and found.finished


def test_an_adjustment_that_has_no_solution_ends_a_refit(
    a: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refitting, "_stepped", lambda *_, **__: None)
    assert refit(a, held("K1", a), a) is None
    monkeypatch.undo()

    def undetermined(*_: object) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr(refitting, "reduce_adjustment", undetermined)
    assert refit(a, held("K1", a), a) is None


def test_earlier_alternatives_are_adjusted_with_a_new_one(a: Adjustment) -> None:
    """Both end at the same parameters, whichever comes first; each gets its own ones back."""
    first, second = held("K1", a), held("b1", a)
    alone = refit(a, first, a)
    assert alone is not None
    both = refit(a, second, alone.adjustment, [(first, alone.beta)])
    other = refit(a, second, a)
    assert both is not None and other is not None
    swapped = refit(a, first, other.adjustment, [(second, other.beta)])
    assert swapped is not None and len(both.before) == len(swapped.before) == 1
    np.testing.assert_allclose(both.beta, swapped.before[0], rtol=1e-3, atol=2e-3)
    np.testing.assert_allclose(both.before[0], swapped.beta, rtol=1e-3, atol=2e-3)
    assert both.adjustment.vPv == pytest.approx(swapped.adjustment.vPv, rel=1e-6)
    assert both.gain == pytest.approx(
        refitting.log_likelihood_of(both.adjustment) - refitting.log_likelihood_of(alone.adjustment)
    )


@pytest.mark.parametrize(("loss", "halved"), [(-5.0, 0), (0.008, 0), (0.013, 1), (50.0, 1)])
def test_a_step_is_halved_where_it_loses_likelihood(
    a: Adjustment, loss: float, halved: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By more than a hundredth, which rounding and the last iteration may take."""
    found = [replace(a, iterations=k) for k in range(2)]
    value = {0: -loss, 1: 1.0}
    tried = iter(found)
    monkeypatch.setattr(refitting, "readjusted", lambda *_: next(tried))
    monkeypatch.setattr(
        refitting, "log_likelihood_of", lambda one: 0.0 if one is a else value[one.iterations]
    )
    D = np.ones((len(a.rejected), 2, 1))
    stepped = refitting._stepped(a, D, a, np.array([3.0]), np.array([2.0]), least=0.0)
    assert stepped is not None
    taken, beta, count = stepped
    assert taken is found[halved] and count == 1 + halved
    assert beta.tolist() == [3.0 + 2.0 / 2**halved]


def test_where_every_step_loses_the_first_that_was_solved_is_taken(
    a: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = [None, *(replace(a, iterations=k) for k in range(9))]
    tried = iter(found)
    monkeypatch.setattr(refitting, "readjusted", lambda *_: next(tried))
    monkeypatch.setattr(refitting, "log_likelihood_of", lambda one: 0.0 if one is a else -9.0)
    D = np.ones((len(a.rejected), 2, 1))
    stepped = refitting._stepped(a, D, a, np.zeros(1), np.ones(1), least=0.0)
    assert stepped is not None and stepped[0] is found[1] and stepped[1].tolist() == [0.5]


def test_an_adjustment_that_is_not_checked_is_none(a: Adjustment, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may reject all image points but those that it needs; its errors are those of the network."""
    shared: Any = SimpleNamespace(name="shared")
    plain = replace(a, error_correlation=shared)

    def solved(**parts: Any) -> Adjustment | None:
        monkeypatch.setattr(refitting, "adjust", lambda *_, **__: replace(a, **parts))
        return readjusted(plain, a.network, a)

    good = solved(redundancy=1)
    assert good is not None and good.error_correlation is shared
    assert solved(redundancy=0) is None and solved(converged=False) is None

    def refuse(*_: object, **__: object) -> Adjustment:
        raise GeometryError("none")

    monkeypatch.setattr(refitting, "adjust", refuse)
    assert readjusted(plain, a.network, a) is None


@pytest.mark.parametrize("design_effect", [1.0, 2.5])
def test_a_trial_has_the_redundancy_of_an_adjustment_with_covariance(
    a: Adjustment, design_effect: float
) -> None:
    """Errors in common lower it by redundancy numbers, for which the covariance is needed; else it is not."""
    network = replace(a.network, sources=(replace(a.network.sources[0], design_effect=design_effect),))
    plain = adjust(network, a.estimate, datum=Datum("free"))
    trial = readjusted(plain, network, plain)
    assert trial is not None and trial.redundancy == plain.redundancy
    assert trial.sigma0 == pytest.approx(plain.sigma0) and (trial.rejected == plain.rejected).all()
    assert np.isfinite(trial.covariance.points).all() == (design_effect > 1)


def test_another_network_is_adjusted_as_the_plain_one(a: Adjustment, monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {}
    monkeypatch.setattr(refitting, "adjust", lambda *_, **options: given.update(options) or a)
    rejected = np.arange(len(a.rejected)) < 3
    for datum in ("free", "control"):
        plain = replace(a, datum=datum, test_alpha=1e-4, false_alarm=0.02)
        readjusted(plain, a.network, replace(a, rejected=rejected))
        assert given["datum"].kind == datum
        assert (given["options"].alpha, given["false_alarm"], given["reject"]) == (1e-4, 0.02, "tau")
        np.testing.assert_array_equal(given["rejected"], rejected)


def test_with_control_the_shift_is_that_of_the_cameras() -> None:
    """The largest of all cameras and parameters in standard deviations; held ones have none."""
    network, truth = make_network(
        seed_of("shift of cameras"), images=6, points=20, cameras=2, free=("c", "x0")
    )
    control = ObjectPoints(np.arange(20), truth.points, np.zeros((20, 3, 3)))
    plain = adjust(network.with_given(control), truth, datum=Datum("control"), reject="none")
    sigma = [plain.interior_sigma(k) for k in range(2)]
    assert np.isfinite(sigma[0][:2]).all() and not sigma[0][2] > 0

    def changed(*by: tuple[int, int, float]) -> Adjustment:
        cameras = list(plain.estimate.cameras)
        for k, s, step in by:
            p = cameras[k].parameters.copy()
            p[s] += step
            cameras[k] = cameras[k].with_parameters(p)
        return replace(plain, estimate=replace(plain.estimate, cameras=tuple(cameras)))

    one = held("K1", plain)
    for by, shift in (
        ([(0, 0, 3 * sigma[0][0])], 3.0),
        ([(0, 0, -3 * sigma[0][0]), (1, 1, 4 * sigma[1][1])], 4.0),
        ([(0, 1, -7 * sigma[0][1]), (1, 0, 4 * sigma[1][0])], 7.0),
        ([(1, 2, 1.0)], 0.0),
    ):
        largest, rms = shifts_of(plain, plain, changed(*by), one, np.zeros(1))
        assert largest == pytest.approx(shift) and np.isnan(rms)


@pytest.mark.parametrize(("datum", "images", "points"), [("free", 4, 14), ("control", 8, 30)])
def test_photographs_without_common_errors_scatter_as_stated(
    datum: Literal["free", "control"], images: int, points: int
) -> None:
    """The factor corrects for the redundancy and the number of photographs, and is 10 to 15 % too large."""
    factors = []
    for k in range(8):
        rng = seed_of(f"scatter of photographs {k}")
        network, truth = make_network(rng, images=images, points=points, free=("c",), noise_px=0.1)
        if datum == "control":
            network = network.with_control(network.points, truth.points)
        a = adjust(network, truth, datum=Datum(datum), reject="none")
        factors.append(precision_factor(a))
    rms = float(np.sqrt(np.mean(np.square(factors))))
    assert (1.0 if datum == "free" else 0.7) < rms < 1.3


def test_errors_common_to_a_photograph_widen_a_calibration() -> None:
    """c, x0 and y0 of photographs of given points whose scales differ by 0.6 px at the edge."""
    factors = []
    for scale in (0.0, 3e-3):
        rng = seed_of("scales of photographs")
        network, truth = make_network(rng, images=12, points=40, free=("c", "x0", "y0"), noise_px=0.1)
        seen = network.image_points
        control = network.with_control(network.points[:6], truth.points[:6])
        by = scale * rng.standard_normal((12, 1))[seen.image] * (seen.xy - (999.5, 749.5))
        network = replace(control, image_points=replace(seen, xy=seen.xy + by))
        a = adjust(network, truth, datum=Datum("control"), reject="none")
        factors.append(precision_factor(a))
    assert factors[1] > 1.5 * factors[0]


def moved_refit(name: str, *, scatter: float = 0.0) -> tuple[Refit, Alternative]:
    """Return the refit of points that moved, by vectors that scatter among the photographs or do not."""
    rng = seed_of(name)
    network, truth = make_network(rng, images=12, points=30, free=("c",), noise_px=0.1)
    xy = network.image_points.xy.copy()
    seen = network.image_points
    for i in range(6, 12):
        X = truth.points.copy()
        X[:5] += np.array([2e-3, -1e-3, 1e-3]) * (1 + scatter * rng.standard_normal())
        there = observed_anew(network, replace(truth, points=X), 0.1, seed_of(f"{name} {i}"))
        xy[seen.image == i] = there.image_points.xy[seen.image == i]
    a = adjust(replace(network, image_points=replace(seen, xy=xy)), truth, datum=Datum("free"), reject="none")
    reduced = reduce_adjustment(a)
    points = np.arange(5)
    one = Alternative(families.MOVED, "split", (np.arange(12) >= 6).astype(float), points=points)
    gain = refitting.gain_of(*reduced.project(one.whitened(reduced)))
    one = replace(one, gain=gain)
    found = refit(a, one, a)
    assert found is not None
    return found, one


def test_a_movement_is_the_same_in_all_photographs_that_show_it() -> None:
    """What single photographs say of it scatters by chance only, and more where it is no movement."""
    same, other = (
        [
            spread_of_photographs(*moved_refit(f"movement {scatter} {k}", scatter=scatter), [])
            for k in range(6)
        ]
        for scatter in (0.0, 0.2)
    )
    assert 0.4 < np.mean(same) < 1.5
    assert np.mean(other) > 2.5


def test_what_other_causes_explain_is_no_spread_of_photographs() -> None:
    """The direction of an alternative is what is left of it beside the others."""
    found, one = moved_refit("movement 0.0 0")
    a = found.adjustment
    reduced = reduce_adjustment(a)
    others = replace(one, points=np.array([20, 21]))
    effect, taken = (some.whitened(reduced) for some in (one, others))
    both = np.concatenate([(effect @ found.beta)[:, :, None], taken], axis=2)
    left = reduced.absorb(both)[2].reshape(-1, 7)
    along = left[:, 0] - left[:, 1:] @ np.linalg.pinv(left[:, 1:]) @ left[:, 0]
    slope = [(reduced.v * along.reshape(-1, 2))[reduced.image == i].sum() for i in range(reduced.photographs)]
    expected = np.square(slope).sum() / (along @ along) * 12 / 11
    assert spread_of_photographs(found, one, [others]) == pytest.approx(expected)
    assert spread_of_photographs(found, one, []) != pytest.approx(expected)


@pytest.mark.parametrize(("asked", "expected"), [(-np.inf, 3), (4.0, 3), (12.0, 2)])
def test_rounds_end_where_the_gain_that_is_asked_for_is_out_of_reach(
    a: Adjustment, monkeypatch: pytest.MonkeyPatch, asked: float, expected: int
) -> None:
    """The rounds stay at a gain of 0, and a further step promises 9."""
    count, found = rounds(a, monkeypatch, [9.0, 9.0, 0.0], most=24, asked=asked)
    assert count == expected and found is not None and found.finished
