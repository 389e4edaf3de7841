"""Correspondence: synthetic truth with missing and false targets, planar grids and spatial clouds."""

from __future__ import annotations

import zlib
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from sfm.matching.conjugate import difference_of_blur, match_points
from sfm.matching.conjugate_patches import MatchSettings
from sfm.matching.epipolar import epipolar_distance, essential_matrices
from sfm.matching.lsm.surface_planes import on_surface
from sfm.matching.tracks import correspondence, evidence
from sfm.matching.tracks.correspondence import match_targets
from sfm.model.camera import camera_from_values, project, tangents_from_pixel
from sfm.model.conventions import BoolArray, FloatArray, rotation_from_angles, rotation_from_vector
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints
from tests.synthetic import seed_of
from tests.textures import natural_texture, with_noise

SIZE = (2000, 1500)
CAMERA = camera_from_values(
    "synthetic", "brown", SIZE, (0.005, 0.005), c_mm=10.0, values=(("K1", 1e-3), ("P1", 1e-4), ("x0", 0.05))
)


def generator(name):
    return np.random.default_rng(zlib.crc32(name.encode()))


def convergent_network(photographs, *, elevation_deg=(90.0, 50.0, 55.0, 60.0), distance=1.6):
    """Photographs around a scene of about one unit, rolled about their axes."""
    position, rotation = [], []
    for k in range(photographs):
        up = np.radians(elevation_deg[k % len(elevation_deg)])
        around = 2 * np.pi * k / photographs
        away = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
        z = away
        x = np.cross([-np.sin(around), np.cos(around), 0.3], z)
        x /= np.linalg.norm(x)
        R = np.column_stack([x, np.cross(z, x), z]) @ rotation_from_angles(0, 0, np.pi / 2 * (k % 4))
        position.append(distance * away)
        rotation.append(R)
    return Estimate((CAMERA,), np.array(position), np.array(rotation), np.zeros((0, 3)))


def plane_grid(n):
    """A regular grid on a plane, the worst case for matching: every shift by a cell looks alike."""
    g = np.linspace(-0.45, 0.45, n)
    return np.array([[x, y, 0.0] for x in g for y in g])


def measure(estimate, points, rng, *, noise_px, missing=0.2, false=0.2):
    """Targets of each photograph and their true point, -1 for false ones."""
    targets, truth = [], []
    for X0, R in zip(estimate.position, estimate.rotation, strict=True):
        xy = project(CAMERA, X0, R, points)
        seen = np.isfinite(xy).all(axis=1) & (xy > 0).all(axis=1) & (xy < SIZE).all(axis=1)
        seen &= rng.random(len(points)) >= missing
        xy = xy[seen] + noise_px * rng.normal(size=(seen.sum(), 2))
        wrong = round(false * len(xy))
        box = (xy.min(axis=0), xy.max(axis=0)) if len(xy) else (0, SIZE)
        order = rng.permutation(len(xy) + wrong)
        targets.append(np.concatenate([xy, rng.uniform(*box, (wrong, 2))])[order])
        truth.append(np.concatenate([np.flatnonzero(seen), np.full(wrong, -1)])[order])
    return targets, truth


def disturbed(estimate, rng, *, shift, turn_deg):
    turn = rotation_from_vector(np.radians(turn_deg) * rng.normal(size=(len(estimate.position), 3)))
    moved = estimate.position + shift * rng.normal(size=estimate.position.shape)
    return replace(estimate, position=moved, rotation=estimate.rotation @ turn)


def judge(found, truth):
    """Precision and recall of rays, and how many true points appear twice."""
    named = np.array([truth[i][t] for i, t in zip(found.image, found.target, strict=True)], dtype=int)
    owner = np.full(len(found.points), -1)
    for p in range(len(found.points)):
        ids, count = np.unique(named[found.point == p], return_counts=True)
        owner[p] = ids[np.argmax(count)]
    right = np.sum((named == owner[found.point]) & (named >= 0))
    real = owner[owner >= 0]
    total = sum(np.sum(t >= 0) for t in truth)
    return right / max(len(named), 1), right / total, len(real) - len(np.unique(real))


def is_consistent(found, targets):
    pairs = list(zip(found.image, found.target, strict=True))
    once = len(set(pairs)) == len(pairs)
    rays = list(zip(found.image, found.point, strict=True))
    return once and len(set(rays)) == len(rays)


