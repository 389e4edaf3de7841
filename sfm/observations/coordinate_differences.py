"""Differences of coordinates between object points, as of GNSS baselines or a tracker."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np

from sfm.conventions import FloatArray
from sfm.observations.point_pairs import PointPairs


class CoordinateDifferences(PointPairs):
    """Differences of X, Y and Z between object points."""

    name: ClassVar[str] = "coordinate differences"
    single: ClassVar[str] = "coordinate difference"
    components: ClassVar[tuple[str, ...]] = ("dX", "dY", "dZ")

    @classmethod
    def computed(cls, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return d, and the unit matrix."""
        return d, np.broadcast_to(np.eye(3), (len(d), 3, 3))

    def mistakes(self) -> Mapping[str, Self]:
        """Return the differences between exchanged points."""
        return {**super().mistakes(), "exchanged": replace(self, value=-self.value)}
