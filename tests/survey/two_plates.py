"""A plate and a smaller one above it, with codes on both, to be rendered."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sfm.conventions import FloatArray
from sfm.rendering.scene import CircularTargets, Faces, Scene, coded_ring, join_marks
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.rings import CodeFamily

# Places on a plate and on one above it, mm: (face, x, y).
PLACES = [(0, x, y) for x in (-165.0, -110.0, 110.0, 165.0) for y in (-115.0, -40.0, 40.0, 115.0)]
PLACES += [(0, x, y) for x in (-40.0, 40.0) for y in (-120.0, 120.0)]
PLACES += [(1, x, y) for x in (-35.0, 35.0) for y in (-25.0, 25.0)]
FIRST_CODE = 10


def two_plates(place: Mapping[int, int], moved: Mapping[int, FloatArray] | None = None) -> Scene:
    """Return plates with codes.

    Args:
        place: for each code the number of its place.
        moved: how far codes lie from their places, mm, (2,) each.
    """
    family = code_family("ring14")
    assert isinstance(family, CodeFamily)
    faces = Faces(
        np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 60.0]]),
        np.tile(np.eye(3)[:2], (2, 1, 1)),
        np.array([[210.0, 160.0], [60.0, 50.0]]),
        np.array([0.8, 0.85]),
        np.zeros(2),
        np.ones(2),
    )
    marks = []
    for code, k in place.items():
        face, x, y = PLACES[k]
        at = np.array([x, y]) + (moved or {}).get(code, 0.0)
        marks.append(coded_ring(face, at, 7.0, code, family, 0.08, turn=0.3 * code))
    none = CircularTargets(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
    return Scene(faces, join_marks(marks), none)
