"""Measured points and functions of their coordinates, with their joint covariance.

A function keeps its values and its derivatives by the coordinates, so that its covariance, and that of any
functions together, is J Q J'. In a free network only what does not change with the motions that the datum
leaves open has a covariance that means something: J G = 0, with G the shifts, rotations and, without a scale,
the scale of the whole.

Functions of coordinates: distances, angles, heights above a plane, in any mixture of points and shapes. Each
takes functions of coordinates and returns one, so that the covariance of the network goes along: of points as
well as of centres, axes and planes that were fitted to points.

Source: Baarda (1973), S-transformations and criterion matrices; Caspary (2000), Concepts of network and
deformation analysis, sec. 6 (estimable functions); Luhmann et al. (2020), Close-Range Photogrammetry and 3D
Imaging, sec. 2.4 (propagation of covariances) and 6.6 (hidden-point devices).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.network import index_of
from sfm.similarity import similarity_motions
from sfm.solution import Solution

# Change with a motion over the largest that derivatives of this size could have, below which there is none:
# those of a fit are taken at adjusted points, so that residuals of a hundredth of the size still pass.
INVARIANT = 1e-2
OWN_DATUM = ("control", "aligned")  # datums that coordinates are meant in


@dataclass(frozen=True)
class Function:
    """Values computed from coordinates, with their derivatives."""

    value: FloatArray  # (q,)
    points: IntArray  # indices of the points that it depends on, (m,)
    jacobian: FloatArray  # by X Y Z of each of them, (q, 3 m)

    def __getitem__(self, rows: slice | IntArray) -> Function:
        return Function(self.value[rows], self.points, self.jacobian[rows])

    def times(self, matrix: FloatArray, value: FloatArray) -> Function:
        """Return a function of this one, by its value and its derivatives by these values (r, q)."""
        return Function(np.atleast_1d(value), self.points, matrix @ self.jacobian)


@dataclass(frozen=True)
class MeasuredPoints:
    """Points of a result, or of anything else that gives coordinates."""

    names: tuple[str, ...]  # (n,)
    xyz: FloatArray  # object unit, (n, 3)
    covariance: FloatArray | None  # of all together (3 n, 3 n), or of each by itself (n, 3, 3), object unit^2
    unit: str = ""  # of lengths, as people call it
    datum: str = ""  # free | minimal | control | aligned; empty where it is not known
    has_scale: bool = True  # whether lengths are in a known unit
    redundancy: int | None = None  # of the variances; None where they count as known
    sample: IntArray | None = None  # points that are known together where `covariance` is of each alone, (s,)
    sample_covariance: FloatArray | None = None  # of these, object unit^2, (3 s, 3 s)

    @property
    def correlated(self) -> bool:
        """Whether the covariance between points is known."""
        return self.covariance is not None and self.covariance.ndim == 2

    def correlated_among(self, points: IntArray) -> bool:
        """Whether the covariance between some points is known."""
        return self.correlated or bool(self.sample is not None and np.isin(points, self.sample).all())

    @property
    def blocks(self) -> FloatArray:
        """Covariance of each point by itself, NaN where not known, (n, 3, 3)."""
        n = len(self.names)
        if self.covariance is None:
            return np.full((n, 3, 3), np.nan)
        if self.covariance.ndim == 3:
            return self.covariance
        return np.stack([self.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(n)])

    def index(self, name: str) -> int:
        """Return the number of a point; UnknownNameError if there is none of that name."""
        return index_of(self.names, name, "point")

    def matching(self, patterns: Sequence[str], what: str) -> IntArray:
        """Return the points that any of some names or patterns (`*`, `?`, `[...]`) names, in their order.

        Args:
            patterns: names, patterns, or ranges of numbers such as 101-120.
            what: asks for them, for messages.

        Raises:
            GeometryError: a pattern that names none.
        """
        chosen = np.zeros(len(self.names), dtype=bool)
        for pattern in patterns:
            matched = np.array([matches(name, pattern) for name in self.names], dtype=bool)
            if not matched.any():
                raise GeometryError(f"{what}: '{pattern}' is the name of no point, and no pattern of any")
            chosen |= matched
        return np.flatnonzero(chosen)

    def covariance_of(self, points: IntArray) -> FloatArray:
        """Return the covariance of some points together, object unit^2, (3 m, 3 m).

        Raises:
            GeometryError: it is not known.
        """
        if self.covariance is None:
            raise GeometryError("covariance: that of the points is not known")
        if self.covariance.ndim == 2:
            if len(points) == len(self.names) and (np.diff(points) == 1).all():
                return self.covariance  # a copy would take longer than what is done with it
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
        """Return the covariance of the values of some functions together; NaN where it is not known.

        Args:
            functions: of the coordinates, q values in all.

        Returns:
            Covariance, (q, q).
        """
        q = sum(len(one.value) for one in functions)
        if self.covariance is None:
            return np.full((q, q), np.nan)
        points = np.unique(np.concatenate([one.points for one in functions]))
        J = np.vstack([self._spread(one, points) for one in functions])
        return np.asarray(J @ self.covariance_of(points) @ J.T)

    def _spread(self, one: Function, points: IntArray) -> FloatArray:
        J = np.zeros((len(one.value), 3 * len(points)))
        np.add.at(J.T, coordinates_of(np.searchsorted(points, one.points)), one.jacobian.T)
        return J

    def depends_on_datum(self, one: Function) -> BoolArray:
        """Return which values change with a motion of the whole that the datum only assumes, (q,)."""
        if self.datum in OWN_DATUM:
            return np.zeros(len(one.value), dtype=bool)
        xyz = self.xyz[one.points]
        size = max(float(np.linalg.norm(xyz - xyz.mean(axis=0), axis=1).max(initial=0.0)), 1e-300)
        G = similarity_motions(xyz, centre=xyz.mean(axis=0), size=size).reshape(-1, 7)
        G = G[:, : 6 if self.has_scale else 7]
        change = np.abs(one.jacobian @ G)
        most = np.abs(one.jacobian) @ np.abs(G)
        return np.asarray((change > INVARIANT * most.max(axis=1, keepdims=True)).any(axis=1))


@checked_arguments()
def measured_points(result: Solution) -> MeasuredPoints:
    """Return the points of a result that have coordinates, with the covariance that is known of them.

    Where only that of a sample of the points is known together, all others count by themselves.
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


