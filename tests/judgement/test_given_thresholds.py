"""Numbers by which given values are judged: each test fails where one of them is twice or half as large."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.judgement.given import free_network
from sfm.judgement.given import groups as given_groups
from sfm.judgement.given import judge as given
from sfm.judgement.given import scales as given_scales
from sfm.judgement.given.judge import judge_given
from sfm.judgement.given.scales import Comparison, Scales, Source
from sfm.judgement.given.values import GivenModel, Judgement
from sfm.model.distributions import LEVEL
from sfm.model.network import Network, ObjectPoints, ScaleBars
from sfm.model.remarks.remark import Remark, kinds_of, of_kind
from sfm.pipeline import run_survey
from sfm.survey.inputs.exterior_table import ObservedExterior
from sfm.survey.inputs.given_values import KnownPoints, ScaleBar
from tests.findings import findings_of
from tests.survey import mistyped
from tests.survey.mistyped import SIGMA, scene
from tests.surveys import remarks_on_given, survey_of
from tests.synthetic import make_network, observed_anew, seed_of


@pytest.mark.parametrize(("off", "contradicted"), [(0.006, False), (0.01, True)])
def test_a_print_may_be_half_a_percent_larger_than_stated(off: float, contradicted: bool) -> None:
    """Of coordinates without standard deviations, whose scale is known to 0.2 %: beyond 3.8 times that."""
    network, truth = make_network(seed_of("print"), images=8, points=30)
    control = KnownPoints.from_arrays([str(k + 1) for k in range(8)], (1 + off) * truth.points[:8])
    bar = ScaleBar("9", "20", float(np.linalg.norm(truth.points[8] - truth.points[19])), 1e-4)
    result = run_survey(survey_of(network, truth, control=control, scale_bars=(bar,), datum={"kind": "free"}))
    assert ("scale_contradicted" in kinds_of(remarks_on_given(result))) == contradicted


@pytest.mark.parametrize("weaker", [5.0, 11.0, 100.0])
def test_each_weakly_checked_value_has_its_number(weaker: float) -> None:
    """Of two bars the redundancy number of the better is 1 / (1 + q^2), where q is their ratio."""
    network, truth = make_network(seed_of("weak bars"), images=8, points=30)
    network = observed_anew(network, truth, 0.0, seed_of("weak bars"))
    bars = []
    for i, j, sigma in ((8, 19, 1e-4), (3, 12, weaker * 1e-4)):
        length = float(np.linalg.norm(truth.points[i] - truth.points[j]))
        bars.append(ScaleBar(str(i + 1), str(j + 1), length, sigma * length))
    found = remarks_on_given(run_survey(survey_of(network, truth, scale_bars=tuple(bars))))
    assert kinds_of(found) == ("given_weakly_checked",) and found[0].names("given") == ("9 - 20",)
    assert found[0].number("sigmas") == pytest.approx(4.13 * weaker, rel=0.02)


def test_standard_deviations_that_are_too_small_are_named_once() -> None:
    """Against the free network and, as stated weights remain, by the residuals."""
    network, truth = make_network(seed_of("named once"), images=8, points=30)
    xyz = truth.points[:20] + 1.2e-3 * seed_of("six times").standard_normal((20, 3))
    control = KnownPoints.from_arrays([str(k + 1) for k in range(20)], xyz, 2e-4)
    parts = {"control": control, "datum": {"kind": "control"}, "adjust": {"weights": "stated"}}
    result = run_survey(survey_of(network, truth, **parts))
    (said,) = (one for one in findings_of(result).verdict.remarks if one.kind == "given_sigmas")
    assert said.names("of") == ("control",) and said.number("factor") == pytest.approx(6, rel=0.3)


@pytest.mark.parametrize("weights", ["stated", "components"])
def test_bars_of_too_small_standard_deviations_take_part_as_the_weights_say(
    weights: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged = Judgement(90.0, 2, 1e-6, factor=6.0, score=-20.0)
    alone = Judgement(0.0, 0, 1.0)  # of each bar beside others of its ends
    monkeypatch.setattr(given_scales, "judge_values", lambda model, _: judged if model.items > 1 else alone)
    network, truth = make_network(seed_of("small bars"), images=8, points=30)
    bars = tuple(
        ScaleBar(str(k + 1), str(k + 16), float(np.linalg.norm(truth.points[k] - truth.points[k + 15])), 1e-3)
        for k in range(3)
    )
    result = run_survey(survey_of(network, truth, scale_bars=bars, adjust={"weights": weights}))
    (said,) = of_kind(remarks_on_given(result), "given_sigmas")
    assert said.number("factor") == 6.0
    used = 1.0 if weights == "stated" else 6.0
    np.testing.assert_allclose(result.network.scale_bars.sigma, used * 1e-3, rtol=1e-6)


def test_names_that_may_be_exchanged_are_in_the_remark(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    run = mistyped.run_survey
    monkeypatch.setattr(mistyped, "run_survey", lambda survey: found.append(run(survey)) or found[-1])
    mistyped.mistyped("two names of a box", 101)
    (said,) = of_kind(remarks_on_given(found[0]), "given_contradicted")
    assert len(said.names("exchanged")) >= 2
    assert set(said.names("exchanged")) <= set(said.names("given"))


def test_the_shift_by_a_value_is_in_standard_deviations_of_what_all_give() -> None:
    """The last of four lengths is 2 sigma off the mean of the others, and shifts theirs by half a sigma."""
    model = GivenModel(
        np.array([0.0, 0, 0, 2]), np.zeros((4, 4)), np.eye(4), np.ones((4, 1)), np.arange(4), 500
    )
    judgement = SimpleNamespace(one_wrong=True, doubtful=(3,), statistic=3.0, dof=3)
    placed = SimpleNamespace(strain=None, model=model, exchangeable=())
    group: Any = SimpleNamespace(judgement=judgement, placed=placed, names=tuple("abcd"), of="control")
    task: Any = SimpleNamespace(settings=SimpleNamespace(rescale=False))
    shift = given._doubtful(task, group).number("shift")
    assert shift == pytest.approx(0.5 / np.sqrt(1 / 4))


def test_contradicting_lengths_differ_by_their_standard_deviation() -> None:
    v, variance = np.log([1.0, 1.1, 1.02]), np.array([1e-4, 3e-4, 2e-4])
    model = GivenModel(v, np.zeros((3, 3)), np.diag(variance), np.ones((3, 1)), np.arange(3), 100)

    def said(points: str = "", **found: tuple[int, ...]) -> tuple[set[int], Remark]:
        scales = Scales(v, csr_matrix((3, 3)), variance)
        sources = [Source("a", scales), Source("b", scales), Source("control", scales, points=points)]
        compared = Comparison(sources, model, Judgement(30.0, 2, 1e-6, **found), 1e-3)
        if compared.is_open(on_points=bool(points)):
            out, remark = compared.contradiction()
            return set(out), remark
        return {*compared.judgement.wrong}, next(compared.remarks("bars", rescale=True))

    out, both = said(doubtful=(0, 1, 2))
    assert out == {0, 1, 2}
    assert both.number("off") == pytest.approx(10.0)
    assert both.number("sigmas") == pytest.approx(np.log(1.1) / np.sqrt(4e-4))
    mean = (v[0] / 1e-4 + v[2] / 2e-4) / (1 / 1e-4 + 1 / 2e-4)
    out, one = said(wrong=(1,))
    assert out == {1}
    assert one.number("off") == pytest.approx(100 * np.expm1(v[1] - mean))
    assert one.number("sigmas") == pytest.approx((v[1] - mean) / np.sqrt(3e-4 + 1 / 1.5e4))
    mean = (v[0] / 1e-4 + v[1] / 3e-4) / (1 / 1e-4 + 1 / 3e-4)
    for points, wrong, kind in (("", {2}, "scale_left_out"), ("control", {0, 1, 2}, "scale_contradicted")):
        out, one = said(points, wrong=(2,))
        assert (out, one.kind, one.names("given")) == (wrong, kind, ("control",))
        assert abs(one.number("off")) == pytest.approx(
            100 * np.expm1(v[2] - mean if v[2] > mean else mean - v[2]), rel=0.02
        )


@pytest.mark.parametrize(
    ("factor", "percent"), [(1.95, 95.0), (1 / 1.95, 100 / 1.95 - 100), (2.05, None), (0.1, None)]
)
def test_more_than_twice_is_a_factor(factor: float, percent: float | None) -> None:
    found = given_scales.numbers_of_scale(float(np.log(factor)), 1e-3, LEVEL)
    assert found.get("times") == (None if percent else pytest.approx(factor))
    assert found.get("off", (None,))[0] == (percent and pytest.approx(percent))
    assert found["sigmas"] == pytest.approx(abs(np.log(factor)) / 1e-3)


@pytest.mark.parametrize(("apart", "unit"), [(3.2, 25.4), (3.4, None)])
def test_a_length_is_that_of_a_unit_at_the_level(apart: float, unit: float | None) -> None:
    found = given_scales.numbers_of_scale(float(np.log(25.4 * (1 + apart * 1e-3))), 1e-3, LEVEL)
    assert found.get("unit_factor") == unit and (unit is None or found["coarser"] == "inch")


@pytest.mark.parametrize(("apart", "agree"), [(3.4, True), (4.0, False)])
def test_bars_of_the_same_ends_are_one_scale_if_they_agree_at_the_level(apart: float, agree: bool) -> None:
    """Three tests share the level of 0.001: 3.6 standard deviations."""
    network, truth = make_network(seed_of("same ends"), images=8, points=30)
    length = float(np.linalg.norm(truth.points[8] - truth.points[19]))
    bars = (
        ScaleBar("9", "20", length, 1e-3),
        ScaleBar("20", "9", length + apart * 1e-3 * np.sqrt(2), 1e-3),
    )
    said = remarks_on_given(run_survey(survey_of(network, truth, scale_bars=bars)))
    assert kinds_of(said) == (("scale_unchecked",) if agree else ("scale_contradicted",))


@pytest.mark.parametrize("copies", [1, 2, 6])
def test_a_bar_given_several_times_counts_once(copies: int) -> None:
    """It is 3 standard deviations from another bar, which is no contradiction however often it is written."""
    network, truth = make_network(seed_of("twice"), images=8, points=30)
    length = [float(np.linalg.norm(truth.points[i] - truth.points[j])) for i, j in ((8, 19), (3, 12))]
    off = 3 * np.sqrt(2) * 1e-3
    first = ScaleBar("9", "20", (1 + off) * length[0], 1e-3 * length[0])
    bars = (*[first] * copies, ScaleBar("4", "13", length[1], 1e-3 * length[1]))
    said = remarks_on_given(run_survey(survey_of(network, truth, scale_bars=bars)))
    assert "scale_contradicted" not in kinds_of(said)


@pytest.mark.parametrize(("false_alarm", "found"), [(0.05, True), (1e-4, False)])
def test_the_level_of_given_values_follows_the_false_alarm_of_the_survey(
    false_alarm: float, found: bool
) -> None:
    """Two bars that are 4 standard deviations apart."""
    network, truth = make_network(seed_of("level of bars"), images=8, points=30)
    network = observed_anew(network, truth, 0.0, seed_of("level of bars"))
    length = [float(np.linalg.norm(truth.points[i] - truth.points[j])) for i, j in ((8, 19), (3, 12))]
    relative = 1e-4
    bars = (
        ScaleBar("9", "20", length[0], relative * length[0]),
        ScaleBar("4", "13", (1 + 4 * np.sqrt(2) * relative) * length[1], relative * length[1]),
    )
    said = remarks_on_given(
        run_survey(survey_of(network, truth, scale_bars=bars, adjust={"false_alarm": false_alarm}))
    )
    assert ("scale_contradicted" in kinds_of(said)) == found


def test_all_rows_of_a_long_table_that_is_wrong_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 30 lengths 10 are judged: eight in feet, two right ones in none of the tables, which stay."""
    monkeypatch.setattr(free_network, "MAX_PLACES", 10)
    network, truth = make_network(seed_of("long tape"), images=8, points=30)
    start, end = np.array([(k, k + 9) for k in range(15)] + [(k, k + 11) for k in range(15)]).T
    length = np.linalg.norm(truth.points[end] - truth.points[start], axis=1)
    in_feet = ~np.isin(np.arange(30), (0, 3))
    bars = ScaleBars(
        start, end, length / np.where(in_feet, 0.3048, 1.0), np.full(30, 1e-3), in_feet.astype(np.int64)
    )
    free = free_network.FreeNetwork(adjust(network, truth, datum=Datum("free")))
    settings = given_groups.GivenSettings(Datum("free"), "m")
    judged = judge_given(network.with_given(bars), free, settings)
    (said,) = of_kind(judged.remarks, "scale_left_out")
    assert said.names("given") == ("the table of distances",)
    assert judged.network.scale_bars.start.tolist() == [0, 3]
    (test,) = judged.tests
    assert (test.what, test.judged, test.given) == ("scale", 10, 30)
    monkeypatch.setattr(free_network, "MAX_PLACES", 30)
    (test,) = judge_given(network.with_given(bars), free, settings).tests
    assert test.judged is test.given is None


