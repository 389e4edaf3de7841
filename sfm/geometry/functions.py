"""Functions of coordinates: distances, angles, heights above a plane, in any mixture of points and shapes.

Each takes functions of coordinates and returns one, so that the covariance of the network goes along: of
points as well as of centres, axes and planes that were fitted to points.

Source: law of propagation of covariances; Luhmann et al. (2020), Close-Range Photogrammetry and 3D Imaging,
sec. 2.4.
"""

from __future__ import annotations

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.geometry.measured import Function, MeasuredPoints, coordinates_of


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