def with_covariance(points: MeasuredPoints, covariance: FloatArray | None) -> MeasuredPoints:
    """Return the points with another covariance."""
    return replace(points, covariance=covariance)


def coordinates_of(points: IntArray) -> IntArray:
    """Return the rows of X Y Z of some points among those of all, (3 m,)."""
    return np.asarray((3 * np.asarray(points)[:, None] + np.arange(3)).ravel())


def matches(name: str, pattern: str) -> bool:
    """Whether a name is a pattern's: the name itself, `*` and `?`, or a range of numbers such as 101-120."""
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
    """Return the points with a hidden one behind two targets.

    Args:
        points: of a result.
        name: of the new point.
        start: name of the first target.
        end: name of the second, nearer to the hidden point.
        distance: from the second target on, away from the first, object unit.
        sigma: its standard deviation, object unit.

    Raises:
        UnknownNameError: a target is not there.
        GeometryError: the name is taken, or both targets are in one place.

    Source: Luhmann et al. (2020), sec. 6.6.
    """
    if name in points.names:
        raise GeometryError(f"hidden point {name}: there is a point of that name already")
    a, b = point_function(points, start), point_function(points, end)
    d = difference(a, b)
    length = float(np.linalg.norm(d.value))
    if not length > 0:
        raise GeometryError(f"hidden point {name}: targets {start} and {end} are in one place")
    u = d.value / length
    along = distance * (np.eye(3) - np.outer(u, u)) / length
    found = joined([b, d]).times(np.hstack([np.eye(3), along]), b.value + distance * u)
    of_hidden = sigma**2 * np.outer(u, u) + points.covariance_between([found])
    Q = points.covariance
    if Q is not None and Q.ndim == 3:
        Q = np.concatenate([Q, of_hidden[None]])
    elif Q is not None:
        cross = found.jacobian @ Q[coordinates_of(found.points)]
        Q = np.block([[Q, cross.T], [cross, of_hidden]])
    sample, known = points.sample, points.sample_covariance
    if sample is not None and known is not None and points.correlated_among(found.points):
        place = np.full(len(points.names), -1)
        place[sample] = np.arange(len(sample))
        cross = found.jacobian @ known[coordinates_of(place[found.points])]
        known = np.block([[known, cross.T], [cross, of_hidden]])
        sample = np.append(sample, len(points.names))
    return replace(
        points,
        names=(*points.names, name),
        xyz=np.vstack([points.xyz, found.value]),
        covariance=Q,
        sample=sample,
        sample_covariance=known,
    )


@checked_arguments()
def point_function(points: MeasuredPoints, name: str) -> Function:
    """Return the coordinates of a point as a function of themselves.

    Raises:
        UnknownNameError: there is no point of that name.
    """
    j = points.index(name)
    return Function(points.xyz[j], np.array([j], dtype=np.int64), np.eye(3))


