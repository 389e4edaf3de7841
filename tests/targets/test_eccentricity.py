"""Eccentricity against circles projected point by point, under distortion too."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sfm.model.camera import Camera, camera_from_values, pixel_curvature, pixel_jacobian, project
from sfm.model.conventions import FloatArray, rotation_from_angles, rotation_from_vector
from sfm.orientation.eccentricity import CircleViews, ellipse_shape, fit_circles
from tests.outlines import moments_of_area
from tests.synthetic import seed_of

CAMERA = camera_from_values(
    "c", "brown", (4000, 3000), (0.005, 0.005), c_mm=20.0, values=(("K1", 1e-5), ("P1", 1e-6))
)
RADIUS = np.array([4.0, 6.0, 5.0])  # mm
NORMALS = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, np.sqrt(0.75)], [-0.3, 0.4, np.sqrt(0.75)]])
CENTRES = np.array([[0.0, 0.0, 0.0], [60.0, -40.0, 10.0], [-50.0, 45.0, -20.0]])  # mm
POSITIONS = np.array(
    [[0.0, -250.0, 400.0], [300.0, 50.0, 350.0], [-260.0, 120.0, 380.0], [40.0, 280.0, 360.0]]
)  # mm


def looking_at_origin(position: FloatArray) -> FloatArray:
    z = position / np.linalg.norm(position)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def drawn_ellipse(
    camera: Camera, position: FloatArray, R: FloatArray, j: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centre, shape (of the ellipse through projected circle points) and image of the circle's centre."""
    n = NORMALS[j]
    e1 = np.cross(n, [1.0, 0.2, 0.1])
    e1 /= np.linalg.norm(e1)
    t = np.linspace(0, 2 * np.pi, 721)[:-1, None]
    circle = CENTRES[j] + RADIUS[j] * (np.cos(t) * e1 + np.sin(t) * np.cross(n, e1))
    xy = project(camera, position, R, circle)
    offset = xy.mean(axis=0)
    centre, axes, angle = cv2.fitEllipseDirect(((xy - offset) * 16).astype(np.float32))
    semi = np.array(axes)[None] / 32
    shape = ellipse_shape(semi, np.deg2rad([angle]))[0]
    return np.array(centre) / 16 + offset, shape, project(camera, position, R, CENTRES[j : j + 1])[0]


def scene() -> tuple[CircleViews, FloatArray]:
    rows = []
    for position in POSITIONS:
        R = looking_at_origin(position) @ rotation_from_vector(np.array([0.0, 0.0, 0.7]))
        for j in range(len(RADIUS)):
            centre, shape, image = drawn_ellipse(CAMERA, position, R, j)
            ray = R.T @ (CENTRES[j] - position)
            J = pixel_jacobian(CAMERA, image[None])[0]
            H = pixel_curvature(CAMERA, -ray[None, :2] / ray[2])[0]
            rows.append((j, shape, ray, R, J, H, centre - image))
    point, shape, rays, R, J, H, shift = (np.array(column) for column in zip(*rows, strict=True))
    return CircleViews(point, shape, rays, R, J, H), shift


def test_radius_normal_and_shift_of_drawn_circles() -> None:
    views, shift = scene()
    circles = fit_circles(views, len(RADIUS))
    assert circles.radius == pytest.approx(RADIUS, rel=2e-3)
    angle = np.arccos(np.clip(np.sum(circles.normal * NORMALS, axis=1), -1, 1))
    assert np.rad2deg(angle).max() < 0.3
    assert np.abs(shift).max() > 0.3  # px: there is something to correct
    # what is left is the curvature of the distortion over the target and the drawn ellipse's rounding
    assert np.abs(circles.shift - shift).max() < 0.01 * np.abs(shift).max()


