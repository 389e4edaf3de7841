"""Comparison of two solutions: datum-free differences, verdict, and two adjusters on one network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from adapters.colmap.adjuster import adjust_with_colmap, adjust_with_covariance
from adapters.formats.photomodeler import read_photomodeler
from benchmarks.random_networks import random_network
from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment, Covariance
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.comparison.pairing import ROUNDING
from sfm.comparison.solutions import compare, interior_effect_px, rotation_angle_deg
from sfm.comparison.two_adjusters import adjusters
from sfm.comparison.two_adjusters.adjusters import common_problem, compare_adjusters, grouped_free
from sfm.model.camera import camera_from_values
from sfm.model.conventions import rotation_from_vector
from sfm.model.distortion.models import MODELS as CAMERA_MODELS
from sfm.model.distortion.models import Role
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.similarity import Similarity
from tests.places import SHARED
from tests.synthetic import make_network, perturb, seed_of
from tests.tables import rows_of

SHARED = SHARED / "data"
CAMCAL, PANEL = SHARED / "camcal", SHARED / "retro-panel"


def covariance_of(network: Network, estimate: Estimate) -> Covariance:
    return adjust(network, estimate, reject="none").covariance


TURN = Similarity(3.7, rotation_from_vector(np.array([0.3, -1.1, 0.7])), np.array([10.0, -20.0, 5.0]))


def test_datum_is_no_difference() -> None:
    network, truth = make_network(seed_of("datum"), model="opencv", noise_px=0.1)
    found = compare(truth, TURN.apply_estimate(truth), network, covariance=covariance_of(network, truth))
    assert found.agree
    assert found.max_point < 1e-13 * found.object_size
    assert found.max_position < 1e-13 * found.object_size * 10
    assert found.max_rotation_deg < 1e-12
    assert found.rms_px[0] == pytest.approx(found.rms_px[1], abs=1e-12)
    assert found.rms_px[0] == pytest.approx(0.1, rel=0.1)
    assert found.a_from_b.scale == pytest.approx(1 / 3.7)
    k = len(network.image_points)
    assert found.cost[0] == pytest.approx(found.rms_px[0] ** 2 * k)


def test_each_difference_is_found_with_its_size() -> None:
    network, truth = make_network(seed_of("each"), model="opencv")
    covariance = covariance_of(network, truth)
    b = TURN.apply_estimate(truth)
    position, rotation, points = b.position.copy(), b.rotation.copy(), b.points.copy()
    position[3] += 3.7 * np.array([0.0, 3e-4, 4e-4])
    rotation[5] = rotation[5] @ rotation_from_vector(np.deg2rad([0, 2e-3, 0]))
    camera = truth.cameras[0]
    b = replace(b, position=position, rotation=rotation)
    found = compare(truth, b, network, covariance=covariance)
    assert found.max_position == pytest.approx(5e-4, rel=1e-6)
    assert np.argmax(np.linalg.norm(found.position, axis=1)) == 3
    assert found.max_rotation_deg == pytest.approx(2e-3, rel=1e-6)
    assert np.argmax(found.rotation_deg) == 5
    assert not found.agree
    assert [text.split(" differs")[0] for text in found.exceeded] == [
        "projection centre of image 4",
        "rotation of image 6",
    ]

    points[7] += 3.7e-5
    found = compare(truth, replace(b, points=points), network, covariance=covariance)
    # 60 points share one error, so the similarity takes up little of it
    assert found.max_point == pytest.approx(1e-5 * np.sqrt(3), rel=0.1)
    assert np.argmax(np.linalg.norm(found.points, axis=1)) == 7

    wider = camera.with_parameters(camera.parameters + np.array([0, 0, 0.25, 0, 0, 0, 0, 0]))
    found = compare(truth, replace(truth, cameras=(wider,)), network, covariance=covariance)
    assert found.interior_px[0] == pytest.approx(0.25, rel=1e-6)
    assert found.interior[0][2] == pytest.approx(0.25)
    (line,) = found.exceeded
    assert line.startswith("cx of camera camera 1 differs by ")


def test_standard_deviations_decide() -> None:
    """The same shift is a difference in a strong network and none in one that is a hundred times weaker."""
    network, truth = make_network(seed_of("thresholds"), model="opencv")
    covariance = covariance_of(network, truth)
    points = truth.points.copy()
    points[0] += 0.02 * np.sqrt(np.diagonal(covariance.points[0]))
    b = replace(truth, points=points)
    assert not compare(truth, b, network, covariance=covariance).agree
    weak = replace(
        covariance,
        points=1e4 * covariance.points,
        exterior=1e4 * covariance.exterior,
        interior=tuple(1e4 * Q for Q in covariance.interior),
    )
    assert compare(truth, b, network, covariance=weak).agree
    nan = replace(truth, points=np.full_like(points, np.nan))
    with pytest.raises(GeometryError, match="0 common points"):
        compare(truth, nan, network, covariance=covariance)


def test_what_only_one_has_is_not_compared() -> None:
    network, truth = make_network(seed_of("partial"), model="opencv")
    points, position = truth.points.copy(), truth.position.copy()
    points[4] = np.nan
    position[2] = np.nan
    found = compare(
        truth,
        replace(truth, points=points, position=position),
        network,
        covariance=covariance_of(network, truth),
    )
    assert found.agree
    assert np.isnan(found.points[4]).all() and np.isnan(found.rotation_deg[2])


def test_angle_is_exact_near_zero_and_right_when_large() -> None:
    for angle in (1e-12, 1e-3, 100.0, 180.0):
        R = rotation_from_vector(np.deg2rad([0.0, angle, 0.0]))
        assert rotation_angle_deg(np.eye(3)[None], R[None])[0] == pytest.approx(angle, rel=1e-9)


def test_interior_effect_between_models() -> None:
    a = camera_from_values("a", "opencv", (2000, 1500), (0.005, 0.005), c_mm=10.0)
    b = camera_from_values("a", "brown", (2000, 1500), (0.005, 0.005), c_mm=10.01)
    corner = np.hypot(1000, 750)
    assert interior_effect_px(a, b) == pytest.approx(corner * 0.001, rel=1e-6)


def test_groups_are_freed_whole_and_alike() -> None:
    a = camera_from_values("a", "opencv", (2000, 1500), (0.005, 0.005), c_mm=10.0, free=("fx", "k1"))
    b = camera_from_values("b", "opencv", (2000, 1500), (0.005, 0.005), c_mm=10.0, free=("p1",))
    c = camera_from_values("c", "opencv", (2000, 1500), (0.005, 0.005), c_mm=10.0)
    a, b, c = grouped_free((a, b, c))
    assert list(a.free) == list(b.free) == [True, True, False, False, True, True, True, True]
    assert not c.free.any()


def test_common_problem_drops_what_does_not_take_part() -> None:
    network, truth = make_network(seed_of("common"), model="brown", points=30, images=6)
    adjustment = adjust(network, truth, datum=Datum("free"), reject="none")
    rejected = adjustment.rejected.copy()
    rejected[(network.image_points.point == 11) & (network.image_points.image > 0)] = True
    rejected[0] = True
    reduced, start, conversions, freed = common_problem(replace(adjustment, rejected=rejected))
    assert "12" not in reduced.points and len(reduced.points) == 29
    assert len(reduced.image_points) == len(network.image_points) - rejected.sum() - 1
    np.testing.assert_allclose(
        reduced.image_points.covariance, np.tile(0.01 * np.eye(2), (len(reduced.image_points), 1, 1))
    )
    assert start.cameras[0].model == "full_opencv"
    assert conversions[0].max_px < 0.06
    assert freed == ()


@pytest.mark.parametrize(
    ("K1", "free", "model"),
    [
        (2e-6, ("c", "K1", "K2"), "opencv"),  # 0.04 % at the edge
        (2e-6, ("c", "K1", "K2", "K3"), "full_opencv"),  # a coefficient more than opencv has
        (2e-3, ("c", "K1", "K2"), "full_opencv"),  # 40 %: its inverse has further terms
    ],
)
def test_the_common_camera_is_the_plainest_that_is_as_good(
    K1: float, free: tuple[str, ...], model: str
) -> None:
    network, truth = make_network(seed_of("plainest"), model="brown", points=30, images=6, noise_px=0.1)
    camera = truth.cameras[0]
    values = np.where([name == "K1" for name in camera.names], K1, 0.0)
    values[camera.plays(Role.FOCAL)] = camera.parameters[camera.plays(Role.FOCAL)]
    plain = replace(camera.with_parameters(values), free=np.isin(camera.names, free))
    adjustment = adjust(network, truth, datum=Datum("free"), reject="none")
    adjustment = replace(adjustment, estimate=replace(adjustment.estimate, cameras=(plain,)))
    _, start, conversions, _ = common_problem(adjustment)
    assert start.cameras[0].model == model
    if model == "opencv":
        assert conversions[0].max_px < 0.1 * adjustment.sigma0_px


@pytest.mark.parametrize("model", ["opencv", "full_opencv", "brown"])
@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("cameras", [1, 2])
def test_both_adjusters_end_at_the_same_optimum(model: str, planar: bool, cameras: int) -> None:
    rng = seed_of(f"same optimum {model} {planar} {cameras}")
    network, truth = make_network(
        rng, model=model, planar=planar, cameras=cameras, noise_px=0.1, visibility=0.8
    )
    start = perturb(truth, rng)
    adjustment = adjust(network, start, datum=Datum("free"), reject="none")
    found = compare_adjusters(adjustment, adjust_with_colmap)
    assert found.model == ("opencv" if model == "opencv" else "full_opencv")
    assert found.comparison.exceeded == ()
    assert found.agree
    assert not (found.held and model == "opencv")
    cost = found.comparison.cost
    assert cost[1] == pytest.approx(cost[0], rel=1e-9)


def test_a_rational_distortion_that_has_grown_may_still_converge() -> None:
    """After 40 steps the largest of k1 to k6 is 50,000; after 46 it has converged there."""
    made = random_network(np.random.default_rng([77, 1459]))
    adjustment = adjust(made.network, made.start, datum=Datum("free"), reject="none")
    found = compare_adjusters(adjustment, adjust_with_colmap, model="full_opencv")
    assert found.held == ()
    assert found.adjustment.converged and found.adjustment.iterations > 40


@pytest.mark.parametrize(
    "model", ["simple_radial", "opencv_fisheye", "fov", "division", "thin_prism_fisheye"]
)
def test_both_adjusters_end_at_the_same_optimum_in_a_model_of_colmap(model: str) -> None:
    rng = seed_of(f"same optimum {model}")
    network, truth = make_network(rng, model=model, noise_px=0.1, visibility=0.8)
    adjustment = adjust(network, perturb(truth, rng), datum=Datum("free"), reject="none")
    found = compare_adjusters(adjustment, adjust_with_colmap)
    assert found.model == model and found.agree and found.comparison.exceeded == ()
    assert found.comparison.cost[1] == pytest.approx(found.comparison.cost[0], rel=1e-9)


def test_a_backend_that_stops_early_is_reported_from_one_that_ends_elsewhere() -> None:
    rng = seed_of("stops early")
    network, truth = make_network(rng, model="opencv")
    adjustment = adjust(network, perturb(truth, rng), datum=Datum("free"), reject="none")
    found = compare_adjusters(adjustment, backend(lambda points: points * (1 + 1e-4 * rng.random((60, 3)))))
    assert found.agree and found.stopped_early and found.comparison.max_sigmas > 0.05
    found = compare_adjusters(adjustment, backend(lambda points: points[::-1].copy()))
    assert not found.agree and not found.stopped_early and found.comparison.exceeded


def backend(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Network, Estimate], Any]:
    """COLMAP's solution with other points."""

    def adjusted(network: Network, estimate: Estimate) -> Any:
        found = adjust_with_colmap(network, estimate)
        return replace(found, estimate=replace(found.estimate, points=change(found.estimate.points)))

    return adjusted