def test_epipolar_distance_vanishes_for_one_point_and_is_a_distance():
    network = convergent_network(2)
    X = np.array([[0.1, -0.2, 0.05]])
    a, b = (
        tangents_from_pixel(CAMERA, project(CAMERA, X0, R, X))[0]
        for X0, R in zip(network.position, network.rotation, strict=True)
    )
    E = essential_matrices(network.position, network.rotation, np.array([[0, 1]]))[0]
    assert epipolar_distance(E, *a, *b) < 1e-12
    line = E @ [*a, -1.0]
    away = b + 0.01 * line[:2] / np.linalg.norm(line[:2])
    assert epipolar_distance(E, *a, *away) == pytest.approx(0.01, rel=1e-9)


def mistaken(targets, tolerance, *, missing=0.2):
    """The part of rays that must go wrong: the target is missing and another is near (mean density)."""
    density = np.mean([len(t) / np.prod(np.ptp(t, axis=0)) for t in targets])
    return missing * density * np.pi * tolerance**2


# (noise of a coordinate, tolerance) in px; the grid's spacing is about 70 px in the photographs.
@pytest.mark.sweep(0, 3, 8)
@pytest.mark.parametrize(
    ("noise", "tolerance"), [(0.1, 0.6), (0.1, 5.0), (1.0, 5.0), (3.0, 12.0), (5.0, 18.0)]
)
@pytest.mark.parametrize("scene", ["grid", "cloud"])
def test_finds_the_points_with_a_fifth_missing_and_a_fifth_false(scene, noise, tolerance):
    rng = generator(f"{scene} {noise} {tolerance}")
    points = plane_grid(11) if scene == "grid" else rng.uniform(-0.4, 0.4, (100, 3))
    network = convergent_network(16)
    targets, truth = measure(network, points, rng, noise_px=noise)
    found = match_targets(network, np.zeros(16, dtype=int), targets, tolerance_px=tolerance)
    precision, recall, double = judge(found, truth)
    assert is_consistent(found, targets)
    assert double == 0
    assert precision > 0.995 - 2.5 * mistaken(targets, tolerance)
    assert recall > (0.97 if noise < 2 else 0.9)
    assert found.residual_px.max() <= tolerance


def roughly_oriented(name, scene, tolerance):
    """Return the targets of photographs, and precision, recall and doubles of their correspondences."""
    rng, network = generator(name), convergent_network(21)
    points = plane_grid(10) if scene == "grid" else rng.uniform(-0.4, 0.4, (100, 3))
    targets, truth = measure(network, points, rng, noise_px=0.1)
    start = disturbed(network, rng, shift=0.001, turn_deg=0.1)
    found = match_targets(start, np.zeros(21, dtype=int), targets, tolerance_px=tolerance)
    return targets, judge(found, truth)


@pytest.mark.parametrize("scene", ["grid", "cloud"])
def test_survives_a_rough_orientation(scene):
    """4 px RMS and 12 px at most of start error, as after a first bundle on a few coded targets."""
    targets, (precision, recall, double) = roughly_oriented(f"rough {scene}", scene, 14)
    assert precision > 0.995 - 2.5 * mistaken(targets, 14)
    assert recall > 0.95
    assert double == 0


def test_an_orientation_beyond_the_tolerance_costs_points_but_makes_no_wrong_ones():
    _, (precision, recall, double) = roughly_oriented("beyond", "grid", 4)
    assert precision > 0.99
    assert 0.3 < recall < 0.95
    assert double <= 2


@pytest.mark.parametrize("tolerance", [3, 4])
def test_accepted_points_are_compared_with_near_ones_as_with_all(tolerance, monkeypatch):
    """The orientation splits targets in two, some of which the comparison recognises."""
    rng, network = generator(f"near {tolerance}"), convergent_network(21)
    targets, _ = measure(network, plane_grid(14), rng, noise_px=0.1)
    start, camera = disturbed(network, rng, shift=0.001, turn_deg=0.1), np.zeros(21, dtype=int)
    same = []

    def compared(*arguments):
        same.append(evidence.same_target(*arguments))
        return same[-1]

    monkeypatch.setattr(correspondence, "same_target", compared)
    found = match_targets(start, camera, targets, tolerance_px=tolerance)
    near, repeated = len(same), sum(same)
    monkeypatch.setattr(correspondence._Search, "_near", lambda search, *_: range(len(search.points)))
    every = match_targets(start, camera, targets, tolerance_px=tolerance)
    assert repeated > 0 and sum(same) == 2 * repeated and len(same) > 2 * near
    for name in ("image", "target", "point", "points"):
        np.testing.assert_array_equal(getattr(found, name), getattr(every, name))


