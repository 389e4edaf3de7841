"""Rank defects: found, counted and named; the rest is adjusted all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.covariance import change_datum, marginal_of
from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import BoolArray, FloatArray, rotation_from_angles
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ObjectPoints
from sfm.model.observations.point_pairs import CoordinateDifferences
from tests.synthetic import C_MM, PIXEL_MM, SIZE_PX, make_network, seed_of

FREE = Datum("free")


def thinned(network: Network, keep: BoolArray) -> Network:
    return replace(network, image_points=network.image_points.select(keep))


def test_point_with_one_ray_and_photograph_with_two_points_are_named() -> None:
    network, truth = make_network(seed_of("thin"), images=7, points=25)
    k = network.image_points
    keep = ~((k.point == 4) & (k.image != 2)) & ~((k.image == 5) & (k.point > 1))
    a = adjust(thinned(network, keep), truth, datum=FREE, reject="none")
    assert a.converged
    assert a.undetermined == ("point 5: 1 ray, 2 are needed", "photograph image 6: 2 points, 3 are needed")
    assert (a.defect, a.expected_defect) == (7 + 1 + 2, 7)
    assert np.isnan(a.covariance.points[4]).all()
    assert np.isnan(a.covariance.exterior[5]).all()
    assert a.rejected.sum() == 3
    assert a.redundancy == a.observations - a.unknowns + 7


def flat_parallel_network() -> tuple[Network, Estimate]:
    """Parallel vertical photographs of a plane: c and the flying height cannot be told apart."""
    camera = camera_from_values("A", "brown", SIZE_PX, PIXEL_MM, c_mm=C_MM, free=("c",))
    x, y = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(25)], axis=1)
    position = np.array([[0, 0, 4.0], [0.3, 0, 4.0], [0, 0.3, 4.0], [-0.3, -0.2, 4.0]])
    rotation = np.stack([rotation_from_angles(0, 0, kappa) for kappa in (0.0, 1.5, 3.0, 4.5)])
    xy = np.concatenate([project(camera, X0, R, points) for X0, R in zip(position, rotation, strict=True)])
    image, point = np.repeat(np.arange(4), 25), np.tile(np.arange(25), 4)
    network = Network(
        ("1", "2", "3", "4"),
        np.zeros(4, dtype=np.int64),
        tuple(str(j) for j in range(25)),
        ImagePoints(image, point, xy, np.tile(0.01 * np.eye(2), (100, 1, 1))),
    )
    return network, Estimate((camera,), position, rotation, points)


def test_c_and_height_of_a_flat_parallel_network_are_named() -> None:
    network, truth = flat_parallel_network()
    network = network.with_given(ObjectPoints(np.arange(25), truth.points, np.zeros((25, 3, 3))))
    a = adjust(network, truth, datum=Datum("control"), reject="none")
    assert (a.defect, a.expected_defect) == (1, 0)
    assert len(a.undetermined) == 1
    assert a.undetermined[0].startswith("c of camera A with ")
    assert "Z0 of 4 photographs" in a.undetermined[0]


def test_two_control_points_leave_a_turn_open() -> None:
    network, truth = make_network(seed_of("two"), images=5, points=15)
    network = network.with_given(ObjectPoints(np.arange(2), truth.points[:2], np.zeros((2, 3, 3))))
    a = adjust(network, truth, datum=Datum("control"), reject="none")
    assert a.converged
    assert (a.defect, a.expected_defect) == (1, 0)  # control is meant to fix all seven
    axis = truth.points[1] - truth.points[0]
    axis *= np.sign(axis[np.argmax(np.abs(axis))]) / np.linalg.norm(axis)
    assert a.undetermined == (
        "datum: 1 of the seven of position, attitude and scale are not determined by the control: "
        f"rotation about ({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f})",
    )


@pytest.mark.parametrize(
    ("known", "words"),
    [
        (((0, "Z"), (1, "Z"), (2, "Z")), "shift along X and Y, rotation about Z, scale"),
        (((0, "XYZ"),), "rotation about X, Y and Z, scale"),
        (((0, "YZ"), (1, "YZ"), (2, "YZ")), "shift along X"),
    ],
)
def test_motions_that_control_leaves_open_are_named(known: tuple[tuple[int, str], ...], words: str) -> None:
    network, truth = make_network(seed_of("open"), images=5, points=15)
    covariance = np.tile(np.diag(np.full(3, np.inf)), (len(known), 1, 1))
    for k, (_, axes) in enumerate(known):
        for axis in axes:
            covariance[k, "XYZ".index(axis), "XYZ".index(axis)] = 1e-8
    index = np.array([j for j, _ in known])
    network = network.with_given(ObjectPoints(index, truth.points[index], covariance))
    a = adjust(network, truth, datum=Datum("control"), reject="none")
    assert len(a.undetermined) == 1 and a.undetermined[0].endswith(f"by the control: {words}")


def test_points_on_parallel_rays_are_named() -> None:
    network, truth = make_network(seed_of("parallel"), images=2, points=20, free=())
    position, rotation = truth.position.copy(), truth.rotation.copy()
    position[1], rotation[1] = position[0], rotation[0]
    truth = replace(truth, position=position, rotation=rotation)
    k = network.image_points
    xy = project(truth.cameras[0], position[0], rotation[0], truth.points)[k.point]
    network = replace(network, image_points=replace(k, xy=xy))
    a = adjust(network, truth, datum=FREE, reject="none", options=AdjustmentOptions(max_iterations=2))
    assert sum("rays are parallel" in words for words in a.undetermined) >= 19


def test_points_that_lost_their_rays_are_named_and_have_no_covariance() -> None:
    """One to the last ray, one to the last but one; what held them is no precision."""
    network, truth = make_network(seed_of("lost rays"), images=6, points=30, visibility=0.8)
    seen, rng = network.image_points, seed_of("errors of lost rays")
    rows = [np.flatnonzero(seen.point == j) for j in (3, 8)]
    keep = np.ones(len(seen), dtype=bool)
    keep[rows[1][2:]] = False
    xy = seen.xy.copy()
    xy[rows[0]] += rng.normal(0, 40, (len(rows[0]), 2))
    xy[rows[1][0]] += [30.0, 30.0]
    network = replace(network, image_points=replace(seen, xy=xy).select(keep))
    a = adjust(network, truth, datum=FREE)
    rays = np.bincount(network.image_points.point[~a.rejected], minlength=30)
    assert rays[[3, 8]].tolist() == [0, 1]
    assert a.undetermined == (
        "point 4: 0 rays accepted, 2 are needed",
        "point 9: 1 ray accepted, 2 are needed",
    )
    for covariance in (a.covariance, change_datum(a, FREE).covariance):
        known = np.isfinite(covariance.points).all(axis=(1, 2))
        assert np.flatnonzero(~known).tolist() == [3, 8]
        assert np.flatnonzero(np.isnan(covariance.points_limiting).any(axis=(1, 2))).tolist() == [3, 8]


@pytest.mark.parametrize("missing", ["image", "point"])
def test_missing_start_values_are_named(missing: str) -> None:
    network, truth = make_network(seed_of("missing"), images=6, points=15)
    position, points = truth.position.copy(), truth.points.copy()
    if missing == "image":
        position[3] = np.nan
    else:
        points[3] = np.nan
    a = adjust(network, replace(truth, position=position, points=points), datum=FREE)
    name = "photograph image 4" if missing == "image" else "point 4"
    assert a.undetermined == (f"{name}: no start value",)
    assert a.defect == 7 + (6 if missing == "image" else 3)  # before, the defect was the expected one
    assert a.converged


def noisy(
    name: str, position: FloatArray, rotation: FloatArray, points: FloatArray, free: tuple[str, ...]
) -> tuple[Network, Estimate]:
    """Return the network of photographs at these stations, with noise of 0.1 px."""
    rng = seed_of(name)
    camera = camera_from_values("A", "brown", SIZE_PX, PIXEL_MM, c_mm=C_MM, free=free)
    rows = []
    for i, (X0, R) in enumerate(zip(position, rotation, strict=True)):
        xy = project(camera, X0, R, points)
        inside = np.isfinite(xy).all(axis=1) & (xy > 0).all(axis=1) & (xy < SIZE_PX).all(axis=1)
        rows += [(i, j, *(xy[j] + rng.normal(0, 0.1, 2))) for j in np.flatnonzero(inside)]
    image, point, *xy_px = np.array(rows).T
    m, n = len(position), len(points)
    network = Network(
        tuple(str(i) for i in range(m)),
        np.zeros(m, dtype=np.int64),
        tuple(str(j) for j in range(n)),
        ImagePoints(
            image.astype(int), point.astype(int), np.stack(xy_px, axis=1),
            np.tile(0.01 * np.eye(2), (len(rows), 1, 1)),
        ),
    )  # fmt: skip
    return network, Estimate((camera,), position, rotation, points)


@pytest.mark.sweep(0, 1)
@pytest.mark.parametrize("case", ["nadir", "pair", "panorama"])
def test_what_drifts_until_the_adjustment_ends_unconverged_is_named(case: str) -> None:
    """The noise makes the normal equations regular by chance: 7 of 7, and nothing undetermined."""
    rng = seed_of(f"degenerate {case}")
    count = {"nadir": 6, "pair": 2, "panorama": 8}[case]
    position = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), np.full(count, 4.0)])
    rotation = np.tile(np.eye(3), (count, 1, 1))
    points = rng.uniform(-1, 1, (40, 3)) * [1, 1, 0.3]
    free: tuple[str, ...] = ("c", "x0", "y0")
    if case == "pair":
        position, free = np.array([[-0.6, 0, 4.0], [0.6, 0, 4.0]]), ("c", "x0", "y0", "K1", "P1", "P2")
    if case == "panorama":
        position, free = np.zeros((count, 3)), ()
        rotation = np.stack([rotation_from_angles(0, phi, 0) for phi in np.linspace(-0.2, 0.2, count)])
        points = points * [1, 1, 1] - [0, 0, 4]
    network, truth = noisy(case, position, rotation, points, free)
    a = adjust(network, truth, datum=FREE)
    assert not a.converged
    assert a.defect > 7 and a.undetermined
    expected = "its rays are parallel" if case == "panorama" else "of camera A"
    assert all(expected in one for one in a.undetermined)
    # directions alike in all photographs shear the object with x0 and y0; a panorama has no scale to lose
    of_cameras = {"nadir": 3, "pair": 4, "panorama": -1}[case]
    assert a.defect == 7 + of_cameras + (len(points) if case == "panorama" else 0)


@pytest.mark.parametrize("seed", [0, 2, 3, 4])
@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_what_drifts_until_the_adjustment_converges_is_named(seed: int, tilt: float) -> None:
    """Nadir photographs of ground that is nearly flat converge, at any c; with tilts they determine c."""
    rng = seed_of(f"flat nadir {seed}")
    position = np.column_stack([rng.uniform(-0.5, 0.5, (6, 2)), np.full(6, 4.0)])
    points = rng.uniform(-1, 1, (40, 3)) * [1, 1, 0.05]
    rotation = np.stack([rotation_from_angles(*one) for one in tilt * rng.standard_normal((6, 3))])
    position[:, :2] += 4.0 * rotation[:, :2, 2]
    network, truth = noisy("nadir", position, rotation, points, ("c", "x0", "y0"))
    a = adjust(network, truth, datum=FREE)
    assert a.converged
    if tilt:
        assert a.defect == 7 and not a.undetermined
    else:
        assert a.defect > 7 and any("c of camera A" in one for one in a.undetermined)


@pytest.mark.parametrize("sigma", [1e-6, 1e-9, 1e-11])
def test_a_point_that_survey_observations_fix_better_than_rays_has_their_sigma(sigma: float) -> None:
    """Below 3e-5 of the sigma of its rays it was 0, as of a coordinate that the datum fixes."""
    network, truth = make_network(seed_of("precise"), images=8, points=30, free=())
    fixed = np.arange(4)
    control = ObjectPoints(fixed, truth.points[fixed], np.zeros((4, 3, 3)))
    ends = np.array([0, 0]), np.array([10, 11])
    to_fixed = CoordinateDifferences(*ends, truth.points[10:12] - truth.points[0], np.full((2, 3), sigma))
    a = adjust(network.with_given(control, further=(to_fixed,)), truth, datum=Datum("control"))
    stated = np.sqrt(np.diagonal(a.covariance.points[10])) / a.sigma0
    assert stated == pytest.approx(np.full(3, sigma), rel=1e-2)
    assert (np.diagonal(a.covariance.points[0]) == 0).all()  # fixed control
    joint = marginal_of(a).joint(np.zeros(0, dtype=np.int64), np.array([10]))
    assert np.sqrt(np.diagonal(joint)) / a.sigma0 == pytest.approx(np.full(3, sigma), rel=1e-2)
