"""Tolerances: deviations from nominal points, a mesh or a shape, and decisions on conformity.

A value conforms if it is inside the limits by its expanded uncertainty U = k sigma. It does not conform if it
is outside the limits by U. In between, the decision is open.

Source: ISO 14253-1:2017, Decision rules for verifying conformity or nonconformity with specifications;
Ericson (2005), Real-Time Collision Detection, sec. 5.1.5 (nearest point of a triangle); Baerentzen and Aanaes
(2005), IEEE TVCG 11(3) (the side of an edge or corner, by the mean of the normals about it).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sfm.model.arguments import check_indices, checked_arguments, checked_fields
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.model.network import indices_of
from sfm.products.geometry.alignment import Nominal
from sfm.products.geometry.measured import MeasuredPoints
from sfm.products.geometry.shapes.fit import ShapeFit

TIE = 1e-9  # difference of equal distances, relative to the size of the mesh
ON_SURFACE = 1e-12  # distance, relative to the size of the mesh, below which the normal is the triangle's
IN, OUT, UNDECIDED, UNKNOWN = "in", "out", "undecided", "not known"
DECISIONS = (IN, UNDECIDED, OUT, UNKNOWN)
COVERAGE = 2.0  # k of the expanded uncertainty, for about 95 %


@checked_fields
@dataclass(frozen=True)
class Tolerance:
    """Limits of deviations, and the certainty with which they must be kept."""

    name: str
    lower: float = -np.inf  # smallest deviation, object unit
    upper: float = np.inf  # largest deviation, object unit
    coverage: float = COVERAGE  # k of the expanded uncertainty U = k sigma


@dataclass(frozen=True)
class Deviations:
    """Deviations of points with their limits."""

    name: str
    against: str  # name of the reference
    points: IntArray  # indices, (m,)
    value: FloatArray  # object unit, (m,)
    sigma: FloatArray  # object unit; NaN where unknown, (m,)
    vector: FloatArray  # measured minus nearest nominal point, object unit, (m, 3)
    lower: float  # limits, object unit
    upper: float
    coverage: float  # k
    decision: tuple[str, ...]  # for each point: in | out | undecided | not known
    missing: tuple[str, ...] = ()  # nominal points that were not measured

    def count(self, decision: str) -> int:
        """Return the number of points with a decision."""
        return self.decision.count(decision)


@checked_arguments()
def deviations_from_points(
    points: MeasuredPoints,
    nominal: Nominal,
    tolerance: Tolerance,
    *,
    chosen: IntArray | None = None,
) -> Deviations:
    """Return the distances of measured points from nominal points of the same names.

    Args:
        points: points aligned to the system of the nominal points.
        nominal: nominal points; their covariance is taken into account.
        tolerance: its largest distance; distances have no lower limit.
        chosen: indices of the points to judge; all with a nominal point if not given.

    Raises:
        GeometryError: no nominal point was measured, or the tolerance has a lower limit.

    Source: ISO 14253-1:2017 for the decisions; law of propagation of covariances.
    """
    if tolerance.lower > -np.inf:
        raise GeometryError(
            f"tolerance {tolerance.name}: lower = {tolerance.lower:g}, distances have no lower limit"
        )
    if chosen is not None:
        check_indices("deviations_from_points: chosen", chosen, len(points.names))
    wanted = set(points.names if chosen is None else [points.names[j] for j in chosen])
    common = [name for name in nominal.names if name in wanted]
    if not common:
        raise GeometryError(f"tolerance {tolerance.name}: no nominal point was measured")
    rows = points.indices(common)
    of_nominal = indices_of(nominal.names, common)
    d = points.xyz[rows] - nominal.xyz[of_nominal]
    Q = points.blocks[rows]
    if nominal.covariance is not None:
        Q = Q + nominal.covariance[of_nominal]
    length = np.linalg.norm(d, axis=1)
    u = np.divide(d, length[:, None], out=np.zeros_like(d), where=length[:, None] > 0)
    sigma = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", u, Q, u), 0.0))
    missing = tuple(name for name in nominal.names if name not in points.names)
    decision = decide(length, sigma, -np.inf, tolerance.upper, tolerance.coverage)
    return Deviations(
        tolerance.name,
        "nominal points",
        rows,
        length,
        sigma,
        d,
        0.0,
        tolerance.upper,
        tolerance.coverage,
        decision,
        missing,
    )


@checked_arguments()
def deviations_from_mesh(
    points: MeasuredPoints,
    mesh: Mesh,
    chosen: IntArray,
    tolerance: Tolerance,
    *,
    against: str,
    offset: float = 0.0,
) -> Deviations:
    """Return the signed distances of points from a mesh, positive outside.

    Args:
        points: points aligned to the system of the mesh.
        mesh: nominal surface.
        chosen: indices of the points to judge.
        tolerance: limits of the signed distances.
        against: name of the mesh.
        offset: distance of the targets from the surface along its normal, object unit.

    Raises:
        GeometryError: the mesh has no triangle with an area.

    Source: ISO 14253-1:2017 for the decisions; law of propagation of covariances.
    """
    check_indices("deviations_from_mesh: chosen", chosen, len(points.names))
    nearest = distances_from_mesh(points.xyz[chosen], mesh)
    value = nearest.distance - offset
    variance = np.einsum("ni,nij,nj->n", nearest.normal, points.blocks[chosen], nearest.normal)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    return _judged(tolerance, against, chosen, value, sigma, value[:, None] * nearest.normal)


@checked_arguments()
def deviations_from_shape(
    points: MeasuredPoints,
    fit: ShapeFit,
    tolerance: Tolerance,
) -> Deviations:
    """Return the distances of points from a shape fitted to them, with the uncertainty of both.

    Args:
        points: points that the shape was fitted to.
        fit: the fitted shape.
        tolerance: limits of the signed distances.

    Source: ISO 14253-1:2017 for the decisions; law of propagation of covariances.
    """
    _, normals, _ = fit.shape.design(points.xyz[fit.points])
    vector = np.einsum("nc,nci->ni", fit.distances, normals)
    against = f"{fit.shape.kind.name} {fit.name}"
    return _judged(tolerance, against, fit.points, fit.deviation, fit.sigma, vector)


def _judged(
    tolerance: Tolerance,
    against: str,
    points: IntArray,
    value: FloatArray,
    sigma: FloatArray,
    vector: FloatArray,
) -> Deviations:
    """Return deviations with the decision on each."""
    lower, upper, coverage = tolerance.lower, tolerance.upper, tolerance.coverage
    decision = decide(value, sigma, lower, upper, coverage)
    return Deviations(
        tolerance.name,
        against,
        points,
        value,
        sigma,
        vector,
        lower,
        upper,
        coverage,
        decision,
    )


@checked_arguments(value="n", sigma="n")
def decide(
    value: FloatArray, sigma: FloatArray, lower: float, upper: float, coverage: float
) -> tuple[str, ...]:
    """Return for each value whether it is proven to be in or out of tolerance.

    Args:
        value: measured values, (m,).
        sigma: standard deviations of the values; NaN where unknown, (m,).
        lower: lower limit, -infinity for none.
        upper: upper limit.
        coverage: k of the expanded uncertainty U = k sigma.

    Source: ISO 14253-1:2017, secs. 4 to 6.
    """
    U = coverage * np.asarray(sigma, dtype=float)
    value = np.asarray(value, dtype=float)
    known = np.isfinite(U) & np.isfinite(value)
    inside = (value - U >= lower) & (value + U <= upper)
    outside = (value + U < lower) | (value - U > upper)
    return tuple(
        UNKNOWN if not k else IN if a else OUT if b else UNDECIDED
        for k, a, b in zip(known, inside, outside, strict=True)
    )


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
        mesh: mesh in the same system.

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
    for value in np.unique(level):
        rows = np.flatnonzero(level == value)
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
    """Return the point of each triangle (t, 3, 3) nearest to a given point, (t, 3)."""
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
