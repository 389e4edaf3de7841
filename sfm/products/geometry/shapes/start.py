"""Start values of shapes from their points: algebraic fits, and robust fits on which most points agree.

A line, plane, circle, ellipse and sphere have direct solutions. With a known axis, a cylinder, cone, torus or
paraboloid becomes a linear problem or a circle. So directions all over the half sphere are tried, and the
best ones are refined by orthogonal distances.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.9 (direct fits); Halir and
Flusser (1998), Numerically stable direct least squares fitting of ellipses; Rousseeuw and Leroy (1987),
Robust Regression and Outlier Detection, ch. 5; Beaton and Tukey (1974), Technometrics 16(2).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import eig

from sfm.model.conventions import MAD_TO_SIGMA, BoolArray, FloatArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.products.geometry.shapes.gauss_helmert import refine_orthogonal
from sfm.products.geometry.shapes.kinds import KINDS, Kind, Shape, axes_along

TRIALS = 30  # samples of few points; with 20 % outliers, 99 % of fits have a clean sample, even for a torus
TRIAL_DIRECTIONS = 40  # directions of an axis that are tried in each sample
MORE_POINTS = 1  # points in a sample beyond those that a shape needs
TRIAL_STEPS = 15
TUKEY = 4.685  # standard deviations beyond which a point has no weight; 95 % efficient
ROUNDS = 50
SEED = 20  # seed of the samples, so that repeated fits give the same result
DIRECTIONS = 120  # over the half sphere, about 13 degrees apart
MAX_ANGLE = np.deg2rad(89.0)  # largest half angle of a cone


def start_shapes(
    kind: Kind,
    xyz: FloatArray,
    *,
    origin: FloatArray | None = None,
    axis: FloatArray | None = None,
    directions: int = DIRECTIONS,
) -> list[Shape]:
    """Return start shapes, likeliest first; empty if the points do not determine any.

    Args:
        kind: kind of the shape.
        xyz: points about their centroid, of unit size, (n, 3).
        origin: held origin of the shape, None if free, (3,).
        axis: held direction of the shape, None if free, (3,).
        directions: number of directions of an axis that are tried.
    """
    normal, along = principal_directions(xyz)
    if kind.name in DIRECT:
        direction = along if kind.name == "line" else normal
        return DIRECT[kind.name](xyz, axes_along(direction if axis is None else axis))
    if axis is not None:
        tried = np.stack([axis, -axis])
    else:
        tried = np.vstack([[normal, along, np.cross(normal, along)], half_sphere(directions)])
    if kind.name == "cone" and origin is not None:
        cones = []  # with this apex; the half angle for each direction is the mean angle to the points
        y = xyz - origin
        for direction in np.vstack([tried, -tried]):
            height = y @ direction
            angle = np.arctan2(np.linalg.norm(y - height[:, None] * direction, axis=1), height).mean()
            if angle < MAX_ANGLE:
                cones.append(Shape(kind, origin, axes_along(direction), np.array([0.0, angle])))
        return _best_first(cones, xyz)
    shapes = [shape for direction in tried for shape in WITH_AXIS[kind.name](xyz, axes_along(direction))]
    return _best_first(shapes, xyz)


def _best_first(shapes: list[Shape], xyz: FloatArray) -> list[Shape]:
    """Return shapes sorted by their sum of squared distances, without those where it is not finite."""
    costs = [float((shape.distances(xyz) ** 2).sum()) for shape in shapes]
    return [shapes[k] for k in np.argsort(costs, kind="stable") if np.isfinite(costs[k])]


def principal_directions(xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the directions in which points about their centroid spread least and most, (3,) each.

    Args:
        xyz: points about their centroid, (n, 3).
    """
    _, _, Vt = np.linalg.svd(xyz, full_matrices=True)
    return Vt[2], Vt[0]


def half_sphere(count: int) -> FloatArray:
    """Return directions spread evenly over half a sphere, (count, 3).

    Source: Gonzalez (2010), Measurement of areas on a sphere using Fibonacci and latitude-longitude lattices.
    """
    k = np.arange(count)
    z = (k + 0.5) / count
    turn = k * np.pi * (3 - np.sqrt(5))
    rho = np.sqrt(1 - z * z)
    return np.stack([rho * np.cos(turn), rho * np.sin(turn), z], axis=1)


def _least_squares(A: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0])


def _circle_in_plane(xy: FloatArray) -> tuple[FloatArray, float]:
    """Return centre and radius of the algebraic circle (Kasa)."""
    u = _least_squares(np.column_stack([2 * xy, np.ones(len(xy))]), (xy**2).sum(axis=1))
    return u[:2], float(np.sqrt(max(u[2] + u[:2] @ u[:2], 0.0)))