def test_known_radius_is_kept() -> None:
    views, shift = scene()
    circles = fit_circles(views, len(RADIUS), radius=np.array([4.0, np.nan, 5.0]))
    assert circles.radius[[0, 2]] == pytest.approx([4.0, 5.0], abs=1e-12)
    assert (circles.covariance[0, 2] == 0).all()
    assert np.abs(circles.shift - shift).max() < 0.01 * np.abs(shift).max()


def test_one_wrong_ellipse_does_not_turn_the_target() -> None:
    views, shift = scene()
    views.shape[0] *= 1.5
    circles = fit_circles(views, len(RADIUS))
    good = np.arange(len(shift)) != 0
    assert np.abs(circles.shift - shift)[good].max() < 0.15 * np.abs(shift).max()


@pytest.mark.slow
def test_sigma_of_the_shift_follows_the_scatter() -> None:
    views, _ = scene()
    rng = np.random.default_rng(7)
    truth = fit_circles(views, len(RADIUS)).shift
    noise = 0.004  # relative, of the semi-axes
    errors, sigmas = [], []
    for _ in range(200):
        E = noise * rng.standard_normal((len(truth), 3)) * [1, 1, 1 / np.sqrt(2)]
        L = np.linalg.cholesky(views.shape)
        W = np.eye(2) + np.stack([2 * E[:, [0, 2]], np.stack([2 * E[:, 2], 2 * E[:, 1]], axis=1)], axis=1)
        noisy = replace(views, shape=L @ W @ np.swapaxes(L, 1, 2))
        circles = fit_circles(noisy, len(RADIUS))
        errors.append(circles.shift - truth)
        sigmas.append(np.diagonal(circles.shift_covariance, axis1=1, axis2=2))
    ratio = np.mean(np.square(errors)) / np.mean(sigmas)
    assert 0.7 < ratio < 1.4


RADIUS_MM, OUTLINE = 4.0, 720


def lens(model: str) -> Camera:
    """Return a wide lens with strong distortion of each model."""
    camera = camera_from_values("wide", model, (1600, 1200), (0.005, 0.005), c_mm=5.0)
    values = {"brown": {"K1": -4e-3, "P1": 3e-4}, "opencv": {"k1": -0.11, "k2": 0.02, "p1": 2e-3}}[model]
    p = camera.parameters.copy()
    for name, value in values.items():
        p[camera.names.index(name)] = value
    return camera.with_parameters(p)


@pytest.mark.parametrize("model", ["brown", "opencv"])
def test_the_shift_is_that_of_the_projected_outline(model: str) -> None:
    camera, rng = lens(model), seed_of(f"bent {model}")
    turn = 2 * np.pi * np.arange(OUTLINE) / OUTLINE
    rim = RADIUS_MM * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    centres = np.column_stack([rng.uniform(-110, 110, 12), rng.uniform(-80, 80, 12), np.zeros(12)])
    point, shape, rays, rotations, jacobian, curvature, truth = ([] for _ in range(7))
    for omega, phi in ((0, 0), (20, 0), (0, -20), (-15, 15)):
        R = rotation_from_angles(np.radians(omega), np.radians(phi), 0.3)
        X0 = R @ np.array([0.0, 0.0, 170.0])
        for k, centre in enumerate(centres):
            xy = project(camera, X0, R, centre[None])
            m, second = moments_of_area(project(camera, X0, R, centre + rim))
            ray = (centre - X0) @ R
            point.append(k)
            shape.append(4 * second)
            rays.append(ray)
            rotations.append(R)
            jacobian.append(pixel_jacobian(camera, xy)[0])
            curvature.append(pixel_curvature(camera, -ray[None, :2] / ray[2])[0])
            truth.append(m - xy[0])
    given = np.array(shape), np.array(rays), np.array(rotations), np.array(jacobian)
    straight = fit_circles(CircleViews(np.array(point), *given, 0 * np.array(curvature)), 12)
    bent = fit_circles(CircleViews(np.array(point), *given, np.array(curvature)), 12)
    assert np.abs(straight.shift - truth).max() > 0.05
    assert np.abs(bent.shift - truth).max() < 0.004
