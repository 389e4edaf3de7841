"""What nothing checks is told: scale of one bar, control, two-ray points; and copies are no observations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.judgement.given.free_network import FreeNetwork
from sfm.judgement.given.groups import GivenSettings, remarks_on_unchecked
from sfm.judgement.given.judge import judge_given
from sfm.judgement.given.values import GivenModel
from sfm.model.camera import pixel_from_tangents
from sfm.model.distributions import LEVEL
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ObjectPoints
from sfm.model.remarks.remark import kinds_of, remark
from sfm.model.similarity import Similarity
from sfm.pipeline import run_survey
from sfm.survey.inputs.checks.copies import same_photographs
from sfm.survey.inputs.exterior_table import ObservedExterior
from sfm.survey.inputs.given_values import KnownPoints, ScaleBar
from tests.findings import findings_of
from tests.given_figures import Figure
from tests.surveys import remarks_on_given, survey_of
from tests.synthetic import add_narrow_points, make_network, observed_anew, seed_of


def _scene(name: str) -> tuple[Network, Estimate]:
    return make_network(seed_of(name), images=8, points=30)


def _bar(truth: Estimate, i: int, j: int) -> ScaleBar:
    return ScaleBar(str(i + 1), str(j + 1), float(np.linalg.norm(truth.points[i] - truth.points[j])), 1e-4)


def _kinds(network: Network, truth: Estimate, **given: object) -> tuple[str, tuple[str, ...]]:
    result = run_survey(survey_of(network, truth, **given))
    return findings_of(result).verdict.level, kinds_of(remarks_on_given(result))


def test_the_scale_of_one_bar_is_unchecked() -> None:
    network, truth = _scene("one bar")
    one = run_survey(survey_of(network, truth, scale_bars=(_bar(truth, 0, 9),)))
    (said,) = remarks_on_given(one)
    assert (said.kind, said.names("given")) == ("scale_unchecked", ("1 - 10",))
    assert findings_of(one).verdict.level == "good"
    assert _kinds(network, truth, scale_bars=(_bar(truth, 0, 9), _bar(truth, 1, 8))) == ("good", ())


def test_only_given_points_in_space_check_the_handedness() -> None:
    network, truth = _scene("handedness")
    seen, centre = network.image_points, pixel_from_tangents(truth.cameras[0], np.zeros((1, 2)))
    turned_over = replace(seen, xy=centre + (seen.xy - centre) * (1, -1))  # y0 stays right
    mirrored = replace(network, image_points=turned_over)
    bars = (_bar(truth, 0, 9), _bar(truth, 1, 8))
    chosen = [0, 5, 9, 14, 20, 25]
    names = [network.points[j] for j in chosen]
    space = KnownPoints.from_arrays(names, truth.points[chosen], 1e-4)
    plane = KnownPoints.from_arrays(names, truth.points[chosen] * (1, 1, 0), 1e-4)
    three = KnownPoints.from_arrays(names[:3], truth.points[chosen[:3]], 1e-4)
    centres = ObservedExterior.from_arrays(network.images, truth.position, 1e-4)
    # approximate values, and centres that are not used, place nothing
    for given in ({}, {"start": truth}, {"exterior": centres}, {"control": three}):
        found = run_survey(survey_of(mirrored, truth, scale_bars=bars, **given))
        assert "handedness_unchecked" in kinds_of(found.tests)
        assert findings_of(found).verdict.level == "good"
    for given in ({"control": space}, {"exterior": centres, "datum": {"kind": "control"}}):
        for one in (network, mirrored):
            result = run_survey(survey_of(one, truth, **given))
            judged = kinds_of((*result.remarks, *result.tests))
            assert "handedness_unchecked" not in judged and ("given_mirrored" in judged) is (one is mirrored)
    flat = run_survey(survey_of(mirrored, truth, control=plane))
    assert "handedness_unchecked" in kinds_of(flat.tests)


def test_control_without_its_wrong_point_checks_the_handedness() -> None:
    """Fixed control, one point 5 mm off, is far from the mirrored network too: it had counted as nothing."""
    network, truth = _scene("doubtful handedness")
    xyz = truth.points[:8] + 2e-4 * seed_of("doubtful handedness").standard_normal((8, 3))
    xyz[0, 0] += 5e-3
    control = KnownPoints.from_arrays(network.points[:8], xyz, 0.0)
    found = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"})).remarks
    assert found[0].kind == "given_left_out" and found[0].names("given") == ("1",)
    assert "handedness_unchecked" not in kinds_of(found)


@pytest.mark.parametrize(("ratio", "weak"), [(1.1, False), (1.6, True)])
def test_a_note_begins_at_five_standard_deviations(ratio: float, weak: bool) -> None:
    """Of two bars the external reliability is 4.13 times the ratio of their relative precision: 4.5, 6.6."""
    network, truth = _scene("two bars")
    one, other = _bar(truth, 0, 9), _bar(truth, 1, 8)
    bars = (one, replace(other, sigma=ratio * one.sigma / one.length * other.length))
    network = replace(
        network, image_points=replace(network.image_points, covariance=network.image_points.covariance / 100)
    )
    network = observed_anew(network, truth, 0.01, seed_of("two bars noise"))
    found = remarks_on_given(run_survey(survey_of(network, truth, scale_bars=bars, sigma=True)))
    weaker = [one.names("given") for one in found if one.kind == "given_weakly_checked"]
    assert weaker == ([("1 - 10",)] if weak else [])


@pytest.mark.parametrize(("scale", "implausible"), [(1 / 540, True), (1 / 270, False)])
def test_an_object_nearer_than_the_image_is_implausible(scale: float, implausible: bool) -> None:
    """c is 10 mm and the object at 3.6 to 4.4 m: in another scale its image is 1.5 or 0.75 times as large."""
    network, truth = _scene("unit")
    bars = tuple(
        replace(one, length=scale * one.length, sigma=scale * one.sigma)
        for one in (_bar(truth, 0, 9), _bar(truth, 1, 8))
    )
    verdict = findings_of(run_survey(survey_of(network, truth, scale_bars=bars))).verdict
    said = [one for one in verdict.remarks if one.kind == "scale_implausible"]
    assert bool(said) == implausible == (verdict.level == "bad")


def test_three_control_points_are_partly_checked() -> None:
    """Two of their distances, beside the scale; of two points nothing is."""
    network, truth = _scene("three points")
    control = KnownPoints.from_arrays(["1", "2", "3"], truth.points[:3], 1e-4)
    level, kinds = _kinds(network, truth, control=control, datum={"kind": "control"})
    assert level == "good" and kinds == ("given_partly_checked", "scale_unchecked")
    three, two = (
        Figure(X, np.tile(1e-8 * np.eye(3), (len(X), 1, 1)), X, 1e-10 * np.eye(3 * len(X)))
        for X in (truth.points[:3], truth.points[:2])
    )
    for one, kind in ((three, "given_partly_checked"), (two, "given_unchecked")):
        model = one.points.model(Similarity(1.0, np.eye(3), np.zeros(3)), estimated=False)
        (said,) = remarks_on_unchecked("control", ["1", "2", "3"], model, (), LEVEL)
        assert said.kind == kind and len(said.names("given")) == len(one.given)


def test_what_is_weakly_checked_is_one_remark() -> None:
    """Of two pairs the better values have redundancy numbers of 1 / 3 and 1 / 10."""
    A = np.array([[1.0, 0], [1, 0], [0, 1], [0, 1]])
    model = GivenModel(np.zeros(4), np.zeros((4, 4)), np.diag([1.0, 2, 1, 9]), A, np.arange(4), 500)
    (said,) = remarks_on_unchecked("lengths", ["a", "b", "c", "control"], model, (), LEVEL)
    assert said.kind == "given_weakly_checked" and said.names("given") == ("a", "c")
    assert said.number("sigmas") == pytest.approx(4.13 * 3, rel=0.01)
    (strict,) = remarks_on_unchecked("lengths", ["a", "b", "c", "control"], model, (), LEVEL / 10)
    assert strict.number("sigmas") == pytest.approx(said.number("sigmas") * 4.73 / 4.13, rel=0.01)


def test_fixed_control_is_held_against_the_free_network() -> None:
    network, truth = _scene("fixed control")
    names = [str(k + 1) for k in range(6)]
    for error in (0.0, 0.002):
        xyz = truth.points[:6] + error * seed_of("error").standard_normal((6, 3))
        control = KnownPoints.from_arrays(names, xyz)
        result = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
        test = result.given_tests[0]
        assert (test.what, test.dof) == ("control", 11)  # 18 coordinates less seven
        said = [one for one in remarks_on_given(result) if one.kind == "given_scatter"]
        assert (test.probability < 0.001) == bool(said) == bool(error)
        scatter = float((xyz - truth.points[:6]).std())
        assert not error or said[0].number("sigma") == pytest.approx(scatter, rel=0.4)


def test_control_without_standard_deviations_is_compared_with_one_another() -> None:
    """Their chi-square by the network alone, 1474 with 5 degrees of freedom, stood beside p = 0.53."""
    network, truth = _scene("unknown standard deviations")
    xyz = truth.points[:6] + 0.002 * seed_of("unknown").standard_normal((6, 3))
    control = KnownPoints.from_arrays([str(k + 1) for k in range(6)], xyz)
    result = run_survey(survey_of(network, truth, control=control, datum={"kind": "free"}))
    (test,) = (said.tested for said in result.verdict.tests if said.kind == "given_tested")
    assert test[2].startswith("standard deviations not stated, each compared with 5 others, p = ")
    assert "chi-square" not in test[2] and result.given_tests[0].probability > 0.01


@pytest.mark.parametrize(("decimals", "kinds"), [(4, ("given_scatter",)), (None, ())])
def test_fixed_control_is_weighted_as_it_scatters(decimals: int | None, kinds: tuple[str, ...]) -> None:
    """Of a network far more precise than 0.1 mm, without noise even; before, a warning."""
    network, truth = _scene("decimals")
    network = observed_anew(network, truth, 0.0, seed_of("no noise"))
    xyz = truth.points[:8] if decimals is None else np.round(truth.points[:8], decimals)
    control = KnownPoints.from_arrays([str(k + 1) for k in range(8)], xyz)
    result = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
    assert {one.severity for one in remarks_on_given(result)} == {"note"}
    assert tuple(one for one in kinds_of(remarks_on_given(result)) if one == "given_scatter") == kinds
    if kinds:
        said = remarks_on_given(result)[0]
        assert said.names("of") == ("control",)
        assert said.number("sigma") == pytest.approx(1e-4 / np.sqrt(12), rel=0.4)
    index = [network.point_index(name) for name in result.network.points]
    assert np.abs(result.estimate.points[index] - truth.points[index]).max() < 5e-5


@pytest.mark.sweep(0, 2)
@pytest.mark.parametrize(("points", "error"), [(4, 0.0), (8, 0.0), (8, 3e-4), (16, 1e-3)])
def test_the_decimals_of_fixed_control_do_not_change_the_result(points: int, error: float) -> None:
    """The same control in mm and, converted, in 0.01 mm: points were left out, or no longer weighted."""
    network, truth = _scene("decimals")
    network = observed_anew(network, truth, 0.1, seed_of("noise"))
    rng = seed_of(f"decimals {points} {error}")
    xyz = np.round(truth.points[:points] + error * rng.standard_normal((points, 3)), 3)
    names, found, kinds = [str(k + 1) for k in range(points)], [], []
    for written in (xyz, xyz + 1e-5 * rng.integers(-4, 5, xyz.shape)):
        control = KnownPoints.from_arrays(names, written)
        result = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
        assert len(result.network.control) == points and not result.adjustment.rejected.any()
        found.append(result.estimate.points)
        kinds.append([one.kind for one in remarks_on_given(result)])
    assert kinds[0] == kinds[1] and kinds[0][0] == "given_scatter"
    index = [network.point_index(name) for name in result.network.points]
    sigma = np.sqrt(np.diagonal(result.adjustment.covariance.points, axis1=1, axis2=2))
    assert (np.abs(found[0] - found[1]) / sigma).max() < 0.3
    errors = (found[1] - truth.points[index]) / sigma
    assert 0.4 < np.sqrt((errors**2).mean()) < 1.8


def test_stated_weights_hold_fixed_control() -> None:
    """It is said that it scatters; the program whose weights were stated holds it too."""
    network, truth = _scene("decimals")
    xyz = np.round(truth.points[:8], 2)
    control = KnownPoints.from_arrays([str(k + 1) for k in range(8)], xyz)
    settings = {"datum": {"kind": "control"}, "adjust": {"weights": "stated"}}
    result = run_survey(survey_of(network, truth, control=control, **settings))
    at = result.network.control
    assert len(at) == 8 and np.abs(result.estimate.points[at.point] - at.xyz).max() < 1e-9
    assert remarks_on_given(result)[0].kind == "given_not_exact"


def test_a_grid_of_a_plate_does_not_scatter() -> None:
    """It is held as the plate states it, with plate_sigma."""
    network, truth = _scene("decimals")
    network = observed_anew(network, truth, 0.001, seed_of("little noise"))
    at = np.arange(8)
    control = ObjectPoints(at, np.round(truth.points[:8], 3), np.zeros((8, 3, 3)))
    free = FreeNetwork(adjust(network, truth, datum=Datum("free")))
    for plates, kind in (((), "given_scatter"), ((network.points[:8],), "given_not_exact")):
        settings = GivenSettings(Datum("control"), "m", plates=tuple(map(frozenset, plates)))
        judged = judge_given(network.with_given(control), free, settings)
        assert kind in kinds_of(judged.remarks)
        assert ("scale_unchecked" in kinds_of(judged.remarks)) is not bool(plates)


def test_a_wrong_point_among_scattering_control_is_left_out() -> None:
    network, truth = _scene("decimals")
    network = observed_anew(network, truth, 0.001, seed_of("little noise"))
    xyz = np.round(truth.points[:8], 3)
    xyz[2, 1] += 0.01
    control = KnownPoints.from_arrays([str(k + 1) for k in range(8)], xyz)
    result = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
    kinds = kinds_of(remarks_on_given(result))
    assert kinds[:2] == ("given_left_out", "given_scatter")
    assert remarks_on_given(result)[0].names("given") == ("3",)


def test_image_points_without_noise_do_not_hide_what_is_given() -> None:
    """Their weights grew to 1e26 times those of the bars, and the adjustment did not converge."""
    network, truth = _scene("no noise and bars")
    network = observed_anew(network, truth, 0.0, seed_of("no noise"))
    bars = (_bar(truth, 0, 9), replace(_bar(truth, 1, 8), sigma=1.1e-4))
    result = run_survey(survey_of(network, truth, scale_bars=bars))
    assert result.adjustment.converged and not result.adjustment.undetermined
    assert kinds_of(remarks_on_given(result)) == ("given_weakly_checked",)


@pytest.mark.slow
def test_the_level_of_the_test_against_the_free_network() -> None:
    low = 0
    for k in range(12):
        network, truth = make_network(seed_of(f"F {k}"), images=5, points=15)
        names = [str(j + 1) for j in range(5)]
        control = KnownPoints.from_arrays(names, truth.points[:5])
        result = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
        low += result.given_tests[0].probability < 0.05
    assert low <= 4  # 0.6 expected


def test_two_ray_points_are_reported() -> None:
    rng = seed_of("two rays")
    network, truth = add_narrow_points(*make_network(rng, images=6, points=30), rng, 7)
    verdict = findings_of(run_survey(survey_of(network, truth))).verdict
    (said,) = (one for one in verdict.tests if one.kind == "third_ray_missing")
    assert (said.number("two"), said.number("total")) == (7, 37)


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
        ("again", remark("copies", original="image 4", same="image points"))
    ]
    assert result.adjustment.redundancy == plain.adjustment.redundancy and result.images_total == 8


def test_another_exposure_from_the_same_place_is_no_copy() -> None:
    rng = seed_of("tripod")
    n = 20
    image, point = np.repeat([0, 1, 2], n), np.tile(np.arange(n), 3)
    xy = np.tile(rng.uniform(0, 1000, (n, 2)), (3, 1))
    xy[n : 2 * n] += 0.02 * rng.standard_normal((n, 2))
    assert same_photographs(image, point, xy, np.zeros(3, dtype=np.int64)) == {2: 0}
    assert same_photographs(image, point, xy, np.array([0, 0, 1])) == {}  # of another camera


@pytest.mark.parametrize("reject", ["tau", pytest.param("none", marks=pytest.mark.slow)])
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
    (said,) = (one for one in remarks_on_given(result) if one.kind == "given_left_out")
    assert sorted(int(name) - 1 for name in said.names("given")) == moved
    assert said.number("distance") == pytest.approx(0.5, abs=0.01)
    index = [network.point_index(name) for name in result.network.points]
    assert np.abs(result.estimate.points - truth.points[index]).max() < 5e-3
    assert findings_of(result).verdict.level == "fair"
