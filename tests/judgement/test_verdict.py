"""Verdicts: what `sfm.adjust` and `run_survey` return states what the image points show of it."""

from __future__ import annotations

import json
import pickle
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import sfm
from sfm.adjustment.quality.consistency import Consistency
from sfm.adjustment.quality.other_solutions import OtherSolution
from sfm.adjustment.quality.statistics import (
    global_test,
    robust_test,
    significance,
    tau_test,
    w_test,
)
from sfm.adjustment.result import Adjustment
from sfm.judgement import verdict as verdicts
from sfm.judgement.bundle_statistics import statistics_of
from sfm.judgement.checks import standard_deviations
from sfm.judgement.survey_result import FailedImage, SurveyResult
from sfm.judgement.verdict import judge_adjustment, judge_survey
from sfm.model.distributions import FALSE_ALARM
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import kinds_of, of_kind, remark
from sfm.model.remarks.verdict import Verdict
from sfm.pipeline import run_survey
from sfm.report.phrases import describe_test
from sfm.report.survey_report import text_report
from tests.findings import findings_of
from tests.surveys import survey_of
from tests.synthetic import make_network, observed_anew, seed_of


@pytest.fixture(scope="module")
def made() -> tuple[Network, Estimate]:
    return make_network(seed_of("verdicts"), images=6, points=30, noise_px=0.1)


def verdict_of(adjustment: Adjustment) -> Verdict:
    assert adjustment.verdict is not None
    return adjustment.verdict


def with_gross_errors(network: Network) -> Network:
    """Return the network with twelve image points that are off by 30 px."""
    xy = network.image_points.xy.copy()
    xy[::15] += 30.0
    return replace(network, image_points=replace(network.image_points, xy=xy))


def test_a_good_adjustment_is_good_and_says_what_was_adjusted(made: tuple[Network, Estimate]) -> None:
    adjustment = sfm.adjust(*made)
    verdict = verdict_of(adjustment)
    assert verdict.level == "good" and "6 of 6 photographs, 30 object points" in verdict.headline
    assert verdict.headline in repr(adjustment) and adjustment.solution.verdict == verdict
    assert pickle.loads(pickle.dumps(sfm.adjust)) is sfm.adjust
    assert verdict_of(pickle.loads(pickle.dumps(adjustment))) == verdict


def test_photographs_without_start_values_are_missing(made: tuple[Network, Estimate]) -> None:
    network, truth = made
    position = truth.position.copy()
    position[0] = np.nan
    verdict = verdict_of(sfm.adjust(network, replace(truth, position=position)))
    (missing,) = [one for one in verdict.remarks if one.kind == "photographs_missing"]
    assert verdict.level == "fair" and "5 of 6 photographs" in verdict.headline
    assert missing.number("missing") == 1
    assert not {"image_points_rejected", "rays_tested"} & set(kinds_of(verdict.remarks))


@pytest.mark.parametrize(("reject", "kept"), [("none", True), ("huber", False), ("tau", False)])
def test_gross_errors_are_said_where_nothing_acts_on_them(
    reject: str, kept: bool, made: tuple[Network, Estimate]
) -> None:
    network, truth = made
    kinds = kinds_of(verdict_of(sfm.adjust(with_gross_errors(network), truth, reject=reject)).remarks)
    assert ("gross_errors_kept" in kinds) == kept


@pytest.mark.parametrize(("undetermined", "more"), [(("c of camera 1",), 0), ((), 1), ((), 0)])
def test_a_rank_defect_is_bad(
    made: tuple[Network, Estimate], undetermined: tuple[str, ...], more: int
) -> None:
    a = sfm.adjust(*made)
    without = replace(a, undetermined=undetermined, defect=a.expected_defect + more)
    verdict = verdict_of(judge_adjustment(without))
    assert (
        ("rank_defect" in kinds_of(verdict.remarks)) == (verdict.level == "bad") == bool(undetermined or more)
    )


