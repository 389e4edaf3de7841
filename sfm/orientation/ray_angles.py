"""Angles at which the rays of object points meet."""

from __future__ import annotations

import numpy as np

from sfm.conventions import BoolArray, FloatArray
from sfm.network import Estimate, Network

MAX_PAIRS = 4_000_000  # of rays that are compared at a time


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
