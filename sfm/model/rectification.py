"""Rectification of a stereo pair: two cameras without distortion whose rows are epipolar lines.

Each camera is rotated by half of their relative rotation, and then so that the base is along rows (or
columns). Focal length and principal point are the same in both, as OpenCV chooses them: see `rectify`.

Source: document 002, II.1.2.1 (normal images); OpenCV 4 documentation, "stereoRectify" (after Bouguet), with
CALIB_ZERO_DISPARITY.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sfm.model.camera import Camera, camera_from_values, tangents_from_pixel
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.errors import GeometryError

GRID = 9  # grid points along each side of a photograph
# As OpenCV: its inverse of a distortion ends after so many iterations, and its corners have single precision.
# Any focal length and principal point would do, and so they are those of cv2.stereoRectify to 1e-9.
ITERATIONS, CORNER = 5, np.float32
OPENCV = ("opencv", "full_opencv")


class Rectification(NamedTuple):
    """Rotations to the rectified cameras, their projections (px), and disparity to depth, as in OpenCV."""

    R1: FloatArray  # (3, 3)
    R2: FloatArray
    P1: FloatArray  # (3, 4)
    P2: FloatArray
    Q: FloatArray  # (4, 4)

    def camera(self, name: str, size_px: tuple[int, int], pixel_mm: FloatArray) -> Camera:
        """Return the rectified camera, in model opencv without distortion; both of a pair are alike.

        Args:
            name: its name.
            size_px: width and height of the rectified photographs, px.
            pixel_mm: width and height of a pixel, mm, (2,).
        """
        f, cx, cy = float(self.P1[0, 0]), float(self.P1[0, 2]), float(self.P1[1, 2])
        values = (("fx", f), ("fy", f), ("cx", cx), ("cy", cy))
        side = float(pixel_mm[1])
        return camera_from_values(name, "opencv", size_px, (side, side), c_mm=f * side, values=values)


def rectify(
    first: Camera, second: Camera, R: FloatArray, T: FloatArray, *, alpha: float = 0.0
) -> Rectification | None:
    """Return the rectification of two cameras to the size of the first one.

    Args:
        first: the first camera, whose axes are those of x1.
        second: the second camera, whose axes are those of x2.
        R: rotation of x2 = R x1 + T, axes x right, y down, z forward, (3, 3).
        T: its translation, any unit, (3,).
        alpha: 0 enlarges the photographs until no border is empty, 1 shows them whole; in between the focal
            length is interpolated.

    Returns:
        The rectification; None if a photograph would reach behind the common image plane.

    Raises:
        GeometryError: the projection centres coincide.
    """
    if not np.linalg.norm(T) > 0:
        raise GeometryError(f"cameras {first.name} and {second.name}: no base between them to rectify along")
    half = rotation_from_vector(-0.5 * np.asarray(Rotation.from_matrix(R).as_rotvec()))
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
    view = common_view((first, second), rotations, axis, alpha)
    if view is None:
        return None
    f, c = view
    P1 = np.array([[f, 0.0, c[0], 0.0], [0.0, f, c[1], 0.0], [0.0, 0.0, 1.0, 0.0]])
    P2 = P1.copy()
    P2[axis, 3] = f * base
    Q = np.array(
        [[1.0, 0.0, 0.0, -c[0]], [0.0, 1.0, 0.0, -c[1]], [0.0, 0.0, 0.0, f], [0.0, 0.0, -1 / base, 0.0]]
    )
    return Rectification(*rotations, P1, P2, Q)


def common_view(
    cameras: tuple[Camera, ...], rotations: tuple[FloatArray, ...], axis: int, alpha: float
) -> tuple[float, FloatArray] | None:
    """Return focal length and principal point of a camera without distortion that sees what others see.

    The corners of the photographs are in the middle of the new ones. The focal length is such that the
    largest box without empty borders fills them (alpha 0), or the whole photographs are in them (alpha 1).

    Args:
        cameras: the cameras; the new photographs have the size of those of the first one.
        rotations: x_new = rotation x of each, axes x right, y down, z forward, (3, 3) each.
        axis: 0 takes the focal lengths along columns, 1 those along rows.
        alpha: 0 to 1.

    Returns:
        Focal length, px, and principal point, px, (2,); None if a photograph reaches behind the image plane.
    """
    focal = [camera.parts[0] for camera in cameras]
    each = [
        camera.parameters[of][-1 if axis == 0 else 0] / (camera.pixel_mm[1 - axis] if camera.in_mm else 1.0)
        for camera, of in zip(cameras, focal, strict=True)
    ]
    f = float(np.mean(each))
    centres = []
    for camera, rotation in zip(cameras, rotations, strict=True):
        corners = _rectified(camera, rotation, 2, CORNER)
        if corners is None:
            return None
        corners = (f * corners).astype(CORNER).astype(float)
        centres.append((np.array(camera.size_px) - 1) / 2 - corners.reshape(-1, 2).mean(axis=0))
    c = np.mean(centres, axis=0)
    size, inner, outer = np.array(cameras[0].size_px), 0.0, np.inf
    for camera, rotation in zip(cameras, rotations, strict=True):
        grid = _rectified(camera, rotation, GRID)
        if grid is None:
            return None
        least = f * np.array([grid[:, 0, 0].max(), grid[0, :, 1].max()])  # of the largest inner box, from c
        most = f * np.array([grid[:, -1, 0].min(), grid[-1, :, 1].min()])
        if not ((least < 0) & (most > 0)).all():
            return None
        inner = max(inner, *(c / -least), *((size - 1 - c) / most))
        from_c = f * grid.reshape(-1, 2)
        outer = min(outer, *(c / -from_c.min(axis=0)), *((size - 1 - c) / from_c.max(axis=0)))
    return f * (inner * (1 - alpha) + outer * alpha), np.asarray(c)


def _rectified(
    camera: Camera, rotation: FloatArray, count: int, precision: type = float
) -> FloatArray | None:
    """Return x/z and y/z of a grid on a photograph after a rotation, (n, n, 2); None if any is behind."""
    x, y = (np.linspace(0.0, side - 1.0, count) for side in camera.size_px)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    plane = _undistorted(camera, grid).astype(precision).astype(float)
    rays = np.column_stack([plane, np.ones(len(plane))]) @ rotation.T
    if not (rays[:, 2] > 0).all():
        return None
    return np.asarray((rays[:, :2] / rays[:, 2:]).reshape(count, count, 2))


def _undistorted(camera: Camera, xy: FloatArray) -> FloatArray:
    """Return x/z and y/z of the rays of pixels, of OpenCV's models as inexact as there, (k, 2)."""
    if camera.model not in OPENCV:
        return np.asarray(tangents_from_pixel(camera, xy) * (1.0, -1.0))
    fx, fy, cx, cy = camera.parameters[:4]
    k1, k2, p1, p2, k3, k4, k5, k6 = np.concatenate([camera.parameters[4:], np.zeros(8)])[:8]
    x0, y0 = (xy[:, 0] - cx) / fx, (xy[:, 1] - cy) / fy
    x, y = x0, y0
    for _ in range(ITERATIONS):
        r2 = x * x + y * y
        inverse = (1 + r2 * (k4 + r2 * (k5 + r2 * k6))) / (1 + r2 * (k1 + r2 * (k2 + r2 * k3)))
        dx, dy = 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (x0 - dx) * inverse, (y0 - dy) * inverse
    return np.column_stack([x, y])