def test_a_wrong_bar_given_twice_does_not_outvote_a_right_one() -> None:
    network, truth = make_network(seed_of("twice"), images=8, points=30)
    right = [float(np.linalg.norm(truth.points[i] - truth.points[j])) for i, j in ((8, 19), (3, 12), (1, 6))]
    wrong = (ScaleBar("9", "20", 1.1 * right[0], 1e-4), ScaleBar("20", "9", 1.1 * right[0], 1e-4))
    others = (ScaleBar("4", "13", right[1], 1e-4), ScaleBar("2", "7", right[2], 1e-4))
    one = remarks_on_given(run_survey(survey_of(network, truth, scale_bars=(*wrong, others[0]))))
    assert kinds_of(one) == ("scale_contradicted",) and one[0].names("given") == ("9 - 20", "4 - 13")
    both = remarks_on_given(run_survey(survey_of(network, truth, scale_bars=(*wrong, *others))))
    assert kinds_of(both)[0] == "scale_left_out" and both[0].names("given") == ("9 - 20",)
    differ = (replace(wrong[0], length=right[0]), wrong[1])
    alone = remarks_on_given(run_survey(survey_of(network, truth, scale_bars=differ)))
    assert kinds_of(alone) == ("scale_contradicted",) and len(set(alone[0].names("given"))) == 2


