"""Distances between object points, as by tape, tachymeter or laser tracker."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sfm.conventions import FloatArray
from sfm.observations.point_pairs import PointPairs


class Distances(PointPairs):
    """Slope distances between object points."""

    name: ClassVar[str] = "distances"
    single: ClassVar[str] = "distance"
    components: ClassVar[tuple[str, ...]] = ("length",)

    @classmethod
    def computed(cls, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return |d|, and its direction."""
        length = np.linalg.norm(d, axis=1, keepdims=True)
        return length, (d / np.maximum(length, np.finfo(float).tiny))[:, None]
