"""Positions of an antenna beside the camera, as by GNSS, with the lever arm in the camera's axes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray, skew
from sfm.observations.kind import PHOTOGRAPH, Block, Linear, RowKind, Values

if TYPE_CHECKING:
    from sfm.network import Estimate, Network


@dataclass(frozen=True)
class AntennaPositions(RowKind):
    """Positions of an antenna that is mounted on the camera."""

    name: ClassVar[str] = "antenna positions"
    single: ClassVar[str] = "antenna position"
    components: ClassVar[tuple[str, ...]] = ("X", "Y", "Z")
    texts: ClassVar[tuple[str, ...]] = ("image",)
    texts_of: ClassVar[str] = PHOTOGRAPH
    numbers: ClassVar[tuple[str, ...]] = ("lever_x", "lever_y", "lever_z")

    image: IntArray  # index of the photograph, (n,)
    lever: FloatArray  # the antenna in image axes from the projection centre, object unit, (n, 3)
    position: FloatArray  # X, Y, Z of the antenna, object unit, (n, 3)
    sigma: FloatArray  # object unit, (n, 3)

    def __len__(self) -> int:
        return len(self.image)

    @property
    def values(self) -> FloatArray:
        """Positions, object unit, (n, 3)."""
        return self.position

    @property
    def without_sigma(self) -> FloatArray:
        """Lever arms, object unit, (n, 3)."""
        return self.lever

    def with_values(self, values: FloatArray) -> Self:
        """Return them with other positions."""
        return replace(self, position=values)

    def with_sigma(self, sigma: FloatArray) -> Self:
        """Return them with other standard deviations."""
        return replace(self, sigma=sigma)

    def blocks(self) -> tuple[Block, ...]:
        """Return the photographs."""
        return (Block(PHOTOGRAPH, self.image),)

    def linearise(self, values: Values) -> Linear:
        """Return X0 + R lever - observed, and the derivatives I and -R [lever]x by X0, w."""
        R = np.swapaxes(values.M[self.image], 1, 2)
        computed = values.position[self.image] + np.einsum("nab,nb->na", R, self.lever)
        unit = np.broadcast_to(np.eye(3), (len(self), 3, 3))
        return Linear(computed - self.position, (np.concatenate([unit, -R @ skew(self.lever)], axis=2),))

    def names(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of the photographs."""
        return tuple(network.images[i] for i in self.image)

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return some of the positions."""
        return replace(
            self,
            image=self.image[rows],
            lever=self.lever[rows],
            position=self.position[rows],
            sigma=self.sigma[rows],
        )

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return them with the photographs at other places."""
        return self if images is None else replace(self, image=images[self.image])

    def shifted(self, by: FloatArray) -> Self:
        """Return them with a shift added to all positions."""
        return replace(self, position=self.position + by)

    @classmethod
    def of_table(cls, indices: tuple[IntArray, ...], value: FloatArray, sigma: FloatArray) -> Self:
        """Return the observations of a table; the lever arms come before the values."""
        return cls(indices[0], value[:, :3], value[:, 3:], sigma)