def test_the_joint_covariance_of_what_is_judged_takes_72_megabytes() -> None:
    assert 50e6 < 8 * (3 * free_network.MAX_PLACES) ** 2 < 100e6


def test_of_many_points_some_are_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(free_network, "MAX_PLACES", 10)
    network, truth = make_network(seed_of("many given"), images=8, points=30)
    control = KnownPoints.from_arrays([str(k + 1) for k in range(30)], truth.points, 1e-3)
    result = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
    assert result.given_tests[0].dof == 3 * 10 - 7


def test_image_points_are_no_better_than_a_thousandth_of_a_pixel() -> None:
    network, truth = make_network(seed_of("no noise"), images=8, points=30)
    network = observed_anew(network, truth, 0.0, seed_of("no noise"))
    length = float(np.linalg.norm(truth.points[8] - truth.points[19]))
    result = run_survey(survey_of(network, truth, scale_bars=(ScaleBar("9", "20", length, 1e-4),)))
    used = np.sqrt(result.adjustment.image_covariance[0, 0, 0])
    assert used == pytest.approx(1e-3, rel=0.4)  # px


def test_contradicting_control_is_an_error_but_for_one_of_some_that_the_others_confirm() -> None:
    """Of two points side by side and far from four others; without two of these nothing is confirmed."""
    near = [[0.0, 0, 0], [0.03, 0, 0], [0, 0.03, 0], [0, 0, 0.03]]
    figure = np.array([*near, [1.0, 0, 0], [1.02, 0, 0]])
    network, truth = scene("far pair", figure)
    xyz = figure + 0.2 * SIGMA * seed_of("far pair").standard_normal(figure.shape)
    xyz[5, 0] += 9 * SIGMA
    bars = (ScaleBar("1", "5", 1.0, 1e-4),)  # which is not compared with what contradicts itself
    for names, kinds in (([0, 1, 2, 3, 4, 5], "warning"), ([0, 1, 4, 5], "error")):
        control = KnownPoints.from_arrays([str(k + 1) for k in names], xyz[names], SIGMA)
        survey = survey_of(network, truth, control=control, scale_bars=bars, datum={"kind": "control"})
        result = run_survey(survey)
        assert [one.dof for one in result.given_tests if one.what == "scale"] == [0]
        said = remarks_on_given(result)[0]
        assert said.kind == "given_contradicted" and said.severity == kinds
        assert (said.number("shift") < 5) == (kinds == "warning")


