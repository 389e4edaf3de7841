"""A shape in space: its kind, its axes and its form, and how distances change with each of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.conventions import FloatArray, rotation_from_vector
from sfm.geometry.shapes.kinds import Kind

PLACED_ALONG = ("line", "cylinder", "cone")  # kinds with an origin anywhere along the axis


@dataclass(frozen=True)
class Shape:
    """A shape in space."""

    kind: Kind
    origin: FloatArray  # c, object unit, (3,)
    rotation: FloatArray  # R, the axes of the shape as columns, (3, 3)
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
            Distances, normals, and derivatives by shifts and rotations of the shape in its axes and by
            its form, (n, c, 6 + q).
        """
        y = (xyz - self.origin) @ self.rotation
        d, g, of_form = self.kind.distance(y, self.form)
        return d, g @ self.rotation.T, np.concatenate([-g, -_cross(y, g), of_form], axis=2)

    def moved(self, step: FloatArray, centroid: FloatArray) -> Shape:
        """Return the shape after a step, its origin abreast of a point where it may be anywhere.

        Args:
            step: shifts and rotations in the axes of the shape, and of the form, (6 + q,).
            centroid: of the points, (3,).
        """
        origin = self.origin + self.rotation @ step[:3]
        rotation = self.rotation @ rotation_from_vector(step[3:6])
        U, _, Vt = np.linalg.svd(rotation)  # rounding must not add up
        return Shape(self.kind, origin, U @ Vt, self.form + step[6:]).placed(centroid)

    def placed(self, centroid: FloatArray) -> Shape:
        """Return the same shape with its origin abreast of a point, where the kind leaves it free."""
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
        """Return the same shape with a direction that does not depend on chance, and its form positive.

        The largest component of the direction is positive; that of a cone opens it, that of a paraboloid
        leads from its vertex to its focus.
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
        """Return the shape after x -> factor x + shift."""
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


def _cross(y: FloatArray, g: FloatArray) -> FloatArray:
    """Return y x g of points (n, 3) and vectors (n, c, 3)."""
    a, b, c = (y[:, None, k] for k in range(3))
    p, q, r = (g[..., k] for k in range(3))
    return np.stack([b * r - c * q, c * p - a * r, a * q - b * p], axis=2)
