"""Distances of one instrument, whose additive constant is found from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.observations.groups import Fit, Group
from sfm.observations.kind import Values

if TYPE_CHECKING:
    from sfm.network import Network


@dataclass(frozen=True)
class OffsetDistances(Group):
    """Slope distances that are all longer than the true ones by the same unknown constant."""

    name: ClassVar[str] = "distances with additive constant"
    single: ClassVar[str] = "distances with additive constant"
    components: ClassVar[tuple[str, ...]] = ("length",)
    texts: ClassVar[tuple[str, ...]] = ("instrument", "from", "to")
    least: ClassVar[int] = 3  # two distances

    ends: IntArray  # of each distance, which of the points, (r, 2)

    @property
    def reported(self) -> tuple[str, ...]:
        """The name of the constant."""
        return ("additive constant",)

    def fit(self, X: FloatArray) -> Fit:
        """Return |X2 - X1| plus the constant less the distances; H by the constant."""
        d = X[self.ends[:, 1]] - X[self.ends[:, 0]]
        length = np.maximum(np.linalg.norm(d, axis=1), np.finfo(float).tiny)
        away, w, row = length - self.value[:, 0], self.weights, np.arange(len(d))
        Jx = np.zeros((len(d), 1, len(X), 3))
        Jx[row, 0, self.ends[:, 1]] = d / length[:, None]
        Jx[row, 0, self.ends[:, 0]] = -d / length[:, None]
        constant = -(w * away).sum() / w.sum()
        return Fit((away + constant)[:, None], Jx, np.ones((len(d), 1, 1)), np.array([constant]))

    def simulated(self, values: Values, rng: np.random.Generator | None = None) -> Self:
        """Return the distances of an instrument with the constant that these have; 0 where they are all 0.

        Distances of a plan are not measured yet: zeros do not state that the constant takes off the lengths.
        """
        one = self
        if not self.value.any():
            start, end = values.points[self.point[self.ends]].swapaxes(0, 1)
            one = replace(self, value=np.linalg.norm(end - start, axis=1)[:, None])
        return super(OffsetDistances, one).simulated(values, rng)

    def row_points(self, network: Network) -> list[tuple[str, ...]]:
        """Return the names of both points of each distance, (r,)."""
        names = [network.points[j] for j in self.point]
        return [(names[i], names[j]) for i, j in self.ends]

    def keep(self, points: BoolArray, images: BoolArray) -> Self:
        """Return the distances between some points alone."""
        return self.select_parts(np.logical_and(*points[self.point[self.ends]].T))

    def select_parts(self, on: BoolArray) -> Self:
        """Return some of the distances, with the points that they are between, (r,)."""
        used, ends = np.unique(self.ends[on], return_inverse=True)
        part = replace(self, point=self.point[used], ends=ends.reshape(-1, 2))
        return replace(part, value=self.value[on], sigma=self.sigma[on])

    @classmethod
    def of_group(
        cls, group: str, points: IntArray, value: FloatArray, sigma: FloatArray, number: Mapping[str, int]
    ) -> Self:
        """Return the distances of an instrument."""
        used, ends = np.unique(points, return_inverse=True)
        return cls(group, used, value, sigma, ends.reshape(-1, 2))