def said_of_control(name: str, factors: tuple[float, ...], fourth_off: float = 0.0) -> tuple[Remark, ...]:
    """Return the remarks on eight control points multiplied by factors, the fourth off in Y, m."""
    network, truth = make_network(seed_of(name), images=8, points=30)
    xyz = truth.points[:8] * factors
    xyz[3, 1] += fourth_off
    control = KnownPoints.from_arrays([str(k + 1) for k in range(8)], xyz, 2e-4)
    return remarks_on_given(run_survey(survey_of(network, truth, control=control, datum={"kind": "control"})))


def test_stretched_control_is_an_error() -> None:
    said = said_of_control("stretched control", (1, 0.99, 1))
    assert said[0].kind == "given_strained" and said[0].severity == "error"
    assert said[0].names("axis") == ("Y",) and said[0].number("elongation") == pytest.approx(-1, rel=0.1)


def test_errors_of_fixed_control_shift_the_datum() -> None:
    """Errors s in a network of sigma: s / sigma sqrt(h / (1 + h)), where h is the leverage."""
    rng = seed_of("fixed shift")
    X, A = rng.normal(size=(2, 24, 7))
    h = np.diagonal(A @ np.linalg.pinv(A)).max()
    model = GivenModel(X[:, 0], 4.0 * np.eye(24), np.zeros((24, 24)), A, np.repeat(np.arange(8), 3), 200)
    assert given.shift_of_fixed(model, 10.0) == pytest.approx(5 * np.sqrt(h / (1 + h)))