def joined(functions: list[Function]) -> Function:
    """Return the values of several functions as one of all their points."""
    points: IntArray = np.unique(np.concatenate([one.points for one in functions]))
    rows = []
    for one in functions:
        J = np.zeros((len(one.value), 3 * len(points)))
        np.add.at(J.T, coordinates_of(np.searchsorted(points, one.points)), one.jacobian.T)
        rows.append(J)
    return Function(np.concatenate([one.value for one in functions]), points, np.vstack(rows))


@checked_arguments()
def distance(a: Function, b: Function) -> Function:
    """Return the distance of two points (object unit).

    Args:
        a: coordinates of the first.
        b: coordinates of the second.

    Raises:
        GeometryError: both are in one place, so that the distance has no derivative.

    Source: law of propagation of covariances; Luhmann et al. (2020), sec. 2.4.
    """
    d = b.value - a.value
    length = float(np.linalg.norm(d))
    if not length > 0:
        raise GeometryError("distance: both points are in one place")
    u = d / length
    return joined([a, b]).times(np.concatenate([-u, u])[None], np.array([length]))


def difference(a: Function, b: Function) -> Function:
    """Return the vector from a to b (object unit), three values."""
    return joined([a, b]).times(np.hstack([-np.eye(3), np.eye(3)]), b.value - a.value)


@checked_arguments()
def angle_of_directions(a: Function, b: Function, *, undirected: bool = False) -> Function:
    """Return the angle between two vectors (rad).

    Args:
        a: first vector, of any length.
        b: second vector.
        undirected: whether they are those of lines or planes, whose angle is at most a right one.

    Raises:
        GeometryError: parallel vectors, whose angle has no derivative, or one without length.

    Source: law of propagation of covariances; Luhmann et al. (2020), sec. 2.4.
    """
    p, q = a.value, b.value
    lp, lq = float(np.linalg.norm(p)), float(np.linalg.norm(q))
    if not (lp > 0 and lq > 0):
        raise GeometryError("angle: two of its points are in one place")
    u, v = p / lp, q / lq
    if undirected and u @ v < 0:
        v, lq = -v, -lq
    cross = np.cross(u, v)
    sine = float(np.linalg.norm(cross))
    if sine < 1e-12:
        raise GeometryError("angle: the directions are parallel, their angle has no standard deviation")
    n = cross / sine
    J = np.concatenate([np.cross(u, n) / lp, np.cross(n, v) / lq])
    return joined([a, b]).times(J[None], np.array([np.arctan2(sine, u @ v)]))


@checked_arguments()
def angle_at(vertex: Function, a: Function, b: Function) -> Function:
    """Return the angle at a point between two others (rad).

    Args:
        vertex: coordinates of the point.
        a: coordinates of the first of the others.
        b: coordinates of the second.

    Source: law of propagation of covariances; Luhmann et al. (2020), sec. 2.4.
    """
    return angle_of_directions(difference(vertex, a), difference(vertex, b))


@checked_arguments()
def height(point: Function, origin: Function, direction: Function) -> Function:
    """Return the height of a point above a plane (object unit), positive on the side of its normal.

    Args:
        point: coordinates.
        origin: of a point of the plane.
        direction: normal of the plane, of unit length.

    Source: law of propagation of covariances; Luhmann et al. (2020), sec. 2.4.
    """
    n, d = direction.value, point.value - origin.value
    # the normal keeps its length of 1: what of its derivative is along itself is rounding
    J = np.concatenate([n, -n, d - (d @ n) * n])
    return joined([point, origin, direction]).times(J[None], np.array([d @ n]))


@checked_arguments()
def distance_from_axis(point: Function, origin: Function, direction: Function) -> Function:
    """Return the distance of a point from a line (object unit).

    Args:
        point: coordinates.
        origin: of a point of the line.
        direction: of the line, of unit length.

    Raises:
        GeometryError: the point is on the line, so that the distance has no derivative.

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
    return joined([point, origin, direction]).times(J[None], np.array([length]))


@checked_arguments(origin="3", rotation="3 3")
def coordinates_in(
    points: MeasuredPoints, names: list[str], origin: FloatArray, rotation: FloatArray, scale: float = 1.0
) -> Function:
    """Return coordinates in another system that is exactly known: scale R' (x - origin), 3 for each point.

    Args:
        points: of a result.
        names: of the points.
        origin: of the system, object unit, (3,).
        rotation: R, axes of the system as columns, (3, 3).
        scale: unit of the system per object unit.

    Raises:
        UnknownNameError: there is no point of a name.

    Source: law of propagation of covariances; Luhmann et al. (2020), sec. 2.4.
    """
    rows = np.array([points.index(name) for name in names], dtype=np.int64)
    value = scale * (points.xyz[rows] - origin) @ rotation
    return Function(value.ravel(), rows, np.asarray(scale * np.kron(np.eye(len(rows)), rotation.T)))
