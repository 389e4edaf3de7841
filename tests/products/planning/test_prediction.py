"""Predicted covariance against adjustments: of one network, of many noisy ones, and of real surveys."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sfm
from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.solve import adjust, predict
from sfm.model.camera import camera_from_values
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError, UnknownNameError
from sfm.model.similarity import fit_similarity
from sfm.products.geometry.tolerance import Mesh
from sfm.products.planning.planned_object import (
    PlannedObject,
    farthest_points,
    object_of_points,
    shape_object,
)
from sfm.products.planning.prediction import (
    Prediction,
    ScaleBarPlan,
    largest_length_sigma,
    predict_network,
    select_usable,
    simulate_network,
)
from sfm.products.planning.stations import ARRANGEMENTS, Stations, aim_camera, around, arrangement
from sfm.products.planning.visibility import Seeing, sight_of
from sfm.products.planning.weakness import calibratability, reason_of, rolled_share, weak_points
from sfm.products.rendering.render import write_photographs
from sfm.products.rendering.scene_file import read_scene
from sfm.report.viewer.pictures import distance_sigmas
from tests.places import DATASETS, SHARED
from tests.synthetic import make_network, seed_of

FREE = ("c", "x0", "y0", "K1", "K2", "P1", "P2")
CAMERA = camera_from_values("c", "brown", (3000, 2000), (0.006, 0.006), c_mm=18.0, free=FREE)
SEEING = Seeing(sigma_px=0.1)


def ratios(predicted: FloatArray, found: FloatArray) -> FloatArray:
    """Return sigma of points over that of others, RMS of their coordinates."""
    return np.asarray(np.sqrt(np.trace(predicted, axis1=1, axis2=2) / np.trace(found, axis1=1, axis2=2)))


def test_a_network_is_predicted_as_it_is_adjusted() -> None:
    network, truth = make_network(seed_of("predicted"), images=8, points=30, visibility=0.8)
    a = adjust(network, truth, reject="none")
    p = predict(network, a.estimate)
    assert p.sigma0 == 1.0 and p.redundancy == a.redundancy and p.defect == a.defect == 7
    scale = a.sigma0**2
    for mine, other in (
        (p.covariance.points, a.covariance.points),
        (p.covariance.exterior, a.covariance.exterior),
        (p.covariance.interior[0], a.covariance.interior[0]),
    ):
        assert np.allclose(mine * scale, other, rtol=1e-3, atol=1e-4 * np.abs(other).max())
    assert np.allclose(p.redundancy_numbers, a.redundancy_numbers, atol=1e-4)


def random_plan(rng: np.random.Generator) -> Prediction:
    """Return a random object with a random camera, and what random stations around it will give."""
    kind, sizes = [("box", (1, 0.6, 0.5)), ("plate", (1, 0.7)), ("dish", (1.0, 0.3)), ("wall", (1.5, 1))][
        rng.integers(4)
    ]
    whole = shape_object(kind, tuple(map(float, sizes)), int(rng.integers(25, 45)))
    free = (FREE, ("c",), ())[rng.integers(3)]
    c = float(rng.uniform(12, 30))
    camera = camera_from_values("c", "brown", (3000, 2000), (0.006, 0.006), c_mm=c, free=free)
    away = rng.normal(size=(int(rng.integers(9, 14)), 3)) + 0.8 * whole.normals.mean(axis=0)
    away[:, 2] = np.abs(away[:, 2]) + 0.2
    bars = (ScaleBarPlan("1", "2", 1e-4),) if rng.random() < 0.5 else ()
    return predict_network(
        whole,
        camera,
        around(whole, camera, away),
        Seeing(sigma_px=float(rng.uniform(0.02, 0.3)), max_incidence_deg=75.0),
        bars=bars,
    )


def sampling_score(prediction: Prediction, rng: np.random.Generator, runs: int) -> float:
    """Return how far the variance of adjusted noisy networks is from the predicted, in standard errors.

    The mean of d^2 / q over all coordinates and runs is 1; its variance follows from all correlations.
    """
    a = prediction.adjustment
    n = len(a.network.points)
    Q = marginal_of(a).joint(np.zeros(0, dtype=np.int64), np.arange(n))
    q = np.diagonal(Q)
    total = []
    for _ in range(runs):
        noisy, _ = simulate_network(a.network, a.estimate, rng)
        found = adjust(noisy, a.estimate, reject="none", covariance=False)
        assert found.converged
        total.append((((found.estimate.points - a.estimate.points).ravel() ** 2) / q).mean())
    rho2 = (Q**2 / np.outer(q, q)).mean()
    return float((np.mean(total) - 1) / np.sqrt(2 * rho2 / runs))


def monte_carlo(name: str, plans: int, runs: int) -> FloatArray:
    rng = seed_of(name)
    scores: list[float] = []
    while len(scores) < plans:
        try:
            prediction = random_plan(rng)
        except GeometryError:  # stations that see too little together
            continue
        if prediction.adjustment.undetermined or (prediction.rays[prediction.determined] < 2).any():
            continue
        if prediction.sigma[prediction.determined].max() > 0.01:  # not linear any more: 1 % of the object
            continue
        scores.append(sampling_score(prediction, rng, runs))
    return np.array(scores)


def test_random_plans_scatter_as_predicted() -> None:
    scores = monte_carlo("few plans", 3, 6)
    assert np.abs(scores).max() < 4.0


@pytest.mark.slow
def test_200_random_plans_scatter_as_predicted() -> None:
    scores = monte_carlo("200 plans", 200, 10)
    print(f"mean {scores.mean():+.3f}, sigma {scores.std():.3f}; {np.abs(scores).max():.2f} at most")
    assert abs(scores.mean()) < 3.3 / np.sqrt(len(scores))
    assert abs(scores.std() - 1) < 3.3 / np.sqrt(2 * len(scores))
    assert (
        np.abs(scores).max() < 4.5
    )  # a score is a sum of squares: its upper tail is longer than the normal one's


def test_unusable_photographs_and_points_are_left_out_together() -> None:
    seen = np.zeros((4, 8), dtype=bool)
    seen[0], seen[1] = True, True
    seen[2, :5] = True
    seen[3, [0, 1, 2]] = True
    photographs, points = select_usable(seen)
    assert photographs.tolist() == [0, 1, 2] and points.tolist() == list(range(8))
    seen[1, :] = False
    seen[1, :3] = True  # then photograph 1 goes, and with it the second ray of the others' last points
    photographs, points = select_usable(seen)
    assert photographs.tolist() == [0, 2] and points.tolist() == list(range(5))


def test_a_weak_point_is_named_with_its_reason() -> None:
    plate = shape_object("plate", (1.0, 0.7), 40)
    two = aim_camera(np.array([0.0, 0.0, -1.0]))
    away = np.array([[0.0, -1, 1], [0.3, 1, 1], [1, 0.2, 1], [-1, 0, 1.2]])
    stations = around(plate, CAMERA, away)
    lonely = np.array([1.2, 0.9, 0.0])
    planned = object_of_points(
        (*plate.names, "far"), np.vstack([plate.xyz, lonely]), np.vstack([plate.normals, [0, 0, 1]])
    )
    side = np.array([lonely - (0.61, 0.3, -2.0), lonely - (0.29, 0.3, -2.0)])
    every = Stations(
        (*stations.names, "a", "b"),
        np.vstack([stations.position, side]),
        np.concatenate([stations.rotation, [two, two]]),
    )
    seen = sight_of(planned, CAMERA, every.position, every.rotation, SEEING)
    seen.visibility[:4, -1] = 1
    p = predict_network(planned, CAMERA, every, SEEING, sight=seen)
    first = weak_points(p)[0]
    assert first.name == "far" and first.reason.startswith("2 rays, 9 degrees, outside the photograph in 4")
    assert reason_of(p, 0).split(",")[0].endswith("rays")
    assert p.largest_sigma[-1] > 1.5 * p.sigma[-1]  # along the rays


@pytest.mark.parametrize(
    "text", ["ring:8", "two-rings:8", "hemisphere:9", "strips:4x2", *list(ARRANGEMENTS)[4:]]
)
def test_arrangements_see_the_object_and_roll_every_second_photograph(text: str) -> None:
    planned = shape_object("plate", (1.0, 0.7), 60)
    stations = arrangement(text, planned, CAMERA)
    assert np.allclose(np.linalg.det(stations.rotation), 1.0)
    assert np.allclose(stations.rotation @ stations.rotation.transpose(0, 2, 1), np.eye(3))
    assert rolled_share(stations.rotation) >= 0.25
    p = predict_network(planned, CAMERA, stations, SEEING)
    assert p.determined.mean() > 0.8
    if text.startswith(("ring", "hemisphere", "four")):
        assert p.determined.all() and 0.2 < p.q < 2.0
    assert p.sight.seen.any(axis=0).all()


def test_what_cannot_be_an_arrangement_is_refused() -> None:
    planned = shape_object("plate", (1.0, 0.7), 20)
    for text, message in (
        ("ring", "needed ring:COUNT"),
        ("ring:2", "count of 3 or more"),
        ("strips:4", "strips:COLUMNSxROWS"),
        ("left-right:4", "has no number"),
        ("spiral:4", "expected one of ring, two-rings"),
    ):
        with pytest.raises(GeometryError, match=message):
            arrangement(text, planned, CAMERA)


def test_stations_all_at_one_place_are_refused() -> None:
    plate = shape_object("plate", (1000, 600), 40)
    ring = arrangement("ring:4", plate, CAMERA)
    one = aim_camera(np.array([0.0, 0.0, -1.0]))
    same = Stations(ring.names, np.tile([0.0, 0.0, 3000.0], (4, 1)), np.stack([one] * 4))
    for free in (CAMERA, replace(CAMERA, free=np.zeros_like(CAMERA.free))):
        with pytest.raises(GeometryError, match="different places, there are 1"):
            predict_network(plate, free, same, SEEING)


@pytest.mark.parametrize("size", [1e300, 1e150, 1e13])
def test_objects_too_large_for_numbers_are_refused(size: float) -> None:
    with pytest.raises(GeometryError, match="needed at most"):
        shape_object("box", (size, 1.0, 1.0), 10)
    with pytest.raises(GeometryError, match="needed at most"):
        object_of_points(("1", "2", "3"), size * np.eye(3), None)
    assert np.isfinite(shape_object("box", (1e12, 1e12, 1e12), 10).xyz).all()


def test_points_are_spread_in_nearly_linear_time() -> None:
    xyz = seed_of("spread").random((30_000, 3)) * [1.0, 1.0, 0.0]
    begun = time.process_time()
    kept = farthest_points(xyz, 1500)
    assert time.process_time() - begun < 1.5  # every distance anew took 4 s and more
    nearest = ((xyz - xyz[kept[0]]) ** 2).sum(axis=1)
    for j in kept[1:60]:
        assert nearest[j] == nearest.max()
        nearest = np.minimum(nearest, ((xyz - xyz[j]) ** 2).sum(axis=1))
    assert len(set(farthest_points(np.zeros((5, 3)), 5))) == 5


def test_calibration_needs_convergence_and_rolled_photographs() -> None:
    plate = shape_object("plate", (1.0, 0.7), 80)
    ring = arrangement("ring:12", plate, CAMERA)
    good = calibratability(predict_network(plate, CAMERA, ring, SEEING), SEEING)
    assert good is not None and good.good and good.rolled == 0.5 and not good.reasons
    upright = replace(ring, rotation=np.array([aim_camera(-R[:, 2]) for R in ring.rotation]))
    worse = calibratability(predict_network(plate, CAMERA, upright, SEEING), SEEING)
    assert worse is not None and worse.contribution > good.contribution and "rolled by 90" in worse.reasons[0]
    flat = calibratability(
        predict_network(plate, CAMERA, arrangement("strips:4x3", plate, CAMERA), SEEING), SEEING
    )
    assert flat is not None and not flat.good and len(flat.reasons) >= 2
    assert any("c of camera" in words for words in flat.undetermined)
    held = replace(CAMERA, free=np.zeros_like(CAMERA.free))
    assert calibratability(predict_network(plate, held, ring, SEEING), SEEING) is None


def test_the_largest_sigma_of_a_length_and_scale_bars() -> None:
    plate = shape_object("plate", (1.0, 0.7), 25)
    stations = arrangement("ring:6", plate, CAMERA)
    p = predict_network(plate, CAMERA, stations, SEEING)
    Q = marginal_of(p.adjustment).joint(np.zeros(0, dtype=np.int64), np.arange(25))
    assert p.length_sigma == pytest.approx(largest_length_sigma(plate.xyz, Q))
    assert p.length_sigma == pytest.approx(float(np.nanmax(distance_sigmas(plate.xyz, Q))))
    bar = predict_network(plate, CAMERA, stations, SEEING, bars=[ScaleBarPlan("1", "2", 0.01)])
    length = np.linalg.norm(plate.xyz[0] - plate.xyz[1])
    longest = np.linalg.norm(plate.xyz[:, None] - plate.xyz[None], axis=2).max()
    assert bar.length_sigma == pytest.approx(
        0.01 * longest / length, rel=0.02
    )  # a bar of 1 cm decides the scale
    with pytest.raises(UnknownNameError, match="unknown point of a scale bar '99'"):
        predict_network(plate, CAMERA, stations, SEEING, bars=[ScaleBarPlan("1", "99", 0.01)])


def plan_of_result(
    result: sfm.SurveyResult, planned: PlannedObject, diameter: float | None = None
) -> FloatArray:
    """Return predicted over a posteriori sigmas of points, from stations, camera and object alone."""
    a = result.adjustment
    (camera,) = a.estimate.cameras
    bars = [
        ScaleBarPlan(a.network.points[i], a.network.points[j], float(s))
        for i, j, s in zip(
            a.network.scale_bars.start, a.network.scale_bars.end, a.network.scale_bars.sigma, strict=True
        )
    ]
    stations = Stations(a.network.images, a.estimate.position, a.estimate.rotation)
    p = predict_network(planned, camera, stations, Seeing(sigma_px=a.sigma0_px, diameter=diameter), bars=bars)
    assert p.determined.all()
    return ratios(p.covariance, a.covariance.points)


def told(name: str, ratio: FloatArray) -> None:
    within = (np.abs(ratio - 1) < 0.1).mean()
    print(
        f"{name}: median {np.median(ratio):.4f}, {ratio.min():.3f} to {ratio.max():.3f}, {within:.1%} in 10 %"
    )


@pytest.mark.slow
def test_demo_is_predicted_from_its_geometry(tmp_path: Path) -> None:
    staging = read_scene(DATASETS / "demo/scene.toml")
    write_photographs(staging, tmp_path / "photographs")
    result = sfm.run_survey(
        sfm.read_survey(DATASETS / "demo/survey.toml"),
        images=tmp_path / "photographs",
        compare_with="none",
    )
    scene, names = staging.scene, result.network.points
    at = scene.faces.place(scene.targets.face, scene.targets.centre)
    code = {str(c): k for k, c in enumerate(scene.targets.code) if c >= 0}
    common = [(j, code[name]) for j, name in enumerate(names) if name in code]
    points = result.estimate.points
    to_scene = fit_similarity(points[[j for j, _ in common]], at[[k for _, k in common]])
    back = to_scene.inverse()
    near = np.linalg.norm(to_scene.apply(points)[:, None] - at[None], axis=2).argmin(axis=1)
    normals = scene.faces.normals()[scene.targets.face[near]] @ back.rotation.T
    corners = back.apply(scene.faces.corners().reshape(-1, 3))
    first = 4 * np.arange(len(scene.faces.centre))[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    ratio = plan_of_result(
        result, PlannedObject(names, points, normals, Mesh(corners, triangles)), diameter=4.2
    )
    told("demo", ratio)
    assert np.median(ratio) == pytest.approx(1, abs=0.03)
    assert (np.abs(ratio - 1) < 0.1).mean() > 0.95  # the others lack rays that were not measured


@pytest.mark.slow
@pytest.mark.skipif(not (SHARED / "data/camcal").is_dir(), reason="its photographs are not here")
def test_camcal_is_predicted_from_its_geometry() -> None:
    result = sfm.run_survey(
        sfm.read_survey(DATASETS / "camcal/survey.toml"),
        images=SHARED / "data/camcal/images",
        compare_with="none",
    )
    points = result.estimate.points
    middle = points - points.mean(axis=0)
    normal = np.linalg.svd(middle, full_matrices=False)[2][2]
    normal *= np.sign(normal @ (result.estimate.position.mean(axis=0) - points.mean(axis=0)))
    ratio = plan_of_result(
        result, object_of_points(result.network.points, points, np.tile(normal, (len(points), 1)))
    )
    told("camcal", ratio)
    assert np.median(ratio) == pytest.approx(1, abs=0.03) and (np.abs(ratio - 1) < 0.1).mean() > 0.97


@pytest.mark.slow
@pytest.mark.skipif(not (SHARED / "data/retro-panel").is_dir(), reason="its photographs are not here")
def test_retro_panel_is_predicted_from_its_geometry() -> None:
    """Two cameras and a panel that moves: the rays are those that were measured, of equal precision."""
    result = sfm.run_survey(
        sfm.read_survey(DATASETS / "retro-panel/survey.toml"),
        images=SHARED / "data/retro-panel/images",
        compare_with="none",
    )
    a = result.adjustment
    seen = a.network.image_points.select(~a.rejected)
    equal = replace(seen, covariance=np.tile(a.sigma0_px**2 * np.eye(2), (len(seen), 1, 1)))
    p = predict(replace(a.network, image_points=equal), a.estimate)
    ratio = ratios(p.covariance.points, a.covariance.points)
    told("retro-panel", ratio)
    assert np.median(ratio) == pytest.approx(1, abs=0.03)
    assert (np.abs(ratio - 1) < 0.1).mean() > 0.96  # the others have image points of less weight
    own = replace(seen, covariance=a.sigma0**2 * seen.covariance)
    exact = ratios(
        predict(replace(a.network, image_points=own), a.estimate).covariance.points, a.covariance.points
    )
    assert exact == pytest.approx(1, abs=1e-3)


def test_a_survey_is_predicted_from_its_geometry() -> None:
    """Short form of the above: an observed network, planned again from stations, camera and points alone."""
    planned = shape_object("plate", (1.0, 0.7), 60)
    stations = arrangement("hemisphere:10", planned, CAMERA)
    p = predict_network(planned, CAMERA, stations, SEEING)
    rng = seed_of("from geometry")
    seen = p.adjustment.network.image_points
    noisy = replace(
        p.adjustment.network,
        image_points=replace(seen, xy=seen.xy + 0.1 * rng.standard_normal(seen.xy.shape)),
    )
    a = adjust(noisy, p.adjustment.estimate, reject="none")
    again = Stations(a.network.images, a.estimate.position, a.estimate.rotation)
    found = predict_network(
        object_of_points(a.network.points, a.estimate.points, planned.normals),
        a.estimate.cameras[0],
        again,
        Seeing(sigma_px=a.sigma0_px),
    )
    ratio = ratios(found.covariance, a.covariance.points)
    assert np.median(ratio) == pytest.approx(1, abs=0.03) and (np.abs(ratio - 1) < 0.1).all()