@pytest.mark.parametrize(
    ("error", "severity", "weighted"), [(4e-4, "warning", "note"), (4e-3, "error", "warning")]
)
def test_fixed_control_that_shifts_the_result_is_an_error(error: float, severity: str, weighted: str) -> None:
    network, truth = make_network(seed_of("not exact"), images=8, points=30)
    xyz = truth.points[:12] + error * seed_of("errors of fixed control").standard_normal((12, 3))
    control = KnownPoints.from_arrays([str(k + 1) for k in range(12)], xyz)
    for weights, kind, expected in (
        ("stated", "given_not_exact", severity),
        ("components", "given_scatter", weighted),
    ):
        survey = survey_of(
            network, truth, control=control, datum={"kind": "control"}, adjust={"weights": weights}
        )
        said = remarks_on_given(run_survey(survey))
        assert said[0].kind == kind and said[0].severity == expected


def test_mirrored_control_names_what_does_not_fit_either() -> None:
    said = said_of_control("mirrored and wrong", (1, 1, -1), fourth_off=0.02)
    assert said[0].kind == "given_mirrored" and said[0].names("given") == ("4",)
    assert said[0].number("mirrored") < 40 < said[0].number("chi2")  # 14 degrees of freedom


@pytest.mark.parametrize(
    ("case", "factor"),
    [
        ({}, 2.0),
        ({"doubtful": ("a",)}, 3.0),
        ({"factor": 1.0}, 1.0),
        ({"rescale": False}, 1.0),
        ({"estimated": True}, 1.0),
        ({"fixed": True}, 1.0),
    ],
)
def test_standard_deviations_are_enlarged_only_where_they_are_stated_and_wrong(
    case: dict[str, Any], factor: float
) -> None:
    of = {"doubtful": (), "factor": 2.0, "rescale": True, "estimated": False, "fixed": False} | case
    stated = np.diag([0.0, 0.0, np.inf] if of["fixed"] else [1e-4, 4e-4, np.inf])[None]
    judgement = SimpleNamespace(doubtful=of["doubtful"], factor=of["factor"], wrong=())
    model = SimpleNamespace(estimated=of["estimated"], factor=lambda: (3.0, 0.0))
    placed: Any = SimpleNamespace(judgement=judgement, model=model, order=())
    group = given_groups.Group("control", np.arange(1), ("a",), placed)
    points = ObjectPoints(np.arange(1), np.zeros((1, 3)), stated)
    found = group.as_judged(points, rescale=of["rescale"], used=True).covariance
    np.testing.assert_allclose(found, np.where(np.isfinite(stated), factor**2 * stated, stated))