@pytest.mark.parametrize(("unreadable", "level"), [(1, "fair"), (9, "fair"), (0, "good")])
def test_files_that_cannot_be_read_are_no_missing_photographs(
    unreadable: int, level: str, made: tuple[Network, Estimate]
) -> None:
    """They made right results bad: half of a folder may be files of another kind."""
    reason = remark("photographs_unreadable", reason="not a photograph")
    failed = tuple(FailedImage(f"{k}.jpg", reason) for k in range(unreadable))
    adjustment = sfm.adjust(*made)
    result = SurveyResult("s", "m", 6, failed, adjustment, np.full(30, -1), None)
    verdict = judge_survey(result).verdict
    kinds = kinds_of(verdict.remarks)
    assert verdict.level == level and "photographs_missing" not in kinds
    assert ("photographs_unreadable" in kinds) == (unreadable > 0)


def test_another_probability_of_a_false_alarm_rejects_and_judges_otherwise(
    made: tuple[Network, Estimate],
) -> None:
    """Image points that are off by three to four standard deviations, and a point that is twice as rough."""
    network, truth = make_network(seed_of("one rough point"), images=12, points=50, free=("c",))
    seen = network.image_points
    off = replace(seen, xy=seen.xy + 0.33 * (np.arange(len(seen)) % 15 == 0)[:, None])
    often, seldom = (
        sfm.adjust(replace(network, image_points=off), truth, false_alarm=level) for level in (0.5, 1e-6)
    )
    assert often.rejected.sum() > 5 and not seldom.rejected.any()
    assert often.test_alpha > 1e-4 > seldom.test_alpha
    rough = (seen.point == 7)[:, None] * 0.2 * seed_of("rough").standard_normal((len(seen), 2))
    rough_one = replace(network, image_points=replace(seen, xy=seen.xy + rough))
    kinds = {
        level: kinds_of(verdict_of(sfm.adjust(rough_one, truth, reject="none", false_alarm=level)).remarks)
        for level in (0.05, 1e-6)
    }
    assert kinds == {0.05: ("points_with_large_residuals",), 1e-6: ()}
    for wrong in (0.0, 1.0):
        with pytest.raises(GeometryError, match="false_alarm"):
            sfm.adjust(*made, false_alarm=wrong)


def test_the_usual_probability_of_a_false_alarm_is_that_stated(made: tuple[Network, Estimate]) -> None:
    """Left out it was 0.1 % of each coordinate, and 0.05 of all only where the user wrote 0.05."""
    plain, stated = sfm.adjust(*made), sfm.adjust(*made, false_alarm=FALSE_ALARM)
    assert plain.test_alpha == stated.test_alpha < 2e-4
    assert sfm.adjust(*made, options=sfm.AdjustmentOptions(alpha=1e-3)).test_alpha == 1e-3
    judged = sfm.adjust(*made, false_alarm=0.01, options=sfm.AdjustmentOptions(alpha=1e-3))
    assert (judged.test_alpha, judged.false_alarm) == (1e-3, 0.01)


def test_every_test_of_an_adjustment_has_a_tenth_of_the_level(made: tuple[Network, Estimate]) -> None:
    usual, strict = (sfm.adjust(*made, false_alarm=level) for level in (0.05, 0.005))
    for test in (w_test, tau_test, robust_test, global_test):
        assert test(strict).alpha == pytest.approx(test(usual).alpha / 10)
    assert [one.alpha for one in statistics_of(strict).global_tests] == [0.005]
    assert "(99.5 %)" in describe_test(global_test(strict))
    assert "(95 %)" in describe_test(global_test(usual))
    for a in (usual, strict):
        assert all(one.significant == (one.probability < a.false_alarm) for one in significance(a))


def test_the_report_of_a_survey_states_its_levels(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("words of levels"), images=6, points=30)
    result = run_survey(survey_of(network, truth, adjust={"reject": "tau", "false_alarm": 0.005}))
    words = " ".join(text_report(findings_of(result)).split())
    assert "(99.5 %)" in words and "t test, 0.5 %" in words
    assert "Baarda's w (sigma of the weights), 0.01 %" in words
    assert "Pope's tau (sigma0 as found), 0.01 %" in words
    assert not any(usual in words for usual in ("(95 %)", "t test, 5 %", "weights), 0.1 %"))


