"""Calibrated cameras: their parameters, and the mounts of a rig with their precision."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

import sfm
from sfm.adjustment.result import Adjustment
from sfm.judgement.calibrated_cameras import (
    CalibratedCamera,
    calibrated_cameras,
    camera_is_result,
    families,
    family_of_photographs,
    interior_of,
    interior_parameters,
    projection_of,
)
from sfm.judgement.survey_result import SurveyResult
from sfm.model.estimate import Estimate
from sfm.model.remarks.remark import remark
from tests.synthetic import make_network, seed_of


def test_parameters_that_are_adjusted_or_held_at_a_value_are_listed_once() -> None:
    network, truth = make_network(seed_of("parameters"), images=6, points=30, free=("c",))
    camera = truth.cameras[0]
    p = np.zeros(len(camera.names))
    p[[camera.names.index("c"), camera.names.index("K1")]] = camera.parameters[camera.names.index("c")], 1e-4
    cameras = (camera.with_parameters(p),)
    a = sfm.adjust(network, Estimate(cameras, truth.position, truth.rotation, truth.points), reject="none")
    listed = interior_parameters(a)
    assert [parameter.name for parameter in listed] == ["c", "K1"]
    assert [parameter.photographs for parameter in listed] == [6, 6]
    assert listed[0].sigma > 0 and not listed[1].sigma > 0


def plate(sigma: float = 0.0, given: int = 40, free: tuple[str, ...] = ("c", "x0", "y0")) -> Adjustment:
    """Return photographs of 40 points of a plane, of which some are given."""
    network, truth = make_network(seed_of("plate"), images=6, points=40, planar=True, free=free)
    network = network.with_control(network.points[:given], truth.points[:given], sigma)
    return sfm.adjust(network, truth, datum="control", reject="none")


@pytest.mark.parametrize(("pixels", "result"), [(0.8, True), (1.3, False)])
def test_points_known_to_a_pixel_make_a_calibration(pixels: float, result: bool) -> None:
    """In the photograph where they are smallest; the standard deviation is the mean of three coordinates."""
    a = plate()
    distance = np.linalg.norm(a.estimate.points[None] - a.estimate.position[:, None], axis=2)
    seen = a.network.image_points
    farthest = np.array([distance[seen.image[seen.point == j], j].max() for j in range(40)])
    sigma = pixels * farthest / a.estimate.cameras[0].c_px
    stated = np.sqrt(3) * sigma[:, None] * [0.6, 0.8, 0.0]
    covariance = stated[:, :, None] ** 2 * np.eye(3)
    control = replace(a.network.control, covariance=covariance)
    far = replace(a.estimate, points=a.estimate.points + 90.0, position=a.estimate.position + 90.0)
    for estimate in (a.estimate, far):
        other = replace(a, estimate=estimate, network=a.network.with_given(control))
        assert camera_is_result(other) == result


def test_a_calibration_has_as_many_parameters_as_unknown_coordinates() -> None:
    """One unknown point has three coordinates, as many as c, x0 and y0; two have six."""
    assert camera_is_result(plate(given=39)) and not camera_is_result(plate(given=38))
    five = ("c", "x0", "y0", "K1", "K2", "P1")
    assert camera_is_result(plate(given=38, free=five)) and not camera_is_result(plate(given=37, free=five))
    assert not camera_is_result(replace(plate(), datum="free"))
    assert not camera_is_result(plate(free=()))
    a = plate(given=38)
    out = a.network.image_points.point == 39  # rejected everywhere, it is not in the result
    assert camera_is_result(replace(a, rejected=out))


def calibrated(a: Adjustment, **parts: Any) -> tuple[CalibratedCamera, ...]:
    result = SurveyResult("c", "m", 6, (), a, np.full(len(a.network.points), -1), None, **parts)
    return calibrated_cameras(result, interior_of(a))


def test_calibrated_cameras_state_their_projection_uncertainty() -> None:
    a = plate()
    (one,) = calibrated(a)
    found = projection_of(a, np.ones(6, dtype=bool))
    assert found is not None
    columns, rows, sigma = found
    assert [parameter.name for parameter in one.parameters] == ["c", "x0", "y0"]
    assert one.projection_rms_px == pytest.approx(np.sqrt((sigma**2).mean()))
    assert one.projection_largest_px == pytest.approx(sigma.max())
    hull = Delaunay(a.network.image_points.xy)
    inside = hull.find_simplex(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)) >= 0
    assert one.observed_rms_px == pytest.approx(np.sqrt((sigma.ravel()[inside] ** 2).mean()), rel=1e-3)
    assert one.observed == pytest.approx(ConvexHull(a.network.image_points.xy).volume / (2000 * 1500))
    assert one.observed_rms_px < one.projection_rms_px < one.projection_largest_px
    failed = remark("calibration_failed", camera=one.name)
    assert calibrated(a, stage_remarks=(failed,)) == ()
    assert calibrated(replace(a, datum="free")) == ()


def test_a_camera_that_is_held_or_not_determined_has_no_projection_uncertainty() -> None:
    a = plate()
    every = np.ones(6, dtype=bool)
    assert projection_of(a, ~every) is None
    for interior, known in ((np.zeros((3, 3)), False), (np.full((3, 3), np.inf), True)):
        size = a.covariance.interior[0].shape
        covariance = replace(a.covariance, interior=(np.broadcast_to(interior[0, 0], size).copy(),))
        other = replace(a, covariance=covariance)
        assert projection_of(other, every) is None
        found = calibrated(other)
        assert len(found) == known
        for one in found:
            assert np.isinf([one.projection_rms_px, one.projection_largest_px, one.observed_rms_px]).all()


def test_a_parameter_over_its_standard_deviation() -> None:
    listed = {one.name: one for one in interior_parameters(plate(free=("c", "x0", "K1")))}
    assert listed["c"].t is None and listed["K2"].t is None  # no null hypothesis, held
    assert listed["K1"].t == pytest.approx(abs(listed["K1"].value) / listed["K1"].sigma)
    negative = replace(listed["K1"], value=-abs(listed["K1"].value))
    assert negative.t == listed["K1"].t and replace(negative, sigma=0.0).t is None


def test_shared_parameters_come_first_and_count_all_photographs() -> None:
    """Two cameras with one c and a principal point each: c of six photographs, the others of three."""
    network, truth = make_network(seed_of("shared c"), images=6, points=30, cameras=2, free=("c", "x0"))
    names = truth.cameras[0].names
    group = tuple("lens" if name == "c" else "" for name in names)
    same = tuple(
        replace(one.with_parameters(truth.cameras[0].parameters), shared=group) for one in truth.cameras
    )
    a = sfm.adjust(
        network, replace(truth, cameras=same), reject="none", options=sfm.AdjustmentOptions(max_iterations=3)
    )
    listed = interior_parameters(a)
    common = [one for one in listed if one.owner == "lens"]
    assert [(one.name, one.photographs) for one in common] == [("c", 6)]
    assert {(one.owner, one.photographs) for one in listed if one.name == "x0"} == {
        ("camera 1", 3),
        ("camera 2", 3),
    }
    interior = interior_of(a)
    owners = [one.owner for one in interior.parameters]
    names_of_families = {one.name for one in interior.families}
    assert [owner in names_of_families for owner in owners] == sorted(
        (owner in names_of_families for owner in owners), reverse=True
    )
    assert {one.owner for one in interior.single} == set(owners) - names_of_families
    assert [len(one) for one in interior.sigmas] == [len(names)] * 2


def test_a_family_has_the_name_and_the_values_of_its_first_camera() -> None:
    """Cameras 1 and 3 share their parameters, camera 2 is of its own kind."""
    network, truth = make_network(seed_of("families"), images=6, points=14, cameras=3, free=("c",))
    first, second, third = truth.cameras
    shared = ("lens",) * len(first.names)
    third = replace(third.with_parameters(first.parameters), shared=shared)
    cameras = (replace(first, shared=shared), second, third)
    a = sfm.adjust(network, replace(truth, cameras=cameras), reject="none")
    found = families(a)
    assert [camera.name for _, camera in found] == [first.name, second.name]
    assert len({name for name, _ in found}) == 2
    of = family_of_photographs(a)
    assert (of[network.camera == 0] == of[network.camera == 2].min()).all()
    assert set(of[network.camera == 1]).isdisjoint(of[network.camera != 1])
