"""Pictures of object points in oriented photographs, and how they move with the points."""

from __future__ import annotations

import numpy as np

from sfm.camera import pixel_jacobian, project
from sfm.conventions import FloatArray, IntArray
from sfm.network import Estimate, rows_of


def facing_warps(
    estimate: Estimate, camera: IntArray, image: IntArray, ref: IntArray, points: FloatArray
) -> FloatArray:
    """Return d (picture) / d (picture in the reference) of a surface that faces the reference, (k, 2, 2).

    Args:
        estimate: interior and exterior orientation of all photographs.
        camera: index of the camera of each photograph, (m,).
        image: photograph of each row, (k,).
        ref: the row of the reference of each row, (k,).
        points: the object point of each row, (k, 3).
    """
    in_object = derivatives(estimate, camera, image, points)
    R = estimate.rotation[image[ref]]
    along = in_object[ref] @ R[:, :, :2]  # pictures of the two axes of the reference, in the reference
    across = in_object @ R[:, :, :2]
    return np.asarray(across @ np.linalg.inv(along))


def derivatives(estimate: Estimate, camera: IntArray, image: IntArray, points: FloatArray) -> FloatArray:
    """Return d (x, y) / d X of each image point, px per object unit, (k, 2, 3)."""
    out = np.full((len(image), 2, 3), np.nan)
    for i, rows in enumerate(rows_of(image, len(estimate.position))):
        if not len(rows):
            continue
        lens, R = estimate.cameras[camera[i]], estimate.rotation[i]
        UVW = (points[rows] - estimate.position[i]) @ R
        u, v = -UVW[:, 0] / UVW[:, 2], -UVW[:, 1] / UVW[:, 2]
        in_uv = np.stack(
            [-(R[:, a] + t[:, None] * R[:, 2]) / UVW[:, 2:] for a, t in enumerate((u, v))], axis=1
        )
        xy = project(lens, estimate.position[i], R, points[rows])
        out[rows] = pixel_jacobian(lens, xy) @ in_uv
    return out


def pictures_of(estimate: Estimate, camera: IntArray, image: IntArray, points: FloatArray) -> FloatArray:
    """Return the picture of one object point for each row, px, (k, 2)."""
    out = np.full((len(image), 2), np.nan)
    for i, rows in enumerate(rows_of(image, len(estimate.position))):
        if not len(rows):
            continue
        lens = estimate.cameras[camera[i]]
        out[rows] = project(lens, estimate.position[i], estimate.rotation[i], points[rows])
    return out
