"""The next poses of a calibration: following them helps more than other photographs."""

from __future__ import annotations

import numpy as np
import pytest

import sfm
from sfm.adjustment.result import Adjustment
from sfm.model.camera import camera_from_values
from sfm.products.calibration.poses import (
    candidates,
    corners_of,
    next_poses,
    with_poses,
    worst_corner,
)
from tests.products.calibration.boards import CAMERA, FREE, simulated_board
from tests.synthetic import seed_of


def calibration(number: int, *, fixed: bool = True, photographs: int = 8) -> Adjustment:
    rng = seed_of(f"poses {number}")
    board = simulated_board(rng, photographs=photographs, fixed=fixed)
    return sfm.adjust(board.noisy(rng), board.truth, datum="control" if fixed else "free", reject="none")


def gains(simulations: int, *, fixed: bool) -> tuple[float, float]:
    """Return by how much three poses lower the worst corner: those advised, and random ones in the mean."""
    advised, random = 0.0, 0.0
    for number in range(simulations):
        a, rng = calibration(number, fixed=fixed), seed_of(f"random {number}")
        further = next_poses(a)
        views, corners = list(candidates(a, 0)), corners_of(CAMERA, a.network.image_points.xy)
        chosen = [views[k] for k in rng.choice(len(views), 3, replace=False)]
        advised += further.before - further.after[-1]
        random += further.before - worst_corner(with_poses(a, 0, chosen), 0, corners)
    return advised, random


@pytest.mark.parametrize("fixed", [True, False], ids=["fixed board", "free board"])
def test_following_the_poses_helps_more_than_random_ones(fixed: bool) -> None:
    advised, random = gains(5, fixed=fixed)
    assert advised > 1.3 * random


@pytest.mark.slow
@pytest.mark.parametrize("fixed", [True, False], ids=["fixed board", "free board"])
def test_following_the_poses_helps_in_fifty_simulations(fixed: bool) -> None:
    advised, random = gains(50, fixed=fixed)
    assert advised > 1.3 * random, (advised, random)


def test_each_pose_helps_and_shows_the_object() -> None:
    a = calibration(0)
    further = next_poses(a)
    assert further.camera == "cam" and len(further.poses) == 3
    assert (np.diff([further.before, *further.after]) < 0).all()
    least = np.bincount(a.network.image_points.image).min()
    assert len({(*pose.position, *pose.rotation.ravel()) for pose in further.poses}) == 3
    for pose in further.poses:
        assert np.isfinite(pose.xy[:, 0]).sum() >= least
        assert np.allclose(pose.rotation @ pose.rotation.T, np.eye(3))


def test_a_held_camera_needs_no_poses() -> None:
    board = simulated_board(
        seed_of("held"), camera=camera_from_values("cam", "brown", (1200, 900), (0.005, 0.005), c_mm=6.0)
    )
    further = next_poses(sfm.adjust(board.network, board.truth, datum="control"))
    assert not further.poses and not further.after


def test_corners_of_a_fisheye_are_where_it_has_rays() -> None:
    fisheye = camera_from_values(
        "fish", "opencv_fisheye", (1000, 1000), (0.005, 0.005), c_mm=1.6, free=("fx", "fy")
    )
    seen = np.array([[500.0, 600.0]])
    corners = corners_of(fisheye, seen)
    assert ((corners > 0) & (corners < 999)).all() and len(FREE)
    off_axis = np.linalg.norm(corners - 499.5, axis=1) / 320
    assert (off_axis < np.pi / 2).all() and (off_axis > np.pi / 2 - 0.1).all()
    beyond = corners_of(fisheye, np.array([[499.5, 499.5 - 320 * np.radians(100)]]))
    off_axis = np.linalg.norm(beyond - 499.5, axis=1) / 320
    assert (off_axis < np.radians(100)).all() and (off_axis > np.radians(100) - 0.1).all()
    assert np.array_equal(corners_of(CAMERA, seen)[3], [1199, 899])
