"""Estimate: the values solved for, as frozen objects of arrays.

Photographs and points have the indices that they have in the network.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray


@dataclass(frozen=True)
class Mounts:
    """Mounts of cameras in their rigs: R_photograph = R_pose R, X0 = X_pose + R_pose X.

    The pose of a rig is the pose of its reference camera. The mount of the reference camera has position 0
    and the unit matrix as rotation; so has the mount of a camera without a rig.
    """

    position: FloatArray  # projection centre of each camera in the axes of its rig, object unit, (a, 3)
    rotation: FloatArray  # R of each camera, its image axes to those of its rig, (a, 3, 3)
    free: BoolArray  # which of X, Y, Z and small rotations about the image axes are adjusted, (a, 6)
    rig: tuple[str, ...]  # name of the rig of each camera; "" without a rig, (a,)

    @property
    def at_reference(self) -> BoolArray:
        """Which cameras are held fixed at 0: references of rigs and cameras without a rig, (a,)."""
        return np.asarray(~self.free.any(axis=1) & ~self.position.any(axis=1))

    def select(self, on: BoolArray) -> Mounts:
        """Return the mounts of the cameras selected by a mask, (a,)."""
        rig = tuple(name for name, keep in zip(self.rig, on, strict=True) if keep)
        return Mounts(self.position[on], self.rotation[on], self.free[on], rig)

    def by_rig(self) -> dict[str, list[int]]:
        """Return the indices of the cameras of each rig, its reference first."""
        cameras: dict[str, list[int]] = {}
        for a in np.argsort(~self.at_reference, kind="stable").tolist():
            if self.rig[a]:
                cameras.setdefault(self.rig[a], []).append(a)
        return dict(sorted(cameras.items(), key=lambda item: self.rig.index(item[0])))


@dataclass(frozen=True, repr=False)
class Estimate:
    """Interior and exterior orientation and object points; NaN where not yet determined.

    Example:
        >>> import sfm
        >>> result.estimate.position.shape, result.estimate.rotation.shape
        ((6, 3), (6, 3, 3))
    """

    cameras: tuple[Camera, ...]
    position: FloatArray  # projection centres X0, object unit, (m, 3)
    rotation: FloatArray  # R of each photograph, image to object axes, (m, 3, 3)
    points: FloatArray  # object points, object unit, (n, 3)
    mounts: Mounts | None = None  # mounts of the cameras; None without rigs

    @property
    def oriented(self) -> BoolArray:
        """Which photographs have an exterior orientation, (m,)."""
        return np.asarray(np.isfinite(self.position).all(axis=1))

    @property
    def determined(self) -> BoolArray:
        """Which points have coordinates, (n,)."""
        return np.asarray(np.isfinite(self.points).all(axis=1))

    def __repr__(self) -> str:
        cameras = ", ".join(f"{camera.name} ({camera.model})" for camera in self.cameras)
        return (
            f"<Estimate: {self.oriented.sum()} of {len(self.position)} photographs oriented, "
            f"{self.determined.sum()} of {len(self.points)} points, cameras {cameras}>"
        )


class AdjustedValues(NamedTuple):
    """Adjusted values in the form of `sfm.model.observations.kind.Values`."""

    points: FloatArray
    position: FloatArray
    M: FloatArray
    parameters: FloatArray
    mount_position: FloatArray
    camera_from_rig: FloatArray


def values_of(estimate: Estimate) -> AdjustedValues:
    """Return the values of an estimate in the form that the kinds of observations use."""
    cameras, mounts = estimate.cameras, estimate.mounts
    parameters = np.full((len(cameras), max(len(camera.parameters) for camera in cameras)), np.nan)
    for a, camera in enumerate(cameras):
        parameters[a, : len(camera.parameters)] = camera.parameters
    nowhere = np.zeros((len(cameras), 3)), np.tile(np.eye(3), (len(cameras), 1, 1))
    position, rotation = nowhere if mounts is None else (mounts.position, mounts.rotation)
    return AdjustedValues(
        estimate.points,
        estimate.position,
        np.swapaxes(estimate.rotation, 1, 2),
        parameters,
        position,
        np.swapaxes(rotation, 1, 2),
    )
