"""Differences of heights between object points, as by levelling; Z is up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np

from sfm.conventions import FloatArray
from sfm.observations.point_pairs import PointPairs


class HeightDifferences(PointPairs):
    """Differences of Z between object points."""

    name: ClassVar[str] = "height differences"
    single: ClassVar[str] = "height difference"
    components: ClassVar[tuple[str, ...]] = ("dZ",)

    @classmethod
    def computed(cls, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return dZ, and the direction of Z."""
        return d[:, 2:], np.broadcast_to(np.array([0.0, 0.0, 1.0]), (len(d), 1, 3))

    def mistakes(self) -> Mapping[str, Self]:
        """Return the differences between exchanged points."""
        return {**super().mistakes(), "exchanged": replace(self, value=-self.value)}
