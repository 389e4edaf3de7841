"""Eccentricity under distortion, which bends images of circles: against outlines projected point by point."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.camera import Camera, camera_from_values, pixel_curvature, pixel_jacobian, project
from sfm.conventions import rotation_from_angles
from sfm.orientation.eccentricity import CircleViews, fit_circles
from tests.outlines import moments_of_area
from tests.synthetic import seed_of

RADIUS, OUTLINE = 4.0, 720


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
    rim = RADIUS * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
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
