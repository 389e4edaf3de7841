"""Projection uncertainty: that of cameras drawn from the covariance, and what a rotation does is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from sfm.adjustment.quality.correlations import observed_part, projection_covariance, projection_map
from sfm.camera import Camera, camera_from_values, pixel_from_tangents, tangents_from_pixel
from sfm.conventions import FloatArray, rotation_from_vector
from tests.synthetic import seed_of

SIZE = (2000, 1500)


def camera_of(free: tuple[str, ...]) -> Camera:
    values = (("K1", 8e-4), ("K2", -4e-6))
    made = camera_from_values("c", "brown", SIZE, (0.005, 0.005), c_mm=10.0, values=values)
    return replace(made, free=np.array([name in free for name in made.names]))


def turned(camera: Camera, uv: FloatArray, w: FloatArray) -> FloatArray:
    rays = np.column_stack([uv, np.full(len(uv), -1.0)]) @ rotation_from_vector(w).T
    return pixel_from_tangents(camera, -rays[:, :2] / rays[:, 2:])


def test_it_is_the_spread_of_cameras_drawn_from_the_covariance() -> None:
    rng = seed_of("projection")
    camera = camera_of(("c", "x0", "y0", "K1"))
    free = np.flatnonzero(camera.free)
    root = np.diag([2e-3, 4e-3, 4e-3, 1e-5]) @ (np.eye(4) + 0.4 * rng.normal(size=(4, 4)))
    covariance = root @ root.T
    seen = rng.uniform((300, 300), (1500, 1200), (60, 2))
    xy = np.array([[100.0, 80.0], [1000.0, 750.0], [1900.0, 1400.0]])
    places, targets = tangents_from_pixel(camera, seen), tangents_from_pixel(camera, xy)
    shifts = []
    for drawn in rng.multivariate_normal(np.zeros(4), covariance, 400):
        parameters = camera.parameters.copy()
        parameters[free] += drawn
        other = camera.with_parameters(parameters)
        fit = least_squares(lambda w, one=other: (turned(one, places, w) - seen).ravel(), np.zeros(3))
        shifts.append(turned(other, targets, fit.x) - xy)
    spread = np.std(shifts, axis=0)
    stated = np.sqrt(np.einsum("kii->ki", projection_covariance(camera, covariance, seen, xy)))
    np.testing.assert_allclose(stated, spread, rtol=0.12)  # 400 draws: 3.5 % each, 3 of these


def test_a_shift_of_the_principal_point_is_nearly_a_rotation() -> None:
    camera = camera_of(("x0",))
    seen = np.random.default_rng(0).uniform((900, 700), (1100, 800), (50, 2))
    sigma_px = 2.0
    Q = projection_covariance(camera, np.array([[(0.005 * sigma_px) ** 2]]), seen, seen)
    assert np.sqrt(np.einsum("kii->k", Q).max()) < 0.01 * sigma_px  # where it was fitted
    x, y, sigma = projection_map(camera, np.array([[(0.005 * sigma_px) ** 2]]), seen)
    assert sigma.shape == (len(y), len(x))
    middle = sigma[len(y) // 2, len(x) // 2]
    assert sigma[0, 0] > 20 * middle  # the rotation is no shift of all places alike
    assert not projection_covariance(camera, np.zeros((1, 1)), seen, seen).any()


def test_image_points_cover_their_convex_hull() -> None:
    triangle, places = (
        np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 50.0]]),
        np.array([[10.0, 10.0], [60.0, 40.0]]),
    )
    area, inside = observed_part(triangle, places)
    assert np.isclose(area, 2500) and inside.tolist() == [True, False]
    for some in (triangle[:2], np.outer(np.arange(4.0), [1, 2])):
        area, inside = observed_part(some, places)
        assert area == 0 and not inside.any()
