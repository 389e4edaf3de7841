"""The search for causes: how much is tried, what is taken, and what a cause needs to be named."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement.hypotheses import families, hypotheses
from sfm.judgement.hypotheses.alternatives import alternatives_of, is_significant
from sfm.judgement.hypotheses.families import Alternative
from sfm.judgement.hypotheses.hypotheses import Cause, find_causes, free_network, judge_alternatives
from sfm.judgement.hypotheses.refit import Refit
from sfm.judgement.hypotheses.score import Gain, log_likelihood_gain, reduce_adjustment
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ScaleBars
from sfm.model.remarks.remark import kinds_of
from tests.synthetic import make_network, observed_anew, seed_of


@pytest.fixture(scope="module")
def a() -> Adjustment:
    network, truth = make_network(seed_of("searched"), images=6, points=14, free=("c",))
    return adjust(network, truth, datum=Datum("free"), reject="none")


@pytest.fixture(scope="module")
def zoomed() -> Adjustment:
    """A network of eight photographs, of which the last three have another c."""
    network, truth = make_network(seed_of("zoomed"), images=8, points=20, free=("c",))
    seen = network.image_points
    by = np.where(seen.image >= 5, 0.04, 0.0)[:, None] * (seen.xy - (999.5, 749.5))
    network = replace(network, image_points=replace(seen, xy=seen.xy + by))
    return adjust(network, truth, datum=Datum("free"), reject="none")


def alternative(kind: str = "c", *, price: float = 5.0, design_effect: float = 1.0) -> Alternative:
    family = {"c": families.CAMERA_FAMILIES[0], "strain": families.STRAIN, "moved": families.MOVED}[kind]
    gain = Gain(9.0, 1, np.ones(1))
    return Alternative(
        family, "split", np.array([0.0, 0, 0, 0, 1, 1]), gain, price=price, design_effect=design_effect
    )


def refitted(a: Adjustment, *, gain: float = 50.0, shift: float = 4.0) -> Refit:
    return Refit(a, np.ones(1), gain, shift, 2.0)


def test_a_cause_matters_where_it_or_a_rival_shifts_the_result(a: Adjustment) -> None:
    def cause(shift: float, *others: float, each: bool = False) -> Cause:
        rival = alternative("strain")
        rival = replace(rival, pattern="each") if each else rival
        as_well = tuple((rival, refitted(a, shift=one)) for one in others)
        return Cause(alternative(), refitted(a, shift=shift), as_well)

    assert not cause(0.9).matters and cause(1.1).matters and cause(float("nan")).matters
    assert cause(0.9, 0.5, 1.2).matters and not cause(0.9, 0.8).matters
    assert not cause(0.9, 7.0, each=True).matters  # what it leaves open is not what it shifts
    assert cause(3.0).otherwise is None and cause(3.0, 2.0, 5.0).otherwise == 5.0
    assert cause(3.0, float("nan"), 2.0).otherwise == 2.0 and cause(3.0, float("inf")).otherwise is None


def test_the_evidence_of_a_cause_is_its_gain_less_its_price(a: Adjustment) -> None:
    plain = Cause(alternative(price=7.0), refitted(a, gain=20.0), ())
    assert plain.evidence == pytest.approx(13.0)
    r = a.redundancy
    common = Cause(alternative(price=7.0, design_effect=3.0), refitted(a, gain=20.0), ())
    squares = r * (1 - np.exp(-2 * 20.0 / r))
    assert common.evidence == pytest.approx(log_likelihood_gain(squares / 3, r) - 7.0)


def test_causes_are_sought_one_beside_the_other_and_are_few(
    a: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without end where each search finds one; those that do not matter are not named."""
    cause = Cause(alternative(), refitted(a), ())
    known: list[int] = []

    def best(plain: Adjustment, causes: tuple[Cause, ...], *, reduced: Any) -> Cause:
        known.append(len(causes))
        return replace(cause, refit=refitted(a, shift=0.5 if len(causes) == 1 else 4.0))

    monkeypatch.setattr(hypotheses, "_best", best)
    monkeypatch.setattr(hypotheses, "_still_needed", lambda _, causes, found: (*causes, found))
    monkeypatch.setattr(hypotheses, "_with_joint_shifts", lambda _, causes: causes)
    found = find_causes(a)
    assert known == list(range(len(known))) and 3 <= len(known) <= 6
    assert len(found) == len(known) - 1