def _straight(name: str) -> Callable[[FloatArray, FloatArray], list[Shape]]:
    return lambda xyz, R: [Shape(KINDS[name], np.zeros(3), R, np.zeros(0))]


def _circles(xyz: FloatArray, R: FloatArray) -> list[Shape]:
    centre, radius = _circle_in_plane((xyz @ R)[:, :2])
    return [Shape(KINDS["circle"], R[:, :2] @ centre, R, np.array([radius]))]


def _spheres(xyz: FloatArray, R: FloatArray) -> list[Shape]:
    u = _least_squares(np.column_stack([2 * xyz, np.ones(len(xyz))]), (xyz**2).sum(axis=1))
    radius = np.sqrt(max(u[3] + u[:3] @ u[:3], 0.0))
    return [Shape(KINDS["sphere"], u[:3], np.eye(3), np.array([radius]))]


def _ellipses(xyz: FloatArray, R: FloatArray) -> list[Shape]:
    """Return the ellipse of Halir and Flusser, if it exists, and two ellipses about the best circle."""
    x, y = (xyz @ R)[:, :2].T
    D1, D2 = np.column_stack([x * x, x * y, y * y]), np.column_stack([x, y, np.ones_like(x)])
    S1, S2, S3 = D1.T @ D1, D1.T @ D2, D2.T @ D2
    T = -np.linalg.lstsq(S3, S2.T, rcond=None)[0]
    M = np.array([[0, 0, 0.5], [0, -1, 0], [0.5, 0, 0]]) @ (S1 + S2 @ T)
    _, vectors = eig(M)
    vectors = vectors.real
    inside = 4 * vectors[0] * vectors[2] - vectors[1] ** 2
    shapes = []
    if (inside > 0).any():
        first = vectors[:, np.argmax(inside)]
        a, b, c, d, e, f = np.concatenate([first, T @ first])
        C = np.array([[a, b / 2], [b / 2, c]])
        centre = np.linalg.solve(C, [-d / 2, -e / 2])
        level = -(f + centre @ [d, e] / 2)
        values, turn = np.linalg.eigh(C)
        squares = level / values
        if (squares > 0).all():
            if np.linalg.det(turn) < 0:
                turn = turn * [1, -1]
            axes = R.copy()
            axes[:, :2] = R[:, :2] @ turn
            shapes.append(Shape(KINDS["ellipse"], R[:, :2] @ centre, axes, np.sqrt(squares)))
    circle = _circles(xyz, R)[0]
    radius = circle.form[0]
    for stretch in (1.3, 1 / 1.3):
        form = radius * np.array([stretch, 1 / stretch])
        shapes.append(Shape(KINDS["ellipse"], circle.origin, R, form))
    return shapes


def _cylinders(xyz: FloatArray, R: FloatArray) -> list[Shape]:
    centre, radius = _circle_in_plane((xyz @ R)[:, :2])
    return [Shape(KINDS["cylinder"], R[:, :2] @ centre, R, np.array([radius]))]


def _cones(xyz: FloatArray, R: FloatArray) -> list[Shape]:
    """Return the cone with this axis: (x - x0)^2 + (y - y0)^2 = (r + z tan)^2 is linear in five unknowns.

    A few points far from any cone may have no solution. Then the cone follows from the circle that they form
    along the axis, and a straight line through their distances from its centre.
    """
    y = xyz @ R
    A = np.column_stack([2 * y[:, :2], np.ones(len(y)), y[:, 2], y[:, 2] ** 2])
    u = _least_squares(A, (y[:, :2] ** 2).sum(axis=1))
    square = u[2] + u[:2] @ u[:2]
    if not (square > 0 and u[4] > 0):
        centre, _ = _circle_in_plane(y[:, :2])
        rho = np.hypot(*(y[:, :2] - centre).T)
        radius, slope = _least_squares(np.column_stack([np.ones(len(y)), y[:, 2]]), rho)
        return [Shape(KINDS["cone"], R[:, :2] @ centre, R, np.array([radius, np.arctan(slope)]))]
    slope = np.sqrt(u[4])
    radius = u[3] / (2 * slope)
    if radius < 0:
        slope, radius = -slope, -radius
    return [Shape(KINDS["cone"], R[:, :2] @ u[:2], R, np.array([radius, np.arctan(slope)]))]


def _tori(xyz: FloatArray, R: FloatArray) -> list[Shape]:
    """Return tori about the circle that the points form as seen along this axis."""
    y = xyz @ R
    centre, major = _circle_in_plane(y[:, :2])
    shapes = []
    for height in (y[:, 2].mean(), (y[:, 2].min() + y[:, 2].max()) / 2):
        ring = np.hypot(*(y[:, :2] - centre).T) - major
        minor = float(np.sqrt((ring**2 + (y[:, 2] - height) ** 2).mean()))
        origin = R @ np.array([*centre, height])
        shapes.append(Shape(KINDS["torus"], origin, R, np.array([major, minor])))
    return shapes


