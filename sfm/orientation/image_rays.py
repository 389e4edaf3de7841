"""Rays of the image points of a network, and the object points in which they meet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.camera import Camera, tangents_from_pixel
from sfm.conventions import FloatArray, IntArray
from sfm.network import Estimate, ImagePoints, rows_of
from sfm.orientation.intersection import Intersection, intersect


def image_tangents(seen: ImagePoints, camera: IntArray, cameras: Sequence[Camera]) -> FloatArray:
    """Return the tangents u = -U/W, v = -V/W of image points, NaN where no ray has them, (k, 2).

    Args:
        seen: image points.
        camera: index of the camera of each photograph, (m,).
        cameras: interior orientations.
    """
    uv = np.full((len(seen), 2), np.nan)
    for one, own in zip(cameras, rows_of(camera[seen.image], len(cameras)), strict=True):
        uv[own] = tangents_from_pixel(one, seen.xy[own])
    return uv


def intersect_image_points(
    seen: ImagePoints, camera: IntArray, estimate: Estimate, *, n_points: int, tolerance_px: float
) -> Intersection:
    """Return the object points that most rays of oriented photographs support; see `intersect`.

    Args:
        seen: image points.
        camera: index of the camera of each photograph, (m,).
        estimate: interior and exterior orientation.
        n_points: number of object points.
        tolerance_px: largest residual of a ray that takes part, px of the camera with the shortest c.
    """
    return intersect(
        image_tangents(seen, camera, estimate.cameras),
        seen.image,
        seen.point,
        estimate.position,
        estimate.rotation,
        n_points=n_points,
        tolerance=tolerance_px / min(one.c_px for one in estimate.cameras),
    )