def tried_in(a: Adjustment, monkeypatch: pytest.MonkeyPatch) -> tuple[list[Alternative], int]:
    """Return the alternatives that a search adjusts, none of which has a solution, and the most of each."""
    tried: list[Alternative] = []
    most: list[int] = []

    def none(plain: Adjustment, one: Alternative, *_: Any, most_of: list[int] = most, **by: int) -> None:
        tried.append(one)
        most_of.append(by["most"])

    monkeypatch.setattr(hypotheses, "refit", none)
    assert hypotheses._best(a) is None
    assert len(set(most)) == 1
    return tried, most[0]


def test_two_alternatives_of_each_kind_are_adjusted(
    zoomed: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The best by the score test may be none in the adjustment; each cause is adjusted once."""
    tried, _ = tried_in(zoomed, monkeypatch)
    causes = [one.family.cause(one) for one in tried]
    assert len(set(causes)) == len(causes)
    count = Counter(cause[0] for cause in causes)
    assert max(count.values()) == 2 and len(count) >= 2
    of_camera = [one.photographs.tolist() for one in tried if one.family.cause(one)[0] == "camera"]
    assert of_camera[0] == [5, 6, 7]


def test_only_what_is_clear_is_adjusted(monkeypatch: pytest.MonkeyPatch) -> None:
    """What chance does not explain, and parameters that would do so in all photographs together."""
    rng = seed_of("clear movement")
    network, truth = make_network(rng, images=8, points=20, free=("c",))
    X = truth.points.copy()
    X[:3, 0] += 4e-3
    there = observed_anew(network, replace(truth, points=X), 0.1, rng).image_points.xy
    seen = network.image_points
    xy = np.where(seen.image[:, None] >= 4, there, seen.xy)
    network = replace(network, image_points=replace(seen, xy=xy))
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    every, needed = alternatives_of(reduce_adjustment(a)), np.log(1 / a.levels.family)
    tried, _ = tried_in(a, monkeypatch)
    assert tried and any(one.family.name == "held" for one in every)
    for one in tried:
        clear = is_significant(one, len(every), a.levels.family) and one.evidence > needed
        assert clear or (one.family.name == "held" and one.evidence_beside_spread > needed)


def test_the_work_of_a_search_is_bounded(zoomed: Adjustment, monkeypatch: pytest.MonkeyPatch) -> None:
    """46 adjustments of 186 photographs take half a minute, as the cube of their number."""
    tried, most = tried_in(zoomed, monkeypatch)
    assert 35 * 186**3 < most * len(tried) * 8**3 < 65 * 186**3


def test_a_gain_at_the_limit_of_work_is_adjusted_to_the_end(
    zoomed: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []
    plain_refit = hypotheses.refit

    def counted(*given: Any, **by: Any) -> Refit | None:
        calls.append(by.get("most", -1))
        return plain_refit(*given, **by)

    monkeypatch.setattr(hypotheses, "refit", counted)
    whole = hypotheses._best(zoomed)
    assert whole is not None and -1 not in calls
    calls.clear()
    monkeypatch.setattr(hypotheses, "MAX_WORK", 1.0)
    bounded = hypotheses._best(zoomed)
    assert bounded is not None and bounded.refit.finished and calls.count(-1) == 1
    assert bounded.alternative.kind == whole.alternative.kind == "other_camera"
    assert bounded.refit.gain == pytest.approx(whole.refit.gain, rel=0.01)


def test_a_cause_must_outweigh_its_price_and_the_level(
    zoomed: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By ln of one over the level of the survey, here 100; refits that gain less are none."""
    needed = np.log(1 / zoomed.levels.family)

    def of_gain(beyond: float) -> Callable[..., Refit]:
        def adjusted(plain: Adjustment, one: Alternative, *_: Any, **__: Any) -> Refit:
            gain = one.price + (needed + beyond if one.kind == "other_camera" else -99.0)
            return refitted(zoomed, gain=gain)

        return adjusted

    monkeypatch.setattr(hypotheses, "refit", of_gain(0.1))
    cause = hypotheses._best(zoomed)
    assert cause is not None and cause.alternative.kind == "other_camera"
    assert cause.evidence == pytest.approx(needed + 0.1)
    monkeypatch.setattr(hypotheses, "refit", of_gain(-0.1))
    assert hypotheses._best(zoomed) is None


@pytest.mark.parametrize(("behind", "as_well"), [(0.5, True), (1.5, False)])
def test_a_kind_that_explains_almost_as_much_is_named_as_well(
    behind: float, as_well: bool, zoomed: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Less than ln 100 behind, the lead that separates two kinds."""

    def adjusted(plain: Adjustment, one: Alternative, *_: Any, **__: Any) -> Refit:
        best = one.kind == "other_camera"
        gain = one.price + (60.0 if best else 60.0 - behind * np.log(100.0))
        return refitted(zoomed, gain=gain)

    monkeypatch.setattr(hypotheses, "refit", adjusted)
    cause = hypotheses._best(zoomed)
    assert cause is not None and cause.alternative.kind == "other_camera"
    assert bool(cause.as_well) == as_well
    assert all(one.kind != "other_camera" for one, _ in cause.as_well)


def causes_of(a: Adjustment, count: int) -> tuple[Cause, ...]:
    betas = tuple(np.full(1, 10.0 + k) for k in range(count))
    return tuple(
        Cause(replace(alternative(), search=float(k)), replace(refitted(a), beta=np.full(1, k)), ())
        for k, _ in enumerate(betas)
    )


def test_earlier_causes_stay_while_the_others_do_not_explain_them(
    a: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is left out on trial; its loss of ln likelihood must exceed its price and the level."""
    first, second = causes_of(a, 2)
    new = Cause(alternative("moved"), replace(refitted(a), before=(np.full(1, 20.0), np.full(1, 21.0))), ())
    limit = 5.0 + np.log(1 / a.levels.family)
    tried: list[list[float]] = []

    def without(losses: dict[float, float]) -> Callable[..., Refit]:
        def alone(
            plain: Adjustment,
            one: Alternative,
            start: Adjustment,
            others: Any,
            *,
            least: float,
            asked: float,
            **_: object,
        ) -> Refit:
            assert least == -np.inf  # without a cause, likelihood is lost
            assert asked == pytest.approx(-limit)  # the rounds end where it cannot rise to that
            kept = {other.search for other, _ in others}
            tried.append([float(beta[0]) for _, beta in others])
            left = 0.0 if kept == {1.0} else 1.0
            before = tuple(beta for _, beta in others)
            return replace(refitted(a), gain=-losses[left], before=before)

        return alone

    monkeypatch.setattr(hypotheses, "refit", without({0.0: limit + 0.1, 1.0: limit + 0.1}))
    kept = hypotheses._still_needed(a, (first, second), new)
    assert [one.alternative.search for one in kept[:2]] == [0.0, 1.0] and kept[
        2
    ].alternative is new.alternative
    assert [float(one.refit.beta[0]) for one in kept[:2]] == [20.0, 21.0]  # as adjusted with the new one
    assert tried == [[21.0], [20.0]]
    monkeypatch.setattr(hypotheses, "refit", without({0.0: limit - 0.1, 1.0: limit + 0.1}))
    kept = hypotheses._still_needed(a, (first, second), new)
    assert [one.alternative.search for one in kept[:-1]] == [1.0]
    monkeypatch.setattr(hypotheses, "refit", lambda *_, **__: None)  # unsolved: needed
    assert len(hypotheses._still_needed(a, (first, second), new)) == 3


def large(m: int, each: int) -> tuple[Network, Estimate]:
    """Return photographs that show so many points each, all of them the same ones."""
    seen = ImagePoints(
        np.repeat(np.arange(m), each),
        np.tile(np.arange(each), m),
        np.zeros((m * each, 2)),
        np.tile(np.eye(2), (m * each, 1, 1)),
    )
    network, truth = make_network(seed_of("large network"), images=3, points=9)
    network = Network(
        images=tuple(map(str, range(m))),
        camera=np.zeros(m, dtype=np.int64),
        points=tuple(map(str, range(each))),
        image_points=seen,
    )
    estimate = replace(
        truth, position=np.zeros((m, 3)), rotation=np.tile(np.eye(3), (m, 1, 1)), points=np.zeros((each, 3))
    )
    return network, estimate


@pytest.mark.parametrize(("each", "whole"), [(1000, True), (1800, False), (4000, False)])
def test_networks_of_some_thousand_image_points_are_tested_whole(each: int, whole: bool) -> None:
    """5,000 image points are, of 9,000 and 20,000 a sample, of which each photograph has its share."""
    network, estimate = large(5, each)
    part, start, rows = hypotheses._sample(network, estimate, hypotheses.MAX_IMAGE_POINTS)
    assert rows.all() == whole and len(start.points) == len(part.points)
    if not whole:
        count = np.bincount(part.image_points.image)
        assert len(count) == 5 and count.min() == count.max()
        assert 5000 < len(part.image_points) < 9000


def of_photographs(a: Adjustment, count: int) -> Adjustment:
    """Return an adjustment that says to have so many photographs."""
    return replace(a, network=replace(a.network, images=tuple(f"{k}.jpg" for k in range(count))))


@pytest.mark.parametrize(("count", "tested"), [(250, True), (400, False)])
def test_networks_of_some_hundred_photographs_are_tested(
    count: int, tested: bool, a: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hypotheses, "free_network", lambda _: None)
    monkeypatch.setattr(hypotheses, "_is_calibration", lambda _: False)
    monkeypatch.setattr(hypotheses, "_judge_parts", lambda *_: "in parts")
    judged = judge_alternatives(of_photographs(a, count))
    if tested:
        assert [said.kind for said in judged.unchecked] == ["assumptions_untested"]
    else:
        assert judged == "in parts"
    monkeypatch.setattr(hypotheses, "_best", lambda _: "asked")
    assert (hypotheses.best_explanation(of_photographs(a, count)) == "asked") == tested


@pytest.mark.parametrize(("count", "said"), [(2, True), (3, True), (4, False)])
def test_of_fewer_than_four_photographs_it_is_said_that_none_can_differ(
    count: int, said: bool, a: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hypotheses, "find_causes", lambda _: ())
    monkeypatch.setattr(hypotheses, "unchecked_assumptions", lambda *_: ())
    few = of_photographs(a, count)
    judged = hypotheses._judge_free(few, "m", None, len(few.network.image_points))
    kinds = kinds_of(judged.unchecked)
    assert ("photographs_untested" in kinds) == said and "assumptions_tested" in kinds


def test_what_is_not_determined_is_not_tested(a: Adjustment, monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*_: object) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr(hypotheses, "find_causes", singular)
    judged = hypotheses._judge_free(a, "m", None, len(a.network.image_points))
    assert kinds_of(judged.unchecked) == ("assumptions_untested",)
    monkeypatch.setattr(hypotheses, "_best", singular)
    assert hypotheses.best_explanation(a) is None


@pytest.mark.parametrize(
    ("given", "datum", "adjusted", "bars", "calibration"),
    [
        (8, "control", 1, 0, True),
        (7, "control", 1, 0, False),
        (8, "free", 1, 0, False),
        (8, "control", 0, 0, False),
        (8, "control", 1, 1, False),
    ],
)
def test_a_calibration_has_most_points_given_and_nothing_else(
    given: int, datum: str, adjusted: int, bars: int, calibration: bool
) -> None:
    """Of 14 points that are in the result; a fifteenth one was rejected."""
    network = SimpleNamespace(
        control=SimpleNamespace(complete=SimpleNamespace(point=np.arange(given))),
        image_points=SimpleNamespace(point=np.r_[np.arange(15), np.arange(14)]),
        scale_bars=[None] * bars,
        exterior=[],
    )
    final: Any = SimpleNamespace(
        network=network, rejected=np.arange(29) == 14, datum=datum, unknown_counts=(6, adjusted, 9)
    )
    assert hypotheses._is_calibration(final) == calibration


def test_image_points_alone_need_two_degrees_of_freedom(
    a: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    bars = ScaleBars(np.array([0]), np.array([1]), np.array([9.0]), np.array([1e-3]))
    final = replace(a, network=a.network.with_given(bars))
    for redundancy, converged, undetermined, there in (
        (2, True, (), True),
        (1, True, (), False),
        (9, False, (), False),
        (9, True, ("X of 1",), False),
    ):
        solved = replace(a, redundancy=redundancy, converged=converged, undetermined=undetermined)
        monkeypatch.setattr(hypotheses, "adjust", lambda *_, found=solved, **__: found)
        assert (free_network(final) is not None) == there


def test_weighted_down_or_kept_gross_errors_are_rejected_before_causes_are_sought(
    a: Adjustment,
) -> None:
    """Only an adjustment that rejected them is its own free network."""
    rejected = np.arange(len(a.rejected)) == 3
    tested = replace(a, rejected=rejected)
    assert free_network(tested) is tested
    weighted = replace(tested, inflation=1.2)
    for other in (a, weighted, replace(tested, datum="control")):
        found = free_network(other)
        assert found is not None and found is not other


def test_kinds_whose_scores_are_near_that_of_the_best_are_adjusted_too(
    zoomed: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of each; none of those that explain much less, as what explains more has been adjusted before."""
    every = alternatives_of(reduce_adjustment(zoomed))
    best = next(one for one in every if one.kind == "other_camera")
    tried: list[str] = []

    def adjusted(plain: Adjustment, one: Alternative, *_: Any, **__: Any) -> Refit:
        tried.append(one.kind)
        return refitted(zoomed, gain=one.price + (60.0 if one.kind == best.kind else 59.0))

    monkeypatch.setattr(hypotheses, "_to_adjust", lambda *_: [best])
    monkeypatch.setattr(hypotheses, "refit", adjusted)
    for lead in (0.0, 40.0, np.inf):
        monkeypatch.setattr(hypotheses, "MIN_LEAD", lead)
        tried.clear()
        cause = hypotheses._best(zoomed)
        assert cause is not None
        near = {
            one.kind for one in every if one.evidence_beside_spread > best.evidence_beside_spread - lead
        } - {best.kind}
        assert tried[0] == best.kind and sorted(tried[1:]) == sorted(near)
        assert {one.kind for one, _ in cause.as_well} == (near if lead > 1 else set())
    assert near


@pytest.mark.parametrize(
    ("points", "bars", "without"), [(8, 0, "control"), (14, 1, "control"), (7, 1, None), (0, 0, None)]
)
def test_coordinates_that_are_all_given_shift_without_the_control_alone(
    points: int, bars: int, without: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 14 points: in a calibration, where most are given, and where none is unknown."""
    network, truth = make_network(seed_of("given or not"), images=6, points=14, free=("c",))
    network = network.with_control(network.points[:points], truth.points[:points], 0.0)
    if bars:
        network = network.with_scale_bar(
            "1", "2", float(np.linalg.norm(np.diff(truth.points[:2], axis=0))), 1e-4
        )
    final = adjust(network, truth, datum=Datum("control" if points else "free"), reject="none")
    of = []
    monkeypatch.setattr(hypotheses, "_judge_free", lambda _, __, of_what, ___: of.append(of_what) or NOTHING)
    monkeypatch.setattr(hypotheses, "cause_in_calibration", lambda *_: None)
    judge_alternatives(final)
    assert of == [without]


NOTHING = hypotheses.JudgedAssumptions()
