"""Planes of the surface at places of an oriented photograph, from the object points that it sees."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from sfm.camera import tangents_from_pixel
from sfm.conventions import FloatArray, IntArray
from sfm.network import Estimate

NEIGHBOURS = 6  # object points whose plane a place is put on
NEAREST, FARTHEST = 0.5, 2.0  # of a plane, in the depths of the nearest and the farthest object point
FLATTEST = 1e-6  # part of the squares of neighbours' tangents that is added where they are in a row


def planes_at(
    estimate: Estimate, camera: IntArray, i: int, xy: FloatArray, point: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Put places of a photograph on the planes through the object points around them.

    Over a plane the inverse of the depth is linear in the tangents: 1 / t = a u + b v + c.

    Args:
        estimate: orientation and object points.
        camera: index of the camera of each photograph, (m,).
        i: the photograph.
        xy: places, px, (k, 2).
        point: object points that it sees.

    Returns:
        Object points of the places, and unit normals of the surface there, towards the photograph, both
        (k, 3); NaN where the neighbours tell no plane in front of the photograph.
    """
    lens, X0, R = estimate.cameras[camera[i]], estimate.position[i], estimate.rotation[i]
    points, normal = np.full((len(xy), 3), np.nan), np.full((len(xy), 3), np.nan)
    UVW = (estimate.points[point] - X0) @ R
    UVW = UVW[UVW[:, 2] < 0]
    uv = tangents_from_pixel(lens, xy)
    rows = np.flatnonzero(np.isfinite(uv).all(axis=1))
    if len(UVW) < NEIGHBOURS or not len(rows):
        return points, normal
    known, inverse, uv = -UVW[:, :2] / UVW[:, 2:], -1 / UVW[:, 2], uv[rows]
    near = cKDTree(known).query(uv, k=NEIGHBOURS)[1]
    away = known[near] - uv[:, None]
    A = np.concatenate([away, np.ones((*near.shape, 1))], axis=2)
    N = np.einsum("kij,kil->kjl", A, A)
    N += FLATTEST * np.einsum("kij,kij->k", away, away)[:, None, None] * np.diag([1.0, 1.0, 0.0])
    plane = np.linalg.solve(N, np.einsum("kij,ki->kj", A, inverse[near])[:, :, None])[:, :, 0]
    value = plane[:, 2].copy()  # inverse of the depth at the place
    plane[:, 2] -= np.sum(plane[:, :2] * uv, axis=1)
    inside = (value > inverse.min() / FARTHEST) & (value < inverse.max() / NEAREST)
    rows, uv, value, plane = rows[inside], uv[inside], value[inside], plane[inside]
    points[rows] = X0 + (np.column_stack([uv, -np.ones(len(uv))]) / value[:, None]) @ R.T
    across = -(plane * [1.0, 1.0, -1.0]) @ R.T
    normal[rows] = across / np.linalg.norm(across, axis=1, keepdims=True)
    return points, normal