def test_kinds_of_given_values_share_the_level() -> None:
    network, truth = make_network(seed_of("shared level"), images=4, points=8)
    bar = network.with_scale_bar("1", "2", 1.0, 1e-4)
    nothing: Any = None

    def level_of(network: Network) -> float:
        settings = given_groups.GivenSettings(Datum("control"), "m")
        return given_groups.Task(network, nothing, nothing, nothing, nothing, settings).level

    assert level_of(network) == level_of(bar) == LEVEL
    assert level_of(bar.with_control(["1", "2"], truth.points[:2])) == LEVEL / 2


def test_four_points_that_are_not_in_a_plane_are_in_space() -> None:
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert given_groups.are_in_space(corner)
    assert not given_groups.are_in_space(corner[:3])
    assert not given_groups.are_in_space(corner * [1, 1, 0.01])


def test_centres_give_the_datum_where_the_control_is_not_used() -> None:
    """Control that is mirrored gives none, but the observed projection centres beside it do."""
    network, truth = make_network(seed_of("mirrored beside centres"), images=8, points=30)
    mirrored = truth.points[:12] * [1.0, 1.0, -1.0]
    control = KnownPoints.from_arrays(network.points[:12], mirrored, 1e-3)
    centres = ObservedExterior.from_arrays(network.images, truth.position, 1e-3)
    given = {"control": control, "exterior": centres, "datum": {"kind": "control"}}
    result = run_survey(survey_of(network, truth, **given))
    assert "given_mirrored" in kinds_of(remarks_on_given(result))
    assert result.adjustment.datum == "control" and len(result.adjustment.network.exterior) == 8
    assert np.abs(result.adjustment.estimate.position - truth.position).max() < 0.01


@pytest.mark.parametrize(
    ("doubtful", "rescale", "stated", "factor"),
    [((1,), True, 1.0, 9.0), ((), True, 1.0, 1.0), ((1,), False, 1.0, 1.0), ((1,), True, 0.0, 0.0)],
)
def test_only_doubtful_points_with_stated_precision_are_weighted(
    doubtful: tuple[int, ...], rescale: bool, stated: float, factor: float
) -> None:
    points = SimpleNamespace(stated=stated * np.ones(3))
    points.select = lambda kept: points
    points.with_stated = lambda covariance: SimpleNamespace(stated=covariance)
    judgement = SimpleNamespace(doubtful=doubtful, wrong=())
    placed: Any = SimpleNamespace(
        points=points, judgement=judgement, model=SimpleNamespace(factor=lambda: (3.0, 1))
    )
    group = given_groups.Group("control", np.arange(3), ("a", "b", "c"), placed)
    np.testing.assert_array_equal(group.taking_part(rescale=rescale).stated, factor * np.ones(3))


def test_coordinates_that_nobody_stated_precise_have_their_scatter_and_no_factor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    network, truth = make_network(seed_of("not exact"), images=8, points=30)
    xyz = truth.points[:12] + 4e-4 * seed_of("errors of fixed control").standard_normal((12, 3))
    control = KnownPoints.from_arrays([str(k + 1) for k in range(12)], xyz)
    scattering, judged = given._scattering, []

    def kept(*of: Any) -> Any:
        judged.append(scattering(*of))
        return judged[-1]

    monkeypatch.setattr(given, "_scattering", kept)
    run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
    assert judged and all(group.judgement.factor == 1 for group in judged)
    assert judged[-1].scatter == pytest.approx(4e-4, rel=0.4)
    assert not judged[-1].judgement.fits or judged[-1].judgement.probability < 1e-3
