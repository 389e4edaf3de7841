"""Verdict and statistics of the report: broken surveys are called broken, statistics are what they say."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from markupsafe import escape
from scipy import stats

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.statistics import (
    component_tests,
    global_test,
    reliability,
    robust_test,
    tau_test,
    w_test,
)
from sfm.adjustment.quality.variance_components import by_kind
from sfm.adjustment.result import Adjustment, ErrorCorrelation
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.comparison.two_adjusters.adjusters import AdjusterComparison, BackendAdjustment, compare_adjusters
from sfm.judgement.bundle_statistics import given_of, statistics_of
from sfm.judgement.calibrated_cameras import families, interior_parameters
from sfm.judgement.checks import longest_residual, sigma0_of
from sfm.judgement.hypotheses.hypotheses import judge_alternatives
from sfm.judgement.survey_result import ControlCheck, Eccentricity, SurveyResult
from sfm.model.camera import Camera
from sfm.model.conventions import angles_from_rotation
from sfm.model.estimate import Estimate
from sfm.model.network import ExteriorObservations, InteriorObservations, Network, ObjectPoints, ScaleBars
from sfm.model.remarks.remark import of_kind
from sfm.report.figures.plots import all_plots, plan_axes
from sfm.report.output import plot_data
from sfm.report.pages import WIDTH, html_of
from sfm.report.phrases import (
    describe_check,
    describe_fixed,
    describe_sigma0,
    describe_test,
    describe_weights,
    signed,
    to_precision,
)
from sfm.report.precision import (
    MAX_LISTED,
    count_observations,
    largest_residuals,
    point_precision,
    precision_of,
)
from sfm.report.survey_report import text_report
from sfm.report.tables.csv_files import write_tables
from sfm.report.tables.summary import summary
from tests.findings import findings_of
from tests.synthetic import make_network, seed_of
from tests.tables import rows_of

NOISE_PX = 0.1


def multiplied(adjustment: Adjustment, factor: float) -> Adjustment:
    """Return the same adjustment of standard deviations stated that much smaller, and multiplied for it."""
    seen = adjustment.network.image_points
    stated = replace(seen, covariance=seen.covariance / factor**2)
    return replace(
        adjustment,
        network=replace(adjustment.network, image_points=stated),
        image_sigma_factor=np.full(len(seen), factor),
    )


def result_of(adjustment: Adjustment, **other: object) -> SurveyResult:
    return SurveyResult(
        "synthetic",
        "m",
        len(adjustment.network.images),
        (),
        adjustment,
        np.full(len(adjustment.network.points), -1),
        None,
        **other,  # type: ignore[arg-type]
    )


@pytest.fixture(scope="module")
def synthetic() -> tuple[Network, Estimate]:
    return make_network(seed_of("statistics"), images=8, points=40, noise_px=NOISE_PX)


def with_control(network: Network, xyz: np.ndarray, sigma: float) -> Network:
    covariance = np.tile(np.eye(3) * sigma**2, (len(xyz), 1, 1))
    return network.with_given(ObjectPoints(np.arange(len(xyz)), xyz, covariance))


def with_bars(network: Network, truth: Estimate, errors: tuple[float, ...], sigma: float) -> Network:
    start, end = np.arange(len(errors)), np.arange(len(errors)) + 10
    length = np.linalg.norm(truth.points[end] - truth.points[start], axis=1) * (1 + np.array(errors))
    return network.with_given(ScaleBars(start, end, length, np.full(len(errors), sigma)))


def spoiled(camera: Camera, factor: float) -> Camera:
    parameters = camera.parameters.copy()
    parameters[camera.names.index("c")] *= factor
    return replace(camera, parameters=parameters)


def test_a_good_survey_is_called_good(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    for one, datum in (
        (network, "free"),
        (with_control(network, truth.points[:6], 1e-4), "control"),
        (with_bars(network, truth, (0.0, 1e-4), 1e-4), "free"),
    ):
        verdict = findings_of(result_of(adjust(one, truth, datum=Datum(datum)))).verdict  # type: ignore[arg-type]
        assert verdict.level == "good", verdict


@pytest.mark.parametrize("sigma", [0.0, 1e-3])
def test_swapped_control_is_no_result(synthetic: tuple[Network, Estimate], sigma: float) -> None:
    network, truth = synthetic
    swapped = with_control(network, truth.points[[1, 0, 2, 3, 4, 5]], sigma)
    verdict = findings_of(result_of(adjust(swapped, truth, datum=Datum("control"), reject="none"))).verdict
    assert verdict.level == "bad"
    assert verdict.headline == "The survey has no dependable result."
    assert of_kind(verdict.remarks, "sigma0_high", "given_differs")


def test_a_scale_bar_that_contradicts_another_is_no_result(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    barred = with_bars(network, truth, (0.0, 0.05), 1e-4)
    a = adjust(barred, truth, datum=Datum("free"), reject="none")
    verdict = findings_of(result_of(a)).verdict
    assert verdict.level == "bad"
    assert of_kind(verdict.remarks, "given_differs")


@pytest.mark.parametrize("sigmas", [0.0, 40.0])
def test_a_given_angle_that_differs_is_a_warning_without_a_shift_of_the_result(
    synthetic: tuple[Network, Estimate], sigmas: float
) -> None:
    network, truth = synthetic
    network = with_control(network, truth.points[:6], 1e-4)
    sigma = 1e-5  # rad; the photographs know the angles about as well
    angles = angles_from_rotation(truth.rotation) + sigmas * sigma * np.eye(len(truth.rotation), 3)
    variance = np.diag([np.inf] * 3 + [sigma**2] * 3)
    observed = ExteriorObservations(
        np.arange(len(angles)), np.zeros_like(angles), angles, np.tile(variance, (len(angles), 1, 1))
    )
    a = adjust(network.with_given(observed), truth, datum=Datum("control"), reject="none")
    found = [one for one in findings_of(result_of(a)).verdict.remarks if one.kind.endswith("_differs")]
    assert [one.kind for one in found] == ["given_differs"] * (sigmas > 0)
    assert all(one.severity == "warning" and one.number("sigmas") > 5 for one in found)


@pytest.mark.parametrize(("sigmas", "wrong"), [(0.5, False), (12.0, False), (50.0, True)])
def test_a_false_calibration_certificate_is_noticed_where_it_shifts_points(
    sigmas: float, wrong: bool
) -> None:
    """The w of 12 sigmas is beyond chance, and c shifts by far more than any object point."""
    network, truth = make_network(seed_of("certificate"), images=8, points=40, noise_px=NOISE_PX, free=("c",))
    camera = truth.cameras[0]
    s = camera.names.index("c")
    sigma = 1e-3  # mm; the photographs know c a few times worse
    one = np.zeros(1, dtype=np.int64)
    given = np.array([camera.parameters[s] + sigmas * sigma])
    certificate = InteriorObservations(one, one + s, given, np.array([sigma]))
    result = result_of(adjust(network.with_given(certificate), truth, datum=Datum("free"), reject="none"))
    found = given_of(result.adjustment, "m").interior
    assert found is not None and found.names == (f"c of camera {camera.name}",)
    counts = count_observations(result.adjustment)
    assert (counts.interior, counts.scale_bars) == (1, 0)
    v = -sigmas * sigma  # of the parameter, if the photographs had no error
    own = adjust(network, truth, datum=Datum("free"), reject="none")
    q = own.covariance.interior[0][0, 0] / own.sigma0**2
    expected = v / np.sqrt(sigma**2 + q)  # independent: misclosure over its standard deviation
    assert found.w[0, 0] == pytest.approx(expected, abs=4, rel=0.05)
    assert found.r[0, 0] == pytest.approx(sigma**2 / (sigma**2 + q), rel=0.1)  # as c moves
    assert findings_of(result).verdict.level == "good"  # residuals of given parameters are no remark
    assert bool(of_kind(judge_alternatives(result.adjustment).causes, "given_parameter")) == wrong
    page, text = html_of(findings_of(result)), text_report(findings_of(result))
    table = page[page.index("<h3>Observed interior orientation</h3>") :].split("</table>")[0]
    values = (f"{found.w[0, 0]:+.2f}", signed(float(found.difference[0, 0])), f"{found.r[0, 0]:.3f}")
    for one in (f"c of camera {camera.name}", *values):
        assert one in table and one in text
    (given,) = findings_of(result).given.kinds[:1]
    assert (
        f">{to_precision(float(given.given.ravel()[0]), sigma)}<" in table
    )  # to the second digit of its sigma
    assert summary(findings_of(result))["weighted_interior"][0]["w"] == pytest.approx(found.w[0, 0])


@pytest.mark.parametrize("fixed", [0, 1, 4])
def test_fixed_coordinates_do_not_make_the_points_look_more_precise(fixed: int) -> None:
    network, truth = make_network(seed_of("fixed points"), images=8, points=20, noise_px=NOISE_PX, free=())
    rows = np.arange(6)
    covariance = np.tile(1e-6 * np.eye(3), (6, 1, 1))
    covariance[:fixed] = 0.0
    control = ObjectPoints(rows, truth.points[rows], covariance)
    result = result_of(adjust(network.with_given(control), truth, datum=Datum("control"), reject="none"))
    a = result.adjustment
    sigma = np.sqrt(np.einsum("nii->ni", a.covariance.points[fixed:]))
    rms = point_precision(a)[0]
    np.testing.assert_allclose(rms[:3], np.sqrt((sigma**2).mean(axis=0)), rtol=1e-12)
    assert rms[3] == pytest.approx(float(np.sqrt((sigma**2).mean())))
    words = {
        0: "",
        1: "without the fixed coordinates of 1 point",
        4: "without the fixed coordinates of 4 points",
    }
    assert describe_fixed(precision_of(a)) == words[fixed]
    assert ("without the fixed" in text_report(findings_of(result))) == (fixed > 0)
    assert ("without the fixed" in html_of(findings_of(result))) == (fixed > 0)


def test_a_limiting_precision_above_the_achieved_one_is_explained(
    synthetic: tuple[Network, Estimate],
) -> None:
    network, truth = synthetic
    a = adjust(network, truth, datum=Datum("free"))
    words = "The limiting precision is in the datum of the cameras"
    for factor, explained in ((0.5, False), (3.0, True)):
        covariance = replace(a.covariance, points_limiting=factor**2 * a.covariance.points)
        result = result_of(replace(a, covariance=covariance))
        assert (words in " ".join(text_report(findings_of(result)).split())) is explained
        assert (words in html_of(findings_of(result))) is explained


def test_a_point_that_lost_more_rays_than_chance_makes_is_named(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    of_point = np.flatnonzero(network.image_points.point == 4)
    for lost, named in ((1, ()), (len(of_point) // 2, (network.points[4],))):
        rejected = a.rejected.copy()
        rejected[of_point[:lost]] = True
        verdict = findings_of(result_of(replace(a, rejected=rejected))).verdict
        assert verdict.level == "good"  # they do not contribute
        (tested,) = of_kind(verdict.tests, "rays_tested")
        assert tested.names("points") == named


def test_a_wrong_fixed_camera_is_no_result() -> None:
    network, truth = make_network(seed_of("fixed"), images=8, points=40, noise_px=NOISE_PX, free=())
    wrong = replace(truth, cameras=tuple(spoiled(camera, 1.05) for camera in truth.cameras))
    a = adjust(network, wrong, datum=Datum("free"), reject="none")
    assert a.sigma0 > 5
    assert findings_of(result_of(a)).verdict.level == "bad"


def test_blunders_left_in_are_no_result(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    seen = network.image_points
    xy = seen.xy.copy()
    blunders = seed_of("blunders").choice(len(xy), 3, replace=False)
    xy[blunders] += (8.0, -8.0)
    a = adjust(replace(network, image_points=replace(seen, xy=xy)), truth, datum=Datum("free"), reject="none")
    verdict = findings_of(result_of(a)).verdict
    assert verdict.level == "bad"
    (kept,) = of_kind(verdict.remarks, "residual_kept")
    worst = longest_residual(a)
    named = {(network.images[seen.image[k]], network.points[seen.point[k]]) for k in blunders}
    assert (worst.image, worst.point) in named
    assert (*kept.names("photograph"), *kept.names("point")) == (worst.image, worst.point)


def test_a_residual_counts_by_the_influence_that_its_lowered_weight_leaves(
    synthetic: tuple[Network, Estimate],
) -> None:
    network, truth = synthetic
    seen = network.image_points
    xy = seen.xy.copy()
    xy[7] += (20.0, 0.0)
    spoiled = replace(network, image_points=replace(seen, xy=xy))
    a = adjust(spoiled, truth, datum=Datum("free"), reject="huber")
    assert np.linalg.norm(a.residuals[7]) > 150 * NOISE_PX and a.weights[7] < 0.01
    assert longest_residual(a).over_sigma < 3  # Huber's weights bound it
    assert not of_kind(findings_of(result_of(a)).verdict.remarks, "residual_kept")
    kept = adjust(spoiled, truth, datum=Datum("free"), reject="none")
    assert of_kind(findings_of(result_of(kept)).verdict.remarks, "residual_kept")


def test_sigma_px_is_only_a_guess(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    seen = network.image_points
    levels = {}
    for guess in (4.0, 1 / 1.5, 1 / 3, 1 / 8):  # of the true standard deviation
        stated = replace(network, image_points=replace(seen, covariance=seen.covariance * guess**2))
        a = adjust(stated, truth, datum=Datum("free"), reject="none")
        assert not global_test(a).passed
        levels[guess] = findings_of(result_of(a)).verdict.level
    assert levels == {4.0: "good", 1 / 1.5: "good", 1 / 3: "fair", 1 / 8: "bad"}


@pytest.mark.parametrize("guess", [1.0, 1.8, 4.0])
def test_a_sigma_that_is_far_too_large_is_reported_with_what_it_would_be(
    synthetic: tuple[Network, Estimate], guess: float
) -> None:
    network, truth = synthetic
    seen = network.image_points
    stated = replace(network, image_points=replace(seen, covariance=seen.covariance * guess**2))
    a = adjust(stated, truth, datum=Datum("free"), reject="none")
    verdict = findings_of(result_of(a)).verdict
    ratio = a.sigma0
    assert verdict.remarks == () and verdict.level == "good"
    (one,) = of_kind(verdict.tests, "image_sigma_tested")
    assert one.number("stated") == pytest.approx(guess * NOISE_PX)
    assert one.number("found") == pytest.approx(ratio * guess * NOISE_PX)
    # the same where the image points were weighted by their own component before
    b = adjust(
        stated, truth, datum=Datum("free"), reject="none", options=AdjustmentOptions(image_sigma_factor=ratio)
    )
    assert b.sigma0 == pytest.approx(1)
    again = findings_of(result_of(b)).verdict
    assert [one.text for one in again.remarks] == [one.text for one in verdict.remarks]


@pytest.mark.parametrize(
    ("bad", "guess", "told"),
    [(0, 1.0, False), (6, 1.0, True), (6, 5.0, True), (6, 0.5, True), (0, 0.5, False)],
)
def test_gross_errors_that_were_not_looked_for_are_counted(
    synthetic: tuple[Network, Estimate], bad: int, guess: float, told: bool
) -> None:
    """Of 1 px; whatever standard deviation is stated."""
    network, truth = synthetic
    seen = network.image_points
    xy = seen.xy.copy()
    xy[seed_of("not looked for").choice(len(xy), bad, replace=False), 0] += 1.0
    spoiled = replace(seen, xy=xy, covariance=guess**2 * seen.covariance)
    a = adjust(replace(network, image_points=spoiled), truth, datum=Datum("free"), reject="none")
    found = of_kind(findings_of(result_of(a, reject="none")).verdict.remarks, "gross_errors_kept")
    assert not of_kind(findings_of(result_of(a)).verdict.remarks, "gross_errors_kept")
    if not told:
        assert found == ()
        return
    test = robust_test(a)
    assert bad <= test.beyond <= bad + 4
    (one,) = found
    assert one.severity == "warning"
    numbers = {name: one.number(name) for name in ("beyond", "tested", "critical", "chance")}
    assert numbers == {
        "beyond": test.beyond,
        "tested": test.tested,
        "critical": test.critical,
        "chance": test.expected,
    }


def test_weights_found_from_the_residuals_do_not_hide_sigma0(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    a = adjust(network, truth, datum=Datum("free"))
    assert findings_of(result_of(multiplied(a, 3.0))).verdict.level == "fair"
    bad = findings_of(result_of(multiplied(a, 200.0))).verdict
    assert bad.level == "bad"
    assert bad.remarks[0].kind == "sigma0_high"
    assert bad.remarks[0].number("stated") == pytest.approx(0.0005, rel=0.2)
    assert "common" not in bad.remarks[0].numbers
    shared = replace(a, error_correlation=ErrorCorrelation(alone=0.2, common=4.0, length_px=800.0))
    high = findings_of(result_of(multiplied(shared, 200.0))).verdict.remarks[0]
    assert high.number("common") == pytest.approx(2 * a.sigma0_px, rel=0.01) and high.number("length") == 800
    apart = replace(a, error_correlation=ErrorCorrelation(alone=2.0, common=1.0, length_px=800.0))
    assert "common" not in findings_of(result_of(multiplied(apart, 200.0))).verdict.remarks[0].numbers
    text = summary(findings_of(result_of(multiplied(a, 3.0))))
    assert text["statistics"]["sigma0_ratio"] == pytest.approx(3 * a.sigma0)


def test_control_that_contradicts_is_separated_from_the_image_points(
    synthetic: tuple[Network, Estimate],
) -> None:
    network, truth = synthetic
    xyz = truth.points[:6].copy()
    xyz[0, 0] += 0.02
    a = adjust(with_control(network, xyz, 1e-3), truth, datum=Datum("control"), reject="none")
    result = result_of(a)
    own = sigma0_of(result.adjustment).image_points_px
    assert a.sigma0_px > 1.05 * own
    assert own == pytest.approx(NOISE_PX, rel=0.1)  # whatever the control does
    figure, words = describe_sigma0(sigma0_of(result.adjustment))
    assert figure == f"{a.sigma0_px:.4f} px"
    assert f"image points alone {own:.4f} px" in words
    page = " ".join(html_of(findings_of(result)).split())
    assert figure in page and words in page
    assert re.search(rf"from the image points alone +{own:.5f}  px", text_report(findings_of(result)))
    written = summary(findings_of(result))["statistics"]
    assert written["image_points_px"] == pytest.approx(own) and written["stated_px"] == pytest.approx(
        NOISE_PX
    )
    free = result_of(adjust(network, truth, datum=Datum("free")))
    assert "points alone" not in " ".join(describe_sigma0(sigma0_of(free.adjustment)))


def test_each_kind_is_tested_against_what_was_stated_in_the_same_words_everywhere(
    synthetic: tuple[Network, Estimate],
) -> None:
    network, truth = synthetic
    a = adjust(with_bars(network, truth, (0.0, 1e-5), 1e-4), truth, datum=Datum("free"))
    for factor, passed in ((1.0, True), (0.8, False), (1.25, False)):
        result = result_of(multiplied(a, factor))
        image, bars = statistics_of(result.adjustment).global_tests
        assert image.passed is passed and bars.passed
        r = float(np.nansum(a.redundancy_numbers))
        seen = a.network.image_points
        squares = (a.residuals[~a.rejected] ** 2).sum() / NOISE_PX**2 * factor**2
        assert image.redundancy == pytest.approx(r) and image.statistic == pytest.approx(squares)
        assert len(seen) > 100
        text = " ".join(text_report(findings_of(result)).split())
        page, written = html_of(findings_of(result)), summary(findings_of(result))["statistics"]
        for test, one in zip((image, bars), written["global_tests"], strict=True):
            words = describe_test(test)
            assert words in text and escape(words) in page and words == one["words"]
            assert one["passed"] is test.passed
            assert ("better than stated" in words) == (test is image and factor < 1)
            assert ("worse than stated" in words) == (test is image and factor > 1)
        words = describe_weights(result)
        assert (words == "") == (factor == 1)
        assert words in text and words in page and words == written["weights"]
        assert written["sigma0_by_kind"]["image points"] == pytest.approx(written["sigma0_ratio"], rel=1e-6)


@pytest.mark.parametrize("reject", ["huber", "tukey"])
def test_the_global_test_of_an_m_estimator_is_left_out_with_the_reason(
    synthetic: tuple[Network, Estimate], reject: str
) -> None:
    network, truth = synthetic
    reason = "not tested, the weights come from the residuals, so v'Pv is not chi-square distributed"
    for one, of in (
        (network, "all observations"),
        (with_bars(network, truth, (0.0, 1e-5), 1e-4), "image points"),
    ):
        result = result_of(adjust(one, truth, datum=Datum("free"), reject=reject))
        first, *other = statistics_of(result.adjustment).global_tests
        assert first.passed is None and all(test.passed for test in other)
        assert describe_test(first) == f"{of}: {reason}"
        written = summary(findings_of(result))["statistics"]["global_tests"][0]
        assert written["passed"] is None and written["words"] == describe_test(first)
        assert describe_test(first) in " ".join(text_report(findings_of(result)).split())
        assert escape(describe_test(first)) in html_of(findings_of(result))
        assert len(other) == len(one.scale_bars) // 2
        assert findings_of(result).verdict.level == "good"


def test_bars_that_are_all_a_little_too_bad_are_noticed(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    errors = 3e-4 * np.array([1, -1, 1, -1, 1, -1])
    a = adjust(with_bars(network, truth, tuple(errors), 1e-4), truth, datum=Datum("free"))
    bars = given_of(a, "m").bars
    assert bars is not None and np.abs(bars.w).max() < 5
    (said,) = of_kind(findings_of(result_of(a)).verdict.remarks, "given_sigmas")
    assert said.severity == "warning" and said.number("factor") > 1.5


def test_words_for_the_scale_of_the_control(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    known = with_control(network, truth.points[:4], 1e-4)
    check = ControlCheck(network.points[:4], np.full((4, 3), 1e-4), 1.0025)
    free = result_of(adjust(known, truth, datum=Datum("free")), control_check=check)
    assert "scale was taken from the control" in html_of(findings_of(free))
    bars = with_bars(known, truth, (0.0,), 1e-4)
    barred = result_of(adjust(bars, truth, datum=Datum("free")), control_check=check)
    page = " ".join(html_of(findings_of(barred)).split())
    assert "lengths by the control are 1.0025 times those by the scale bars" in page
    words = describe_check(check, "m")
    assert "largest 173 µm" in words and words in page and words in text_report(findings_of(barred))
    assert "A single bar gives the scale" in page


def test_residuals_of_control_and_bars_are_adjusted_minus_given(
    synthetic: tuple[Network, Estimate], tmp_path: Path
) -> None:
    network, truth = synthetic
    known = with_bars(with_control(network, truth.points[:6] + 2e-4, 1e-3), truth, (1e-4, -1e-4), 1e-4)
    a = adjust(known, truth, datum=Datum("control"))
    control, bars = given_of(a, "m").control, given_of(a, "m").bars
    assert control is not None and bars is not None
    np.testing.assert_allclose(control.difference, a.estimate.points[:6] - truth.points[:6] - 2e-4)
    np.testing.assert_allclose(control.w, control.difference / (1e-3 * np.sqrt(control.r)))
    np.testing.assert_allclose(bars.w, bars.difference / (1e-4 * np.sqrt(bars.r)))
    adjusted = np.linalg.norm(a.estimate.points[[10, 11]] - a.estimate.points[[0, 1]], axis=1)
    np.testing.assert_allclose(bars.difference[:, 0], adjusted - known.scale_bars.length, atol=1e-15)
    text = summary(findings_of(result_of(a)))
    assert text["control"]["role"] == "datum"
    assert text["control"]["points"][0]["w"] == pytest.approx(control.w[0].tolist())
    assert text["control"]["points"][0]["r"] == pytest.approx(control.r[0].tolist())
    assert text["scale_bars"][1]["from"] == "2" and text["scale_bars"][1]["to"] == "12"
    assert text["scale_bars"][1]["w"] == pytest.approx(bars.w[1, 0])
    assert text["scale_bars"][1]["r"] == pytest.approx(bars.r[1, 0])
    page = html_of(findings_of(result_of(a)))
    assert "<h3>Control</h3>" in page and "<h3>Scale bars</h3>" in page and "2 - 12" in page
    counts = count_observations(a)
    assert (counts.control, counts.scale_bars, counts.constraints) == (18, 2, 0)
    assert counts.image + counts.control + counts.scale_bars == counts.total == a.observations
    write_tables(findings_of(result_of(a)), tmp_path)
    rows = rows_of(tmp_path / "given.csv")
    assert [row["kind"] for row in rows] == ["control point"] * 18 + ["scale bar"] * 2
    assert [row["coordinate"] for row in rows[:3]] == ["X", "Y", "Z"]
    for column, values in (("w", control.w), ("r", control.r), ("difference", control.difference)):
        assert [float(row[column]) for row in rows[:18]] == values.ravel().tolist()


def test_w_of_given_values_is_standard_normal() -> None:
    """Control with correlated coordinates and scale bars, as good as the photographs find the points."""
    network, truth = make_network(seed_of("given"), images=6, points=12, noise_px=0.0, free=())
    rng, k = seed_of("noise of the given"), network.image_points
    factor = 3e-4 * np.array([[1.0, 0, 0], [0.7, 0.7, 0], [0.2, -0.3, 0.9]])
    start, end = np.arange(4), np.arange(4) + 6
    length, w, r, plain = np.linalg.norm(truth.points[end] - truth.points[start], axis=1), [], [], []
    for _ in range(60):
        xyz = truth.points[:5] + rng.standard_normal((5, 3)) @ factor.T
        one = replace(network, image_points=replace(k, xy=k.xy + rng.normal(0, 0.1, k.xy.shape))).with_given(
            ObjectPoints(np.arange(5), xyz, np.tile(factor @ factor.T, (5, 1, 1))),
            ScaleBars(start, end, length + rng.normal(0, 3e-4, 4), np.full(4, 3e-4)),
        )
        a = adjust(one, truth, datum=Datum("control"), reject="none")
        control, bars = given_of(a, "m").control, given_of(a, "m").bars
        assert control is not None and bars is not None
        w.append(np.concatenate([control.w.ravel(), bars.w.ravel()]))
        r.append(np.concatenate([control.r.ravel(), bars.r.ravel()]))
        plain.append((bars.difference / bars.sigma).ravel())
    assert 0.1 < np.mean(r) < 0.9  # some are well checked, some are not
    for part in (np.array(w)[:, :15], np.array(w)[:, 15:]):
        assert stats.kstest(part.ravel(), "norm").pvalue > 0.01
    assert np.std(plain) < 0.9


def test_the_worst_control_stands_in_the_text_with_residual_and_w(
    synthetic: tuple[Network, Estimate],
) -> None:
    network, truth = synthetic
    xyz = truth.points[:6].copy()
    xyz[3, 1] += 5e-3
    result = result_of(adjust(with_control(network, xyz, 1e-3), truth, datum=Datum("control")))
    control = given_of(result.adjustment, "m").control
    assert control is not None
    text = text_report(findings_of(result))
    section = text[text.index("Control -") :].splitlines()
    assert max(map(len, section)) <= WIDTH and "6 control points, RMS" in section[1]
    assert "[mm]" in section[2]
    name, axis, given, v, sigma, r, w = section[3].split()
    assert (name, axis) == (network.points[3], "Y") and given == to_precision(xyz[3, 1], float(sigma) / 1000)
    assert float(v) == pytest.approx(1000 * control.difference[3, 1], rel=0.01) and float(sigma) == 1
    assert float(r) == pytest.approx(control.r[3, 1], abs=1e-3)
    assert float(w) == pytest.approx(control.w[3, 1], abs=0.01)
    assert "and 8 more, in given.csv" in text


def test_what_is_met_exactly_is_not_checked(synthetic: tuple[Network, Estimate], tmp_path: Path) -> None:
    network, truth = synthetic
    single = result_of(adjust(with_bars(network, truth, (0.3,), 1e-4), truth, datum=Datum("free")))
    bars = given_of(single.adjustment, "m").bars
    assert bars is not None and np.isnan(bars.w).all() and bars.r[0, 0] < 1e-6
    assert findings_of(single).verdict.level == "good"
    assert re.search(r"\n  1 - 11 .* 0\.000  not checked", text_report(findings_of(single)))
    assert summary(findings_of(single))["scale_bars"][0]["w"] is None
    assert "<td>not checked" in html_of(findings_of(single))
    write_tables(findings_of(single), tmp_path)
    (row,) = rows_of(tmp_path / "given.csv")
    assert row["kind"] == "scale bar" and row["name"] == "1 - 11" and row["w"] == ""
    assert float(row["given"]) == bars.given[0, 0] and row["unit"] == "m"


def test_fixed_control_has_no_ratio(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    a = adjust(with_control(network, truth.points[:6], 0.0), truth, datum=Datum("control"))
    text = summary(findings_of(result_of(a)))
    assert text["control"]["points"][0]["w"] == [None, None, None]
    assert "6 control points held fixed" in text_report(findings_of(result_of(a)))
    assert count_observations(a).control == 0
    assert "fixed" in html_of(findings_of(result_of(a)))


def test_statistics_are_shown_and_written(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    a = adjust(network, truth, datum=Datum("free"))
    result = result_of(a)
    page, text = (
        html_of(findings_of(result)),
        json.loads(json.dumps(summary(findings_of(result)))),
    )
    test = global_test(a)
    found = text["statistics"]
    (written,) = found["global_tests"]
    assert written["of"] == "all observations" and written["passed"] is test.passed
    assert written["lower"] == test.lower and written["upper"] == test.upper
    assert f"{test.lower:.2f}" in page and f"{test.upper:.2f}" in page
    assert found["observations"]["constraints"] == 7
    assert found["redundancy_number"]["min"] == pytest.approx(np.nanmin(a.redundancy_numbers))
    assert set(found["sigma0_by_photograph"]) == set(a.network.images)
    assert text["length_unit"] == "network units"
    assert text["verdict"] == {
        "level": "good",
        "headline": findings_of(result).verdict.headline,
        "remarks": [],
        "tests": [one.as_dict() for one in findings_of(result).verdict.tests],
    }
    worst = largest_residuals(a)
    assert len(worst) == MAX_LISTED == 10
    w = np.abs(np.where(a.rejected[:, None], 0, a.standardised))
    assert abs(worst[0][4]) == w.max()
    np.testing.assert_array_equal(np.sort(w.max(axis=1))[::-1][:10], [abs(one[4]) for one in worst])
    assert f"{worst[9][4]:+.2f}" in page
    for pair in statistics_of(result.adjustment).camera_correlations:
        assert "of camera" in pair.first and f"{100 * pair.value:+.1f}" in page


def test_parameters_that_mean_nothing_are_named() -> None:
    network, truth = make_network(
        seed_of("insignificant"), images=8, points=40, noise_px=NOISE_PX, free=("c", "K1", "b2")
    )
    a = adjust(network, truth, datum=Datum("free"))
    camera = a.estimate.cameras[0]
    t = abs(camera.value("b2")) / np.sqrt(a.covariance.interior[0][-1, -1])
    assert t < 2  # its true value is 0
    page = html_of(findings_of(result_of(a)))
    assert f"b2 of camera 1 ({t:.1f}, p " in page
    named = summary(findings_of(result_of(a)))["statistics"]["not_significant"]
    assert [one["parameter"] for one in named] == ["b2"]


def test_only_what_may_be_0_is_reported_over_its_standard_deviation(
    synthetic: tuple[Network, Estimate],
) -> None:
    network, truth = synthetic
    a = adjust(network, truth, datum=Datum("free"))
    told = {one.name: one.t for one in interior_parameters(a) if one.sigma > 0}
    assert told["c"] is None and len(told) > 3
    by_name = {test.parameter: test for test in statistics_of(a).significance}
    assert {name: t for name, t in told.items() if t is not None} == {
        name: test.t for name, test in by_name.items()
    }


def test_circles_are_reported(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    a = adjust(network, truth, datum=Datum("free"))
    found = result_of(a, eccentricity=Eccentricity(0.1641, 0.0443, 0.0003), no_circles=("u007", "u<9"))
    text = summary(findings_of(found))
    assert text["eccentricity"] == {"largest_px": 0.1641, "rms_px": 0.0443, "sigma_px": 0.0003}
    assert text["no_circles"] == ["u007", "u<9"]
    page = html_of(findings_of(found))
    assert "u007, u&lt;9" in page and "0.0443 px RMS" in page
    none = summary(findings_of(result_of(a)))
    assert none["eccentricity"] is None and none["no_circles"] == []


@pytest.fixture(scope="module")
def compared(synthetic: tuple[Network, Estimate]) -> tuple[Adjustment, AdjusterComparison]:
    network, truth = synthetic
    a = adjust(network, truth, datum=Datum("free"))

    class Same:
        iterations, converged, seconds, point_covariance = 1, True, 0.1, None

        def __init__(self, estimate: Estimate) -> None:
            self.estimate = estimate

    def backend(part: Network, start: Estimate) -> BackendAdjustment:
        return Same(adjust(part, start, datum=Datum("free"), reject="none").estimate)

    return a, compare_adjusters(a, backend)


def test_comparison_tells_what_it_changed(compared: tuple[Adjustment, AdjusterComparison]) -> None:
    a, both = compared
    both = replace(both, held=("k<4> of camera 1",), freed=("camera 1: k3",))
    result = replace(result_of(a), comparison=both)
    page = html_of(findings_of(result))
    assert "k&lt;4&gt; of camera 1" in page and "camera 1: k3" in page
    assert f"{both.conversions[0].rms_px:.4f}" in page and "Cameras converted to another model" in page
    text = summary(findings_of(result))["comparison"]
    assert text["conversions"][0]["max_px"] == both.conversions[0].max_px
    assert text["held"] == ["k<4> of camera 1"] and text["freed"] == ["camera 1: k3"]


def test_the_model_is_linked_where_it_is(compared: tuple[Adjustment, AdjusterComparison]) -> None:
    result = replace(result_of(compared[0]), comparison=compared[1])
    assert 'href="colmap/"' not in html_of(findings_of(result))
    page = " ".join(html_of(findings_of(result), has_model=True).split())
    assert 'href="colmap/"' in page and "free datum, equal weights" in page


def test_plan_is_seen_from_the_cameras() -> None:
    rng = seed_of("plan")
    level = rng.uniform(-1, 1, (30, 3)) * (5.0, 3.0, 0.1)
    wall = level[:, [0, 2, 1]]
    for points, towards in ((level, (0, 0, 4)), (level, (0, 0, -4)), (wall, (0, 4, 1)), (wall, (0, -4, 1))):
        position = np.array(towards) + rng.uniform(-1, 1, (5, 3))
        axes, names = plan_axes(points, position)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        assert ((position - points.mean(axis=0)) @ axes[2]).mean() > 0
        assert len(names) == 3
    assert plan_axes(level, np.array([[0, 0, -4.0]]))[1] == ("X", "-Y", "-Z")


def test_names_that_the_font_lacks_give_no_warning(
    synthetic: tuple[Network, Estimate], recwarn: pytest.WarningsRecorder, tmp_path: Path
) -> None:
    network, truth = synthetic
    names = tuple(f"写真{k}$.jpg" for k in range(len(network.images)))
    cameras = tuple(replace(camera, name="相機_$x") for camera in truth.cameras)
    network = with_bars(replace(network, images=names), truth, (0.0,), 1e-4)
    a = adjust(network, replace(truth, cameras=cameras), datum=Datum("free"))
    all_plots(plot_data(findings_of(replace(result_of(a), unit="米"))))
    assert not recwarn.list


def test_the_text_report_has_the_figures_of_the_adjustment(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    network = with_bars(network, truth, (0.0, 1e-5), 1e-4)
    a = adjust(network, truth, datum=Datum("free"))
    text = text_report(findings_of(result_of(a)))
    lines = text.splitlines()
    assert len(lines) < 175 and max(map(len, lines)) <= WIDTH
    words = " ".join(lines).split()
    counts = (a.observations, 2 * int((~a.rejected).sum()), a.redundancy, a.unknowns)
    values = (f"{a.sigma0_px:.5f}", f"{w_test(a).critical:.2f};", f"{tau_test(a).critical:.2f};")
    assert {*map(str, counts), *values} <= set(words)
    for test in component_tests(by_kind(a)):
        assert " ".join(describe_test(test).split()) in " ".join(words)
    assert f"{np.nansum(a.redundancy_numbers):.1f}" in words
    assert text == text_report(findings_of(result_of(a)))


def test_what_cannot_be_determined_stands_in_every_report() -> None:
    network, truth = make_network(seed_of("one ray"), images=6, points=20)
    k = network.image_points
    keep = (k.point != 7) | (k.image == 0)
    a = adjust(replace(network, image_points=k.select(keep)), truth, datum=Datum("free"))
    words = "point 8: 1 ray, 2 are needed"
    assert a.undetermined == (words,)
    result = result_of(a)
    assert words in text_report(findings_of(result))
    assert words in html_of(findings_of(result))
    assert summary(findings_of(result))["datum"]["undetermined"] == [words]


def test_tables_of_reliability_and_variance_components(
    synthetic: tuple[Network, Estimate], tmp_path: Path
) -> None:
    network, truth = synthetic
    k = network.image_points
    xy = k.xy.copy()
    xy[3] += 5.0
    network = with_bars(replace(network, image_points=replace(k, xy=xy)), truth, (0.0, 1e-5), 1e-4)
    a = adjust(network, truth, datum=Datum("free"))
    assert a.rejected[3]
    write_tables(findings_of(result_of(a)), tmp_path)
    rows = rows_of(tmp_path / "reliability.csv")
    assert len(rows) == len(k)
    assert rows[3]["rejected"] == "1" and rows[3]["rx"] == rows[3]["mdbx_px"] == rows[3]["extx"] == ""
    found = reliability(a)
    for row, index in ((rows[0], 0), (rows[40], 40)):
        assert float(row["rx"]) == a.redundancy_numbers[index, 0]
        assert float(row["wy"]) == a.standardised[index, 1]
        assert float(row["tauy"]) == a.tau[index, 1]
        assert float(row["mdbx_px"]) == pytest.approx(
            found.delta0 * a.sigma0 * 0.1 / np.sqrt(float(row["rx"])), rel=1e-4
        )
        assert float(row["exty"]) == found.external[index, 1]
    numbers = sum(float(row[c]) for row in rows for c in ("rx", "ry") if row[c])
    components = rows_of(tmp_path / "variance_components.csv")
    kinds = {row["group"]: row for row in components if row["kind"] == "kind"}
    assert set(kinds) == {"image points", "scale bars"}
    assert float(kinds["image points"]["redundancy"]) == pytest.approx(numbers, rel=1e-9)
    assert sum(float(row["redundancy"]) for row in kinds.values()) == pytest.approx(a.redundancy, abs=1e-3)
    photographs = [row for row in components if row["kind"] == "photograph"]
    assert [row["group"] for row in photographs] == list(a.network.images)


def test_shared_parameters_are_reported_once(synthetic: tuple[Network, Estimate]) -> None:
    network, truth = synthetic
    m = len(network.images)
    cameras = tuple(
        replace(
            truth.cameras[0],
            name=f"A image {i + 1}",
            shared=tuple("" if name == "c" else "A" for name in truth.cameras[0].names),
        )
        for i in range(m)
    )
    a = adjust(replace(network, camera=np.arange(m)), replace(truth, cameras=cameras), datum=Datum("free"))
    once = interior_parameters(a)
    assert [one.owner for one in once if one.name == "c"] == [camera.name for camera in cameras]
    assert [(one.owner, one.photographs) for one in once if one.name == "K1"] == [("A", m)]
    assert [name for name, _ in families(a)] == ["A"]
    page = html_of(findings_of(result_of(a)))
    assert page.count("<h4>A</h4>") == 1 and f"{m} parameters of single photographs and groups" in page
    tests = summary(findings_of(result_of(a)))["statistics"]["significance"]
    assert [one["camera"] for one in tests if one["parameter"] == "K1"] == ["A"]


def test_a_camera_without_photographs_in_the_network_has_no_sigmas() -> None:
    network, truth = make_network(seed_of("idle"), images=6, points=20, cameras=2)
    network = replace(network, camera=np.zeros(6, dtype=np.int64))
    a = adjust(network, replace(truth, cameras=(truth.cameras[0], truth.cameras[1])), datum=Datum("free"))
    assert np.isnan(a.interior_sigma(1)).all()
    assert "camera 2" in html_of(findings_of(result_of(a)))
