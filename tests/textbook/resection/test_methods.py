"""Zeng-Wang, Church, Rampal, P4P, DLT, line fitting and the critical cylinder, alone and together."""

import numpy as np
import pytest

from sfm.model.conventions import rotation_from_angles
from sfm.model.errors import GeometryError
from sfm.orientation.resection.fischler_bolles import rays_from_tangents, resect_fischler_bolles
from sfm.orientation.resection.least_squares import checked_points, choose_by_line, solution_of
from sfm.textbook.resection.by_method import Task, cylinder_distance, cylinder_warning, resect
from sfm.textbook.resection.church import resect_church
from sfm.textbook.resection.dlt import resect_dlt
from sfm.textbook.resection.p4p import coplanar_sets, resect_p4p
from sfm.textbook.resection.zeng_wang import (
    distance_quartic,
    resect_rampal,
    resect_triples_zeng_wang,
    resect_zeng_wang,
)
from tests.orientation.resection.test_fischler_bolles import _random_triples
from tests.orientation.resection.test_robust import scene
from tests.places import ROOT
from tests.synthetic import seed_of

TABLE = np.loadtxt(ROOT / "datasets/resection4/resection4_points.csv", delimiter=",", skiprows=1)
POINTS, TANGENTS = TABLE[:, 1:4], TABLE[:, 4:6] / 24.0
FIRST = (0.03701365, 0.69538531, -0.71768222)
SECOND = (0.21604886, -0.17426138, 0.03567370)


def test_zeng_wang_picks_the_first_solution_of_document_001():
    found = resect_zeng_wang(TANGENTS, POINTS)
    np.testing.assert_allclose([s.position for s in found], [FIRST, SECOND], atol=1e-8)
    assert found[0].rms * 24 < 1e-4 < 0.5 < found[1].rms * 24


def test_fischler_bolles_orders_its_solutions():
    found = resect_fischler_bolles(TANGENTS, POINTS)
    np.testing.assert_allclose([s.position for s in found], [FIRST, SECOND], atol=1e-8)
    assert len(resect_fischler_bolles(TANGENTS[:3], POINTS[:3])) == 2


def test_zeng_wang_quartic_against_the_document():
    """N1, N2 and N5 of document 001, eq. 2.72, agree; its N3 and N4 are misprinted."""
    rays = rays_from_tangents(TANGENTS[:3])
    N = distance_quartic(rays, POINTS[:3])
    L = [np.sum((POINTS[i] - POINTS[j]) ** 2) for i, j in ((1, 2), (0, 2), (0, 1))]
    K12, K32 = L[0] / L[1], L[2] / L[1]
    D1, E1, F1 = (2 * rays[i] @ rays[j] for i, j in ((0, 1), (1, 2), (0, 2)))
    N1 = (1 - K12) ** 2 + K32**2 - 2 * (1 - K12) * K32 - K32 * E1**2 + 4 * K32 * (1 - K12)
    N2 = (
        K32 * F1 * (-2 - 2 * K32 + 4 * K12 + E1**2)
        + K12 * (E1 * D1 + 2 * F1 - 2 * K12 * F1)
        + E1 * D1 * (K32 - 1)
    )
    N5 = K32 * (K32 - 2 - 2 * K12) + K12 * (K12 - D1**2 + 2) + 1
    np.testing.assert_allclose(N[[0, 1, 4]], [N1, N2, N5], atol=1e-12)
    roots = np.roots(N)
    n = 0.615352 / 0.778546  # leg 3 over leg 1 of the first solution
    assert np.abs(roots - n).min() < 1e-5


def test_zeng_wang_on_hundred_thousand_random_triples():
    rays, points, X0, R = _random_triples(seed_of("triples"), 100_000)
    poses = resect_triples_zeng_wang(rays, points)
    error = np.fmax(
        np.linalg.norm(poses.position - X0[:, None], axis=2),
        np.abs(poses.rotation - R[:, None]).max(axis=(2, 3)),
    )
    best = np.nanmin(np.where(poses.count[:, None] > 0, error, np.inf), axis=1)
    assert np.mean(best < 1e-6) >= 0.999
    filled = np.arange(4) < poses.count[:, None]
    assert np.isfinite(poses.position[filled]).all() and np.isfinite(poses.rotation[filled]).all()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, np.pi / 2, np.pi])
