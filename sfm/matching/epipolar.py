"""Epipolar geometry of two oriented photographs: essential matrices, and the epipolar lines of points."""

from __future__ import annotations

import numpy as np

from sfm.model.arguments import check_indices, checked_arguments
from sfm.model.camera import project, ray_directions, tangents_from_pixel
from sfm.model.conventions import FloatArray, IntArray, skew
from sfm.model.estimate import Estimate
from sfm.runtime.compiling import compiled

VERTICES = 65  # of a path; between two of them ordinary distortion bends it by less than 0.1 px


def essential_matrices(position: FloatArray, rotation: FloatArray, pairs: IntArray) -> FloatArray:
    """Return E of pairs of photographs; q_j^T E q_i = 0 holds for the image vectors of one point.

    Args:
        position: projection centres X0, object unit, (m, 3).
        rotation: R of each photograph, image to object axes, (m, 3, 3).
        pairs: indices i, j of the photographs, (p, 2).

    Returns:
        E = M_j [b]x R_i with the unit base b from i to j, shape (p, 3, 3); image vectors are
        q = (u, v, -1) with the tangents u = -U/W, v = -V/W.

    Source: Kraus (2007), sec. 4.3; Hartley and Zisserman (2004), sec. 9.6.
    """
    i, j = np.asarray(pairs).T
    base = position[j] - position[i]
    length = np.linalg.norm(base, axis=1, keepdims=True)
    unit = base / np.where(length > 0, length, 1.0)
    return np.asarray(np.swapaxes(rotation[j], 1, 2) @ skew(unit) @ rotation[i])


@checked_arguments(camera="m", xy="k 2")
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
    """Return the images in the right photograph of the rays through points of the left one.

    Args:
        estimate: orientation of both photographs.
        camera: index of the camera of each photograph, (m,).
        left: index of the photograph of the points.
        right: index of the other photograph.
        xy: points in the left photograph, px, (k, 2).
        nearest: smallest depth of the points along the axis of the left camera, object unit.
        farthest: largest depth, object unit.

    Returns:
        k polygons (n, 2) in px, from near to far; points behind the right camera are omitted.
        `sfm.textbook.match_along_line` accepts them.

    Raises:
        GeometryError: the index of a photograph or camera does not exist.

    Source: Kraus (2007), sec. 4.3: an epipolar line is the image of the ray of the other photograph.
    """
    check_indices(
        "epipolar_paths: left, right", np.array([left, right]), min(len(camera), len(estimate.position))
    )
    check_indices("epipolar_paths: camera", camera, len(estimate.cameras))
    uv = tangents_from_pixel(estimate.cameras[camera[left]], xy)
    direction = ray_directions(uv, estimate.rotation[left])
    # equal steps in 1 / depth are nearly equal steps in the image
    depth = 1.0 / np.linspace(1.0 / nearest, 1.0 / farthest, VERTICES)
    paths = []
    for ray in direction:
        points = estimate.position[left] + depth[:, None] * ray
        path = project(
            estimate.cameras[camera[right]], estimate.position[right], estimate.rotation[right], points
        )
        paths.append(path[np.isfinite(path).all(axis=1)])
    return tuple(paths)


@compiled
def epipolar_distance(E: FloatArray, ui: float, vi: float, uj: float, vj: float) -> float:
    """Return the distance of (uj, vj) from the epipolar line of (ui, vi), tangents; inf if there is none."""
    l0 = E[0, 0] * ui + E[0, 1] * vi - E[0, 2]
    l1 = E[1, 0] * ui + E[1, 1] * vi - E[1, 2]
    l2 = E[2, 0] * ui + E[2, 1] * vi - E[2, 2]
    slope = np.sqrt(l0 * l0 + l1 * l1)
    if slope < 1e-15:
        return np.inf
    distance: float = abs(l0 * uj + l1 * vj - l2) / slope
    return distance
