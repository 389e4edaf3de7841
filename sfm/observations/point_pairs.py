"""Observations between two object points each: distances, differences of heights and coordinates, zeniths."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.observations.kind import POINT, Block, Linear, RowKind, Values

if TYPE_CHECKING:
    from sfm.network import Estimate, Network


@dataclass(frozen=True)
class PointPairs(RowKind):
    """Observations of d components between two object points."""

    texts: ClassVar[tuple[str, ...]] = ("from", "to")

    start: IntArray  # index of the first point, (n,)
    end: IntArray  # index of the second point, (n,)
    value: FloatArray  # object unit or rad, (n, d)
    sigma: FloatArray  # (n, d)

    @classmethod
    @abstractmethod
    def computed(cls, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return values (n, d) and derivatives (n, d, 3) by the differences of the points X2 - X1, (n, 3)."""

    def __len__(self) -> int:
        return len(self.start)

    @property
    def values(self) -> FloatArray:
        """What was observed, (n, d)."""
        return self.value

    def blocks(self) -> tuple[Block, ...]:
        """Return both points."""
        return Block(POINT, self.start), Block(POINT, self.end)

    def linearise(self, values: Values) -> Linear:
        """Return computed minus observed, and the derivatives by both points."""
        computed, J = self.computed(values.points[self.end] - values.points[self.start])
        return Linear(computed - self.value, (-J, J))

    def names(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of both points."""
        ends = zip(self.start, self.end, strict=True)
        return tuple(f"{network.points[i]} - {network.points[j]}" for i, j in ends)

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return some of the observations."""
        return replace(
            self,
            start=self.start[rows],
            end=self.end[rows],
            value=self.value[rows],
            sigma=self.sigma[rows],
        )

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return them with the points at other places."""
        return replace(self, start=points[self.start], end=points[self.end])

    @classmethod
    def of_table(cls, indices: tuple[IntArray, ...], value: FloatArray, sigma: FloatArray) -> Self:
        """Return the observations of a table."""
        start, end = indices
        return cls(start, end, value, sigma)
