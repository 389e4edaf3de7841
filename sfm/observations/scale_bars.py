"""Measured distances between object points."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.observations.kind import POINT, Block, Kind, Linear, Values, no_index, no_value

if TYPE_CHECKING:
    from sfm.network import Estimate, Network


@dataclass(frozen=True)
class ScaleBars(Kind):
    """Measured distances between object points."""

    name: ClassVar[str] = "scale bars"
    single: ClassVar[str] = "scale bar"
    components: ClassVar[tuple[str, ...]] = ("length",)

    start: IntArray = field(default_factory=no_index)  # index of the first point, (b,)
    end: IntArray = field(default_factory=no_index)  # index of the second point, (b,)
    length: FloatArray = field(default_factory=no_value)  # object unit, (b,)
    sigma: FloatArray = field(default_factory=no_value)  # object unit, (b,)

    def __len__(self) -> int:
        return len(self.start)

    def covariances(self) -> FloatArray:
        """Return the variance of each length, object unit^2, (b, 1, 1)."""
        return self.sigma[:, None, None] ** 2

    @property
    def values(self) -> FloatArray:
        """Lengths, object unit, (b, 1)."""
        return self.length[:, None]

    def with_values(self, values: FloatArray) -> Self:
        """Return the bars with other lengths."""
        return replace(self, length=values[:, 0])

    def with_sigma(self, sigma: FloatArray) -> Self:
        """Return the bars with other standard deviations, (b,)."""
        return replace(self, sigma=sigma)

    def blocks(self) -> tuple[Block, ...]:
        """Return both ends."""
        return Block(POINT, self.start), Block(POINT, self.end)

    def linearise(self, values: Values) -> Linear:
        """Return |X2 - X1| - length, and the direction between them."""
        d = values.points[self.end] - values.points[self.start]
        length = np.linalg.norm(d, axis=1)
        direction = (d / np.maximum(length, np.finfo(float).tiny)[:, None])[:, None]
        return Linear((length - self.length)[:, None], (-direction, direction))

    def names(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of both ends."""
        ends = zip(self.start, self.end, strict=True)
        return tuple(f"{network.points[i]} - {network.points[j]}" for i, j in ends)

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of lengths."""
        return ((length_unit,),) * len(self)

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return some of the bars."""
        return replace(
            self,
            start=self.start[rows],
            end=self.end[rows],
            length=self.length[rows],
            sigma=self.sigma[rows],
        )

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return them with the points at other places."""
        return replace(self, start=points[self.start], end=points[self.end])
