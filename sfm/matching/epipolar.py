"""Epipolar geometry of two oriented photographs, in images free of distortion."""

from __future__ import annotations

import numpy as np
from numba import njit

from sfm.conventions import FloatArray, IntArray, skew


def essential_matrices(position: FloatArray, rotation: FloatArray, pairs: IntArray) -> FloatArray:
    """Return E of pairs of photographs, so that q_j^T E q_i = 0 for the image vectors of one point.

    Args:
        position: projection centres X0, object unit, (m, 3).
        rotation: R of each photograph, image to object axes, (m, 3, 3).
        pairs: indices i, j of the photographs, (p, 2).

    Returns:
        E = M_j [b]x R_i with the unit base b from i to j, shape (p, 3, 3); image vectors are
        q = (u, v, -1) with the tangents u = -U/W, v = -V/W.

    Source: Kraus (2007), sec. 4.3; Hartley and Zisserman (2004), sec. 9.6.
    """
    i, j = np.asarray(pairs).T
    base = position[j] - position[i]
    length = np.linalg.norm(base, axis=1, keepdims=True)
    unit = base / np.where(length > 0, length, 1.0)
    return np.asarray(np.swapaxes(rotation[j], 1, 2) @ skew(unit) @ rotation[i])


@njit(cache=True)
def epipolar_distance(E, ui, vi, uj, vj):  # type: ignore[no-untyped-def]
    """Distance of (uj, vj) from the epipolar line of (ui, vi), in tangents; inf where there is no line."""
    l0 = E[0, 0] * ui + E[0, 1] * vi - E[0, 2]
    l1 = E[1, 0] * ui + E[1, 1] * vi - E[1, 2]
    l2 = E[2, 0] * ui + E[2, 1] * vi - E[2, 2]
    slope = np.sqrt(l0 * l0 + l1 * l1)
    if slope < 1e-15:
        return np.inf
    return abs(l0 * uj + l1 * vj - l2) / slope
