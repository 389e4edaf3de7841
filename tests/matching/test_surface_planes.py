"""Points of two rays against the surface of their neighbours: what an error along the epipolar line does."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.camera import camera_from_values, project
from sfm.conventions import BoolArray, FloatArray
from sfm.matching.lsm.surface_planes import on_surface
from sfm.network import Estimate, ImagePoints
from tests.synthetic import seed_of

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


CAMERA = np.zeros(2, dtype=np.int64)


@pytest.mark.parametrize("along_px", [2.0, 20.0])
def test_points_off_the_surface_leave_and_their_neighbours_stay(along_px: float) -> None:
    seen, estimate, wrong = pair_over_hills(along_px=along_px)
    good = on_surface(seen, CAMERA, estimate, np.ones(300, dtype=bool))
    assert not good[wrong].any()
    assert good[~wrong].sum() >= 290


def test_points_that_a_third_ray_checks_stay() -> None:
    seen, estimate, wrong = pair_over_hills(along_px=20.0)
    assert on_surface(seen, CAMERA, estimate, np.zeros(300, dtype=bool)).all()
    assert on_surface(seen, CAMERA, estimate, ~wrong)[wrong].all()


def test_points_without_neighbours_are_on_no_surface() -> None:
    seen, estimate, _ = pair_over_hills(along_px=0.0)
    few = seen.select(seen.point < 6)
    alone = Estimate(estimate.cameras, estimate.position, estimate.rotation, estimate.points[:6])
    assert not on_surface(few, CAMERA, alone, np.ones(6, dtype=bool)).any()
    behind: FloatArray = estimate.points.copy()
    behind[40] = [0.0, 0.0, 9.0]
    turned = Estimate(estimate.cameras, estimate.position, estimate.rotation, behind)
    assert not on_surface(seen, CAMERA, turned, np.ones(300, dtype=bool))[40]