def test_the_key_of_a_survey_is_the_level_of_its_adjustment() -> None:
    network, truth = make_network(seed_of("level of a survey"), images=6, points=30)
    for level in (0.05, 1e-3):
        adjust = {"reject": "tau", "false_alarm": level}
        a = run_survey(survey_of(network, truth, adjust=adjust)).adjustment
        assert a.false_alarm == level
        coordinates = 2 * len(network.image_points)
        assert coordinates * a.test_alpha == pytest.approx(level, rel=0.1)


@pytest.mark.parametrize("c_moved", [4.0, 0.0])
def test_another_solution_states_how_far_its_c_is_unless_c_is_held(c_moved: float) -> None:
    network, truth = make_network(seed_of("another solution"), images=6, points=30)
    result = run_survey(survey_of(network, truth))
    flat = OtherSolution("camera", 12.0, "mm", False, 3.0, c_moved, 1.0, truth, True)
    verdict = judge_survey(replace(result, other_solutions=(flat,))).verdict
    (said,) = of_kind(verdict.remarks, "other_solution")
    assert said.number("c") == 12.0
    assert ("c by 4" in said.text) == bool(c_moved)


def test_a_result_that_is_read_has_its_verdict(made: tuple[Network, Estimate], tmp_path: Path) -> None:
    """With the remarks, their numbers and the tests; it was None."""
    network, truth = made
    adjustment = sfm.adjust(with_gross_errors(network), truth, reject="none")
    survey = run_survey(survey_of(with_gross_errors(network), truth, adjust={"reject": "none"}))
    for name, result in (("adjustment", adjustment), ("survey", survey)):
        sfm.write_result(result, tmp_path / name)
        found, verdict = sfm.read_result(tmp_path / name).verdict, result.verdict
        assert found is not None and verdict is not None
        assert found.as_dict() == verdict.as_dict() and found.level != "good" and found.tests
        assert found.headline in repr(sfm.read_result(tmp_path / name))


@pytest.mark.parametrize("unknown", ["kind", "part", "level"])
def test_the_verdict_of_another_version_is_not_invented(
    made: tuple[Network, Estimate], unknown: str, tmp_path: Path
) -> None:
    network, truth = made
    sfm.write_result(sfm.adjust(with_gross_errors(network), truth, reject="none"), tmp_path / "out")
    path = tmp_path / "out" / "summary.json"
    stored = json.loads(path.read_text(encoding="utf-8"))
    if unknown == "kind":
        stored["verdict"]["remarks"][0]["kind"] = "of_another_version"
    if unknown == "part":
        stored["verdict"]["remarks"][0]["numbers"] = {}
    if unknown == "level":
        stored["verdict"]["level"] = "excellent"
    path.write_text(json.dumps(stored), encoding="utf-8")
    if unknown == "level":
        with pytest.raises(SurveyFileError, match="level"):
            sfm.read_result(tmp_path / "out")
    else:
        assert sfm.read_result(tmp_path / "out").verdict is None


