"""The parameters of shapes as people want them, and their derivatives by a shape's own motions and form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.conventions import FloatArray
from sfm.geometry.shapes.shape import Shape

WITH_DIAMETER = ("circle", "sphere", "cylinder")


@dataclass(frozen=True)
class Parameters:
    """What the values of a shape are."""

    names: tuple[str, ...]  # of each parameter: centre, direction, radius ...
    axes: tuple[str, ...]  # X, Y or Z of a vector, empty of a single number
    kinds: tuple[str, ...]  # coordinate | direction | length | angle

    def rows(self, name: str) -> slice:
        """Return the rows of a parameter by its name."""
        first = self.names.index(name)
        return slice(first, first + self.names.count(name))


def parameters_of(shape: Shape) -> tuple[Parameters, FloatArray, FloatArray]:
    """Return the parameters of a shape.

    Args:
        shape: in object units.

    Returns:
        What they are, their values (p,), and their derivatives by shifts and rotations in the shape's own
        axes and by its form, (p, 6 + q).
    """
    kind, R, form = shape.kind, shape.rotation, shape.form
    q = len(form)
    rows: list[tuple[str, str, FloatArray, FloatArray]] = []
    at = np.zeros((3, 6 + q))
    at[:, :3] = R
    direction = np.zeros((3, 6 + q))
    direction[:, 3], direction[:, 4] = -R[:, 1], R[:, 0]
    place, by_place = shape.origin, at
    if kind.name == "cone" and abs(form[1]) > 1e-9:
        # the apex lies where the radius is 0: along = -r / tan
        along = -form[0] / np.tan(form[1])
        by_form = np.array([-1 / np.tan(form[1]), form[0] / np.sin(form[1]) ** 2])
        place = shape.origin + along * R[:, 2]
        by_place = at + along * direction
        by_place[:, 6:] = np.outer(R[:, 2], by_form)
    rows.append((kind.place, "coordinate", place, by_place))
    if kind.name != "sphere":
        rows.append(("direction", "direction", R[:, 2], direction))
    if kind.name == "ellipse":
        major = np.zeros((3, 6 + q))
        major[:, 4], major[:, 5] = -R[:, 2], R[:, 1]
        rows.append(("major_axis", "direction", R[:, 0], major))
    if kind.name == "paraboloid":
        by_focus = at + form[0] * direction
        by_focus[:, 6] = R[:, 2]
        rows.append(("focus", "coordinate", shape.origin + form[0] * R[:, 2], by_focus))
    for k, name in enumerate(kind.form):
        if kind.name == "cone" and name == "radius":
            continue  # that abreast of the centroid is nobody's dimension
        own = np.zeros((1, 6 + q))
        own[0, 6 + k] = 1.0
        rows.append((name, "angle" if name == "half_angle" else "length", form[k : k + 1], own))
        if name == "radius" and kind.name in WITH_DIAMETER:
            rows.append(("diameter", "length", 2 * form[k : k + 1], 2 * own))
    names = tuple(name for name, _, value, _ in rows for _ in value)
    axes = tuple(axis for _, _, value, _ in rows for axis in ("XYZ" if len(value) == 3 else ("",)))
    kinds = tuple(kind for _, kind, value, _ in rows for _ in value)
    values = np.concatenate([value for _, _, value, _ in rows])
    return Parameters(names, axes, kinds), values, np.vstack([J for _, _, _, J in rows])
