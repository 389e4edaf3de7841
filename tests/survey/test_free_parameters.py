"""A survey that does not say what is free: the photographs decide, and a line says what was chosen."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ObjectPoints
from sfm.survey import free_parameters
from sfm.survey.free_parameters import FreeParameters, choose_free_parameters
from sfm.survey.inputs.cameras import split_cameras
from sfm.survey.inputs.settings import TargetSettings
from sfm.survey.inputs.survey import CameraSetup, Survey
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of

USUAL = {"c", "x0", "y0", "K1", "K2"}


def survey_with(**camera: Any) -> Survey:
    return Survey(name="s", cameras=(CameraSetup(name="a", images="*.jpg", **camera),))


def nominal(network: Network, truth: Estimate) -> Estimate:
    """Return start values with the camera as a data sheet has it, adjusted to the image points."""
    known = truth.cameras[0]
    pixel = (float(known.pixel_mm[0]), float(known.pixel_mm[1]))
    camera = camera_from_values("a", "brown", known.size_px, pixel, c_mm=10.2)
    return replace(truth, cameras=(camera,))


def chosen(network: Network, truth: Estimate, **options: Any) -> FreeParameters:
    return choose_free_parameters(survey_with(), network, nominal(network, truth), **options)


def planar(
    rng: np.random.Generator, count: int, *, tilt: float, flat: bool = True
) -> tuple[Network, Estimate]:
    """Return photographs of a plane, or of a cube, from above, none of them turned about its axis."""
    network, truth = make_network(rng, images=count, points=40, planar=flat)
    position = np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)), np.full(count, 4.0)])
    angle = tilt * rng.standard_normal((count, 2))
    rotation = np.stack([_turned(x, y) for x, y in angle])
    seen = network.image_points
    xy = np.array(
        [
            project(truth.cameras[0], position[i], rotation[i], truth.points[j : j + 1])[0]
            for i, j in zip(seen.image, seen.point, strict=True)
        ]
    )
    xy += 0.1 * rng.standard_normal(xy.shape)
    keep = np.isfinite(xy).all(axis=1)
    points = ImagePoints(seen.image[keep], seen.point[keep], xy[keep], seen.covariance[keep])
    return replace(network, image_points=points), replace(truth, position=position, rotation=rotation)


def _turned(x: float, y: float) -> FloatArray:
    X = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    return np.asarray(X @ np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]]))


def test_a_convergent_network_frees_what_it_determines_and_demands() -> None:
    network, truth = make_network(seed_of("free by default"), images=12, points=50)
    found = chosen(network, truth)
    free = set(found.cameras[0].free)
    assert free >= USUAL | {"b1"}  # b1 is 2e-4, a third of a pixel at the edge
    (note,) = found.remarks
    assert note.kind == "parameters_chosen" and note.severity == "note" and note.number("photographs") == 12
    assert set(note.names("parameters")) == free
    a = adjust(network, found.estimate, datum=Datum("free"), reject="none")
    assert a.sigma0 < 1.1
    assert abs(a.estimate.cameras[0].value("c") - 10.0) < 4 * a.interior_sigma(0)[0]
    assert set(chosen(network, truth, extend=False).cameras[0].free) == USUAL


@pytest.mark.parametrize("given", [False, True])
def test_a_point_whose_ray_is_rejected_holds_no_camera(given: bool) -> None:
    """Nor does it where its coordinates are known, in a datum that does not use them."""
    network, truth = make_network(seed_of("a wrong ray"), images=12, points=50)
    seen = network.image_points
    kept = (seen.point != 7) | (np.cumsum(seen.point == 7) <= 2)
    seen = seen.select(kept)
    xy = seen.xy.copy()
    xy[np.flatnonzero(seen.point == 7)[0]] += [40.0, -40.0]  # of two rays: one is left of the point
    wrong = replace(network, image_points=replace(seen, xy=xy))
    if given:
        wrong = wrong.with_given(ObjectPoints(np.array([7]), truth.points[7:8], np.zeros((1, 3, 3))))
    free = chosen(wrong, truth, extend=False).cameras[0].free
    assert free == chosen(network, truth, extend=False).cameras[0].free != ()


@pytest.mark.parametrize("model", ["brown", "opencv"])
def test_on_a_plate_decentring_and_affinity_are_candidates(model: str) -> None:
    """As in a draft of a plate; without a plate they are freed only where the residuals demand them."""
    network, truth = make_network(seed_of("plate"), images=14, points=54, planar=True, model=model)
    camera = CameraSetup(name="a", images="*.jpg", model=model)
    names = {"brown": {"P1", "P2", "b1"}, "opencv": {"p1", "p2"}}[model]
    targets = TargetSettings(codes="checkerboard", rows=6, columns=9, pitch=30.0)
    for survey, expected in (
        (Survey(name="s", cameras=(camera,), targets=targets), names),
        (Survey(name="s", cameras=(camera,)), set()),
    ):
        found = choose_free_parameters(survey, network, truth, extend=False)
        assert set(found.cameras[0].free) & names == expected


def test_what_a_network_does_not_determine_is_held() -> None:
    network, truth = planar(seed_of("parallel photographs of a plane"), 8, tilt=0.005)
    assert not {"c", "x0", "y0"} & set(chosen(network, truth).cameras[0].free)


def test_what_start_values_leave_open_is_not_adjusted(monkeypatch: pytest.MonkeyPatch) -> None:
    """With c free, parallel photographs of a plane drift through hundreds of steps before they fail."""
    network, truth = planar(seed_of("parallel photographs of a plane"), 8, tilt=0.0)
    begun = nominal(network, truth)
    free: list[set[str]] = []

    def counted(part: Network, start: Estimate, **given: Any) -> Adjustment:
        a = adjust(part, start, **given)
        if a.iterations:
            camera = start.cameras[0]
            free.append({name for name, now in zip(camera.names, camera.free, strict=True) if now})
        return a

    monkeypatch.setattr(free_parameters, "adjust", counted)
    found = choose_free_parameters(survey_with(), network, begun)
    assert "c" not in found.cameras[0].free and not any("c" in names for names in free)
    free.clear()
    convergent, truth = make_network(seed_of("free by default"), images=12, points=50)
    found = choose_free_parameters(survey_with(), convergent, nominal(convergent, truth))
    assert "c" in found.cameras[0].free and any("c" in names for names in free)


@pytest.mark.parametrize("images", [1, 2])
def test_two_photographs_hold_the_camera_and_say_so(images: int) -> None:
    network, truth = make_network(seed_of("two photographs"), images=2, points=40)
    if images == 1:
        network = replace(network, image_points=network.image_points.select(network.image_points.image == 0))
    found = chosen(network, truth)
    assert found.cameras[0].free == found.cameras[0].weighted == ()
    (note,) = found.remarks
    assert note.kind == "interior_held" and note.severity == "note" and note.number("photographs") <= 2


def test_three_photographs_observe_c_with_what_exif_data_are_worth() -> None:
    network, truth = make_network(seed_of("three photographs"), images=3, points=40)
    found = chosen(network, truth)
    (one,) = found.cameras
    assert dict(one.weighted)["c"] == pytest.approx((10.2, 1.02)) and one.c_mm is None
    assert one.adjusted == (*one.free, "c") and "c" not in one.free
    assert {"K1"} <= set(one.free)
    assert found.estimate.cameras[0].value("c") == 10.2 and not found.estimate.cameras[0].free[0]
    observed, freed = found.remarks
    assert observed.kind == "parameters_chosen" and observed.number("photographs") == 3
    assert "weighted with its start value 10.2 mm, standard deviation 1.02 mm" in observed.tested[2]
    assert observed.number("given") == 10.2 and observed.number("sigma") == pytest.approx(1.02)
    assert freed.kind == "parameters_chosen" and set(freed.names("parameters")) == set(one.free)


def test_c_that_the_survey_states_is_observed_whatever_the_orientation_began_from() -> None:
    network, truth = make_network(seed_of("three photographs"), images=3, points=40)
    start = nominal(network, truth)
    p = start.cameras[0].parameters.copy()
    p[0] *= 0.9
    tried = replace(start, cameras=(start.cameras[0].with_parameters(p),))
    found = choose_free_parameters(survey_with(c_mm=10.1), network, tried)
    assert dict(found.cameras[0].weighted)["c"] == pytest.approx((10.1, 1.01))


def test_two_focal_lengths_are_observed_with_their_ratio() -> None:
    """Apart, each by 10 %, they would stretch the photographs to one side."""
    network, truth = make_network(seed_of("three photographs"), images=3, points=40)
    known = truth.cameras[0]
    pixel = (float(known.pixel_mm[0]), float(known.pixel_mm[1]))
    camera = camera_from_values("a", "opencv", known.size_px, pixel, c_mm=10.2)
    survey = survey_with(model="opencv")
    found = choose_free_parameters(survey, network, replace(truth, cameras=(camera,)))
    (one,) = found.cameras
    assert [name for name, _ in one.weighted] == ["fx", "fy"]
    ((_, _, rho),) = one.correlations
    assert np.sqrt(2 * (1 - rho)) * 0.1 == pytest.approx(1e-3)
    split, estimate = split_cameras(found.cameras, network, found.estimate)
    a = adjust(split, estimate, datum=Datum("free"), reject="none")
    fx, fy = a.estimate.cameras[0].value("fx"), a.estimate.cameras[0].value("fy")
    assert abs(fx / fy * pixel[0] / pixel[1] - 1) < 4e-3


def test_control_determines_what_three_photographs_do_not() -> None:
    network, truth = make_network(seed_of("three photographs and control"), images=3, points=40)
    given = np.arange(0, 40, 2)
    control = ObjectPoints(given, truth.points[given], np.zeros((len(given), 3, 3)))
    found = chosen(network.with_given(control), truth, datum="control")
    assert {"c", "K1"} <= set(found.cameras[0].free)


@pytest.mark.parametrize("off", [0.0, 0.05])
def test_wrong_control_does_not_decide_what_is_free(off: float) -> None:
    """One point of fourteen 50 mm wrong: the residuals that it leaves hid that b1 is not zero."""
    network, truth = make_network(seed_of("free beside wrong control"), images=12, points=40)
    given = np.arange(0, 40, 3)
    xyz = truth.points[given]
    xyz[2, 1] += off
    control = ObjectPoints(given, xyz, np.tile(1e-8 * np.eye(3), (len(given), 1, 1)))
    found = chosen(network.with_given(control), truth, datum="control")
    assert found.cameras == chosen(network, truth).cameras and "b1" in found.cameras[0].free


def test_control_determines_c_of_many_photographs_that_do_not() -> None:
    network, truth = planar(seed_of("parallel photographs and control"), 8, tilt=0.005, flat=False)
    given = np.arange(0, 40, 2)
    control = ObjectPoints(given, truth.points[given], np.tile(1e-8 * np.eye(3), (len(given), 1, 1)))
    alone, with_control = (
        set(chosen(one, truth, datum="control").cameras[0].free)
        for one in (network, network.with_given(control))
    )
    assert "c" not in alone and "c" in with_control
    assert alone == set(chosen(network, truth).cameras[0].free)


def test_a_camera_that_the_survey_describes_stays_as_described() -> None:
    network, truth = make_network(seed_of("described"), images=12, points=40)
    for camera in ({"free": []}, {"free": ["c"]}, {"fixed": {"K1": 1e-4}}, {"weighted": {"c": (10.0, 0.1)}}):
        survey = survey_with(**camera)
        found = choose_free_parameters(survey, network, truth)
        assert found.cameras == survey.cameras and found.estimate is truth and not found.remarks


def test_image_points_that_are_given_keep_the_camera_given_with_them() -> None:
    network, truth = make_network(seed_of("given"), images=8, points=20, free=())
    camera = CameraSetup(
        name="a", size_px=truth.cameras[0].size_px, pixel_mm=truth.cameras[0].pixel_mm.tolist(), c_mm=10.0
    )
    assert not camera.states_free
    survey = replace(survey_of(network, truth), cameras=(camera,))
    assert survey.cameras[0].states_free and survey.cameras[0].free == ()