def test_points_of_three_rays_need_a_small_tolerance():
    rng = generator("three")
    network = convergent_network(3, elevation_deg=(60.0,))
    points = plane_grid(10)
    targets, truth = measure(network, points, rng, noise_px=0.1, missing=0.0)
    found = match_targets(network, np.zeros(3, dtype=int), targets, tolerance_px=0.5)
    precision, recall, _ = judge(found, truth)
    assert precision > 0.98
    assert recall > 0.95
    assert (found.rays() == 3).all()
    # Object precision of 0.1 px at this scale, a few times its sigma.
    nearest = np.linalg.norm(found.points[:, None] - points[None], axis=2).min(axis=1)
    assert np.median(nearest) < 3 * 0.1 * 1.6 / CAMERA.c_px
    vague = match_targets(network, np.zeros(3, dtype=int), targets, tolerance_px=10)
    assert judge(vague, truth)[0] > 0.9 or len(vague.points) == 0


def test_noise_alone_makes_no_points():
    rng = generator("noise")
    network = convergent_network(12)
    targets = [rng.uniform(0, SIZE, (100, 2)) for _ in range(12)]
    found = match_targets(network, np.zeros(12, dtype=int), targets, tolerance_px=3)
    assert len(found.points) <= 1  # max_false is 0.1 expected


def test_two_rays_only_on_request_and_without_rivals():
    rng = generator("two")
    network = convergent_network(2, elevation_deg=(60.0,))
    points = rng.uniform(-0.4, 0.4, (15, 3))
    targets, truth = measure(network, points, rng, noise_px=0.1, missing=0.0, false=0.0)
    camera = np.zeros(2, dtype=int)
    assert len(match_targets(network, camera, targets, tolerance_px=0.5).points) == 0
    found = match_targets(network, camera, targets, tolerance_px=0.5, min_rays=2)
    assert len(found.points) > 5
    assert judge(found, truth)[0] == 1.0


def test_a_better_known_size_or_kind_parts_close_targets():
    """Two targets at every place, closer than the tolerance: only their kind or size tells them apart."""
    rng = generator("kinds")
    network = convergent_network(8)
    camera = np.zeros(8, dtype=int)
    points = np.repeat(rng.uniform(-0.4, 0.4, (40, 3)), 2, axis=0)
    points[1::2] += 0.003
    targets, truth = measure(network, points, rng, noise_px=0.8, missing=0.0, false=0.0)
    kinds = [t % 2 for t in truth]
    by_kind = judge(match_targets(network, camera, targets, tolerance_px=5, kinds=kinds), truth)
    without = judge(match_targets(network, camera, targets, tolerance_px=5), truth)
    assert by_kind[0] == 1.0
    assert by_kind[0] > without[0]
    diameters = [np.where(t % 2, 10.0, 20.0) for t in truth]
    by_size = judge(match_targets(network, camera, targets, tolerance_px=5, diameters_px=diameters), truth)
    assert by_size[0] == 1.0


def test_photographs_without_orientation_or_targets_are_passed_over():
    rng = generator("unoriented")
    network = convergent_network(8)
    targets, _ = measure(network, plane_grid(6), rng, noise_px=0.1)
    targets[2] = np.zeros((0, 2))
    position = network.position.copy()
    position[5] = np.nan
    rotation = network.rotation.copy()
    rotation[5] = np.nan
    found = match_targets(
        replace(network, position=position, rotation=rotation),
        np.zeros(8, dtype=int),
        targets,
        tolerance_px=1,
    )
    assert len(found.points) >= 30
    assert not np.isin(found.image, [2, 5]).any()


def test_nothing_to_match():
    network = convergent_network(3)
    found = match_targets(network, np.zeros(3, dtype=int), [np.zeros((0, 2))] * 3, tolerance_px=1)
    assert len(found.points) == len(found.image) == 0
    nobody = Estimate((CAMERA,), np.full((3, 3), np.nan), np.full((3, 3, 3), np.nan), np.zeros((0, 3)))
    assert (
        len(match_targets(nobody, np.zeros(3, dtype=int), [np.ones((4, 2))] * 3, tolerance_px=1).points) == 0
    )


