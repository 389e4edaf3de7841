"""Mounts of the cameras of a rig known beforehand, as from an earlier calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray, angles_from_rotation
from sfm.observations.exterior import exterior_jacobian
from sfm.observations.kind import MOUNT, Block, Kind, Linear, Values

if TYPE_CHECKING:
    from sfm.network import Estimate, Network


@dataclass(frozen=True)
class MountObservations(Kind):
    """Mounts of the cameras of a rig known beforehand, as from an earlier calibration."""

    name: ClassVar[str] = "mounts"
    single: ClassVar[str] = "mount"
    components: ClassVar[tuple[str, ...]] = ("X", "Y", "Z", "omega", "phi", "kappa")

    camera: IntArray  # index of the camera, (c,)
    position: FloatArray  # projection centre in the axes of the rig, object unit, (c, 3)
    angles: FloatArray  # omega, phi, kappa of image axes to those of the rig, rad, (c, 3)
    covariance: FloatArray  # of both; infinite = not observed, (c, 6, 6)

    def __len__(self) -> int:
        return len(self.camera)

    def covariances(self) -> FloatArray:
        """Return the covariance of each, (c, 6, 6)."""
        return self.covariance

    @property
    def values(self) -> FloatArray:
        """X, Y, Z in the object unit and omega, phi, kappa in rad, (c, 6)."""
        return np.hstack([self.position, self.angles])

    def blocks(self) -> tuple[Block, ...]:
        """Return the mounts."""
        return (Block(MOUNT, self.camera),)

    def linearise(self, values: Values) -> Linear:
        """Return X, Y, Z, omega, phi, kappa minus those observed, and the derivatives by X, w."""
        M = values.camera_from_rig[self.camera]
        angles = angles_from_rotation(np.swapaxes(M, 1, 2)) - self.angles
        turned = (angles + np.pi) % (2 * np.pi) - np.pi
        return Linear(
            np.hstack([values.mount_position[self.camera] - self.position, turned]), (exterior_jacobian(M),)
        )

    def names(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of the cameras."""
        return tuple(estimate.cameras[a].name for a in self.camera)

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of lengths, and rad."""
        return ((length_unit,) * 3 + ("rad",) * 3,) * len(self)

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return some of the mounts."""
        return replace(
            self,
            camera=self.camera[rows],
            position=self.position[rows],
            angles=self.angles[rows],
            covariance=self.covariance[rows],
        )
