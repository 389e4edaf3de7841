"""Horizontal directions from a station, as by theodolite; its orientation is found from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np

from sfm.conventions import FloatArray, IntArray
from sfm.observations.groups import Fit, Group


class HorizontalDirections(Group):
    """Directions in X, Y from one object point to others, clockwise as instruments count; Z is up."""

    name: ClassVar[str] = "horizontal directions"
    single: ClassVar[str] = "horizontal direction"
    components: ClassVar[tuple[str, ...]] = ("direction",)
    texts: ClassVar[tuple[str, ...]] = ("station", "point")
    angles: ClassVar[tuple[str, ...]] = ("direction",)
    labelled: ClassVar[bool] = False
    least: ClassVar[int] = 3  # the station and two targets

    def fit(self, X: FloatArray) -> Fit:
        """Return atan2(dX, dY) less orientation and direction; H by the orientation."""
        d = X[1:, :2] - X[0, :2]
        square = np.maximum((d**2).sum(axis=1), np.finfo(float).tiny)
        away = np.arctan2(d[:, 0], d[:, 1]) - self.value[:, 0]
        w = self.weights
        orientation = np.arctan2((w * np.sin(away)).sum(), (w * np.cos(away)).sum())
        l = (away - orientation + np.pi) % (2 * np.pi) - np.pi
        l = l - (w * l).sum() / w.sum()
        Jx = np.zeros((len(d), 1, len(X), 3))
        by = np.stack([d[:, 1] / square, -d[:, 0] / square], axis=1)
        Jx[np.arange(len(d)), 0, 1 + np.arange(len(d)), :2] = by
        Jx[:, 0, 0, :2] = -by
        return Fit(l[:, None], Jx, -np.ones((len(d), 1, 1)))

    def mistakes(self) -> Mapping[str, Self]:
        """Return the directions counted the other way round."""
        return {**super().mistakes(), "counter-clockwise": replace(self, value=-self.value)}

    @classmethod
    def of_group(
        cls, group: str, points: IntArray, value: FloatArray, sigma: FloatArray, number: Mapping[str, int]
    ) -> Self:
        """Return the directions from a station, whose point comes before those of its targets."""
        return cls(group, np.concatenate([[number[group]], points[:, 0]]), value, sigma)
