"""Epipolar paths: where a point of one photograph may be in another, distortion and all."""

from __future__ import annotations

import numpy as np

from sfm.camera import project, tangents_from_pixel
from sfm.conventions import FloatArray, IntArray
from sfm.network import Estimate

VERTICES = 65  # of a path; between them distortion bends it by less than 0.1 px on ordinary lenses


def epipolar_paths(
    estimate: Estimate,
    camera: IntArray,
    left: int,
    right: int,
    xy: FloatArray,
    *,
    nearest: float,
    farthest: float,
) -> tuple[FloatArray, ...]:
    """Return the pictures, in the right photograph, of the rays through points of the left one.

    Args:
        estimate: orientation of both photographs.
        camera: index of the camera of each photograph, (m,).
        left, right: the photographs.
        xy: points in the left photograph, px, (k, 2).
        nearest, farthest: depths along the axis of the left camera between which the points are, object unit.

    Returns:
        k polygons (n, 2) in px, from near to far; points behind the right camera are left out. Use them with
        `ncc.match_along_line`.

    Source: Kraus (2007), sec. 4.3: an epipolar line is the picture of the other photograph's ray.
    """
    uv = tangents_from_pixel(estimate.cameras[camera[left]], xy)
    direction = np.column_stack([uv, -np.ones(len(uv))]) @ estimate.rotation[left].T
    # equal steps in 1 / depth are about equal steps in the picture
    depth = 1.0 / np.linspace(1.0 / nearest, 1.0 / farthest, VERTICES)
    paths = []
    for ray in direction:
        points = estimate.position[left] + depth[:, None] * ray
        path = project(
            estimate.cameras[camera[right]], estimate.position[right], estimate.rotation[right], points
        )
        paths.append(path[np.isfinite(path).all(axis=1)])
    return tuple(paths)
