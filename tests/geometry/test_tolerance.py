"""Deviations from points, meshes and shapes, their decisions by ISO 14253-1, and hidden points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.conventions import FloatArray
from sfm.errors import GeometryError
from sfm.geometry.alignment import Nominal
from sfm.geometry.measured import MeasuredPoints, distance, point_function, with_hidden_point
from sfm.geometry.shapes.fit import fit_shape
from sfm.geometry.tolerance import (
    Mesh,
    decide,
    deviations_from_mesh,
    deviations_from_points,
    deviations_from_shape,
    distances_from_mesh,
)
from tests.geometry.simulated import points_on, random_covariance, simulated_shape
from tests.synthetic import seed_of

FACES = ((0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7), (0, 1, 5), (0, 5, 4), (1, 2, 6), (1, 6, 5),
         (2, 3, 7), (2, 7, 6), (3, 0, 4), (3, 4, 7))  # fmt: skip
CORNERS = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
CUBE = Mesh(100.0 * np.array(CORNERS, dtype=float), np.array(FACES))


def cube_distance(xyz: FloatArray) -> FloatArray:
    q = np.abs(xyz - 50) - 50
    outside = np.linalg.norm(np.maximum(q, 0), axis=1)
    return np.asarray(outside + np.minimum(q.max(axis=1), 0))


def test_distances_from_a_cube_are_exact_inside_and_outside() -> None:
    xyz = seed_of("cube").uniform(-60, 160, (500, 3))
    found = distances_from_mesh(xyz, CUBE)
    np.testing.assert_allclose(found.distance, cube_distance(xyz), atol=1e-9)
    step = 1e-5
    for axis in range(3):
        moved = distances_from_mesh(xyz + step * np.eye(3)[axis], CUBE).distance
        slope = (moved - found.distance) / step
        assert np.median(np.abs(slope - found.normal[:, axis])) < 1e-6
    on_edge = distances_from_mesh(np.array([[100.0, 50, 100], [100, 100, 100]]), CUBE)
    np.testing.assert_allclose(on_edge.distance, 0)
    np.testing.assert_allclose(on_edge.normal[0], [np.sqrt(0.5), 0, np.sqrt(0.5)], atol=0.2)


def test_triangles_of_very_different_size_are_found() -> None:
    """A fan of long triangles beside small ones: the nearest has its centroid far away."""
    fine = np.array([[x, y, 0.0] for x in range(5) for y in range(5)])
    small = [(5 * i + j, 5 * i + j + 5, 5 * i + j + 1) for i in range(4) for j in range(4)]
    vertices = np.vstack([fine, [[-5000.0, -1, 1], [5000, -1, 1], [0, -3000, 1]]])
    mesh = Mesh(vertices, np.array([*small, (25, 27, 26)]))
    found = distances_from_mesh(np.array([[3000.0, -2.0, 3.0], [1.2, 1.1, 0.5]]), mesh)
    np.testing.assert_allclose(np.abs(found.distance), [2.0, 0.5], atol=1e-9)


def test_nothing_is_decided_within_the_uncertainty() -> None:
    value = np.array([0.0, 0.079, 0.085, 0.119, 0.121, -0.121, 0.05])
    sigma = np.array([0.01] * 6 + [np.nan])
    told = decide(value, sigma, -0.1, 0.1, 2.0)
    assert told == ("in", "in", "undecided", "undecided", "out", "out", "not known")
    assert decide(np.array([0.0]), np.array([0.06]), -0.1, 0.1, 2.0) == ("undecided",)


def test_a_length_has_the_sigma_of_its_direction() -> None:
    Q = np.diag([1e-4, 4e-4, 9e-4, 1e-4, 1e-4, 1e-4])
    points = MeasuredPoints(("a", "b"), np.array([[0.0, 0.5, 0], [1, 1, 1]]), Q, "mm", "aligned")
    nominal = Nominal(("a", "c"), np.zeros((2, 3)), np.tile(5e-4 * np.eye(3), (2, 1, 1)))
    found = deviations_from_points(points, nominal, name="x", upper=0.6)
    assert found.value.tolist() == [0.5] and found.missing == ("c",)
    assert found.sigma[0] == pytest.approx(0.03) and found.decision == ("in",)
    with pytest.raises(GeometryError, match="tolerance x: no nominal point was measured"):
        deviations_from_points(points, Nominal(("c",), np.zeros((1, 3))), name="x", upper=1.0)


def test_deviations_from_a_mesh_and_a_shape_have_the_uncertainty_of_both() -> None:
    rng = seed_of("deviations")
    truth = simulated_shape("cylinder", rng)
    xyz = points_on(truth, 30, rng)
    points = MeasuredPoints(tuple(map(str, range(30))), xyz, random_covariance(30, 0.1, rng), "mm", "aligned")
    fit = fit_shape(points, "cylinder")
    found = deviations_from_shape(points, fit, name="roundness", lower=-1.0, upper=1.0)
    assert found.count("in") == 30
    # a residual has less than the point itself, since the shape follows it
    assert np.median(found.sigma) < np.median(np.sqrt(np.einsum("nii->n", points.blocks) / 3))
    found = deviations_from_mesh(points, CUBE, np.arange(5), name="m", against="cube.stl", lower=-1, upper=1)
    assert (found.sigma > 0).all() and len(found.decision) == 5


def test_a_hidden_point_takes_the_covariance_of_its_targets() -> None:
    rng = seed_of("hidden")
    xyz = np.array([[0.0, 0, 0], [100, 0, 0], [0, 50, 0]])
    points = MeasuredPoints(("a", "b", "c"), xyz, random_covariance(3, 0.1, rng), "mm", "free")
    found = with_hidden_point(points, "tip", "a", "b", 200.0, 0.05)
    np.testing.assert_allclose(found.xyz[3], [300, 0, 0])
    J = np.zeros((3, 9))
    for k in range(9):
        h = np.zeros(9)
        h[k] = 1e-4
        moved = [replace(points, xyz=xyz + s * h.reshape(3, 3)) for s in (1, -1)]
        up, down = (with_hidden_point(one, "tip", "a", "b", 200.0).xyz[3] for one in moved)
        J[:, k] = (up - down) / 2e-4
    Q = J @ points.covariance @ J.T + np.diag([0.05**2, 0, 0])
    np.testing.assert_allclose(found.covariance[9:, 9:], Q, rtol=1e-6)
    np.testing.assert_allclose(found.covariance[9:, :9], J @ points.covariance, rtol=1e-5, atol=1e-9)
    own = distance(point_function(found, "b"), point_function(found, "tip"))
    assert found.covariance_between([own])[0, 0] == pytest.approx(0.05**2, rel=1e-6)
    single = with_hidden_point(replace(points, covariance=points.blocks), "tip", "a", "b", 200.0)
    assert single.blocks.shape == (4, 3, 3)
    for told, call in {
        "a point of that name": lambda: with_hidden_point(points, "c", "a", "b", 1.0),
        "in one place": lambda: with_hidden_point(points, "tip", "a", "a", 1.0),
    }.items():
        with pytest.raises(GeometryError, match=told):
            call()
