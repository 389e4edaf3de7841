"""The object of a plan: its points, their normals, and the surface that hides points.

A surface is sampled evenly: many random points of equal density are drawn, and each next chosen point is the
farthest from those chosen before.

A mesh hides a point if a triangle is between the point and the projection centre. The triangles are sorted
into a tree of boxes, which are halved along their longest side, so that a ray meets few of them.

Source: Gonzalez (1985), Theoretical Computer Science 38 (farthest point sampling); Moeller and Trumbore
(1997), J. Graphics Tools 2(1) (ray and triangle); Kay and Kajiya (1986), SIGGRAPH (ray and box).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import heapify, heappop, heappushpop

import numpy as np
from scipy.spatial import cKDTree

from sfm.files.csv_tables import MAX_NUMBER
from sfm.model.arguments import checked_arguments
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.products.geometry.tolerance import Mesh
from sfm.runtime.compiling import compiled

LEAF = 4  # triangles in a box that is not halved further
OFF_SURFACE = 1e-4  # of the size of the mesh: triangles closer to the point do not hide it
DEPTH = 64  # largest depth of nested boxes; halving by number needs log2 of the triangles
SEGMENTS = 48  # of a round shape: its facets are up to 0.2 % of the radius inside
PER_POINT = 20  # random points of a surface for each chosen point
SAME_VERTEX = 1e-9  # of the size of a mesh: closer corners are one
ON_LINE = 1e-9  # of the extent of points: they are on a line if their breadth is less
REACH = 1 + 1e-9  # factor on the radius of a search, so that rounding loses no point
SHAPES = {
    "box": ("LX", "LY", "LZ"),
    "cylinder": ("DIAMETER", "HEIGHT"),
    "plate": ("LX", "LY"),
    "wall": ("LENGTH", "HEIGHT"),
    "dish": ("DIAMETER", "DEPTH"),
}
"""sizes of each shape by its name; `shape_object` makes them"""


@dataclass(frozen=True)
class PlannedObject:
    """The object to be measured."""

    names: tuple[str, ...]  # of the points, (n,)
    xyz: FloatArray  # object unit, (n, 3)
    normals: FloatArray  # unit vectors of the directions that the points face; NaN if unknown, (n, 3)
    mesh: Mesh | None = None  # surface that hides points; None = nothing hides them

    @cached_property
    def tree(self) -> BoxTree | None:
        """The mesh sorted into boxes, None without a mesh."""
        return None if self.mesh is None else box_tree(self.mesh)

    @property
    def centre(self) -> FloatArray:
        """Middle of the box around the points, object unit, (3,)."""
        return np.asarray((self.xyz.min(axis=0) + self.xyz.max(axis=0)) / 2)

    @property
    def size(self) -> float:
        """Diagonal of the box around the points, object unit."""
        return float(np.linalg.norm(np.ptp(self.xyz, axis=0)))


@checked_arguments(xyz="n 3", normals="n 3")
def object_of_points(names: tuple[str, ...], xyz: FloatArray, normals: FloatArray | None) -> PlannedObject:
    """Return points as an object without a surface.

    Args:
        names: names of the points, (n,).
        xyz: coordinates, object unit, (n, 3).
        normals: directions that the points face, of any length, (n, 3); None if unknown.

    Raises:
        GeometryError: fewer than 3 points, a wrong number of names, all points on a line, too large
            coordinates, or a normal of length 0.
    """
    count = counted(len(xyz), "point")
    if len(xyz) < 3:
        raise GeometryError(f"object: {count}, needed 3 or more")
    if len(names) != len(xyz):
        raise GeometryError(f"object: {len(names)} names for {count}, needed one for each")
    _refuse_too_large(xyz)
    extent = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if extent[1] <= ON_LINE * extent[0]:
        raise GeometryError(f"object: {count} on one line, needed 3 or more that are not")
    if normals is None:
        return PlannedObject(names, xyz, np.full(xyz.shape, np.nan))
    length = np.linalg.norm(normals, axis=1)
    if (length == 0).any():
        raise GeometryError(f"object: point {names[int(np.argmax(length == 0))]} has a normal of length 0")
    return PlannedObject(names, xyz, normals / length[:, None])


@checked_arguments()
def object_of_mesh(
    mesh: Mesh, count: int, *, open_surface: bool = False, bare: BoolArray | None = None
) -> PlannedObject:
    """Return points spread evenly over a mesh, which hides points behind it.

    Args:
        mesh: triangles; those of a closed mesh are oriented outwards.
        count: number of points.
        open_surface: whether the mesh may have edges of only one triangle; it is seen from the side on which
            its triangles run counter-clockwise.
        bare: triangles without points, such as the bottom that an object rests on, (t,).

    Raises:
        GeometryError: no area, too large coordinates, fewer than 3 points, a mesh with holes that is not
            declared open, or triangles of inconsistent orientation.
    """
    if count < 3:
        raise GeometryError(f"object: {counted(count, 'point')} asked for, needed 3 or more")
    _refuse_too_large(mesh.vertices)
    edges = open_edges(mesh)
    if edges and not open_surface:
        raise GeometryError(
            f"mesh: {counted(edges, 'edge')} of one triangle only: it has holes, or is an open "
            "surface, through which points would be seen from behind; close it, or use --open-mesh"
        )
    ends = _edges(mesh)
    _, of, uses = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
    along = np.bincount(of.reshape(-1), weights=ends[:, 0] < ends[:, 1], minlength=len(uses))
    alike = int(((uses == 2) & (along != 1)).sum())  # both triangles run through them in one direction
    if alike:
        raise GeometryError(
            f"mesh: at {counted(alike, 'edge')} neighbouring triangles run in opposite directions, so "
            "that inside and outside are not known; turn its triangles to run alike"
        )
    corners = mesh.vertices[mesh.triangles]
    if not edges and np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        mesh = replace(mesh, triangles=mesh.triangles[:, ::-1])
        corners = mesh.vertices[mesh.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    share = np.where(bare, 0.0, area) if bare is not None else area
    if not share.sum() > 0:
        raise GeometryError("mesh: none of its triangles has an area")
    rng = np.random.default_rng(0)
    which = rng.choice(len(area), size=PER_POINT * count, p=share / share.sum())
    u, v = np.sqrt(rng.random(len(which))), rng.random(len(which))
    weight = np.stack([1 - u, u * (1 - v), u * v], axis=1)  # uniform over a triangle
    xyz = np.einsum("ka,kai->ki", weight, corners[which])
    kept = farthest_points(xyz, count)
    names = tuple(f"{k + 1}" for k in range(count))
    return PlannedObject(names, xyz[kept], (across / np.maximum(area, 1e-300)[:, None])[which[kept]], mesh)


@checked_arguments()
def shape_object(kind: str, sizes: tuple[float, ...], count: int) -> PlannedObject:
    """Return points spread evenly over a simple shape.

    Boxes and cylinders stand on Z = 0 about the Z axis, without points on the bottom. A plate lies in Z = 0
    and faces up. A wall stands on Z = 0 in the plane Y = 0 and faces -Y. A dish is a paraboloid that opens
    upwards, with its vertex at the origin.

    Args:
        kind: a name in SHAPES.
        sizes: sizes in the order of SHAPES, object unit.
        count: number of points.

    Raises:
        GeometryError: an unknown shape, a wrong number of sizes, or a size that is not positive.
    """
    if kind not in SHAPES:
        raise GeometryError(f"object: shape '{kind}', expected one of {', '.join(SHAPES)}")
    if len(sizes) != len(SHAPES[kind]) or not all(math.isfinite(s) and s > 0 for s in sizes):
        raise GeometryError(
            f"object: {kind} of {', '.join(f'{s:g}' for s in sizes) or 'no size'}, expected "
            f"{len(SHAPES[kind])} positive sizes {','.join(SHAPES[kind])}"
        )
    if kind == "box":
        mesh = _prism(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2 * sizes[:2], sizes[2])
    elif kind == "cylinder":
        mesh = _prism(sizes[0] / 2 * _circle(), sizes[1])
    elif kind == "plate":
        x, y = np.array(sizes) / 2
        mesh = _rectangle([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
    elif kind == "wall":
        x, z = sizes[0] / 2, sizes[1]
        mesh = _rectangle([[-x, 0, 0], [x, 0, 0], [x, 0, z], [-x, 0, z]])
    else:
        mesh = _dish(*sizes)
    closed = kind in ("box", "cylinder")
    corners = mesh.vertices[mesh.triangles]
    bare = (corners[:, :, 2] == 0).all(axis=1) if closed else None
    return object_of_mesh(mesh, count, open_surface=not closed, bare=bare)


def _refuse_too_large(xyz: FloatArray) -> None:
    """Raise GeometryError for coordinates too large for tables, whose squares and products overflow."""
    largest = float(np.abs(xyz).max(initial=0.0))
    if not largest <= MAX_NUMBER:
        raise GeometryError(f"object: a coordinate of {largest:g}, needed at most {MAX_NUMBER:g}; see --unit")


def open_edges(mesh: Mesh) -> int:
    """Return the number of edges that belong to only one triangle; coincident vertices count as one."""
    _, count = np.unique(np.sort(_edges(mesh), axis=1), axis=0, return_counts=True)
    return int((count == 1).sum())


def _edges(mesh: Mesh) -> IntArray:
    """Return the directed edges of the triangles, with coincident vertices merged, (3 t, 2)."""
    step = SAME_VERTEX * max(float(np.abs(np.ptp(mesh.vertices, axis=0)).max()), 1e-300)
    _, same = np.unique(np.round(mesh.vertices / step), axis=0, return_inverse=True)
    t = same.reshape(-1)[mesh.triangles]
    t = t[(t[:, 0] != t[:, 1]) & (t[:, 1] != t[:, 2]) & (t[:, 2] != t[:, 0])]
    return np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])


def farthest_points(xyz: FloatArray, count: int) -> IntArray:
    """Return indices of points, each the farthest from those before, (count,); all points if there are fewer.

    The first is the nearest to the middle. A new point only changes the distances of points that are closer
    to it than it is to the points before. Distances only decrease, so a distance in the queue is never too
    short.

    Args:
        xyz: points, (n, 3).
        count: number of points to choose.
    """
    count = min(count, len(xyz))
    chosen = np.empty(count, dtype=np.int64)
    chosen[0] = np.argmin(((xyz - xyz.mean(axis=0)) ** 2).sum(axis=1))
    nearest = ((xyz - xyz[chosen[0]]) ** 2).sum(axis=1)
    tree = cKDTree(xyz)
    queue = [(-d, j) for j, d in enumerate(nearest.tolist()) if j != chosen[0]]
    heapify(queue)
    for k in range(1, count):
        d, j = heappop(queue)
        while -d > nearest[j]:
            d, j = heappushpop(queue, (-float(nearest[j]), j))
        chosen[k] = j
        near = np.array(tree.query_ball_point(xyz[j], np.sqrt(nearest[j]) * REACH), dtype=np.int64)
        nearest[near] = np.minimum(nearest[near], ((xyz[near] - xyz[j]) ** 2).sum(axis=1))
    return chosen


def _circle() -> FloatArray:
    angle = 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _rectangle(corners: list[list[float]]) -> Mesh:
    return Mesh(np.array(corners, dtype=float), np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int64))


def _prism(outline: FloatArray, height: float) -> Mesh:
    """Return a closed prism on Z = 0 over a convex, counter-clockwise outline, (k, 2)."""
    k = len(outline)
    low = np.column_stack([outline, np.zeros(k)])
    vertices = np.concatenate([low, low + np.array([0.0, 0.0, height])])
    i, j = np.arange(k), (np.arange(k) + 1) % k
    fan = np.arange(1, k - 1)
    triangles = [
        np.column_stack([i, j, j + k]),
        np.column_stack([i, j + k, i + k]),
        np.column_stack([np.zeros(k - 2, dtype=np.int64), fan + 1, fan]),
        np.column_stack([np.full(k - 2, k), fan + k, fan + 1 + k]),
    ]
    return Mesh(vertices, np.concatenate(triangles).astype(np.int64))


def _dish(diameter: float, depth: float) -> Mesh:
    """Return the paraboloid z = depth (r / R)^2, facing up."""
    rings = SEGMENTS // 4
    radius = np.arange(1, rings + 1) / rings
    flat = (radius[:, None, None] * _circle()[None] * diameter / 2).reshape(-1, 2)
    height = np.repeat(depth * radius**2, SEGMENTS)
    vertices = np.concatenate([np.zeros((1, 3)), np.column_stack([flat, height])])
    i, j = np.arange(SEGMENTS), (np.arange(SEGMENTS) + 1) % SEGMENTS
    triangles = [np.column_stack([np.zeros(SEGMENTS, dtype=np.int64), 1 + i, 1 + j])]
    for r in range(rings - 1):
        a, b = 1 + r * SEGMENTS, 1 + (r + 1) * SEGMENTS
        triangles += [np.column_stack([a + i, b + i, b + j]), np.column_stack([a + i, b + j, a + j])]
    return Mesh(vertices, np.concatenate(triangles).astype(np.int64))


@dataclass(frozen=True)
class BoxTree:
    """A mesh sorted into boxes."""

    low: FloatArray  # corners of the boxes, object unit, (b, 3)
    high: FloatArray  # (b, 3)
    first: IntArray  # first triangle of a leaf, or the first of its two inner boxes, (b,)
    count: IntArray  # number of triangles of a leaf, 0 for a box with inner boxes, (b,)
    corners: FloatArray  # of the triangles in sorted order, (t, 3, 3)
    tolerance: float  # triangles within this distance of a point do not hide it, object unit


@checked_arguments()
def box_tree(mesh: Mesh) -> BoxTree:
    """Return a mesh sorted into boxes."""
    corners = mesh.vertices[mesh.triangles]
    low, high, centre = corners.min(axis=1), corners.max(axis=1), corners.mean(axis=1)
    order = np.arange(len(corners))
    boxes: list[tuple[FloatArray, FloatArray, int, int]] = []
    todo = [(0, len(corners), 0)]  # first triangle, end, and index of their box
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
    """Return the points that a mesh hides from a projection centre, (n,).

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
