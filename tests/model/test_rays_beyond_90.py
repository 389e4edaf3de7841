"""Rays at and beyond 90 degrees from the axis: models of directions against their formulas in angles."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.model.camera import (
    Camera,
    angle_between,
    camera_from_values,
    outermost_reached,
    parameter_jacobian,
    pixel_from_rays,
    pixel_from_tangents,
    pixel_jacobian,
    project,
    ray_jacobian,
    rays_from_pixel,
    tangents_from_pixel,
)
from sfm.model.conventions import FloatArray
from sfm.model.distortion.models import MODELS
from tests.model.test_camera import lens
from tests.synthetic import seed_of

REACHING = [name for name, model in MODELS.items() if model.stereographic]
TANGENTS = [name for name in MODELS if name not in REACHING]


def directions(angles_deg: FloatArray, around: FloatArray) -> FloatArray:
    """Unit rays by their angle to the axis and around it, y up."""
    theta = np.radians(angles_deg)
    return np.column_stack([np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), -np.cos(theta)])


def wide(model: str, *values: tuple[str, float]) -> Camera:
    return camera_from_values("wide", model, (1000, 1000), (1.0, 1.0), c_mm=260.0, values=values)


def some_rays(name: str, widest_deg: float = 110.0) -> FloatArray:
    rng = seed_of(name)
    angles = np.concatenate([[0.0, 1e-6, 89.9999999, 90.0, 90.0000001], rng.uniform(0, widest_deg, 60)])
    return directions(angles, rng.uniform(0, 2 * np.pi, len(angles)))


def test_an_equidistant_lens_images_the_angle_at_any_angle() -> None:
    camera = wide("opencv_fisheye", ("k1", -0.02), ("k2", 0.003), ("k3", -4e-4), ("k4", 2e-5))
    rays = some_rays("equidistant", 125.0)
    across = np.hypot(rays[:, 0], rays[:, 1])
    theta = np.arctan2(across, -rays[:, 2])
    r = theta * (1 - 0.02 * theta**2 + 0.003 * theta**4 - 4e-4 * theta**6 + 2e-5 * theta**8)
    towards = rays[:, :2] / np.where(across > 0, across, 1.0)[:, None] * (1, -1)
    expected = 499.5 + 260 * r[:, None] * towards
    np.testing.assert_allclose(pixel_from_rays(camera, rays), expected, atol=1e-9)


def test_a_unified_lens_images_directions() -> None:
    alpha, beta = 0.62, 1.1
    camera = wide("eucm", ("alpha", alpha), ("beta", beta))
    rays = some_rays("unified")
    x, y, z = rays[:, 0], -rays[:, 1], -rays[:, 2]
    below = alpha * np.sqrt(beta * (x**2 + y**2) + z**2) + (1 - alpha) * z
    expected = 499.5 + 260 * np.column_stack([x, y]) / below[:, None]
    np.testing.assert_allclose(pixel_from_rays(camera, rays), expected, atol=1e-9)


def test_a_lens_with_division_sends_pixels_in_directions() -> None:
    k = -0.25
    camera = wide("simple_division", ("k", k))
    xy = seed_of("division").uniform(0, 999, (200, 2))
    a, b = ((xy - 499.5) / 260).T
    expected = np.column_stack([a, -b, -(1 + k * (a**2 + b**2))])
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    assert (expected[:, 2] > 0).sum() > 20  # beyond 90 degrees
    np.testing.assert_allclose(rays_from_pixel(camera, xy), expected, atol=1e-12)


@pytest.mark.parametrize("model", REACHING)
def test_rays_and_pixels_are_inverse_beyond_90_degrees(model: str) -> None:
    camera = lens(model)
    rays = some_rays(f"inverse {model}", 100.0)
    xy = pixel_from_rays(camera, rays * seed_of(model).uniform(0.1, 10.0, (len(rays), 1)))
    known = np.isfinite(xy).all(axis=1)
    assert known.mean() > 0.8 and (known & (rays[:, 2] > 0.05)).any()
    np.testing.assert_allclose(rays_from_pixel(camera, xy[known]), rays[known], atol=1e-11)
    tangents = tangents_from_pixel(camera, xy[known])
    ahead = rays[known, 2] < 0
    told = np.abs(rays[known, 2]) > 1e-12
    assert (np.isfinite(tangents).all(axis=1) == ahead)[told].all()
    near = ahead & (rays[known, 2] < -1e-3)
    np.testing.assert_allclose(tangents[near], -rays[known][near, :2] / rays[known][near, 2:], rtol=1e-8)
    np.testing.assert_allclose(pixel_from_tangents(camera, tangents[near]), xy[known][near], atol=1e-8)


@pytest.mark.parametrize("model", MODELS)
def test_derivatives_by_rays_equal_differences(model: str) -> None:
    camera = lens(model)
    rays = some_rays(f"jacobian {model}", 100.0 if MODELS[model].stereographic else 25.0)
    rays *= seed_of(model).uniform(0.5, 2.0, (len(rays), 1))
    xy = pixel_from_rays(camera, rays)
    inside = np.isfinite(xy).all(axis=1) & (np.abs(xy - 800) < 2000).all(axis=1)
    rays, xy = rays[inside], xy[inside]
    J, h = ray_jacobian(camera, xy, rays), 1e-5
    for a, step in enumerate(h * np.eye(3)):
        ends = pixel_from_rays(camera, rays + step), pixel_from_rays(camera, rays - step)
        difference = (ends[0] - ends[1]) / (2 * h)
        known = np.isfinite(difference).all(axis=1) & np.isfinite(J[:, :, a]).all(axis=1)
        assert known.mean() > 0.8
        assert np.abs(J[:, :, a] - difference)[known].max() < 1e-4 * camera.c_px
    ahead = rays[:, 2] < -0.2 * np.linalg.norm(rays, axis=1)
    by_tangents = J[ahead, :, :2] * -rays[ahead, 2, None, None]
    np.testing.assert_allclose(pixel_jacobian(camera, xy[ahead]), by_tangents, rtol=1e-4, atol=0.05)


@pytest.mark.parametrize("model", REACHING)
def test_derivatives_by_parameters_equal_differences_beyond_90_degrees(model: str) -> None:
    camera = lens(model)
    rays = directions(np.array([30.0, 89.0, 90.0, 96.0]), np.array([0.3, 2.0, 4.0, 5.5]))
    J = parameter_jacobian(camera, rays)
    assert np.isfinite(J).all()
    for s in range(len(camera.parameters)):
        step = np.zeros(len(camera.parameters))
        step[s] = 1e-3 / max(np.abs(J[:, :, s]).max(), 1.0)  # some coefficients act elsewhere
        ahead, behind = (
            pixel_from_rays(camera.with_parameters(camera.parameters + sign * step), rays) for sign in (1, -1)
        )
        assert np.abs(J[:, :, s] * step[s] - (ahead - behind) / 2).max() < 1e-7


def test_a_point_beside_and_behind_a_fisheye_is_seen_and_not_by_a_lens_of_tangents() -> None:
    points = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.1], [0.0, 0.0, -1.0]])
    fisheye, ideal = wide("simple_fisheye"), wide("simple_pinhole")
    xy = project(fisheye, np.zeros(3), np.eye(3), points)
    np.testing.assert_allclose(xy[:, 0], 499.5 + 260 * np.array([np.pi / 2, np.pi / 2 + np.arctan(0.1), 0.0]))
    assert np.isfinite(project(ideal, np.zeros(3), np.eye(3), points)).all(axis=1).tolist() == [0, 0, 1]


@pytest.mark.parametrize("model", TANGENTS)
def test_models_of_tangents_give_their_rays_to_the_last_bit(model: str) -> None:
    camera = lens(model)
    xy = seed_of("bits").uniform((0, 0), (2000, 1500), (50, 2))
    uv = tangents_from_pixel(camera, xy)
    rays = rays_from_pixel(camera, xy)
    assert (rays[:, :2] == uv).all() and (rays[:, 2] == -1).all()
    assert (pixel_from_rays(camera, rays) == pixel_from_tangents(camera, uv)).all()
    with_rays, with_tangents = parameter_jacobian(camera, rays), parameter_jacobian(camera, uv)
    assert (with_rays == with_tangents).all()


def test_the_format_of_a_fisheye_ends_where_image_points_end() -> None:
    """An image circle in a format that is wider: the model alone would reach 2 x 149 degrees."""
    camera = camera_from_values("wide", "simple_fisheye", (1600, 1200), (1.0, 1.0), c_mm=307.0)
    ends = np.array([[0.0, 599.5], [1599.0, 599.5]])
    seen = np.array([[799.5, 599.5 - 307.0 * np.radians(95.0)]])
    left, right = rays_from_pixel(camera, outermost_reached(camera, ends, seen))
    assert 186 < np.degrees(angle_between(left, right)) <= 190
    tele = camera_from_values("tele", "brown", (1600, 1200), (1.0, 1.0), c_mm=3000.0)
    assert np.array_equal(outermost_reached(tele, ends, seen), ends)
