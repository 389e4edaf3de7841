"""Shapes in space and their kinds: orthogonal distances of points, with derivatives.

Each shape has axes y = R' (x - c), with its axis or normal along y3. A kind lists the motions of
these axes that change it; a sphere has no direction, and a cylinder no position along its axis. It also lists
its form parameters. One function gives the signed distance d of points, its gradient g by the point, which is
a unit vector, and its derivative by the form parameters. A curve in space has two distances, in its plane and
perpendicular to it. The derivatives by the motions follow from g in the same way for all kinds
(`Shape.design`).

Source: Ahn (2004), Least Squares Orthogonal Distance Fitting of Curves and Surfaces in Space, ch. 3;
Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.8.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sfm.model.conventions import FloatArray, rotation_from_vector

PLACED_ALONG = ("line", "cylinder", "cone")  # kinds with an arbitrary origin along the axis
Distances = tuple[FloatArray, FloatArray, FloatArray]
"""d (n, c), gradients by the point (n, c, 3), derivatives by the form parameters (n, c, q)"""
BISECTIONS = 60  # bisections for the foot point on an ellipse; Newton's steps follow
NEWTON_STEPS = 60  # largest number for the foot point on a parabola
TINY = 1e-300  # keeps quotients finite on the axis, where a distance has no direction


@dataclass(frozen=True)
class Kind:
    """One kind of shape."""

    name: str
    place: str  # name of its origin
    form: tuple[str, ...]  # names of the form parameters, lengths except for `half_angle`, rad
    moves: tuple[int, ...]  # motions that change it: 0-2 shifts along y1 y2 y3, 3-5 rotations about them
    constraints: int  # number of distances of a point: 1 for a surface, 2 for a curve
    min_points: int
    distance: Callable[[FloatArray, FloatArray], Distances]  # from points y (n, 3) and form (q,)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.moves) + len(self.form)


def _straight(across: slice, y: FloatArray, q: FloatArray) -> Distances:
    """Return the coordinates across a line or a plane as its distances."""
    d, axes = y[:, across], np.eye(3)[across]
    return d, np.broadcast_to(axes, (len(y), len(axes), 3)), np.zeros((len(y), len(axes), 0))


def _radial(y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distance from the axis and its gradient, (n,) and (n, 3)."""
    rho = np.hypot(y[:, 0], y[:, 1])
    g = np.zeros_like(y)
    g[:, :2] = y[:, :2] / np.maximum(rho, TINY)[:, None]
    return rho, g


def _circle(y: FloatArray, q: FloatArray) -> Distances:
    rho, g = _radial(y)
    n = len(y)
    up = np.broadcast_to([0.0, 0.0, 1.0], (n, 3))
    dq = np.broadcast_to([[-1.0], [0.0]], (n, 2, 1))
    return np.stack([rho - q[0], y[:, 2]], axis=1), np.stack([g, up], axis=1), dq