def test_zeng_wang_with_equal_coordinates_and_special_rotations(axis, angle):
    # points with the same Y and Z, on which the elimination of Awange and Grafarend divides by zero
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]])
    vector = np.zeros(3)
    vector[axis] = angle
    R = rotation_from_angles(*vector)
    X0 = np.array([0.4, 0.3, 0.3]) + R @ np.array([0.1, 0.0, 4.0])
    UVW = (points - X0) @ R
    found = resect_zeng_wang(-UVW[:, :2] / UVW[:, 2:], points)
    np.testing.assert_allclose(found[0].position, X0, atol=1e-7)
    np.testing.assert_allclose(found[0].rotation, R, atol=1e-7)


@pytest.mark.parametrize("target", [FIRST, SECOND], ids=["first", "second"])
def test_church_converges_from_the_neighbourhood(target):
    rng = seed_of("church")
    for _ in range(20):
        start = np.array(target) + 0.05 * rng.uniform(-1, 1, 3)
        result = resect_church(TANGENTS, POINTS, start)
        np.testing.assert_allclose(result.position, target, atol=1e-6)
        assert len(result.history) < 12
        np.testing.assert_array_equal(result.history[0], start)
    # rows of M as in the document's table 4.8
    if target is FIRST:
        np.testing.assert_allclose(result.rotation[0], [-0.998033, 0.034382, 0.052427], atol=1e-6)


def test_church_refusals():
    with pytest.raises(GeometryError, match="church: the start coincides with an object point"):
        resect_church(TANGENTS, POINTS, POINTS[0])
    with pytest.raises(GeometryError, match=r"church: .* start"):
        resect_church(TANGENTS, POINTS, 2 * POINTS[:3].mean(axis=0) - np.array(FIRST))


@pytest.mark.sweep(1)
@pytest.mark.parametrize("planar", [False, True], ids=["spatial", "planar"])
def test_rampal_finds_the_truth_from_six_points(planar):
    rng = seed_of(f"rampal {planar}")
    for _ in range(50):
        uv, points, X0, R = scene(rng, 6, sigma=0, planar=planar)
        best = resect_rampal(uv, points)[0]
        np.testing.assert_allclose(best.position, X0, atol=1e-6)
        np.testing.assert_allclose(best.rotation, R, atol=1e-6)


def test_rampal_on_document_001():
    three = resect_rampal(TANGENTS[:3], POINTS[:3])
    assert len(three) == 1
    np.testing.assert_allclose(three[0].position, SECOND, atol=1e-7)  # the one with the smaller tilt
    np.testing.assert_allclose(resect_rampal(TANGENTS, POINTS)[0].position, FIRST, atol=5e-6)


def test_p4p_is_exact_on_planes():
    rng = seed_of("p4p")
    for k in range(200):
        uv, points, X0, R = scene(rng, 4 + k % 3, sigma=0, planar=True)
        (only,) = resect_p4p(uv, points)
        np.testing.assert_allclose(only.position, X0, atol=1e-8)
        np.testing.assert_allclose(only.rotation, R, atol=1e-8)


@pytest.mark.parametrize("tilt", [0.0, 1e-13, 1e-7, 1e-3])
@pytest.mark.parametrize("below", [False, True])
def test_p4p_with_parallel_planes(tilt, below):
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1.2, 1.3, 0]]) + 10
    R = rotation_from_angles(tilt + np.pi * below, 0.0, 0.7)
    X0 = np.array([10.3, 10.4, 5.0 if below else 15.0])
    UVW = (points - X0) @ R
    (only,) = resect_p4p(-UVW[:, :2] / UVW[:, 2:], points)
    np.testing.assert_allclose(only.position, X0, atol=1e-6)
    np.testing.assert_allclose(only.rotation, R, atol=1e-6)


def test_p4p_takes_the_points_in_one_plane_and_names_them():
    """Of points in space it takes those in the plane by which all points are imaged best."""
    rng, names = seed_of("p4p of a plane"), tuple("ABCDEFGHI")
    plane = np.array([1, 3, 4, 6, 8])
    position, rotation = np.array([0.3, -0.2, 0.0]), np.eye(3)
    points = np.column_stack([rng.uniform(-1, 1, (9, 2)), rng.uniform(-6, -3, 9)])
    points[plane, 2] = -4.0 + 0.3 * points[plane, 0]
    ray = points - position
    uv = -ray[:, :2] / ray[:, 2:]
    assert plane.tolist() in [rows.tolist() for rows in coplanar_sets(points)]
    result = resect(Task(names, 50 * uv, uv, points, 50.0, None), "p4p")
    assert result.points == 5 and result.warning.startswith("only B, D, E, G, I were used")
    assert np.allclose(result.solutions[0].position, position, rtol=0, atol=1e-9)
    assert np.allclose(result.solutions[0].rotation, rotation, rtol=0, atol=1e-9)
    whole = resect(Task(names[:5], 50 * uv[plane], uv[plane], points[plane], 50.0, None), "p4p")
    assert not whole.warning
    with pytest.raises(GeometryError, match="p4p: no four of the points are in one plane"):
        resect(Task(names[:4], uv[[0, 2, 5, 7]], uv[[0, 2, 5, 7]], points[[0, 2, 5, 7]], 50.0, None), "p4p")


