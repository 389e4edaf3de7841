"""Distances of points from a mesh of triangles.

Source: Ericson (2005), Real-Time Collision Detection, sec. 5.1.5 (nearest point of a triangle); Baerentzen
and Aanaes (2005), IEEE TVCG 11(3) (the side of an edge or corner, by the mean of the normals about it).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sfm.conventions import FloatArray, IntArray
from sfm.errors import GeometryError

TIE = 1e-9  # of distances that are one, over the size of the mesh
ON_SURFACE = 1e-12  # distance over the size of the mesh at which the normal is the triangle's


@dataclass(frozen=True)
class Mesh:
    """Triangles, counter-clockwise as seen from outside."""

    vertices: FloatArray  # object unit, (v, 3)
    triangles: IntArray  # indices of vertices, (t, 3)


@dataclass(frozen=True)
class MeshDistances:
    """Nearest points of a mesh."""

    distance: FloatArray  # signed, positive outside, object unit, (n,)
    normal: FloatArray  # derivative of the distance by the point, (n, 3)


def distances_from_mesh(xyz: FloatArray, mesh: Mesh) -> MeshDistances:
    """Return the signed distances of points from a mesh.

    Args:
        xyz: points, object unit, (n, 3).
        mesh: in the same system.

    Raises:
        GeometryError: no triangle has an area.
    """
    corners = mesh.vertices[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    kept = area > 1e-14 * max(float(area.max(initial=0.0)), 1e-300)
    if not kept.any():
        raise GeometryError("mesh: none of its triangles has an area")
    corners, normals = corners[kept], normals[kept] / area[kept, None]
    size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    centre = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    level = np.floor(np.log2(radius / radius.max())).astype(np.int64)
    trees = []
    bound = np.full(len(xyz), np.inf)
    for one in np.unique(level):
        rows = np.flatnonzero(level == one)
        tree = cKDTree(centre[rows])
        trees.append((rows, tree, float(radius[rows].max())))
        bound = np.minimum(bound, tree.query(xyz)[0])
    distance, normal = np.empty(len(xyz)), np.empty((len(xyz), 3))
    for i, point in enumerate(xyz):
        near = [rows[tree.query_ball_point(point, bound[i] + r + TIE * size)] for rows, tree, r in trees]
        triangles = np.concatenate(near)
        foot = _feet(point, corners[triangles])
        length = np.linalg.norm(point - foot, axis=1)
        best = int(np.argmin(length))
        same = np.linalg.norm(foot - foot[best], axis=1) <= TIE * size
        mean = normals[triangles[same]].mean(axis=0)
        d = point - foot[best]
        if length[best] <= ON_SURFACE * size:
            distance[i] = 0.0
            normal[i] = mean / max(float(np.linalg.norm(mean)), 1e-300)
        else:
            side = 1.0 if d @ mean >= 0 else -1.0
            distance[i], normal[i] = side * length[best], side * d / length[best]
    return MeshDistances(distance, normal)


def _feet(p: FloatArray, corners: FloatArray) -> FloatArray:
    """Return the nearest point of each triangle (t, 3, 3) to a point, (t, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac = b - a, c - a
    n = np.cross(ab, ac)
    square = (n * n).sum(axis=1)
    ap = p - a
    v = (np.cross(ap, ac) * n).sum(axis=1) / square
    w = (np.cross(ab, ap) * n).sum(axis=1) / square
    inside = (v >= 0) & (w >= 0) & (v + w <= 1)
    plane = a + v[:, None] * ab + w[:, None] * ac
    on_edges = np.stack([_on_edge(p, a, b), _on_edge(p, b, c), _on_edge(p, c, a)], axis=1)
    nearest = np.argmin(np.linalg.norm(on_edges - p, axis=2), axis=1)
    return np.asarray(np.where(inside[:, None], plane, on_edges[np.arange(len(a)), nearest]))


def _on_edge(p: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    ab = b - a
    t = ((p - a) * ab).sum(axis=1) / np.maximum((ab * ab).sum(axis=1), 1e-300)
    return np.asarray(a + np.clip(t, 0.0, 1.0)[:, None] * ab)