def test_a_result_is_judged_once_and_when_it_is_asked(
    made: tuple[Network, Estimate], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """`.solution` judges nothing, and writing a survey does not judge it again."""
    count = Counter[str]()
    judge = verdicts.judge

    def counting(*given: Any) -> Verdict:
        count["judged"] += 1
        return judge(*given)

    monkeypatch.setattr(verdicts, "judge", counting)
    solution = sfm.adjust(*made).solution
    assert not count
    assert solution.verdict is not None and solution.verdict is solution.verdict
    assert count["judged"] == 1
    survey = run_survey(survey_of(*made))
    sfm.write_result(survey, tmp_path / "out")
    assert count["judged"] == 2


def test_an_effect_below_what_users_expect_is_a_row_of_the_table(made: tuple[Network, Estimate]) -> None:
    result = run_survey(survey_of(*made))
    for shift, kinds in ((1.9, ()), (2.1, ("other_camera",))):
        cause = remark("other_camera", photographs=("a",), of="coordinates", shift=shift, wrong=shift)
        verdict = judge_survey(replace(result, stage_remarks=(cause,))).verdict
        assert tuple(one.kind for one in verdict.remarks if one.kind == "other_camera") == kinds
        slight = [one for one in verdict.tests if one.kind == "slight_effect"]
        assert [one.number("shift") for one in slight] == ([] if kinds else [shift])
        assert all("a different camera" in one.tested[1] for one in slight)


def test_a_cause_of_large_residuals_is_named_whatever_it_shifts() -> None:
    """b1 is held at a wrong value, which the other unknowns compensate in all but the residuals."""
    network, truth = make_network(seed_of("held 1"), images=16, points=80)
    camera = truth.cameras[0]
    values = dict(zip(camera.names, camera.parameters, strict=True)) | {"b1": 3e-3}
    right = replace(camera, parameters=np.array([values[name] for name in camera.names]))
    network = observed_anew(network, replace(truth, cameras=(right,)), 0.1, seed_of("held b1 noise"))
    result = run_survey(survey_of(network, truth, free=("c", "x0", "y0", "K1")))
    named = {said.kind: said for said in result.verdict.remarks}
    assert named["sigma0_high"].number("ratio") > 2
    assert "b1" in named["held_parameter"].names("parameters")
    assert named["held_parameter"].number("shift") < 2


def test_no_test_of_points_is_a_row_where_none_was_tested() -> None:
    for tested, kinds in ((0, ()), (5, ("points_tested", "doubtful_tested"))):
        assert kinds_of(verdicts.consistency_remarks(Consistency((), None, tested=tested), 3)) == kinds


def test_as_many_mirrored_photographs_as_others_decide_nothing() -> None:
    """Two mirrored alone and two together, beside 7 or 30 others: a sign test of all of them."""
    alone, together = remark("photograph_mirrored"), remark("photograph_of_mirror_image", photographs="cd")
    failed = [SimpleNamespace(image=k, reason=alone) for k in "ab"]
    failed += [SimpleNamespace(image=k, reason=together) for k in "cd"]
    for right, decided in ((7, ()), (30, ("most photographs",))):
        network = SimpleNamespace(images=("x",) * right, named=np.zeros(0, dtype=bool))
        adjustment = SimpleNamespace(network=network, false_alarm=FALSE_ALARM)
        result: Any = SimpleNamespace(failed=failed, adjustment=adjustment, stage_remarks=())
        *single, both = verdicts._mirrored(result)
        assert [one.names("photograph") for one in single] == [("a",), ("b",)]
        assert both.names("decided_by") == decided


def test_standard_deviations_of_negative_variances_are_unknown() -> None:
    np.testing.assert_array_equal(standard_deviations(np.diag([4.0, 0.0, -1.0])), [2.0, 0.0, np.nan])


def test_undetermined_unknowns_are_named(made: tuple[Network, Estimate]) -> None:
    a = sfm.adjust(*made)
    (said,) = verdicts.convergence_remarks(replace(a, undetermined=("c of camera A", "point 7")))
    assert said.kind == "rank_defect" and said.names("undetermined") == ("c of camera A", "point 7")
    assert verdicts.convergence_remarks(a) == ()


def test_a_level_left_out_is_the_same_as_the_same_level_stated() -> None:
    """In everything that is said; single questions had Baarda's level at the default, whatever that was."""
    network, truth = make_network(seed_of("stated and left out"), images=6, points=30)
    network = with_gross_errors(network)
    reports = []
    for adjust in ({"reject": "tau"}, {"reject": "tau", "false_alarm": FALSE_ALARM}):
        result = run_survey(survey_of(network, truth, adjust=adjust))
        reports.append((result.verdict, text_report(findings_of(result))))
        assert result.adjustment.levels.question == pytest.approx(FALSE_ALARM / 50)
    assert reports[0] == reports[1]