def test_p4p_refusals():
    with pytest.raises(GeometryError, match="p4p: the points are not in one plane"):
        resect_p4p(*scene(seed_of("thick"), 5)[:2])
    square = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]])
    X0 = np.array([0.5, 0.5, 4.0])
    uv = -(square - X0)[:, :2] / (square - X0)[:, 2:]
    with pytest.raises(GeometryError, match=r"p4p: .* lie on one line"):
        resect_p4p(uv, square)


def _dlt_scene(rng, n, *, distortion=(0.0,) * 5):
    R = rotation_from_angles(0.3, -0.2, 1.0)
    centre = np.array([1000.0, 2000.0, 30.0])
    points = centre + rng.uniform(-2, 2, (n, 3))
    X0 = centre + R @ np.array([0.0, 0, 6.0])
    UVW = (points - X0) @ R
    u, v = (-UVW[:, :2] / UVW[:, 2:]).T
    ideal = np.stack([20.02 * u + 0.05 * v, 20.0 * v], axis=1)
    xb = ideal.copy()
    for _ in range(200):  # invert the corrections of the measured point
        x, y = xb.T
        r2 = x * x + y * y
        K1, K2, K3, P1, P2 = distortion
        radial = K1 * r2 + K2 * r2**2 + K3 * r2**3
        dx = x * radial + P1 * (r2 + 2 * x * x) + 2 * P2 * x * y
        dy = y * radial + P2 * (r2 + 2 * y * y) + 2 * P1 * x * y
        xb = ideal - np.stack([dx, dy], axis=1)
    return xb + np.array([0.1, -0.05]), points, X0, R


@pytest.mark.parametrize("n", [6, 7, 30])
def test_dlt_interior_and_exterior_orientation(n):
    xy, points, X0, R = _dlt_scene(seed_of(f"dlt {n}"), n)
    result = resect_dlt(xy, points)
    assert result.c == pytest.approx(20.0, abs=1e-7)
    assert result.affinity == pytest.approx(0.001, abs=1e-8)
    assert result.shear == pytest.approx(-0.0025, abs=1e-6)
    np.testing.assert_allclose(result.principal_point, (0.1, -0.05), atol=1e-7)
    np.testing.assert_allclose(result.position, X0, atol=1e-7)
    np.testing.assert_allclose(result.rotation, R, atol=1e-8)
    assert result.redundancy == 2 * n - 11
    A = points @ result.L[8:] + 1
    x = (points @ result.L[:3] + result.L[3]) / A
    np.testing.assert_allclose(x, xy[:, 0], atol=1e-7)


def test_dlt_with_distortion():
    true = (2e-4, -1e-6, 2e-9, 3e-5, -2e-5)
    xy, points, X0, _ = _dlt_scene(seed_of("distorted dlt"), 40, distortion=true)
    plain = resect_dlt(xy, points)
    full = resect_dlt(xy, points, distortion=("K1", "K2", "K3", "P1", "P2"))
    assert plain.rms > 1e-3 and full.rms < 1e-9
    np.testing.assert_allclose(full.distortion, true, rtol=1e-4)
    np.testing.assert_allclose(full.position, X0, atol=1e-7)
    noisy = xy + 1e-3 * seed_of("dlt noise").standard_normal(xy.shape)
    result = resect_dlt(noisy, points, distortion=("K1", "K2"))
    assert result.sigma0 == pytest.approx(1e-3, rel=0.4) and result.redundancy == 80 - 13
    assert result.cofactors.shape == (13, 13)


def test_dlt_refusals():
    xy, points, *_ = _dlt_scene(seed_of("dlt refusals"), 8)
    with pytest.raises(GeometryError, match="dlt: 5 points, at least 6 are needed"):
        resect_dlt(xy[:5], points[:5])
    with pytest.raises(GeometryError, match="dlt: 6 points, at least 8 are needed for 16 parameters"):
        resect_dlt(xy[:6], points[:6], distortion=("K1", "K2", "K3", "P1", "P2"))
    with pytest.raises(GeometryError, match="dlt: the points lie in one plane"):
        resect_dlt(xy, points * (1, 1, 0))
    with pytest.raises(GeometryError, match="dlt: no distortion parameter 'K9'"):
        resect_dlt(xy, points, distortion=("K9",))
    with pytest.raises(GeometryError, match="mirrored"):
        resect_dlt(xy * (1, -1), points)


