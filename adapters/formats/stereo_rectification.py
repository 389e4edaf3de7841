"""Rectification of a pair of cameras as OpenCV does it: a common image plane, rows as epipolar lines.

Each camera is turned by half of their relative rotation and then so that the base is along rows (or columns);
focal length and principal point, the same in both, show in both as much as is without empty borders.

Source: cv::stereoRectify of OpenCV 4 (after Bouguet), with CALIB_ZERO_DISPARITY and alpha = 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sfm.camera import Camera, tangents_from_pixel
from sfm.conventions import FloatArray, rotation_from_vector

GRID = 9  # points along each side of a photograph


class Rectification(NamedTuple):
    """Rotations into the rectified cameras, their projections (px) and disparity to depth, as in OpenCV."""

    R1: FloatArray  # (3, 3)
    R2: FloatArray
    P1: FloatArray  # (3, 4)
    P2: FloatArray
    Q: FloatArray  # (4, 4)


def rectify(first: Camera, second: Camera, R: FloatArray, T: FloatArray) -> Rectification | None:
    """Return the rectification of two cameras to the size of the first one.

    Args:
        first: the first camera, with x1 in its axes.
        second: the other, with x2.
        R: rotation of x2 = R x1 + T, axes x right, y down, z forward, (3, 3).
        T: its translation, any unit, (3,).

    Returns:
        The rectification, None where a photograph would reach behind the common image plane.
    """
    half = rotation_from_vector(-0.5 * _vector(R))
    t = half @ T
    axis = 0 if abs(t[0]) > abs(t[1]) else 1
    along = np.zeros(3)
    along[axis] = 1.0 if t[axis] > 0 else -1.0
    normal = np.cross(t, along)
    length = float(np.linalg.norm(normal))
    if length > 0:
        normal *= np.arccos(min(abs(t[axis]) / np.linalg.norm(t), 1.0)) / length
    turn = rotation_from_vector(normal)
    rotations = (turn @ half.T, turn @ half)
    base = float((rotations[1] @ T)[axis])
    cameras = (first, second)
    other = "fy" if axis == 0 else "fx"
    f = sum(camera.value(other) for camera in cameras) / 2
    centres = []
    for camera, rotation in zip(cameras, rotations, strict=True):
        corners = _rectified(camera, rotation, 2)
        if corners is None:
            return None
        centres.append((np.array(camera.size_px) - 1) / 2 - f * corners.reshape(-1, 2).mean(axis=0))
    c = np.mean(centres, axis=0)
    size, scale = np.array(first.size_px), 0.0
    for camera, rotation in zip(cameras, rotations, strict=True):
        grid = _rectified(camera, rotation, GRID)
        if grid is None:
            return None
        least = f * np.array([grid[:, 0, 0].max(), grid[0, :, 1].max()])  # of the largest box inside, from c
        most = f * np.array([grid[:, -1, 0].min(), grid[-1, :, 1].min()])
        if not ((least < 0) & (most > 0)).all():
            return None
        scale = max(scale, *(c / -least), *((size - 1 - c) / most))
    f *= scale
    P1 = np.array([[f, 0.0, c[0], 0.0], [0.0, f, c[1], 0.0], [0.0, 0.0, 1.0, 0.0]])
    P2 = P1.copy()
    P2[axis, 3] = f * base
    Q = np.array(
        [[1.0, 0.0, 0.0, -c[0]], [0.0, 1.0, 0.0, -c[1]], [0.0, 0.0, 0.0, f], [0.0, 0.0, -1 / base, 0.0]]
    )
    return Rectification(*rotations, P1, P2, Q)


def _vector(R: FloatArray) -> FloatArray:
    """Return the rotation vector of a rotation, rad, (3,)."""
    return np.asarray(Rotation.from_matrix(R).as_rotvec())


def _rectified(camera: Camera, rotation: FloatArray, count: int) -> FloatArray | None:
    """Return x/z and y/z of a grid over a photograph after a rotation, None if one is behind, (n, n, 2)."""
    x, y = (np.linspace(0.0, side - 1.0, count) for side in camera.size_px)
    uv = tangents_from_pixel(camera, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    rays = np.column_stack([uv[:, 0], -uv[:, 1], np.ones(len(uv))]) @ rotation.T
    if not (rays[:, 2] > 0).all():
        return None
    return np.asarray((rays[:, :2] / rays[:, 2:]).reshape(count, count, 2))
