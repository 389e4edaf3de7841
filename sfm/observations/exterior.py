"""Exterior orientation known beforehand (satellite positions, a calibrated rig)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.observations.kind import PHOTOGRAPH, Block, Values, no_index
from sfm.observations.pose import PoseObservations

if TYPE_CHECKING:
    from sfm.network import Estimate, Network


@dataclass(frozen=True)
class ExteriorObservations(PoseObservations):
    """Exterior orientation known beforehand (satellite positions, a calibrated rig)."""

    name: ClassVar[str] = "exterior orientation"
    single: ClassVar[str] = "photograph"
    components: ClassVar[tuple[str, ...]] = ("X0", "Y0", "Z0", "omega", "phi", "kappa")

    image: IntArray = field(default_factory=no_index)  # index of the photograph, (e,)
    position: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # X0, object unit, (e, 3)
    angles: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # omega, phi, kappa, rad, (e, 3)
    covariance: FloatArray = field(
        default_factory=lambda: np.zeros((0, 6, 6))
    )  # of X0, Y0, Z0, omega, phi, kappa; variance 0 = fixed, infinite = not observed, (e, 6, 6)

    def with_values(self, values: FloatArray) -> Self:
        """Return them with other positions and angles."""
        return replace(self, position=values[:, :3], angles=values[:, 3:])

    def blocks(self) -> tuple[Block, ...]:
        """Return the photographs."""
        return (Block(PHOTOGRAPH, self.image),)

    def poses(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return X0, (e, 3), and object to image axes, (e, 3, 3)."""
        return values.position[self.image], values.M[self.image]

    def names(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of the photographs."""
        return tuple(network.images[i] for i in self.image)

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return some of the photographs."""
        return replace(
            self,
            image=self.image[rows],
            position=self.position[rows],
            angles=self.angles[rows],
            covariance=self.covariance[rows],
        )

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return them with the photographs at other places."""
        return self if images is None else replace(self, image=images[self.image])

    def shifted(self, by: FloatArray) -> Self:
        """Return them with a shift added to all projection centres."""
        return replace(self, position=self.position + by)
