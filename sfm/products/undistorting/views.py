"""What photographs without distortion show: new cameras, and where their pixels are in the former ones.

An undistorted photograph has the projection centre and the axes of the former one, and a camera in model
opencv without distortion. The photographs of a rectified pair are turned in addition, so that conjugate
points have the same row, see `sfm.model.rectification`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sfm.comparison.camera_conversion import ideal_camera
from sfm.model.camera import Camera, camera_from_values, pixel_from_tangents, tangents_from_pixel
from sfm.model.conventions import VISION_AXES, AnyArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import Mounts
from sfm.model.rectification import Rectification, common_view, rectify
from sfm.model.solution import Solution

BLOCK_ROWS = 256  # rows of a photograph whose places are computed at a time


@dataclass(frozen=True)
class View:
    """A new camera that sees what a photograph shows."""

    former: Camera
    camera: Camera
    """the new camera, in model opencv without distortion"""
    rotation: FloatArray
    """x_new = rotation x_former, axes x right, y down, z forward, (3, 3)"""

    @property
    def matrix(self) -> FloatArray:
        """K of the new camera, px, (3, 3)."""
        fx, fy, cx, cy = (self.camera.value(name) for name in ("fx", "fy", "cx", "cy"))
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def places(self) -> tuple[AnyArray, AnyArray]:
        """Return where each pixel of the new photograph is in the former one.

        Returns:
            Columns and rows, px, float32, (H, W) each; -1 where the former photograph has no such pixel.
        """
        width, height = self.camera.size_px
        x, y = np.full((height, width), -1.0, np.float32), np.full((height, width), -1.0, np.float32)
        from_pixel = self.rotation.T @ np.linalg.inv(self.matrix)
        for start in range(0, height, BLOCK_ROWS):
            rows = np.arange(start, min(start + BLOCK_ROWS, height))
            grid = np.stack(np.meshgrid(np.arange(width), rows), axis=-1).reshape(-1, 2)
            rays = np.column_stack([grid, np.ones(len(grid))]) @ from_pixel.T
            ahead = rays[:, 2] > 0
            place = np.full((len(grid), 2), -1.0)
            uv: FloatArray = rays[ahead, :2] / rays[ahead, 2:] * np.array([1.0, -1.0])
            place[ahead] = np.nan_to_num(pixel_from_tangents(self.former, uv), nan=-1.0)
            x[rows], y[rows] = place.reshape(len(rows), width, 2).transpose(2, 0, 1)
        return x, y

    def pixels(self, xy: FloatArray) -> FloatArray:
        """Return where pixels of the former photograph are in the new one, px, (k, 2); NaN without a ray."""
        uv = tangents_from_pixel(self.former, xy)
        rays = np.column_stack([uv[:, 0], -uv[:, 1], np.ones(len(uv))]) @ self.rotation.T
        projected = rays @ self.matrix.T
        return np.asarray(projected[:, :2] / np.where(projected[:, 2:] > 0, projected[:, 2:], np.nan))


@dataclass(frozen=True)
class RectifiedPair:
    """A stereo pair with conjugate points on equal rows (or columns)."""

    first: View
    second: View
    rectification: Rectification
    base: FloatArray
    """from the first to the second, x2 = x1 + base in rectified axes, unit of the mounts, (3,)"""

    @property
    def axis(self) -> int:
        """0 if conjugate points have equal rows, 1 if they have equal columns."""
        return int(self.base[1] != 0.0)


def undistorted_view(camera: Camera, alpha: float | None = None) -> View:
    """Return the view of a camera without distortion.

    Args:
        camera: the calibrated camera.
        alpha: 0 enlarges the photographs until no border is empty, 1 shows them whole, numbers in between
            interpolate the focal length; None keeps principal distance and principal point.

    Raises:
        GeometryError: the photograph sees too wide for an image plane, or alpha is not between 0 and 1.
    """
    if alpha is None:
        return View(camera, ideal_camera(camera, ("opencv",)), np.eye(3))
    _refuse_alpha(alpha)
    view = common_view((camera,), (np.eye(3),), 0, alpha)
    if view is None or not np.isfinite(view[0]):
        raise GeometryError(
            f"camera {camera.name}: its photographs see too wide for one image plane; without --alpha, their "
            "middle is shown"
        )
    f, (cx, cy) = view[0], view[1].tolist()
    side = float(camera.pixel_mm[1])
    values = (("fx", f), ("fy", f), ("cx", cx), ("cy", cy))
    new = camera_from_values(
        camera.name, "opencv", camera.size_px, (side, side), c_mm=f * side, values=values
    )
    return View(camera, new, np.eye(3))


def rectified_pair(
    cameras: tuple[Camera, ...], mounts: Mounts, first: int, second: int, alpha: float = 0.0
) -> RectifiedPair:
    """Return the rectified pair of two cameras of a rig.

    Args:
        cameras: cameras of the rig.
        mounts: how they are mounted.
        first: index of the first camera.
        second: index of the second camera.
        alpha: see `undistorted_view`.

    Raises:
        GeometryError: other sizes, viewing directions that differ too much, no base, or a wrong alpha.

    Source: document 002, II.1.2.1 (normal images).
    """
    _refuse_alpha(alpha)
    a, b = cameras[first], cameras[second]
    if a.size_px != b.size_px:
        raise GeometryError(
            f"cameras {a.name} and {b.name}: photographs of {a.size_px[0]} x {a.size_px[1]} px and of "
            f"{b.size_px[0]} x {b.size_px[1]} px cannot be rectified to a pair, needed the same size"
        )
    from_rig = [VISION_AXES @ mounts.rotation[k].T @ VISION_AXES for k in (first, second)]
    R = from_rig[1] @ from_rig[0].T
    T = -from_rig[1] @ VISION_AXES @ (mounts.position[second] - mounts.position[first])
    rectification = rectify(a, b, R, T, alpha=alpha)
    if rectification is None:
        raise GeometryError(
            f"cameras {a.name} and {b.name}: their viewing directions differ too much for one image plane"
        )
    new = [rectification.camera(camera.name, a.size_px, camera.pixel_mm) for camera in (a, b)]
    base = rectification.R2 @ T
    base = np.where(np.arange(3) == int(np.argmax(np.abs(base))), base, 0.0)
    return RectifiedPair(
        View(a, new[0], rectification.R1), View(b, new[1], rectification.R2), rectification, base
    )


def _refuse_alpha(alpha: float) -> None:
    if not 0.0 <= alpha <= 1.0:
        raise GeometryError(f"--alpha {alpha:g}, needed 0 (no empty border) to 1 (everything visible)")


def row_differences(pair: RectifiedPair, solution: Solution) -> FloatArray:
    """Return by how much the rows of conjugate image points differ in a rectified pair, px, (k,).

    Args:
        pair: the rectified pair; of equal columns, their differences are returned.
        solution: the result that calibrated the cameras, with moments.
    """
    network = solution.network
    names = [camera.name for camera in solution.estimate.cameras]
    moment, seen = network.moment, network.image_points
    if moment is None:
        return np.zeros(0)
    rows = [
        np.flatnonzero(network.camera[seen.image] == names.index(view.former.name))
        for view in (pair.first, pair.second)
    ]
    keys = [moment[seen.image[of]] * len(network.points) + seen.point[of] for of in rows]
    _, *common = np.intersect1d(keys[0], keys[1], return_indices=True)
    first, second = (
        view.pixels(seen.xy[of[at]])
        for view, of, at in zip((pair.first, pair.second), rows, common, strict=True)
    )
    return np.asarray((second - first)[:, 1 - pair.axis])


def pairs_of(mounts: Mounts) -> Iterator[tuple[int, int]]:
    """Yield the indices of the reference camera and another camera of each rig."""
    for reference, *others in mounts.by_rig().values():
        for other in others:
            yield reference, other
