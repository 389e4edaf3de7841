"""Points hidden by a mesh: is a triangle between a point and a projection centre?

The triangles are sorted into a tree of boxes, halved along their longest side, so that a ray meets few.

Source: Moeller and Trumbore (1997), J. Graphics Tools 2(1) (ray and triangle); Kay and Kajiya (1986),
SIGGRAPH (ray and box).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.geometry.mesh import Mesh
from sfm.kernels.compiling import compiled

LEAF = 4  # triangles in a box that is not halved any more
OFF_SURFACE = 1e-4  # of the size of the mesh: what is nearer to the point does not hide it
DEPTH = 64  # boxes inside one another at most; halving by count needs log2 of the triangles


@dataclass(frozen=True)
class BoxTree:
    """A mesh sorted into boxes."""

    low: FloatArray  # corners of the boxes, object unit, (b, 3)
    high: FloatArray  # (b, 3)
    first: IntArray  # first triangle of a leaf, or the first of two boxes inside, (b,)
    count: IntArray  # triangles of a leaf, 0 where there are boxes inside, (b,)
    corners: FloatArray  # of the triangles in their order, (t, 3, 3)
    tolerance: float  # distance from a point within which nothing hides it, object unit


@checked_arguments()
def box_tree(mesh: Mesh) -> BoxTree:
    """Return a mesh sorted into boxes."""
    corners = mesh.vertices[mesh.triangles]
    low, high, centre = corners.min(axis=1), corners.max(axis=1), corners.mean(axis=1)
    order = np.arange(len(corners))
    boxes: list[tuple[FloatArray, FloatArray, int, int]] = []
    todo = [(0, len(corners), 0)]  # triangles from, to, and the place of their box
    boxes.append((np.zeros(3), np.zeros(3), 0, 0))
    while todo:
        start, end, place = todo.pop()
        inside_box = order[start:end]
        a, b = low[inside_box].min(axis=0), high[inside_box].max(axis=0)
        if end - start <= LEAF:
            boxes[place] = (a, b, start, end - start)
            continue
        axis = int(np.argmax(np.ptp(centre[inside_box], axis=0)))
        middle = (end - start) // 2
        order[start:end] = inside_box[np.argpartition(centre[inside_box, axis], middle)]
        inside = len(boxes)
        boxes[place] = (a, b, inside, 0)
        boxes += [(a, b, 0, 0), (a, b, 0, 0)]
        todo += [(start, start + middle, inside), (start + middle, end, inside + 1)]
    size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    return BoxTree(
        np.array([box[0] for box in boxes]),
        np.array([box[1] for box in boxes]),
        np.array([box[2] for box in boxes], dtype=np.int64),
        np.array([box[3] for box in boxes], dtype=np.int64),
        np.ascontiguousarray(corners[order]),
        OFF_SURFACE * size,
    )


@checked_arguments(position="3", xyz="n 3")
def hidden_points(tree: BoxTree, position: FloatArray, xyz: FloatArray) -> BoolArray:
    """Return which points a mesh hides from a projection centre, (n,).

    Args:
        tree: the mesh.
        position: projection centre, object unit, (3,).
        xyz: points, on the mesh or off it, (n, 3).

    Source: Moeller and Trumbore (1997), J. Graphics Tools 2(1).
    """
    place = np.ascontiguousarray(position, dtype=float)
    points = np.ascontiguousarray(xyz, dtype=float)
    return _hidden(tree.low, tree.high, tree.first, tree.count, tree.corners, tree.tolerance, place, points)


@compiled
def _hidden(
    low: FloatArray,
    high: FloatArray,
    first: IntArray,
    count: IntArray,
    corners: FloatArray,
    tolerance: float,
    position: FloatArray,
    xyz: FloatArray,
) -> BoolArray:
    out = np.zeros(len(xyz), dtype=np.bool_)
    stack = np.empty(DEPTH + 2, dtype=np.int64)
    ray, e, f, p, q, s = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(xyz)):
        length = 0.0
        for i in range(3):
            ray[i] = position[i] - xyz[k, i]
            length += ray[i] ** 2
        nearest = tolerance / np.sqrt(length)
        depth = 1
        stack[0] = 0
        while depth > 0 and not out[k]:
            depth -= 1
            box = stack[depth]
            near, far = nearest, 1.0
            for i in range(3):
                if ray[i] == 0.0:
                    if xyz[k, i] < low[box, i] or xyz[k, i] > high[box, i]:
                        far = -1.0
                    continue
                a, b = (low[box, i] - xyz[k, i]) / ray[i], (high[box, i] - xyz[k, i]) / ray[i]
                near, far = max(near, min(a, b)), min(far, max(a, b))
            if near > far:
                continue
            if count[box] == 0:
                stack[depth], stack[depth + 1] = first[box], first[box] + 1
                depth += 2
                continue
            for t in range(first[box], first[box] + count[box]):
                for i in range(3):
                    e[i] = corners[t, 1, i] - corners[t, 0, i]
                    f[i] = corners[t, 2, i] - corners[t, 0, i]
                    s[i] = xyz[k, i] - corners[t, 0, i]
                p[0] = ray[1] * f[2] - ray[2] * f[1]
                p[1] = ray[2] * f[0] - ray[0] * f[2]
                p[2] = ray[0] * f[1] - ray[1] * f[0]
                det = e[0] * p[0] + e[1] * p[1] + e[2] * p[2]
                if det == 0.0:
                    continue
                u = (s[0] * p[0] + s[1] * p[1] + s[2] * p[2]) / det
                if u < 0.0 or u > 1.0:
                    continue
                q[0] = s[1] * e[2] - s[2] * e[1]
                q[1] = s[2] * e[0] - s[0] * e[2]
                q[2] = s[0] * e[1] - s[1] * e[0]
                v = (ray[0] * q[0] + ray[1] * q[1] + ray[2] * q[2]) / det
                if v < 0.0 or u + v > 1.0:
                    continue
                at = (f[0] * q[0] + f[1] * q[1] + f[2] * q[2]) / det
                if nearest < at < 1.0:
                    out[k] = True
                    break
    return out