@pytest.mark.skipif(not CAMCAL.is_dir(), reason="reference data camcal is not beside the repository")
@pytest.mark.parametrize("model", ["opencv", "full_opencv"])
def test_camcal_reference_points_end_at_the_same_optimum(model: str) -> None:
    network, estimate = read_photomodeler(CAMCAL / "camcal-pmexport.txt")
    adjustment = adjust(network, estimate, datum=Datum("free"), reject="none")
    found = compare_adjusters(adjustment, adjust_with_colmap, model=model)
    assert found.comparison.exceeded == ()
    assert found.agree
    assert found.held == () or model == "full_opencv"  # whose minima are told apart by rounding alone
    assert found.conversions[0].max_px < (0.03 if model == "full_opencv" else 0.4)


def test_a_rational_distortion_that_ends_elsewhere_is_compared_with_it_held(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two minima whose numerator and denominator nearly cancel are no difference of the solvers."""
    rng = seed_of("two minima")
    network, truth = make_network(rng, model="full_opencv", noise_px=0.1)
    adjustment = adjust(network, perturb(truth, rng), datum=Datum("free"), reject="none")
    calls: list[Estimate] = []
    solved = adjusters._adjusted

    def elsewhere(network: Network, estimate: Estimate) -> Any:
        calls.append(estimate)
        return backend(lambda points: points[::-1].copy() if len(calls) == 1 else points)(network, estimate)

    def goes_on(network: Network, start: Estimate, sigma_px: float) -> Adjustment:
        found = replace(solved(network, start, sigma_px), undetermined=())
        if len(calls) == 1 and start.cameras[0].free.all():  # from the other's end, another minimum
            points = found.estimate.points[::-1].copy()
            found = replace(found, estimate=replace(found.estimate, points=points))
        return found

    monkeypatch.setattr(adjusters, "_adjusted", goes_on)
    found = compare_adjusters(adjustment, elsewhere)
    first, second = (one.cameras[0].free.sum() for one in calls)
    assert second < first
    assert len(found.held) == 1 and "different minima" in found.held[0]
    assert found.agree and found.comparison.exceeded == ()


def panel(model: str) -> tuple[Network, Estimate]:
    """Reference image points and start values of retro-panel (see ../shared/data/README.md)."""
    with (PANEL / "panel-points-mm.txt").open() as file:
        xyz = {int(row[0]): [float(v) for v in row[1:4]] for row in map(str.split, file)}
    poses = sorted(rows_of(PANEL / "reference-poses.csv"), key=lambda row: row["image"])
    rows = rows_of(PANEL / "reference-image-points.csv")
    images = [pose["image"] for pose in poses]
    points = sorted({int(row["point"]) for row in rows})
    cameras = tuple(
        camera_from_values(
            name,
            model,
            (2000, 1333),
            (0.01175, 0.01175),
            c_mm=c_px * 0.01175,
            free=tuple(name for name in CAMERA_MODELS[model].names if name != "b2"),
            values=(("cx", 986.0), ("cy", 660.0), ("k1", -0.097), ("k2", 0.1))
            if model != "brown"
            else (("K1", 1.6e-4), ("K2", -2.2e-7)),
        )
        for name, c_px in (("043", 2095.5), ("671", 2092.0))
    )
    R = np.array([[float(pose[f"r{i}{j}"]) for i in "123" for j in "123"] for pose in poses]).reshape(
        -1, 3, 3
    )
    estimate = Estimate(
        cameras,
        np.array([[float(pose[key]) for key in ("X_mm", "Y_mm", "Z_mm")] for pose in poses]),
        (np.diag([1.0, -1.0, -1.0]) @ R).transpose(0, 2, 1),
        np.array([xyz[j] for j in points]),
    )
    seen = ImagePoints(
        np.array([images.index(row["image"]) for row in rows]),
        np.array([points.index(int(row["point"])) for row in rows]),
        np.array([[float(row["x_px"]), float(row["y_px"])] for row in rows]),
        np.tile(0.02**2 * np.eye(2), (len(rows), 1, 1)),
    )
    camera = np.array([int(image.startswith("671")) for image in images])
    return Network(tuple(images), camera, tuple(str(j) for j in points), seen), estimate


@pytest.mark.skipif(not PANEL.is_dir(), reason="reference data retro-panel is not beside the repository")
@pytest.mark.parametrize("model", ["opencv", "brown"])
def test_retro_panel_reference_points_end_at_the_same_optimum(model: str) -> None:
    network, estimate = panel(model)
    adjustment = adjust(
        network, estimate, datum=Datum("free"), reject="none", options=AdjustmentOptions(sigma_px=0.02)
    )
    assert adjustment.rms_px < 0.02
    found = compare_adjusters(adjustment, adjust_with_colmap)
    assert found.comparison.exceeded == ()
    assert found.agree
    assert len(found.adjustment.estimate.cameras) == 2


def test_conditional_covariances_of_both_stand_beside_the_marginal() -> None:
    """What COLMAP calls the covariance of a point is that with photographs and cameras held."""
    network, truth = make_network(seed_of("conditional"), model="opencv", noise_px=0.1)
    adjustment = adjust(network, truth, datum=Datum("free"), reject="none")
    found = compare_adjusters(adjustment, adjust_with_covariance)
    own = found.adjustment.covariance
    assert found.backend_points is not None
    np.testing.assert_allclose(found.backend_points, own.points_limiting, rtol=1e-5, atol=1e-16)
    assert not np.allclose(own.points, own.points_limiting, rtol=0.005, atol=0.0)


def test_rounding_is_no_difference() -> None:
    """Noise-free observations leave standard deviations of rounding, by which nothing is judged."""
    network, truth = make_network(seed_of("rounded"), model="opencv", noise_px=0.0)
    exact = replace(covariance_of(network, truth), points=np.full((60, 3, 3), 1e-30) * np.eye(3))
    size = float(np.sqrt(((truth.points - truth.points.mean(axis=0)) ** 2).sum(axis=1).mean()))
    for times, agree in ((0.3, True), (3.0, False)):
        noise = np.where(seed_of("signs").random(truth.points.shape) < 0.5, -1.0, 1.0)
        b = replace(truth, points=truth.points + times * ROUNDING * size * noise)
        assert compare(truth, b, network, covariance=exact).agree is agree, times


@pytest.mark.parametrize(("gap", "outcome"), [(2.0, "fits alike"), (8.0, "differs")])
def test_solutions_that_the_image_points_do_not_tell_apart_fit_alike(gap: float, outcome: str) -> None:
    """By the chi-square test of 5 % with one degree of freedom, 3.84, of what v'Pv differs by."""
    network, truth = make_network(seed_of("gap"), model="opencv")
    a = adjust(network, truth, reject="none")
    both = compare_adjusters(a, adjust_with_colmap)
    assert both.outcome == "agrees" and both.gap < 1e-3
    far = replace(both.comparison, sigmas=(("object point 1", 0.5),))
    sigma = both.adjustment.sigma0 * both.adjustment.sigma_px
    far = replace(far, cost=(far.cost[0], far.cost[0] + gap / 2 * sigma**2))
    found = replace(both, comparison=far)
    assert found.gap == pytest.approx(gap) and found.outcome == outcome
