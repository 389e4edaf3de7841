"""What nothing checks is told: scale of one bar, control, two-ray points; and copies are no observations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.quality.against_free import control_apart, given_test
from sfm.network import Estimate, ImagePoints, Network
from sfm.pipeline import run_survey
from sfm.remarks.remark import of_kind
from sfm.report.findings.findings import findings_of
from sfm.survey.inputs.checks.same_photographs import same_photographs
from sfm.survey.inputs.given import KnownPoints, ScaleBar
from tests.surveys import survey_of
from tests.synthetic import add_narrow_points, make_network, seed_of


def _scene(name: str) -> tuple[Network, Estimate]:
    return make_network(seed_of(name), images=8, points=30)


def _bar(truth: Estimate, i: int, j: int) -> ScaleBar:
    return ScaleBar(str(i + 1), str(j + 1), float(np.linalg.norm(truth.points[i] - truth.points[j])), 1e-4)


def _remarks(network: Network, truth: Estimate, **given: object) -> tuple[str, str]:
    verdict = findings_of(run_survey(survey_of(network, truth, **given))).verdict
    return verdict.level, " ".join(one.text for one in verdict.remarks)


def test_the_scale_of_one_bar_is_told_as_unchecked() -> None:
    network, truth = _scene("one bar")
    level, told = _remarks(network, truth, scale_bars=(_bar(truth, 0, 9),))
    assert level == "good" and "The scale rests on the scale bar 1 - 10, which nothing checks" in told
    level, told = _remarks(network, truth, scale_bars=(_bar(truth, 0, 9), _bar(truth, 1, 8)))
    assert level == "good" and "nothing checks" not in told


def test_fixed_control_is_held_against_the_free_network() -> None:
    network, truth = _scene("fixed control")
    names = [str(k + 1) for k in range(6)]
    for error, contradicts in ((0.0, False), (0.002, True)):
        xyz = truth.points[:6] + error * seed_of("error").standard_normal((6, 3))
        control = KnownPoints.from_arrays(names, xyz)
        result = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
        test = given_test(result.adjustment, result.free_network)
        assert test is not None and test.redundancy == 11  # 18 coordinates less seven
        assert (test.probability < 0.001) == contradicts
        told = " ".join(one.text for one in findings_of(result).verdict.remarks)
        assert ("contradicts them: F" in told) == contradicts


def test_the_level_of_the_f_test() -> None:
    low = 0
    for k in range(12):
        network, truth = make_network(seed_of(f"F {k}"), images=5, points=15)
        names = [str(j + 1) for j in range(5)]
        control = KnownPoints.from_arrays(names, truth.points[:5])
        result = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
        test = given_test(result.adjustment, result.free_network)
        assert test is not None
        low += test.probability < 0.05
    assert low <= 4  # 0.6 expected


def test_two_ray_points_are_told() -> None:
    rng = seed_of("two rays")
    network, truth = add_narrow_points(*make_network(rng, images=6, points=30), rng, 7)
    (two,) = of_kind(findings_of(run_survey(survey_of(network, truth))).verdict.remarks, "two_rays")
    assert (two.number("two"), two.number("total"), two.severity) == (7, 37, "note")


def test_a_copy_among_the_image_points_is_no_photograph() -> None:
    network, truth = _scene("copy")
    seen = network.image_points
    again = seen.select(seen.image == 3)
    both = ImagePoints(
        np.concatenate([seen.image, np.full(len(again), 8)]),
        np.concatenate([seen.point, again.point]),
        np.concatenate([seen.xy, again.xy]),
        np.concatenate([seen.covariance, again.covariance]),
    )
    copied = replace(
        network,
        images=(*network.images, "again"),
        camera=np.append(network.camera, 0),
        image_points=both,
    )
    result, plain = (run_survey(survey_of(one, truth)) for one in (copied, network))
    assert [(one.image, one.reason) for one in result.failed] == [
        ("again", "its image points are those of image 4")
    ]
    assert result.adjustment.redundancy == plain.adjustment.redundancy and result.images_total == 9


def test_another_exposure_from_the_same_place_is_no_copy() -> None:
    rng = seed_of("tripod")
    n = 20
    image, point = np.repeat([0, 1, 2], n), np.tile(np.arange(n), 3)
    xy = np.tile(rng.uniform(0, 1000, (n, 2)), (3, 1))
    xy[n : 2 * n] += 0.02 * rng.standard_normal((n, 2))
    assert same_photographs(image, point, xy, np.zeros(3, dtype=np.int64)) == {2: 0}
    assert same_photographs(image, point, xy, np.array([0, 0, 1])) == {}  # of another camera


@pytest.mark.parametrize("reject", ["tau", "none"])
def test_a_third_of_the_control_half_a_metre_off_is_named(reject: str) -> None:
    """10 of 30 control points stated to 1 mm: sigma0 was 500 times too large, and no line said which."""
    rng = seed_of("third of control")
    network, truth = make_network(rng, images=6, points=40)
    xyz = truth.points[:30] + 1e-3 * rng.standard_normal((30, 3))
    moved = sorted(rng.permutation(30)[:10].tolist())
    xyz[moved] += 0.5 * np.eye(3)[rng.integers(0, 3, 10)]
    control = KnownPoints.from_arrays([str(k + 1) for k in range(30)], xyz, 1e-3)
    given = {"control": control, "datum": {"kind": "control"}, "adjust": {"reject": reject}}
    result = run_survey(survey_of(network, truth, **given))
    found = control_apart(result.adjustment, result.free_network)
    assert sorted(int(one.point) - 1 for one in found) == moved
    assert all(one.distance == pytest.approx(0.5, abs=0.01) for one in found)
    verdict = findings_of(result).verdict
    assert verdict.level == "bad"
    assert any("10 control point(s) do not fit" in one.text for one in verdict.remarks)


def test_good_control_fits_the_free_network() -> None:
    network, truth = _scene("good control")
    noisy = truth.points[:8] + 1e-3 * seed_of("good control noise").standard_normal((8, 3))
    control = KnownPoints.from_arrays([str(k + 1) for k in range(8)], noisy, 1e-3)
    result = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
    assert control_apart(result.adjustment, result.free_network) == ()
