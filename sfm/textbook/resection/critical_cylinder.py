"""The critical (danger) cylinder: where the resection from three points has no accuracy."""

from __future__ import annotations

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import FloatArray
from sfm.errors import GeometryError

# Relative distance below which the error of the position grows more than tenfold.
MAX_RELATIVE_DISTANCE = 0.05


@checked_arguments(position="3", points="3 3")
def cylinder_distance(position: FloatArray, points: FloatArray) -> float:
    """Return how far a projection centre is from the critical cylinder of three points, in radii.

    Args:
        position: projection centre, shape (3,), object unit.
        points: three object points, shape (3, 3), object unit.

    Returns:
        Distance from the axis over radius, minus 1: 0 on the cylinder, -1 on the axis, positive outside.

    Raises:
        GeometryError: the points lie on one line.

    Source: Finsterwalder (1903); Thompson (1966), Photogramm. Record 5(27): the circular cylinder through the
    three points with its axis at right angles to their plane.
    """
    A, B, C = np.asarray(points, dtype=float)
    b, c = B - A, C - A
    normal = np.cross(b, c)
    square = normal @ normal
    if square <= 1e-20 * (b @ b) * (c @ c):
        raise GeometryError("critical cylinder: the three points lie on one line or coincide")
    centre = (np.cross(normal, b) * (c @ c) + np.cross(c, normal) * (b @ b)) / (2 * square)
    offset = np.asarray(position) - A - centre
    across = offset - (offset @ normal) / square * normal
    return float(np.linalg.norm(across) / np.linalg.norm(centre) - 1)


def cylinder_warning(position: FloatArray, points: FloatArray) -> str:
    """Return a warning if the camera is near the critical cylinder of three points, else an empty string."""
    distance = cylinder_distance(position, points)
    if abs(distance) >= MAX_RELATIVE_DISTANCE:
        return ""
    where = "outside" if distance > 0 else "inside"
    return (
        f"the camera is {abs(distance):.1%} of the radius {where} the critical cylinder of the three points, "
        "where position and rotation are weak"
    )
