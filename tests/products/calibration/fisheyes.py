"""Simulated photographs of a board by a fisheye of 190 degrees: many of its points lie beyond 90 degrees."""

from __future__ import annotations

import numpy as np

from sfm.model.camera import Camera, camera_from_values, project
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.orientation.image_rays import axes_along
from tests.products.calibration.boards import SimulatedBoard, board_network, board_points

REACH_DEG = 95.0  # half the field of view
FISHEYE = camera_from_values(
    "cam", "opencv_fisheye", (1200, 1200), (0.005, 0.005), c_mm=1.75,
    free=("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    values=(("cx", 604.2), ("cy", 597.1), ("k1", -0.012), ("k2", 4e-3), ("k3", -1e-3), ("k4", 1e-4)),
)  # fmt: skip


def off_axis(position: FloatArray, rotation: FloatArray, points: FloatArray) -> FloatArray:
    """Return the angles of points to the axis of a camera, deg, (n,)."""
    rays = (points - position) @ rotation
    return np.asarray(np.degrees(np.arccos(-rays[:, 2] / np.linalg.norm(rays, axis=1))))


def fisheye_board(
    rng: np.random.Generator, *, photographs: int = 24, camera: Camera = FISHEYE
) -> SimulatedBoard:
    """Return photographs of a board whose middle is up to 85 degrees off the axis, in a circle of 190."""
    points = board_points()
    position, rotation, image, point, xy = [], [], [], [], []
    for i in range(photographs):
        # half of the boards at the border of the circle, the others anywhere
        angle = np.radians(rng.uniform(70, 85) if i % 2 else rng.uniform(0, 60))
        around = 2 * np.pi * (i + rng.uniform()) / photographs * 7
        ray = np.array([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), -np.cos(angle)])
        # the board faces the camera, tilted; its axes in those of the camera
        tilt, roll = np.radians(rng.uniform(-30, 30, 2)), np.pi / 2 * rng.integers(4)
        from_board = axes_along(ray[None])[0] @ _turned(tilt[0], tilt[1], roll)
        X0 = -from_board.T @ (rng.uniform(130.0, 260.0) * ray)
        R = from_board.T
        pixels = project(camera, X0, R, points)
        inside = (off_axis(X0, R, points) < REACH_DEG) & np.isfinite(pixels).all(axis=1)
        inside &= ((pixels >= 0) & (pixels <= np.array(camera.size_px) - 1)).all(axis=1)
        seen = np.flatnonzero(inside)
        position.append(X0)
        rotation.append(R)
        image.append(np.full(len(seen), i))
        point.append(seen)
        xy.append(pixels[seen])
    network = board_network(image, point, xy, points=len(points))
    network = network.with_control(network.points, points, 0.0)
    return SimulatedBoard(network, Estimate((camera,), np.array(position), np.array(rotation), points))


def _turned(a: float, b: float, roll: float) -> FloatArray:
    ca, sa, cb, sb, ck, sk = np.cos(a), np.sin(a), np.cos(b), np.sin(b), np.cos(roll), np.sin(roll)
    x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    return np.asarray(x @ y @ np.array([[ck, -sk, 0], [sk, ck, 0], [0, 0, 1]]))
