"""Depths of single points on the ray of one photograph, from how alike windows along it are in others.

The epipolar line of a point is searched in all photographs at once: at each depth windows are projected on a
plane there, and correlated. A wrong depth may be alike in one photograph by chance, or on a repeated pattern,
but hardly in several with different bases.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sfm.camera import ray_directions, tangents_from_pixel
from sfm.conventions import AnyArray, FloatArray, IntArray
from sfm.matching.correlation import match_ncc_warped
from sfm.matching.lsm.coverage import plane_warps, project_points
from sfm.network import Estimate

REACH_PX = 2  # distance from the line and along it that a correlation covers
VERTICES = 65  # of the line of which the length gives the number of depths


def search_depth(
    template: AnyArray,
    others: Mapping[int, AnyArray],
    estimate: Estimate,
    camera: IntArray,
    i: int,
    xy: FloatArray,
    *,
    normal: FloatArray,
    nearest: float,
    farthest: float,
    window_px: int,
) -> FloatArray:
    """Return the object point on a ray whose surroundings other photographs show most alike.

    Args:
        template: the photograph of the ray, (H, W).
        others: other photographs, by their index, (H, W).
        estimate: orientation of all photographs, good to REACH_PX.
        camera: index of the camera of each photograph, (m,).
        i: index of the photograph of the ray.
        xy: image point of the ray, px, (2,).
        normal: normal of the surface, towards the photograph, (3,).
        nearest: smallest depth along the axis of the photograph, object unit.
        farthest: largest depth, object unit.
        window_px: odd side of the windows.

    Returns:
        The object point, (3,).
    """
    (ray,) = ray_directions(tangents_from_pixel(estimate.cameras[camera[i]], xy[None]), estimate.rotation[i])

    def on_ray(count: int) -> FloatArray:
        # equal steps in 1 / depth are nearly equal steps in the image
        depth = 1 / np.linspace(1 / nearest, 1 / farthest, count)
        return np.asarray(estimate.position[i] + depth[:, None] * ray)

    def path(j: int, points: FloatArray) -> FloatArray:
        return project_points(estimate, camera, np.full(len(points), j), points)

    lengths = [np.nansum(np.linalg.norm(np.diff(path(j, on_ray(VERTICES)), axis=0), axis=1)) for j in others]
    points = on_ray(2 + int(max(lengths, default=0.0) / (2 * REACH_PX)))
    k = len(points)
    correlation = np.zeros(k)
    for j, other in others.items():
        at = path(j, points)
        warp = plane_warps(
            estimate, camera, i, j, np.tile(xy, (k, 1)), points, np.tile(normal, (k, 1)), window_px / 2
        )
        match = match_ncc_warped(
            template,
            other,
            np.tile(xy, (k, 1)),
            at,
            warp[:, :2, :2],
            reach_px=np.full(k, REACH_PX),
            template_px=window_px,
        )
        correlation += np.fmax(match.correlation, 0.0)  # 0 outside the photograph
    return np.asarray(points[np.argmax(correlation)])
