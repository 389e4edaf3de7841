"""Mounts of the cameras of a rig known beforehand, as from an earlier calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.observations.kind import MOUNT, Block, Values
from sfm.observations.pose import PoseObservations

if TYPE_CHECKING:
    from sfm.network import Estimate, Network


@dataclass(frozen=True)
class MountObservations(PoseObservations):
    """Mounts of the cameras of a rig known beforehand, as from an earlier calibration."""

    name: ClassVar[str] = "mounts"
    single: ClassVar[str] = "mount"
    components: ClassVar[tuple[str, ...]] = ("X", "Y", "Z", "omega", "phi", "kappa")

    camera: IntArray  # index of the camera, (c,)
    position: FloatArray  # projection centre in the axes of the rig, object unit, (c, 3)
    angles: FloatArray  # omega, phi, kappa of image axes to those of the rig, rad, (c, 3)
    covariance: FloatArray  # of both; infinite = not observed, (c, 6, 6)

    def with_values(self, values: FloatArray) -> Self:
        """Return them with other positions and angles."""
        return replace(self, position=values[:, :3], angles=values[:, 3:])

    def blocks(self) -> tuple[Block, ...]:
        """Return the mounts."""
        return (Block(MOUNT, self.camera),)

    def poses(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the projection centres, (c, 3), and axes of the rig to image axes, (c, 3, 3)."""
        return values.mount_position[self.camera], values.camera_from_rig[self.camera]

    def names(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of the cameras."""
        return tuple(estimate.cameras[a].name for a in self.camera)

    def of_cameras(self, on: BoolArray) -> Self:
        """Return the mounts of some cameras, counted anew, (a,)."""
        kept = self.select(on[self.camera])
        return replace(kept, camera=(np.cumsum(on) - 1)[kept.camera])

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return some of the mounts."""
        return replace(
            self,
            camera=self.camera[rows],
            position=self.position[rows],
            angles=self.angles[rows],
            covariance=self.covariance[rows],
        )
