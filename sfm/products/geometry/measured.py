"""Measured points and functions of their coordinates, with joint covariance.

A `Function` keeps its values and their derivatives J by the coordinates. So its covariance, and the joint
covariance of several functions, is J Q J'. In a free network only values that do not depend on the datum have
a meaningful covariance. For these J G = 0, with G the shifts, rotations and, without a scale, the scale of
the network.

Distances, angles and heights above a plane take functions of coordinates and return one. So they propagate
the covariance of points, and also of centres, axes and planes fitted to points, in any combination.

Source: Baarda (1973), S-transformations and criterion matrices; Caspary (2000), Concepts of network and
deformation analysis, sec. 6 (estimable functions); Luhmann et al. (2020), Close-Range Photogrammetry and 3D
Imaging, sec. 2.4 (propagation of covariances) and 6.6 (hidden-point devices).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.model.network import index_of, indices_of
from sfm.model.similarity import similarity_motions
from sfm.model.solution import Solution

# Change with a motion, relative to the largest possible change for derivatives of this size, below which
# values count as invariant. Derivatives of a fit are taken at adjusted points; residuals of 1 % of the size
# still pass.
INVARIANT = 1e-2
OWN_DATUM = ("control", "aligned")  # datums in which coordinates themselves are meaningful


@dataclass(frozen=True)
class Function:
    """Values computed from coordinates, with their derivatives."""

    value: FloatArray  # (q,)
    points: IntArray  # indices of the points that it depends on, (m,)
    jacobian: FloatArray  # derivatives by X, Y, Z of these points, (q, 3 m)

    def __getitem__(self, rows: slice | IntArray) -> Function:
        return Function(self.value[rows], self.points, self.jacobian[rows])

    def times(self, matrix: FloatArray, value: FloatArray) -> Function:
        """Return a function of these values.

        Args:
            matrix: derivatives of the new values by these values, (r, q).
            value: new values, (r,).
        """
        return Function(np.atleast_1d(value), self.points, matrix @ self.jacobian)


@dataclass(frozen=True)
class MeasuredPoints:
    """Points of a result, or of any other source of coordinates."""

    names: tuple[str, ...]  # (n,)
    xyz: FloatArray  # object unit, (n, 3)
    covariance: FloatArray | None  # joint (3 n, 3 n), or of each point (n, 3, 3), object unit^2
    unit: str = ""  # name of the unit of lengths
    datum: str = ""  # free | minimal | control | aligned; empty where unknown
    has_scale: bool = True  # whether lengths are in a known unit
    redundancy: int | None = None  # redundancy of the variances; None if they count as known
    sample: IntArray | None = None  # points with a joint covariance if `covariance` is of each point, (s,)
    sample_covariance: FloatArray | None = None  # joint covariance of these, object unit^2, (3 s, 3 s)

    @property
    def correlated(self) -> bool:
        """Whether the covariance between points is known."""
        return self.covariance is not None and self.covariance.ndim == 2

    def correlated_among(self, points: IntArray) -> bool:
        """Return whether the covariance between some points, given by index, is known."""
        return self.correlated or bool(self.sample is not None and np.isin(points, self.sample).all())

    @property
    def blocks(self) -> FloatArray:
        """Covariance of each point, NaN where unknown, (n, 3, 3)."""
        n = len(self.names)
        if self.covariance is None:
            return np.full((n, 3, 3), np.nan)
        if self.covariance.ndim == 3:
            return self.covariance
        return np.stack([self.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(n)])

    def index(self, name: str) -> int:
        """Return the index of a point; UnknownNameError if no point has that name."""
        return index_of(self.names, name, "point")

    def indices(self, names: Sequence[str]) -> IntArray:
        """Return the indices of points, (k,); UnknownNameError if no point has one of the names."""
        return indices_of(self.names, names)

    def matching(self, patterns: Sequence[str], what: str) -> IntArray:
        """Return the indices of the points that match any of several names or patterns, in their order.

        Args:
            patterns: names, patterns with `*`, `?` or `[...]`, or ranges of numbers such as 101-120.
            what: name of what needs the points, for the message.

        Raises:
            GeometryError: a pattern matches no point.
        """
        chosen = np.zeros(len(self.names), dtype=bool)
        for pattern in patterns:
            matched = np.array([matches(name, pattern) for name in self.names], dtype=bool)
            if not matched.any():
                raise GeometryError(f"{what}: '{pattern}' matches no point")
            chosen |= matched
        return np.flatnonzero(chosen)

    def covariance_of(self, points: IntArray) -> FloatArray:
        """Return the joint covariance of some points, object unit^2, (3 m, 3 m).

        Args:
            points: indices of the points, (m,).

        Raises:
            GeometryError: it is unknown.
        """
        if self.covariance is None:
            raise GeometryError("covariance: the covariance of the points is unknown")
        if self.covariance.ndim == 2:
            if len(points) == len(self.names) and (np.diff(points) == 1).all():
                return self.covariance  # a copy would take longer than its use
            rows = coordinates_of(points)
            return self.covariance[np.ix_(rows, rows)]
        Q = np.zeros((3 * len(points), 3 * len(points)))
        for k, j in enumerate(points):
            Q[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = self.covariance[j]
        if self.sample is not None and self.sample_covariance is not None:
            place = np.full(len(self.names), -1)
            place[self.sample] = np.arange(len(self.sample))
            known = np.flatnonzero(place[points] >= 0)
            rows, of_sample = coordinates_of(known), coordinates_of(place[points[known]])
            Q[np.ix_(rows, rows)] = self.sample_covariance[np.ix_(of_sample, of_sample)]
        return Q

    def covariance_between(self, functions: Sequence[Function]) -> FloatArray:
        """Return the joint covariance of the values of several functions; NaN where unknown.

        Args:
            functions: functions of the coordinates, q values in total.

        Returns:
            Covariance, (q, q).
        """
        q = sum(len(function.value) for function in functions)
        if self.covariance is None:
            return np.full((q, q), np.nan)
        points = np.unique(np.concatenate([function.points for function in functions]))
        J = np.zeros((q, 3 * len(points)))
        first = 0
        for function in functions:
            columns = coordinates_of(np.searchsorted(points, function.points))
            rows = J[first : first + len(function.value)]
            np.add.at(rows.T, columns, function.jacobian.T)
            first += len(function.value)
        return np.asarray(J @ self.covariance_of(points) @ J.T)

    def depends_on_datum(self, function: Function) -> BoolArray:
        """Return which values depend on the datum, because a motion of the whole changes them, (q,)."""
        if self.datum in OWN_DATUM:
            return np.zeros(len(function.value), dtype=bool)
        xyz = self.xyz[function.points]
        size = max(float(np.linalg.norm(xyz - xyz.mean(axis=0), axis=1).max(initial=0.0)), 1e-300)
        G = similarity_motions(xyz, centre=xyz.mean(axis=0), size=size).reshape(-1, 7)
        G = G[:, : 6 if self.has_scale else 7]
        change = np.abs(function.jacobian @ G)
        most = np.abs(function.jacobian) @ np.abs(G)
        return np.asarray((change > INVARIANT * most.max(axis=1, keepdims=True)).any(axis=1))


@checked_arguments()
def measured_points(result: Solution) -> MeasuredPoints:
    """Return the points of a result that have coordinates, with their covariance as far as it is known.

    If the joint covariance is known for a sample of the points only, the others have marginal covariances.

    Args:
        result: solution of an adjustment or read from files.
    """
    kept = np.flatnonzero(result.estimate.determined)
    covariance = result.covariance
    sample = sample_covariance = None
    if covariance is not None and result.covariance_points is None:
        rows = coordinates_of(kept)
        covariance = covariance[np.ix_(rows, rows)]
    elif result.point_covariance is not None:
        blocks = result.point_covariance[kept]
        covariance = blocks if np.isfinite(blocks).all() else None
        if covariance is not None and result.covariance_points is not None:
            sample = np.searchsorted(kept, result.covariance_points)
            sample_covariance = result.covariance
    else:
        covariance = None
    return MeasuredPoints(
        tuple(result.network.points[j] for j in kept),
        result.estimate.points[kept],
        covariance,
        result.unit,
        result.datum,
        result.has_scale,
        result.redundancy,
        sample,
        sample_covariance,
    )


def coordinates_of(points: IntArray) -> IntArray:
    """Return the rows of X, Y, Z of points in a joint covariance, (3 m,), given their indices (m,)."""
    return np.asarray((3 * np.asarray(points)[:, None] + np.arange(3)).ravel())


def matches(name: str, pattern: str) -> bool:
    """Return whether a name matches a pattern.

    Args:
        name: name of a point.
        pattern: the name itself, a pattern with `*` and `?`, or a range of numbers such as 101-120.
    """
    if name == pattern or fnmatchcase(name, pattern):
        return True
    low, dash, high = pattern.partition("-")
    if not (dash and low.isdecimal() and high.isdecimal() and name.isdecimal()):
        return False
    return int(low) <= int(name) <= int(high)


@checked_arguments()
def with_hidden_point(
    points: MeasuredPoints, name: str, start: str, end: str, distance: float, sigma: float = 0.0
) -> MeasuredPoints:
    """Return the points with an additional hidden point on the line through two targets.

    Args:
        points: points of a result.
        name: name of the new point.
        start: name of the first target.
        end: name of the second target, nearer to the hidden point.
        distance: distance from the second target, away from the first, object unit.
        sigma: standard deviation of the distance, object unit.

    Raises:
        UnknownNameError: a target does not exist.
        GeometryError: the name is taken, or both targets coincide.

    Source: Luhmann et al. (2020), sec. 6.6.
    """
    if name in points.names:
        raise GeometryError(f"hidden point {name}: a point of that name exists already")
    a, b = point_function(points, start), point_function(points, end)
    d = difference(a, b)
    length = float(np.linalg.norm(d.value))
    if not length > 0:
        raise GeometryError(f"hidden point {name}: targets {start} and {end} coincide")
    u = d.value / length
    along = distance * (np.eye(3) - np.outer(u, u)) / length
    placed = join_functions([b, d]).times(np.hstack([np.eye(3), along]), b.value + distance * u)
    of_hidden = sigma**2 * np.outer(u, u) + points.covariance_between([placed])
    Q = points.covariance
    if Q is not None and Q.ndim == 3:
        Q = np.concatenate([Q, of_hidden[None]])
    elif Q is not None:
        cross = placed.jacobian @ Q[coordinates_of(placed.points)]
        Q = np.block([[Q, cross.T], [cross, of_hidden]])
    sample, known = points.sample, points.sample_covariance
    if sample is not None and known is not None and points.correlated_among(placed.points):
        place = np.full(len(points.names), -1)
        place[sample] = np.arange(len(sample))
        cross = placed.jacobian @ known[coordinates_of(place[placed.points])]
        known = np.block([[known, cross.T], [cross, of_hidden]])
        sample = np.append(sample, len(points.names))
    return replace(
        points,
        names=(*points.names, name),
        xyz=np.vstack([points.xyz, placed.value]),
        covariance=Q,
        sample=sample,
        sample_covariance=known,
    )


@checked_arguments()
def point_function(points: MeasuredPoints, name: str) -> Function:
    """Return the coordinates of a point as a function of themselves.

    Args:
        points: points of a result.
        name: name of the point.

    Raises:
        UnknownNameError: no point has that name.
    """
    j = points.index(name)
    return Function(points.xyz[j], np.array([j], dtype=np.int64), np.eye(3))


def join_functions(functions: list[Function]) -> Function:
    """Return the values of several functions as one function of all their points."""
    points: IntArray = np.unique(np.concatenate([function.points for function in functions]))
    rows = []
    for function in functions:
        J = np.zeros((len(function.value), 3 * len(points)))
        np.add.at(J.T, coordinates_of(np.searchsorted(points, function.points)), function.jacobian.T)
        rows.append(J)
    return Function(np.concatenate([function.value for function in functions]), points, np.vstack(rows))


@checked_arguments()
def distance(a: Function, b: Function) -> Function:
    """Return the distance between two points (object unit).

    Args:
        a: coordinates of the first point.
        b: coordinates of the second point.

    Raises:
        GeometryError: the points coincide, so the distance has no derivative.

    Source: law of propagation of covariances; Luhmann et al. (2020), sec. 2.4.
    """
    d = b.value - a.value
    length = float(np.linalg.norm(d))
    if not length > 0:
        raise GeometryError("distance: both points coincide")
    u = d / length
    return join_functions([a, b]).times(np.concatenate([-u, u])[None], np.array([length]))


def difference(a: Function, b: Function) -> Function:
    """Return the vector from a to b (object unit), three values."""
    return join_functions([a, b]).times(np.hstack([-np.eye(3), np.eye(3)]), b.value - a.value)


@checked_arguments()
def angle_of_directions(a: Function, b: Function, *, undirected: bool = False) -> Function:
    """Return the angle between two vectors (rad).

    Args:
        a: first vector, of any length.
        b: second vector.
        undirected: whether the vectors belong to lines or planes, which form an angle of at most 90 degrees.

    Raises:
        GeometryError: the vectors are parallel, so the angle has no derivative, or one has no length.

    Source: law of propagation of covariances; Luhmann et al. (2020), sec. 2.4.
    """
    p, q = a.value, b.value
    lp, lq = float(np.linalg.norm(p)), float(np.linalg.norm(q))
    if not (lp > 0 and lq > 0):
        raise GeometryError("angle: two of its points coincide")
    u, v = p / lp, q / lq
    if undirected and u @ v < 0:
        v, lq = -v, -lq
    cross = np.cross(u, v)
    sine = float(np.linalg.norm(cross))
    if sine < 1e-12:
        raise GeometryError("angle: the directions are parallel, their angle has no standard deviation")
    n = cross / sine
    J = np.concatenate([np.cross(u, n) / lp, np.cross(n, v) / lq])
    return join_functions([a, b]).times(J[None], np.array([np.arctan2(sine, u @ v)]))


@checked_arguments()
def angle_at(vertex: Function, a: Function, b: Function) -> Function:
    """Return the angle at a point between two others (rad).

    Args:
        vertex: coordinates of the point.
        a: coordinates of the first of the other points.
        b: coordinates of the second of the other points.

    Source: law of propagation of covariances; Luhmann et al. (2020), sec. 2.4.
    """
    return angle_of_directions(difference(vertex, a), difference(vertex, b))


@checked_arguments()
def height(point: Function, origin: Function, direction: Function) -> Function:
    """Return the height of a point above a plane (object unit), positive on the side of its normal.

    Args:
        point: coordinates of the point.
        origin: coordinates of a point of the plane.
        direction: unit normal of the plane.

    Source: law of propagation of covariances; Luhmann et al. (2020), sec. 2.4.
    """
    n, d = direction.value, point.value - origin.value
    # the normal keeps its length of 1: the part of its derivative along itself is rounding
    J = np.concatenate([n, -n, d - (d @ n) * n])
    return join_functions([point, origin, direction]).times(J[None], np.array([d @ n]))


@checked_arguments()
def distance_from_axis(point: Function, origin: Function, direction: Function) -> Function:
    """Return the distance of a point from a line (object unit).

    Args:
        point: coordinates of the point.
        origin: coordinates of a point of the line.
        direction: unit direction of the line.

    Raises:
        GeometryError: the point is on the line, so the distance has no derivative.

    Source: law of propagation of covariances; Luhmann et al. (2020), sec. 2.4.
    """
    a, d = direction.value, point.value - origin.value
    along = float(d @ a)
    across = d - along * a
    length = float(np.linalg.norm(across))
    if not length > 0:
        raise GeometryError("distance: the point is on the line")
    u = across / length
    J = np.concatenate([u, -u, -along * u])
    return join_functions([point, origin, direction]).times(J[None], np.array([length]))


@checked_arguments(origin="3", rotation="3 3")
def coordinates_in(
    points: MeasuredPoints, names: list[str], origin: FloatArray, rotation: FloatArray, scale: float = 1.0
) -> Function:
    """Return coordinates in another system that is known exactly: scale R' (x - origin), three per point.

    Args:
        points: points of a result.
        names: names of the points.
        origin: origin of the system, object unit, (3,).
        rotation: R, axes of the system as columns, (3, 3).
        scale: unit of the system per object unit.

    Raises:
        UnknownNameError: a name is not that of a point.

    Source: law of propagation of covariances; Luhmann et al. (2020), sec. 2.4.
    """
    rows = points.indices(names)
    value = scale * (points.xyz[rows] - origin) @ rotation
    return Function(value.ravel(), rows, np.asarray(scale * np.kron(np.eye(len(rows)), rotation.T)))