def _paraboloids(xyz: FloatArray, R: FloatArray) -> list[Shape]:
    """Return the paraboloid z = (x^2 + y^2) / (4 f) + linear terms, open along this axis or against it."""
    y = xyz @ R
    A = np.column_stack([(y[:, :2] ** 2).sum(axis=1), y[:, :2], np.ones(len(y))])
    k, bx, by, c = _least_squares(A, y[:, 2])
    if not abs(k) > 1e-9:
        return []
    if k < 0:  # rotated about its first axis: y2 and y3 change sign
        R, k, bx, c = R * np.array([1.0, -1, -1]), -k, -bx, -c
    vertex = np.array([-bx / (2 * k), -by / (2 * k), c - (bx * bx + by * by) / (4 * k)])
    return [Shape(KINDS["paraboloid"], R @ vertex, R, np.array([1 / (4 * k)]))]


DIRECT = {
    "line": _straight("line"),
    "plane": _straight("plane"),
    "circle": _circles,
    "ellipse": _ellipses,
    "sphere": _spheres,
}
WITH_AXIS = {"cylinder": _cylinders, "cone": _cones, "torus": _tori, "paraboloid": _paraboloids}


def robust_shape(
    kind: Kind,
    xyz: FloatArray,
    *,
    free: BoolArray,
    offset: FloatArray,
    origin: FloatArray | None,
    axis: FloatArray | None,
    form: FloatArray,
    placed: bool,
) -> tuple[Shape, BoolArray]:
    """Return the shape on which most of the points agree, and which points these are, (n,).

    Args:
        kind: kind of the shape.
        xyz: points about their centroid, of unit size, (n, 3).
        free: which of the six motions and the form are adjusted, (6 + q,).
        offset: required signed distances of the points, (c,).
        origin: held origin, None if free, (3,).
        axis: held direction, None if free, (3,).
        form: held form parameters, NaN for free ones, (q,).
        placed: whether the origin may be anywhere along the axis.

    Raises:
        GeometryError: too few points to separate good points from others.
    """
    n, size = len(xyz), kind.min_points + MORE_POINTS
    if n < size + 1:
        raise GeometryError(f"{counted(n, 'point')}, a robust fit of a {kind.name} needs {size + 1} or more")
    rng = np.random.default_rng(SEED)
    best, least = None, np.inf
    for trial in range(TRIALS + 1):
        rows = np.arange(n) if trial == 0 else rng.permutation(n)[:size]
        centre = xyz[rows].mean(axis=0)
        for start in start_shapes(
            kind,
            xyz[rows] - centre,
            origin=None if origin is None else origin - centre,
            axis=axis,
            directions=TRIAL_DIRECTIONS,
        )[:1]:
            shape = with_held(start.scaled(1.0, centre), origin, form)
            if not np.isfinite(shape.form).all():
                continue
            shape, _, _ = refine_orthogonal(
                shape, xyz[rows], free=free, offset=offset, placed=placed, iterations=TRIAL_STEPS
            )
            median = float(np.median(_lengths(shape, xyz, offset)))
            if median < least:
                best, least = shape, median
    if best is None:
        raise GeometryError(f"its points do not determine a {kind.name}")
    weight = np.ones(n)
    for _ in range(ROUNDS):
        length = _lengths(best, xyz, offset)
        sigma = max(robust_sigma(length, int(free.sum())), 1e-14)
        new = np.where(length < TUKEY * sigma, (1 - (length / (TUKEY * sigma)) ** 2) ** 2, 0.0)
        best, _, _ = refine_orthogonal(best, xyz, free=free, offset=offset, weight=new, placed=placed)
        if np.abs(new - weight).max() < 1e-6:
            break
        weight = new
    return best, weight > 0


def robust_sigma(length: FloatArray, parameters: int) -> float:
    """Return the robust standard deviation of distances, with Rousseeuw's factor for few of them.

    Args:
        length: distances, (n,).
        parameters: number of fitted parameters.
    """
    return float(MAD_TO_SIGMA * (1 + 5 / max(len(length) - parameters, 1)) * np.median(length))


def with_held(shape: Shape, origin: FloatArray | None, form: FloatArray) -> Shape:
    """Return a shape with its held values inserted.

    Args:
        shape: the shape.
        origin: held origin, None if free, (3,).
        form: held form parameters, NaN for free ones, (q,).
    """
    return Shape(
        shape.kind,
        shape.origin if origin is None else origin,
        shape.rotation,
        np.where(np.isnan(form), shape.form, form),
    )


def _lengths(shape: Shape, xyz: FloatArray, offset: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(shape.distances(xyz) - offset, axis=1))
