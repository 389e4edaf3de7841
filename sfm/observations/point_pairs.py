"""Observations between two object points, or two photographs, each."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.observations.kind import PHOTOGRAPH, POINT, Block, Linear, RowKind, Values

if TYPE_CHECKING:
    from sfm.network import Estimate, Network


@dataclass(frozen=True)
class Pairs(RowKind):
    """Observations of d components between two object points or photographs."""

    texts: ClassVar[tuple[str, ...]] = ("from", "to")

    start: IntArray  # index of the first one, (n,)
    end: IntArray  # index of the second one, (n,)
    value: FloatArray  # object unit or rad, (n, d)
    sigma: FloatArray  # (n, d)

    def __len__(self) -> int:
        return len(self.start)

    @property
    def values(self) -> FloatArray:
        """Observed values, (n, d)."""
        return self.value

    def with_values(self, values: FloatArray) -> Self:
        """Return them with other observed values."""
        return replace(self, value=values)

    def with_sigma(self, sigma: FloatArray) -> Self:
        """Return them with other standard deviations."""
        return replace(self, sigma=sigma)

    def blocks(self) -> tuple[Block, ...]:
        """Return both ends."""
        return Block(self.texts_of, self.start), Block(self.texts_of, self.end)

    def names(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of both ends."""
        of = network.images if self.texts_of == PHOTOGRAPH else network.points
        return tuple(f"{of[i]} - {of[j]}" for i, j in zip(self.start, self.end, strict=True))

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
        """Return them with their ends at other places."""
        place = points if self.texts_of == POINT else images
        return self if place is None else replace(self, start=place[self.start], end=place[self.end])

    @classmethod
    def of_table(cls, indices: tuple[IntArray, ...], value: FloatArray, sigma: FloatArray) -> Self:
        """Return the observations of a table."""
        start, end = indices
        return cls(start, end, value, sigma)


class PointPairs(Pairs):
    """Observations that depend on the difference of the coordinates of two object points."""

    @classmethod
    @abstractmethod
    def computed(cls, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return values (n, d) and derivatives (n, d, 3) by the differences of the points X2 - X1, (n, 3)."""

    def linearise(self, values: Values) -> Linear:
        """Return computed minus observed, and the derivatives by both points."""
        computed, J = self.computed(values.points[self.end] - values.points[self.start])
        return Linear(computed - self.value, (-J, J))
