"""Rays of the image points of a network, and the object points in which they meet.

Angles at which the rays of object points meet.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.camera import Camera, tangents_from_pixel
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.network import Estimate, ImagePoints, Network, rows_of
from sfm.orientation.intersection import Intersection, intersect

MAX_PAIRS = 4_000_000  # of rays that are compared at a time


def image_tangents(seen: ImagePoints, camera: IntArray, cameras: Sequence[Camera]) -> FloatArray:
    """Return the tangents u = -U/W, v = -V/W of image points, NaN where no ray has them, (k, 2).

    Args:
        seen: image points.
        camera: index of the camera of each photograph, (m,).
        cameras: interior orientations.
    """
    uv = np.full((len(seen), 2), np.nan)
    for one, of_camera in zip(cameras, rows_of(camera[seen.image], len(cameras)), strict=True):
        uv[of_camera] = tangents_from_pixel(one, seen.xy[of_camera])
    return uv


def intersect_image_points(
    seen: ImagePoints, camera: IntArray, estimate: Estimate, *, n_points: int, tolerance_px: float
) -> Intersection:
    """Return the object points that most rays of oriented photographs support; see `intersect`.

    Rays of wide-angle cameras are compared by their angles: each is taken as the axis of a separate
    photograph. Their tangents would weigh a pixel at 70 degrees off the axis as much as eight in the middle.

    Args:
        seen: image points.
        camera: index of the camera of each photograph, (m,).
        estimate: interior and exterior orientation.
        n_points: number of object points.
        tolerance_px: largest residual of a ray that takes part, px of the camera with the shortest c.
    """
    uv, image = image_tangents(seen, camera, estimate.cameras), seen.image
    position, rotation = estimate.position, estimate.rotation
    wide = np.array([one.wide_angle for one in estimate.cameras])[camera[image]]
    if wide.any():
        position = np.concatenate([position, position[image[wide]]])
        rotation = np.concatenate([rotation, _along_rays(rotation[image[wide]], uv[wide])])
        image = image.copy()
        image[wide] = len(estimate.position) + np.arange(int(wide.sum()))
        uv[wide] *= 0.0  # NaN stays
    return intersect(
        uv,
        image,
        seen.point,
        position,
        rotation,
        n_points=n_points,
        tolerance=tolerance_px / min(one.c_px for one in estimate.cameras),
    )


def _along_rays(rotation: FloatArray, uv: FloatArray) -> FloatArray:
    """Return rotations whose axis -z is the ray with tangents (u, v) under other ones, (k, 3, 3)."""
    u, v = uv.T
    one = np.ones(len(uv))
    z = np.column_stack([-u, -v, one])
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.column_stack([one, 0 * one, u])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.asarray(rotation @ np.stack([x, np.cross(z, x), z], axis=2))


def ray_angles(network: Network, estimate: Estimate, used: BoolArray) -> FloatArray:
    """Return the largest angle between two rays of each point, deg, NaN with fewer than two, (n,).

    Rays that meet head on are as parallel as those side by side, so that no angle is above 90 degrees.

    Args:
        network: of k image points and n points.
        estimate: of the same, all that is used determined.
        used: image points whose rays count, (k,).
    """
    seen = network.image_points.select(used)
    order = np.argsort(seen.point, kind="stable")
    image, point = seen.image[order], seen.point[order]
    ray = estimate.points[point] - estimate.position[image]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    count = np.bincount(point, minlength=len(network.points))
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    angle = np.full(len(network.points), np.nan)
    for r in np.unique(count[count >= 2]):
        points = np.flatnonzero(count == r)
        for some in np.array_split(points, 1 + len(points) * r * r // MAX_PAIRS):
            u = ray[first[some][:, None] + np.arange(r)]
            sine = np.sqrt(np.maximum(1 - np.einsum("nia,nja->nij", u, u) ** 2, 0))
            angle[some] = np.degrees(np.arcsin(np.minimum(sine.max(axis=(1, 2)), 1)))
    return angle