def test_bad_input_is_named():
    network = convergent_network(3)
    with pytest.raises(GeometryError, match="2 lists of targets for 3 photographs"):
        match_targets(network, np.zeros(3, dtype=int), [np.zeros((0, 2))] * 2, tolerance_px=1)
    with pytest.raises(GeometryError, match="min_rays is 1"):
        match_targets(network, np.zeros(3, dtype=int), [np.zeros((0, 2))] * 3, tolerance_px=1, min_rays=1)


@pytest.mark.parametrize("tolerance", [2.0, 10.0])
def test_camcal_dots_from_the_reference_orientation(shared_data, tolerance):
    """All 96 dots of a regular grid in 21 photographs, their reference numbers unknown to the matching."""
    rows = [line.split() for line in (shared_data / "camcal/camcal-pmexport.txt").read_text().splitlines()]
    station = [k for k, row in enumerate(rows) if len(row) == 2 and row[1].endswith("JPG")]
    eo = np.array([rows[k + 1][1:] for k in station], dtype=float)
    marks = np.array(
        [row[:4] for row in rows if len(row) == 6 and row[1].isdigit() and "." in row[2] and "." in row[5]],
        dtype=float,
    )
    pixel = 5.43764 / 1704
    camera = camera_from_values(
        "olympus", "brown", (2272, 1704), (pixel, pixel), c_mm=7.457,
        values=(("x0", 3.61546 - pixel * 1136), ("y0", pixel * 852 - 2.61329), ("K1", 0.0045886),
                ("K2", -4.5135e-5), ("K3", -2.0525e-6)),
    )  # fmt: skip
    rotation = np.array([rotation_from_angles(*np.radians(angles[::-1])) for angles in eo[:, 3:]])
    estimate = Estimate((camera,), eo[:, :3], rotation, np.zeros((0, 3)))
    dots = marks[marks[:, 1] < 1000]
    targets = [dots[dots[:, 0] == i][:, 2:] - 0.5 for i in range(21)]
    truth = [dots[dots[:, 0] == i][:, 1].astype(int) for i in range(21)]
    found = match_targets(estimate, np.zeros(21, dtype=int), targets, tolerance_px=tolerance)
    precision, recall, double = judge(found, truth)
    assert len(found.points) == 96
    assert (precision, double) == (1.0, 0)
    assert recall > 0.998  # the reference orientation itself is off by up to 1.6 px


SIZE_PX = (800, 600)
WRONG = [117, 118, 130, 255]  # two of them neighbours


def pair_over_hills(*, along_px: float) -> tuple[ImagePoints, Estimate, BoolArray]:
    """Return a pair over hills, points 0.02 px off along the epipolar line, and which are WRONG."""
    rng = seed_of("hills")
    lens = camera_from_values("lens", "brown", SIZE_PX, (0.01, 0.01), c_mm=8.0, values=())
    position = np.array([[-0.5, 0.0, 5.0], [0.5, 0.1, 5.0]])
    x, y = (one.ravel() for one in np.meshgrid(np.linspace(-2, 2, 20), np.linspace(-1.5, 1.5, 15)))
    x, y = x + rng.normal(0, 0.04, 300), y + rng.normal(0, 0.04, 300)
    truth = np.column_stack([x, y, 0.05 * np.sin(1.5 * x) + 0.03 * np.cos(2 * y)])
    error_px = rng.normal(0, 0.02, 300)
    error_px[WRONG] = along_px * np.array([1.0, 1.0, -1.0, 1.0])
    depth = 5.0 - truth[:, 2:]
    moved = depth / (1 + depth * error_px[:, None] / lens.c_px)  # parallax is c times base over depth
    points = position[0] + (truth - position[0]) * moved / depth
    xy = [project(lens, one, np.eye(3), points) for one in position]
    image, point = np.repeat([0, 1], 300), np.tile(np.arange(300), 2)
    seen = ImagePoints(image, point, np.concatenate(xy), np.tile(4e-4 * np.eye(2), (600, 1, 1)))
    wrong = np.isin(np.arange(300), WRONG)
    return seen, Estimate((lens,), position, np.tile(np.eye(3), (2, 1, 1)), points), wrong


