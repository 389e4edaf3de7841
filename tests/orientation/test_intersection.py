"""Intersection: document 002, covariance, wrong rays, points that are not determined."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from sfm.model.camera import Camera, project, tangents_from_pixel
from sfm.model.conventions import rotation_from_angles
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints
from sfm.orientation import intersection
from sfm.orientation.image_rays import intersect_image_points
from sfm.orientation.intersection import RayLimits, intersect
from tests.places import ROOT
from tests.synthetic import make_network, seed_of

STEREO = ROOT / "datasets/stereo10/stereo10_points.csv"
C = 18.5558
LEFT = (-0.342, -1.8718, -0.0908, 0.3346, 0.6424, -0.0338)
RIGHT = (-2.9792, 0.1888, 0.2852, -0.5369, -0.3954, 1.0051)


def test_document_002():
    table = np.loadtxt(STEREO, delimiter=",", skiprows=1)
    tangents = np.concatenate([table[:, 5:7], table[:, 7:9]]) / C
    image, point = np.repeat([0, 1], 10), np.tile(np.arange(10), 2)
    positions = np.array([LEFT[:3], RIGHT[:3]])
    rotations = np.stack([rotation_from_angles(*LEFT[3:]), rotation_from_angles(*RIGHT[3:])])
    result = intersect(tangents, image, point, positions, rotations)
    assert result.redundancy == 10
    assert result.sigma0 * C == pytest.approx(0.05108, abs=5e-6)
    # the document takes the radians of its angles for degrees: the least v'v, whatever side the points are on
    wrong = [rotation_from_angles(*np.radians(angles[3:])) for angles in (LEFT, RIGHT)]
    rng = seed_of("starts")

    def least(k: int) -> float:
        def v(X: np.ndarray) -> np.ndarray:
            local = [R.T @ (X - place) for R, place in zip(wrong, positions, strict=True)]
            return np.concatenate([C * (tangents[k + 10 * i] + d[:2] / d[2]) for i, d in enumerate(local)])

        starts = rng.normal(size=(12, 3)) * np.tile([[1.0], [5.0], [30.0]], (4, 1))
        return min(2 * least_squares(v, X0, method="lm").cost for X0 in starts)

    assert np.sqrt(sum(map(least, range(10))) / 10) == pytest.approx(2.503, abs=1e-3)
    # its So is of two points after one iteration, 8 observations and 6 unknowns; their printed residuals
    v = np.array([1.218381, -0.010667, -1.553381, 0.039454, 0.762102, 0.118594, -0.808628, -0.122549])
    assert np.sqrt(v @ v / (8 - 6)) == pytest.approx(1.607, abs=1e-3)


def _rays(noise_px=0.1, **kw):
    network, truth = make_network(seed_of("intersection"), noise_px=noise_px, **kw)
    seen = network.image_points
    uv = np.concatenate([tangents_from_pixel(truth.cameras[0], xy[None]) for xy in seen.xy])
    return network, truth, uv, noise_px / truth.cameras[0].c_px


def test_points_lie_within_their_covariance():
    network, truth, uv, sigma = _rays(points=300)
    seen = network.image_points
    result = intersect(uv, seen.image, seen.point, truth.position, truth.rotation)
    assert result.used.all() and result.redundancy == 2 * len(uv) - 3 * 300
    # distorted pixels have tangents of slightly different weight: within 5 %
    assert result.sigma0 == pytest.approx(sigma, rel=0.05)
    d = result.points - truth.points
    squares = np.einsum("ni,nij,nj->n", d, np.linalg.inv(result.covariance), d)
    assert squares.mean() == pytest.approx(3, abs=4 * np.sqrt(6 / 300))
    assert (result.angle > np.radians(20)).all()


def test_wrong_rays_are_left_out():
    network, truth, uv, sigma = _rays(points=100)
    seen = network.image_points
    rng = seed_of("wrong rays")
    wrong = rng.random(len(uv)) < 0.2
    uv[wrong] += rng.choice([-1, 1], (wrong.sum(), 2)) * rng.uniform(0.02, 0.1, (wrong.sum(), 2))
    result = intersect(
        uv, seen.image, seen.point, truth.position, truth.rotation, limits=RayLimits(tolerance=6 * sigma)
    )
    assert not result.used[wrong].any() and result.used[~wrong].mean() > 0.999
    assert np.abs(result.points - truth.points).max() < 0.005


def test_weights_pull_the_point():
    positions = np.array([[0.0, 0, 5], [2, 0, 5], [-2, 0, 5]])
    rotations = np.stack([np.eye(3)] * 3)
    X = np.array([0.3, 0.2, 0.0])
    uv = -(X - positions)[:, :2] / (X - positions)[:, 2:]
    uv[2] += 0.01
    image, point = np.arange(3), np.zeros(3, dtype=int)
    light = np.stack([np.eye(2), np.eye(2), 1e-8 * np.eye(2)])
    free = intersect(uv, image, point, positions, rotations).points[0]
    pulled = intersect(uv, image, point, positions, rotations, weights=light).points[0]
    assert np.linalg.norm(pulled - X) < 1e-6 < np.linalg.norm(free - X)


def test_undetermined_points_are_nan():
    positions = np.array([[0.0, 0, 5], [0.01, 0, 5], [np.nan] * 3])
    rotations = np.stack([np.eye(3), np.eye(3), np.full((3, 3), np.nan)])
    uv = np.array([[0.1, 0.0], [0.098, 0.0], [0.1, 0.0], [0.2, 0.1], [0.0, 0.0], [0.0, 0.0]])
    image = np.array([0, 1, 0, 2, 0, 1])
    point = np.array([0, 0, 1, 1, 2, 2])
    result = intersect(uv, image, point, positions, rotations, n_points=4, limits=RayLimits(min_angle_deg=1))
    assert np.isnan(result.points).all() and not result.used.any() and (result.rays == 0).all()
    wide = intersect(uv, image, point, positions, rotations, n_points=4)
    assert np.isfinite(wide.points[0]).all() and np.isnan(wide.points[1:]).all()
    np.testing.assert_allclose(wide.points[0], [0.5, 0, 0], atol=1e-9)


def test_rays_that_meet_behind_the_cameras_do_not_intersect():
    positions = np.array([[-1.0, 0, 0], [1, 0, 0]])
    rotations = np.stack([np.eye(3)] * 2)
    diverging = np.array([[-0.2, 0.0], [0.2, 0.0]])
    result = intersect(diverging, np.arange(2), np.zeros(2, dtype=int), positions, rotations)
    assert np.isnan(result.points).all() and not result.used.any()


def test_rays_of_wide_angle_cameras_count_by_their_angles() -> None:
    """A pixel at 80 degrees off the axis is 33 times as long in tangents as one in the middle."""
    rng = seed_of("wide angle")
    camera = Camera("lens", "simple_fisheye", (1000, 1000), np.ones(2), np.array([300.0, 499.5, 499.5]))
    m, n, noise_px = 4, 200, 0.5
    position = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])
    tilt = np.radians([0.0, 75.0, -75.0, 40.0])  # the points are near the axis of the first only
    rotation = np.array([rotation_from_angles(angle, 0.0, 0.0) for angle in tilt])
    points = np.array([0.0, 0.0, -4.0]) + rng.uniform(-0.5, 0.5, (n, 3))
    estimate = Estimate((camera,), position, rotation, np.full((n, 3), np.nan))
    of_each = [project(camera, *pose, points) for pose in zip(position, rotation, strict=True)]
    xy = np.concatenate(of_each) + rng.normal(0, noise_px, (m * n, 2))
    seen = ImagePoints(
        np.repeat(np.arange(m), n),
        np.tile(np.arange(n), m),
        xy,
        np.tile(noise_px**2 * np.eye(2), (m * n, 1, 1)),
    )
    found = intersect_image_points(
        seen, np.zeros(m, dtype=np.int64), estimate, n_points=n, tolerance_px=5 * noise_px
    )
    assert found.used.all()
    assert found.sigma0 * camera.c_px == pytest.approx(noise_px, rel=5 / np.sqrt(2 * found.redundancy))
    errors = found.points - points
    normed = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(found.covariance), errors)
    assert normed.mean() == pytest.approx(3.0, rel=5 * np.sqrt(2 / (3 * n)))


@pytest.mark.parametrize(("rays", "pairs"), [(29, 406), (41, 410)])
def test_up_to_four_hundred_pairs_of_rays_are_tried(rays: int, pairs: int, monkeypatch) -> None:
    """Every pair of 29 rays, every second one of the 820 of 41 rays; the same in Python as compiled."""
    angle = np.linspace(-0.8, 0.8, rays)
    positions = 5.0 * np.column_stack([np.sin(angle), 0.1 * angle, np.cos(angle)])
    rotations = rotation_from_angles(np.zeros(rays), angle, np.zeros(rays))
    rotations = np.moveaxis(rotations, -1, 0) if rotations.shape[0] == 3 else rotations
    inside = np.einsum("mji,mj->mi", rotations, -positions)
    uv = -inside[:, :2] / inside[:, 2:]
    uv[0] += 0.05
    arguments = uv, np.arange(rays), np.zeros(rays, dtype=int), positions, rotations
    compiled = intersect(*arguments, limits=RayLimits(tolerance=1e-3))
    tried = 0

    def nearest(rays_, of_point, direction, used, *more):
        nonlocal tried
        tried += int(used[of_point].sum() == 2)
        return real(rays_, of_point, direction, used, *more)

    real = intersection._nearest_to_rays
    for name in ("_intersect_all", "_best_pair"):
        monkeypatch.setattr(intersection, name, getattr(intersection, name).py_func)
    monkeypatch.setattr(intersection, "_nearest_to_rays", nearest)
    found = intersect(*arguments, limits=RayLimits(tolerance=1e-3))
    assert tried == pairs and not found.used[0] and found.used[1:].all()
    np.testing.assert_allclose(found.points, compiled.points, atol=1e-12)
