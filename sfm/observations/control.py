"""Object points whose coordinates are known beforehand (control)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.observations.kind import POINT, Block, Kind, Linear, Values, no_index

if TYPE_CHECKING:
    from sfm.network import Estimate, Network


@dataclass(frozen=True)
class ObjectPoints(Kind):
    """Object points whose coordinates are known beforehand (control)."""

    name: ClassVar[str] = "control points"
    single: ClassVar[str] = "control point"
    components: ClassVar[tuple[str, ...]] = ("X", "Y", "Z")

    point: IntArray = field(default_factory=no_index)  # index of the point, (n,)
    xyz: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # object unit, (n, 3)
    covariance: FloatArray = field(
        default_factory=lambda: np.zeros((0, 3, 3))
    )  # object unit^2; variance 0 = fixed, infinite = not known, (n, 3, 3)

    def __len__(self) -> int:
        return len(self.point)

    def covariances(self) -> FloatArray:
        """Return the covariance of each, (n, d, d)."""
        return self.covariance

    @property
    def values(self) -> FloatArray:
        """Coordinates, object unit, (n, 3)."""
        return self.xyz

    @property
    def complete(self) -> ObjectPoints:
        """Those of which all three coordinates are known."""
        return self.select(np.isfinite(np.einsum("nii->ni", self.covariance)).all(axis=1))

    def with_values(self, values: FloatArray) -> Self:
        """Return them with other coordinates."""
        return replace(self, xyz=values)

    def blocks(self) -> tuple[Block, ...]:
        """Return the points."""
        return (Block(POINT, self.point),)

    def linearise(self, values: Values) -> Linear:
        """Return X - observed, and the unit matrix."""
        J = np.broadcast_to(np.eye(3), (len(self), 3, 3))
        return Linear(values.points[self.point] - self.xyz, (J,))

    def names(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of the points."""
        return tuple(network.points[j] for j in self.point)

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of lengths."""
        return ((length_unit,) * 3,) * len(self)

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return some of the points."""
        return replace(self, point=self.point[rows], xyz=self.xyz[rows], covariance=self.covariance[rows])

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return them with the points at other places."""
        return replace(self, point=points[self.point])

    def shifted(self, by: FloatArray) -> Self:
        """Return them with a shift added to all coordinates."""
        return replace(self, xyz=self.xyz + by)