@pytest.mark.parametrize("along_px", [2.0, 20.0])
def test_points_off_the_surface_leave_and_their_neighbours_stay(along_px: float) -> None:
    seen, estimate, wrong = pair_over_hills(along_px=along_px)
    good = on_surface(seen, estimate, np.ones(300, dtype=bool))
    assert not good[wrong].any()
    assert good[~wrong].sum() >= 290


def test_points_that_a_third_ray_checks_stay() -> None:
    seen, estimate, wrong = pair_over_hills(along_px=20.0)
    assert on_surface(seen, estimate, np.zeros(300, dtype=bool)).all()
    assert on_surface(seen, estimate, ~wrong)[wrong].all()


def test_points_without_neighbours_are_on_no_surface() -> None:
    seen, estimate, _ = pair_over_hills(along_px=0.0)
    few = seen.select(seen.point < 6)
    alone = Estimate(estimate.cameras, estimate.position, estimate.rotation, estimate.points[:6])
    assert not on_surface(few, alone, np.ones(6, dtype=bool)).any()
    behind: FloatArray = estimate.points.copy()
    behind[40] = [0.0, 0.0, 9.0]
    turned = Estimate(estimate.cameras, estimate.position, estimate.rotation, behind)
    assert not on_surface(seen, turned, np.ones(300, dtype=bool))[40]


PICTURE_PX = (420, 380)
NOISE = 2.0
A, SHIFT = np.array([[1.03, -0.05], [0.04, 0.98]]), np.array([6.4, -9.7])
MIDDLE = np.array(PICTURE_PX) / 2


@cache
def _pair(blur_left: float, blur_right: float) -> tuple[FloatArray, FloatArray]:
    scene = natural_texture(np.random.default_rng(3), PICTURE_PX)
    back = np.linalg.inv(A)
    M = np.column_stack([back, MIDDLE - back @ (MIDDLE + SHIFT)])
    warped = cv2.warpAffine(
        scene,
        M,
        PICTURE_PX,
        flags=cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT,
    )
    both = (
        cv2.GaussianBlur(one, (0, 0), blur) if blur else one
        for one, blur in ((scene, blur_left), (warped, blur_right))
    )
    left, right = (with_noise(one, NOISE, k) for k, one in enumerate(both))
    return left, right


def _points() -> FloatArray:
    y, x = np.mgrid[100:281:30, 100:321:30].astype(float)
    return np.column_stack([x.ravel(), y.ravel()]) + 0.3


@pytest.mark.parametrize("sigma", [1.0, 1.5, 3.0, 5.0])
def test_difference_of_blur_is_that_put_in(sigma: float) -> None:
    assert difference_of_blur(*_pair(0.0, sigma)) == pytest.approx(sigma**2, rel=0.15)
    assert difference_of_blur(*_pair(sigma, 0.0)) == pytest.approx(-(sigma**2), rel=0.15)


def test_photographs_alike_have_no_difference_of_blur() -> None:
    assert abs(difference_of_blur(*_pair(0.0, 0.0))) < 0.1
    noise = [with_noise(np.full(PICTURE_PX, 128.0), NOISE, k) for k in (5, 6)]
    assert difference_of_blur(*noise) == 0.0
    assert difference_of_blur(np.zeros((9, 9), np.uint8), np.zeros((9, 9), np.uint8)) == 0.0


@pytest.mark.parametrize(("blur_left", "blur_right"), [(0.0, 3.0), (3.0, 0.0), (0.0, 1.5)])
def test_one_photograph_out_of_focus_is_matched(blur_left: float, blur_right: float) -> None:
    points = _points()
    truth = (points - MIDDLE) @ A.T + MIDDLE + SHIFT
    found = match_points(*_pair(blur_left, blur_right), points, settings=MatchSettings(search_px=81))
    e = (found.right - truth)[found.good]
    assert found.good.mean() > 0.6
    assert np.abs(e).max() < 1.5 and np.sqrt((e**2).mean()) < 0.3
    assert np.sqrt((e**2 / found.sigma[found.good] ** 2).mean()) == pytest.approx(1.0, abs=0.5)
    k = int(np.flatnonzero(found.good)[0])
    mapped = found.warp[k] @ [0.0, 0.0, 1.0]
    assert mapped[:2] / mapped[2] == pytest.approx(found.right[k], abs=1e-9)
    assert found.warp[k, :2, :2] == pytest.approx(A, abs=0.3)