def _ellipse(y: FloatArray, q: FloatArray) -> Distances:
    a, b = q
    cosine, sine = _foot_on_ellipse(y[:, 0], y[:, 1], a, b)
    normal = np.stack([b * cosine, a * sine], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    d = ((y[:, :2] - np.stack([a * cosine, b * sine], axis=1)) * normal).sum(axis=1)
    n = len(y)
    g = np.zeros((n, 2, 3))
    g[:, 0, :2] = normal
    g[:, 1, 2] = 1.0
    dq = np.zeros((n, 2, 2))
    dq[:, 0] = -normal * np.stack([cosine, sine], axis=1)
    return np.stack([d, y[:, 2]], axis=1), g, dq


def _foot_on_ellipse(x: FloatArray, y: FloatArray, a: float, b: float) -> tuple[FloatArray, FloatArray]:
    """Return cosine and sine of the parameter of the nearest point on an ellipse with semi-axes a and b.

    Source: Eberly (2013), Distance from a point to an ellipse, an ellipsoid, or a hyperellipsoid, sec. 2.
    """
    u, v = np.abs(x), np.abs(y)
    # the left side of (a u / (t + a^2))^2 + (b v / (t + b^2))^2 = 1 falls with t; these bounds enclose the
    # root
    least = min(a, b) ** 2
    low = np.maximum(a * u - a * a, b * v - b * b)
    low = np.maximum(low, -least)
    high = np.hypot(a * u, b * v) - least
    for _ in range(BISECTIONS):
        t = (low + high) / 2
        above = np.hypot(a * u / np.maximum(t + a * a, TINY), b * v / np.maximum(t + b * b, TINY)) > 1
        low, high = np.where(above, t, low), np.where(above, high, t)
    theta = np.arctan2(b * v * (high + a * a), a * u * (high + b * b))
    for _ in range(3):
        s, c = np.sin(theta), np.cos(theta)
        slope = (b * b - a * a) * (c * c - s * s) + a * c * u + b * s * v
        value = (b * b - a * a) * s * c + a * s * u - b * c * v
        theta = theta - np.where(slope > 0, value / np.where(slope > 0, slope, 1.0), 0.0)
    return np.cos(theta) * np.where(x < 0, -1, 1), np.sin(theta) * np.where(y < 0, -1, 1)


def _sphere(y: FloatArray, q: FloatArray) -> Distances:
    length = np.linalg.norm(y, axis=1)
    g = y / np.maximum(length, TINY)[:, None]
    return (length - q[0])[:, None], g[:, None], np.full((len(y), 1, 1), -1.0)


def _cylinder(y: FloatArray, q: FloatArray) -> Distances:
    rho, g = _radial(y)
    return (rho - q[0])[:, None], g[:, None], np.full((len(y), 1, 1), -1.0)


def _cone(y: FloatArray, q: FloatArray) -> Distances:
    radius, angle = q  # at y3 = 0
    s, c = np.sin(angle), np.cos(angle)
    rho, g = _radial(y)
    d = (rho - radius) * c - y[:, 2] * s
    normal = c * g
    normal[:, 2] = -s
    dq = np.stack([np.full(len(y), -c), -(rho - radius) * s - y[:, 2] * c], axis=1)
    return d[:, None], normal[:, None], dq[:, None]


def _torus(y: FloatArray, q: FloatArray) -> Distances:
    major, minor = q
    rho, g = _radial(y)
    length = np.hypot(rho - major, y[:, 2])
    along = (rho - major) / np.maximum(length, TINY)
    normal = along[:, None] * g
    normal[:, 2] = y[:, 2] / np.maximum(length, TINY)
    dq = np.stack([-along, np.full(len(y), -1.0)], axis=1)
    return (length - minor)[:, None], normal[:, None], dq[:, None]


def _paraboloid(y: FloatArray, q: FloatArray) -> Distances:
    f = q[0]
    rho, g = _radial(y)
    s = _foot_on_parabola(rho, y[:, 2], f)
    slope = s / (2 * f)
    root = np.sqrt(1 + slope**2)
    normal = -(slope / root)[:, None] * g
    normal[:, 2] = 1 / root
    d = (-slope * (rho - s) + (y[:, 2] - s * s / (4 * f))) / root
    dq = s * s / (4 * f * f) / root
    return d[:, None], normal[:, None], dq[:, None, None]


def _foot_on_parabola(rho: FloatArray, z: FloatArray, f: float) -> FloatArray:
    """Return the distance from the axis of the nearest point on z = rho^2 / (4 f), rho >= 0.

    It is the largest root of s^3 / (8 f^2) + s (1 - z / (2 f)) - rho, which Newton's method approaches from
    above.
    """
    linear = 1 - z / (2 * f)
    s = np.sqrt(8 * f * f * np.maximum(-linear, 0)) + np.cbrt(8 * f * f * rho)
    for _ in range(NEWTON_STEPS):
        slope = 3 * s * s / (8 * f * f) + linear
        step = (s**3 / (8 * f * f) + s * linear - rho) / np.where(slope > 0, slope, 1.0)
        s = np.maximum(s - np.where(slope > 0, step, 0.0), 0.0)
        if not (np.abs(step) > 4e-16 * (s + abs(f))).any():
            break
    return s


SHIFTS, TILTS = (0, 1, 2), (3, 4)
KINDS = {
    kind.name: kind
    for kind in (
        Kind("line", "point", (), (0, 1, *TILTS), 2, 2, partial(_straight, slice(0, 2))),
        Kind("plane", "point", (), (2, *TILTS), 1, 3, partial(_straight, slice(2, 3))),
        Kind("circle", "centre", ("radius",), (*SHIFTS, *TILTS), 2, 3, _circle),
        Kind("ellipse", "centre", ("semi_major", "semi_minor"), (*SHIFTS, *TILTS, 5), 2, 5, _ellipse),
        Kind("sphere", "centre", ("radius",), SHIFTS, 1, 4, _sphere),
        Kind("cylinder", "point", ("radius",), (0, 1, *TILTS), 1, 5, _cylinder),
        Kind("cone", "apex", ("radius", "half_angle"), (0, 1, *TILTS), 1, 6, _cone),
        Kind("torus", "centre", ("major_radius", "minor_radius"), (*SHIFTS, *TILTS), 1, 7, _torus),
        Kind("paraboloid", "vertex", ("focal_length",), (*SHIFTS, *TILTS), 1, 6, _paraboloid),
    )
}
"""all kinds of shapes by name"""


@dataclass(frozen=True)
class Shape:
    """A shape in space."""

    kind: Kind
    origin: FloatArray  # c, object unit, (3,)
    rotation: FloatArray  # R, axes of the shape as columns, (3, 3)
    form: FloatArray  # values of kind.form, object unit, rad, (q,)

    @property
    def axis(self) -> FloatArray:
        """Direction of the axis or normal, (3,)."""
        return self.rotation[:, 2]

    def distances(self, xyz: FloatArray) -> FloatArray:
        """Return the signed orthogonal distances of points (n, 3), object unit, (n, c)."""
        return self.kind.distance((xyz - self.origin) @ self.rotation, self.form)[0]

    def design(self, xyz: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return distances (n, c), normals in object axes (n, c, 3), and derivatives by all parameters.

        Args:
            xyz: points, object unit, (n, 3).

        Returns:
            Distances, normals, and derivatives by shifts and rotations of the shape in its axes and by its
            form, (n, c, 6 + q).
        """
        y = (xyz - self.origin) @ self.rotation
        d, g, of_form = self.kind.distance(y, self.form)
        a, b, c = (y[:, None, k] for k in range(3))
        p, q, r = (g[..., k] for k in range(3))
        y_cross_g = np.stack([b * r - c * q, c * p - a * r, a * q - b * p], axis=2)
        return d, g @ self.rotation.T, np.concatenate([-g, -y_cross_g, of_form], axis=2)

    def moved(self, step: FloatArray, centroid: FloatArray) -> Shape:
        """Return the shape after a step, with an arbitrary origin moved next to the points.

        Args:
            step: shifts and rotations in the axes of the shape, and changes of the form, (6 + q,).
            centroid: centroid of the points, (3,).
        """
        origin = self.origin + self.rotation @ step[:3]
        rotation = self.rotation @ rotation_from_vector(step[3:6])
        U, _, Vt = np.linalg.svd(rotation)  # keeps rounding from accumulating
        return Shape(self.kind, origin, U @ Vt, self.form + step[6:]).placed(centroid)

    def placed(self, centroid: FloatArray) -> Shape:
        """Return the same shape with its origin as close to a point as its kind allows.

        Args:
            centroid: the point, (3,).
        """
        axis, form = self.axis, self.form
        along = float(axis @ (centroid - self.origin))
        if self.kind.name in PLACED_ALONG:
            if self.kind.name == "cone":
                form = form + np.array([along * np.tan(form[1]), 0.0])
            return replace(self, origin=self.origin + along * axis, form=form)
        if self.kind.name == "plane":
            return replace(self, origin=centroid - along * axis)
        return self

    def turned(self) -> Shape:
        """Return the same shape with a unique direction and positive form parameters.

        The largest component of the direction is positive. The direction of a cone points to its opening,
        that of a paraboloid from its vertex to its focus.
        """
        name, form, flip = self.kind.name, self.form.copy(), False
        rotation = self.rotation
        if name == "cone":
            flip = form[1] < 0
            form[1] = abs(form[1])
        elif name == "paraboloid":
            flip = form[0] < 0
            form[0] = abs(form[0])
        else:
            form = np.abs(form)
            flip = self.axis[np.argmax(np.abs(self.axis))] < 0
        if name == "ellipse" and form[0] < form[1]:
            form = form[::-1].copy()
            rotation = rotation @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        rotation = rotation * (np.array([1.0, -1, -1]) if flip else np.ones(3))
        if rotation[np.argmax(np.abs(rotation[:, 0])), 0] < 0:
            rotation = rotation * np.array([-1.0, -1, 1])
        return replace(self, rotation=rotation, form=form)

    def scaled(self, factor: float, shift: FloatArray) -> Shape:
        """Return the shape after the transformation x -> factor x + shift."""
        lengths = np.array([1.0 if name == "half_angle" else factor for name in self.kind.form])
        return replace(self, origin=factor * self.origin + shift, form=self.form * lengths)


def axes_along(direction: FloatArray) -> FloatArray:
    """Return right-handed axes as columns, the third along a direction, (3, 3).

    Source: Duff et al. (2017), Building an orthonormal basis, revisited, JCGT 6(1).
    """
    x, y, z = direction / np.linalg.norm(direction)
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    return np.array([[1 + sign * x * x * a, b, x], [sign * b, sign + y * y * a, y], [-sign * x, -y, z]])
