"""Depths of single points on the ray of one photograph, from how alike windows along it are in others.

The epipolar line of a point is searched in all photographs at once: at each depth windows are projected on a
plane there, and correlated. A wrong depth may be alike in one photograph by chance, or on a repeated pattern,
but hardly in several with different bases: where the pattern is as regular as the bases, there are several
depths, which are all returned.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sfm.matching.correlation import START_CORRELATION, match_ncc_warped
from sfm.matching.lsm.coverage import plane_warps, project_points
from sfm.model.camera import ray_directions, tangents_from_pixel
from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.model.estimate import Estimate

REACH_PX = 2  # distance from the line and along it that a correlation covers
VERTICES = 65  # of the line of which the length gives the number of depths
MIN_ALIKE = 2  # photographs that show the surroundings alike at a further depth
MOST = 8  # depths that are returned; two would do to see that a pattern is repeated


@dataclass(frozen=True)
class SearchedRay:
    """The ray of an image point, and where on it a surface may be."""

    image: int  # index of the photograph
    xy: FloatArray  # image point, px, (2,)
    normal: FloatArray  # normal of the surface, towards the photograph, (3,)
    nearest: float  # smallest depth along the axis of the photograph, object unit
    farthest: float  # largest depth, object unit


def search_depths(
    template: AnyArray,
    others: Mapping[int, AnyArray],
    estimate: Estimate,
    camera: IntArray,
    searched: SearchedRay,
    *,
    window_px: int,
) -> FloatArray:
    """Return the object points on a ray whose surroundings other photographs show alike, the best first.

    The first is the most alike, however little it is.

    Args:
        template: the photograph of the ray, (H, W).
        others: other photographs, by their index, (H, W).
        estimate: orientation of all photographs, good to REACH_PX.
        camera: index of the camera of each photograph, (m,).
        searched: the ray.
        window_px: odd side of the windows.

    Returns:
        Object points, (p, 3).
    """
    i, xy, normal = searched.image, searched.xy, searched.normal
    (ray,) = ray_directions(tangents_from_pixel(estimate.cameras[camera[i]], xy[None]), estimate.rotation[i])

    def on_ray(count: int) -> FloatArray:
        # equal steps in 1 / depth are nearly equal steps in the image
        depth = 1 / np.linspace(1 / searched.nearest, 1 / searched.farthest, count)
        return np.asarray(estimate.position[i] + depth[:, None] * ray)

    def path(j: int, points: FloatArray) -> FloatArray:
        return project_points(estimate, camera, np.full(len(points), j), points)

    lengths = [np.nansum(np.linalg.norm(np.diff(path(j, on_ray(VERTICES)), axis=0), axis=1)) for j in others]
    points = on_ray(2 + int(max(lengths, default=0.0) / (2 * REACH_PX)))
    k = len(points)
    correlation, alike = np.zeros(k), np.zeros(k, dtype=np.int64)
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
        r = np.fmax(match.correlation, 0.0)  # 0 outside the photograph
        correlation += r
        alike += r >= START_CORRELATION
    # the search around each depth covers the next as well
    before, behind = (np.pad(correlation, 2)[shift : shift + k] for shift in (1, 3))
    peaks = np.flatnonzero(
        (correlation > before) & (correlation >= behind) & (alike >= min(MIN_ALIKE, len(others)))
    )
    order = peaks[np.argsort(-correlation[peaks], kind="stable")]
    best = int(np.argmax(correlation))
    return np.asarray(points[[best, *order[order != best][: MOST - 1]]])
