"""Photographs to add to a survey, and a plan photographed by rendering."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sfm
from sfm.adjustment.solve import predict
from sfm.model.camera import camera_from_values
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import of_kind
from sfm.model.solution import Solution
from sfm.products.inspection.planned_survey import compare_with_plan, read_plan, write_simulation
from sfm.products.planning.further_page import headline, weakest
from sfm.products.planning.plan import describe_plan, further_photographs, verdict_of_plan
from sfm.products.planning.planned_object import shape_object
from sfm.products.planning.prediction import WantedPrecision, predict_network
from sfm.products.planning.stations import Stations, arrangement
from sfm.products.planning.visibility import Seeing, TargetImage
from sfm.products.rendering.planned_targets import PlannedTargets, planned_scene
from sfm.report.page import Banner
from sfm.report.pages import page_of, write_page
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.rings import CodeFamily
from tests.rigs import make_rig
from tests.synthetic import seed_of

CAMERA = camera_from_values("c", "brown", (3000, 2000), (0.006, 0.006), c_mm=18.0, free=("c", "x0", "y0"))


def survey() -> tuple[Network, Estimate]:
    """Return a survey of a plate from one side of it, so that its far end is weak."""
    plate = shape_object("plate", (1.0, 0.7), 60)
    ring = arrangement("ring:16", plate, CAMERA)
    near = np.flatnonzero(ring.position[:, 0] > -0.2)[:6]
    a = predict_network(plate, CAMERA, ring.of(near), Seeing(sigma_px=0.1)).adjustment
    return a.network, a.estimate


def test_further_photographs_help_the_weakest_points(tmp_path: Path) -> None:
    network, estimate = survey()
    found = further_photographs(network, estimate, sigma_px=0.1, count=2, candidate_count=60)
    before = np.sqrt(np.trace(predict(network, estimate).covariance.points, axis1=1, axis2=2) / 3)
    assert np.allclose(found.before, before)
    assert found.points[0] == np.argmax(before)
    assert (found.after < found.before * (1 + 1e-9)).all()
    gain = found.before[found.points].max() / found.after[found.points].max()
    assert gain > 1.15
    # the network of both is what the adjuster makes of it, and the first photograph alone helps less
    assert found.adjustment.network.images[-2:] == ("new 1", "new 2")
    alone = further_photographs(network, estimate, sigma_px=0.1, count=1, candidate_count=60)
    assert found.after.max() < alone.after.max() < before.max()
    assert np.allclose(alone.stations.position[0], found.stations.position[0])
    result = Solution("plate", network, estimate, unit="m")
    page = write_page(found, tmp_path / "more", result=result).read_text(encoding="utf-8")
    assert headline(found, result) in page and weakest(found, result)[0][1] in page
    assert (tmp_path / "more" / "exterior.csv").read_text(encoding="utf-8").count("\n") == 3


def test_further_photographs_of_a_rig_are_single_ones() -> None:
    network, truth = make_rig(seed_of("further"), moments=4)
    found = further_photographs(network, truth, sigma_px=0.1, count=2)
    assert found.camera == "camera 1" and (found.after < found.before).all()
    moment = found.adjustment.network.moment
    assert moment is not None and moment.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 5]
    single = "These are single photographs by camera camera 1, without the others of its rig."
    stated = page_of(found, result=Solution("rig", network, truth, unit="m")).verdict
    assert isinstance(stated, Banner) and single in [line.text for line in stated.lines]


def test_what_cannot_be_helped_is_said() -> None:
    network, estimate = survey()
    with pytest.raises(GeometryError, match="0 further photographs, needed 1 or more"):
        further_photographs(network, estimate, sigma_px=0.1, count=0)
    lost = replace(estimate, position=np.full_like(estimate.position, np.nan))
    with pytest.raises(GeometryError, match="0 photographs and 60 points of two rays, needed 2 and 3"):
        further_photographs(network, lost, sigma_px=0.1)


def test_a_plan_is_achieved_by_its_rendered_photographs(tmp_path: Path) -> None:
    camera = camera_from_values("small", "brown", (900, 700), (0.005, 0.005), c_mm=6.0, free=("c",))
    plate = shape_object("plate", (500.0, 380.0), 20)
    target = TargetImage(contrast=120, noise=3, blur_px=0.8)
    stations: Stations = arrangement("ring:8", plate, camera)
    seeing = Seeing(diameter=12.0, target=target)
    prediction = predict_network(plate, camera, stations, seeing)
    plan = describe_plan("plate", "mm", prediction, seeing, WantedPrecision())
    write_page(plan, tmp_path / "plan")
    read = read_plan(tmp_path / "plan")
    assert (read.seen == plan.prediction.sight.seen).all() and read.cameras[0].free.sum() == 1
    assert np.allclose(read.stations.rotation, stations.rotation, atol=1e-9)
    path = write_simulation(read, tmp_path)
    result = sfm.run_survey(path, compare_with="none")
    found = compare_with_plan(read, "ring14", result)
    assert found.points == found.planned == 20
    # 60 coordinates, correlated through the datum: 10 % of sampling error, and sigma0 of some 200 redundancy
    assert found.ratio == pytest.approx(1.0, abs=0.25) and found.error_ratio_squared**0.5 == pytest.approx(
        1.0, abs=0.35
    )
    assert found.sigma_px == pytest.approx(found.predicted_px, rel=0.2)
    (tmp_path / "plan" / "points.csv").write_text("id,X\n", encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"points\.csv, line 1: no column Y"):
        read_plan(tmp_path / "plan")


def test_targets_that_overlap_are_refused(tmp_path: Path) -> None:
    camera = camera_from_values("small", "brown", (900, 700), (0.005, 0.005), c_mm=6.0, free=("c",))
    plate = shape_object("plate", (100.0, 100.0), 20)
    seeing = Seeing(diameter=12.0)
    prediction = predict_network(plate, camera, arrangement("ring:6", plate, camera), seeing)
    plan = describe_plan("plate", "mm", prediction, seeing, WantedPrecision())
    write_page(plan, tmp_path / "plan")
    with pytest.raises(GeometryError, match="overlap; needed fewer points or smaller targets"):
        write_simulation(read_plan(tmp_path / "plan"), tmp_path)


def test_a_planned_target_lies_where_its_point_is() -> None:
    family = code_family("ring14")
    assert isinstance(family, CodeFamily)
    normals = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    xyz = np.array([[1.0, 2, 3], [4, 5, 6]])
    scene = planned_scene(PlannedTargets(xyz, normals, np.array([-1, 5]), 2.0, family))
    assert np.allclose(scene.faces.normals(), normals)
    assert np.allclose(scene.faces.place(scene.targets.face, scene.targets.centre), scene.faces.centre)


def test_groups_that_nothing_joins_are_named() -> None:
    """Two rings of stations of which each sees other sides of a box are two networks, not one that is "
    "weak."""
    camera = camera_from_values("full", "brown", (6000, 4000), (0.006, 0.006), c_mm=35.0)
    box = shape_object("box", (400.0, 300.0, 200.0), 200)
    seeing = Seeing(sigma_px=0.05)
    named = {}
    for rings in ("two-rings:16", "ring:16"):
        stations = arrangement(rings, box, camera)
        prediction = predict_network(box, camera, stations, seeing)
        plan = describe_plan("box", "mm", prediction, seeing, WantedPrecision())
        found = of_kind(verdict_of_plan(plan).remarks, "plan_not_connected", "plan_undetermined")
        named[rings] = [(one.kind, one.names("photographs"), one.names("others")) for one in found]
        assert sorted(name for group in plan.groups for name in group) == sorted(stations.names)
    upper, lower = (tuple(f"S{k:02d}" for k in range(first, 17, 2)) for first in (1, 2))
    assert named == {"two-rings:16": [("plan_not_connected", lower, upper)], "ring:16": []}