def test_line_fitting_chooses_the_first_solution():
    solutions = resect_zeng_wang(TANGENTS, POINTS)[::-1]
    chosen, lines = choose_by_line(solutions, TANGENTS)
    np.testing.assert_allclose(chosen.position, FIRST, atol=1e-8)
    assert lines[1].slope == pytest.approx(1, abs=1e-5) and lines[1].scatter * 24 < 1e-4
    assert abs(lines[0].slope - 1) > 0.01 or lines[0].scatter * 24 > 0.5
    with pytest.raises(GeometryError, match="line fitting: 3 points, at least 4"):
        choose_by_line(solutions, TANGENTS[:3])
    behind = solution_of(
        solutions[0].position + 5 * solutions[0].rotation[:, 2] * -1, solutions[0].rotation, TANGENTS, POINTS
    )
    with pytest.raises(GeometryError, match="behind the camera in every solution"):
        choose_by_line((behind,), TANGENTS)


def test_critical_cylinder():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])  # axis through (0.5, 0.5), radius sqrt(1/2)
    radius = np.sqrt(0.5)
    assert cylinder_distance(np.array([0.5, 0.5 + radius, 3.0]), points) == pytest.approx(0, abs=1e-12)
    assert cylinder_distance(np.array([0.5, 0.5, -8.0]), points) == pytest.approx(-1)
    assert cylinder_distance(np.array([0.5 + 3 * radius, 0.5, 1.0]), points) == pytest.approx(2)
    assert "outside the critical cylinder" in cylinder_warning(np.array([0.5, 0.52 + radius, 3.0]), points)
    assert cylinder_warning(np.array([0.5, 0.5, 3.0]), points) == ""
    with pytest.raises(GeometryError, match="one line"):
        cylinder_distance(np.zeros(3), np.outer([0, 1, 2], [1.0, 1, 1]))


def test_on_the_critical_cylinder_accuracy_is_lost():
    """The reason for the warning: a change of the image of 1e-6 moves the position by its square root."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    X0 = np.array([0.5, 0.5 + np.sqrt(0.5), 3.0])
    uv = -(points - X0)[:, :2] / (points - X0)[:, 2:]
    moved = [
        np.linalg.norm(solution.position - X0)
        for noise in np.eye(6) * 1e-6
        for solution in _found(uv + noise.reshape(3, 2), points)
    ]
    assert max(moved) > 1e-4


def _found(uv, points):
    try:
        return resect_zeng_wang(uv, points)
    except GeometryError:
        return ()


@pytest.mark.parametrize("method", [resect_fischler_bolles, resect_zeng_wang, resect_rampal, resect_p4p])
def test_degenerate_points_are_refused(method):
    X0 = np.array([0.2, 0.1, 5.0])
    line = np.outer([0.0, 1, 2, 3], [1.0, 0.5, 0.0])
    uv = -(line - X0)[:, :2] / (line - X0)[:, 2:]
    with pytest.raises(GeometryError, match="lie on one line"):
        method(uv, line)
    same = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0]])
    uv = -(same - X0)[:, :2] / (same - X0)[:, 2:]
    with pytest.raises(GeometryError, match="points 1 and 2 coincide"):
        method(uv, same)
    with pytest.raises(GeometryError, match="2 points, at least"):
        method(uv[:2], same[2:])
    with pytest.raises(GeometryError, match="not a finite number"):
        method(np.full((4, 2), np.nan), POINTS)


def test_points_far_from_the_origin_do_not_coincide():
    far = 1e10 + np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    assert (checked_points("p4p", TANGENTS[:4], far, needed=4)[1] == far).all()


def test_p4p_prefers_the_plane_that_images_all_points() -> None:
    """Of 80 points ten are exactly in a plane, and more are nearly in another: that would be metres off."""
    rng = seed_of("p4p near a plane")
    for _ in range(5):
        points = rng.uniform(-300, 300, (60, 3)) * [1, 1, 0.5]
        points[:10, 2] = 0.2 * points[:10, 0] + 10
        points[10:24, 2] = -0.4 * points[10:24, 1] + rng.uniform(-5, 5, 14)
        position, R = np.array([40.0, -30.0, 1500.0]), rotation_from_angles(0.05, -0.03, 0.4)
        ray = (points - position) @ R
        uv = -ray[:, :2] / ray[:, 2:]
        result = resect(Task(tuple(map(str, range(60))), 50 * uv, uv, points, 50.0, None), "p4p")
        assert np.linalg.norm(result.solutions[0].position - position) < 0.5, result.warning
