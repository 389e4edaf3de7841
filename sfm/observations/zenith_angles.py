"""Zenith angles from one object point to another, as by theodolite; Z is up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np

from sfm.conventions import FloatArray
from sfm.observations.point_pairs import PointPairs


class ZenithAngles(PointPairs):
    """Angles between Z and the direction from one object point to another."""

    name: ClassVar[str] = "zenith angles"
    single: ClassVar[str] = "zenith angle"
    components: ClassVar[tuple[str, ...]] = ("zenith",)
    angles: ClassVar[tuple[str, ...]] = ("zenith",)

    @classmethod
    def computed(cls, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return atan2(h, dZ) with the horizontal distance h, and its derivatives."""
        tiny = np.finfo(float).tiny
        h = np.maximum(np.hypot(d[:, 0], d[:, 1]), tiny)
        square = np.maximum(h**2 + d[:, 2] ** 2, tiny)
        along = d[:, 2] / (square * h)
        J = np.stack([along * d[:, 0], along * d[:, 1], -h / square], axis=1)
        return np.arctan2(h, d[:, 2])[:, None], J[:, None]

    def mistakes(self) -> Mapping[str, Self]:
        """Return the angles counted from the horizon, and between exchanged points."""
        return {
            **super().mistakes(),
            "elevation": replace(self, value=np.pi / 2 - self.value),
            "exchanged": replace(self, value=np.pi - self.value),
        }
