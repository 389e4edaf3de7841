"""Given positions and angles of photographs, mounts, photograph pairs and antennas."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from sfm.model.conventions import (
    BoolArray,
    FloatArray,
    IntArray,
    angles_from_rotation,
    rotation_from_angles,
    skew,
)
from sfm.model.estimate import Estimate
from sfm.model.observations.kind import (
    MOUNT,
    PHOTOGRAPH,
    Block,
    CoordinateKind,
    Kind,
    Linear,
    Names,
    RowKind,
    Values,
    no_index,
)
from sfm.model.observations.point_pairs import Pairs

MIN_COS_PHI = 1e-8  # closer to +-90 deg, omega and kappa have no separate sigmas


class PoseObservations(Kind):
    """Given positions and angles of n photographs or mounts; a derived class adds their indices."""

    position: FloatArray  # X0, object unit, (n, 3)
    angles: FloatArray  # omega, phi, kappa, rad, (n, 3)
    covariance: FloatArray  # position and angles; variance 0 = fixed, infinite = not observed, (n, 6, 6)

    @abstractmethod
    def poses(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return X0, (n, 3), and the rotations to image axes, (n, 3, 3), at given values."""

    def __len__(self) -> int:
        return len(self.position)

    def covariances(self) -> FloatArray:
        """Return the covariance of each observation, (n, 6, 6)."""
        return self.covariance

    @property
    def values(self) -> FloatArray:
        """X0 in the object unit and omega, phi, kappa in rad, (n, 6)."""
        return np.hstack([self.position, self.angles])

    def linearise(self, values: Values) -> Linear:
        """Return X0, omega, phi, kappa minus the observed ones, and the derivatives by X0, w."""
        position, M = self.poses(values)
        angles = angles_from_rotation(np.swapaxes(M, 1, 2)) - self.angles
        turned = (angles + np.pi) % (2 * np.pi) - np.pi
        return Linear(np.hstack([position - self.position, turned]), (exterior_jacobian(M),))

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the length unit, and rad."""
        return ((length_unit,) * 3 + ("rad",) * 3,) * len(self)


def angle_jacobian(M: FloatArray) -> FloatArray:
    """Return d (omega, phi, kappa) / d w of small rotations in the image axes, R <- R exp([w]x).

    Args:
        M: object to image axes, shape (m, 3, 3).

    Returns:
        Derivatives, shape (m, 3, 3); huge if phi is near +-90 deg, where omega is not separable.
    """
    _, phi, kappa = np.moveaxis(angles_from_rotation(np.swapaxes(M, 1, 2)), -1, 0)
    sk, ck = np.sin(kappa), np.cos(kappa)
    cos_phi = np.maximum(np.cos(phi), MIN_COS_PHI)
    T = np.zeros(M.shape)
    T[:, 0, 0], T[:, 0, 1] = ck / cos_phi, -sk / cos_phi
    T[:, 1, 0], T[:, 1, 1] = sk, ck
    T[:, 2, :2] = -np.sin(phi)[:, None] * T[:, 0, :2]
    T[:, 2, 2] = 1.0
    return T


def exterior_jacobian(M: FloatArray) -> FloatArray:
    """Return d (X0, omega, phi, kappa) / d (X0, w), see `angle_jacobian`, (m, 6, 6).

    Args:
        M: object to image axes, shape (m, 3, 3).
    """
    J = np.zeros((len(M), 6, 6))
    J[:, :3, :3] = np.eye(3)
    J[:, 3:, 3:] = angle_jacobian(M)
    return J


@dataclass(frozen=True)
class OfPhotographs(Kind):
    """Observations of single photographs."""

    image: IntArray  # index of the photograph, (n,)

    def blocks(self) -> tuple[Block, ...]:
        """Return the block of the photographs."""
        return (Block(PHOTOGRAPH, self.image),)

    def names(self, network: Names, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of the photographs."""
        return tuple(network.images[i] for i in self.image)

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return the observations with new indices of the photographs."""
        return self if images is None else replace(self, image=images[self.image])


@dataclass(frozen=True)
class ExteriorObservations(OfPhotographs, PoseObservations, CoordinateKind):
    """Given exterior orientation (satellite positions, a calibrated rig)."""

    name: ClassVar[str] = "exterior orientation"
    single: ClassVar[str] = "photograph"
    components: ClassVar[tuple[str, ...]] = ("X0", "Y0", "Z0", "omega", "phi", "kappa")

    image: IntArray = field(default_factory=no_index)  # index of the photograph, (e,)
    position: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # X0, object unit, (e, 3)
    angles: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # omega, phi, kappa, rad, (e, 3)
    # of X0, Y0, Z0, omega, phi, kappa; variance 0 = fixed, infinite = not observed, (e, 6, 6)
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 6, 6)))

    def with_values(self, values: FloatArray) -> Self:
        """Return the observations with other positions and angles, (e, 6)."""
        return replace(self, position=values[:, :3], angles=values[:, 3:])

    def with_covariance(self, covariance: FloatArray) -> Self:
        """Return the observations with another covariance, (e, 6, 6)."""
        return replace(self, covariance=covariance)

    @property
    def of_positions(self) -> Self:
        """The observations without their angles."""
        covariance = np.zeros_like(self.covariance)
        covariance[:, :3, :3] = self.covariance[:, :3, :3]
        covariance[:, range(3, 6), range(3, 6)] = np.inf
        return self.with_covariance(covariance)

    def poses(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return X0, (e, 3), and object to image axes, (e, 3, 3)."""
        return values.position[self.image], values.M[self.image]

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return the observations selected by a mask or indices."""
        return replace(
            self,
            image=self.image[rows],
            position=self.position[rows],
            angles=self.angles[rows],
            covariance=self.covariance[rows],
        )

    def shifted(self, by: FloatArray) -> Self:
        """Return the observations with a shift added to all projection centres, object unit, (3,)."""
        return replace(self, position=self.position + by)


@dataclass(frozen=True)
class MountObservations(PoseObservations):
    """Given mounts of the cameras of a rig, for example from an earlier calibration."""

    name: ClassVar[str] = "mounts"
    single: ClassVar[str] = "mount"
    components: ClassVar[tuple[str, ...]] = ("X", "Y", "Z", "omega", "phi", "kappa")

    camera: IntArray  # index of the camera, (c,)
    position: FloatArray  # projection centre in the axes of the rig, object unit, (c, 3)
    angles: FloatArray  # omega, phi, kappa from image axes to rig axes, rad, (c, 3)
    covariance: FloatArray  # position and angles; infinite = not observed, (c, 6, 6)

    def with_values(self, values: FloatArray) -> Self:
        """Return the mounts with other positions and angles, (c, 6)."""
        return replace(self, position=values[:, :3], angles=values[:, 3:])

    def blocks(self) -> tuple[Block, ...]:
        """Return the block of the mounts."""
        return (Block(MOUNT, self.camera),)

    def poses(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the projection centres, (c, 3), and the rotations from rig axes to image axes, (c, 3, 3)."""
        return values.mount_position[self.camera], values.camera_from_rig[self.camera]

    def mistakes(self) -> Mapping[str, Self]:
        """Return the inverse poses, the opposite bases and the inverse rotations."""
        X, S = self.position, self.covariance
        R = np.array([rotation_from_angles(*angles) for angles in self.angles]).reshape(-1, 3, 3)
        inverse, turned = np.swapaxes(R, 1, 2), S.copy()
        by_rotation = (X**2).sum(axis=1) * S[:, 3:, 3:].max(axis=(1, 2), initial=0.0)
        turned[:, :3, :3] = inverse @ S[:, :3, :3] @ R + by_rotation[:, None, None] * np.eye(3)
        angles, back = angles_from_rotation(inverse), -np.einsum("nab,nb->na", inverse, X)
        return {
            "inverse pose": replace(self, position=back, angles=angles, covariance=turned),
            "opposite base": replace(self, position=-X),
            "inverse rotation": replace(self, angles=angles),
        }

    def names(self, network: Names, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of the cameras."""
        return tuple(estimate.cameras[a].name for a in self.camera)

    def of_cameras(self, on: BoolArray) -> Self:
        """Return the mounts of the cameras selected by a mask (a,), with new camera indices."""
        kept = self.select(on[self.camera])
        return replace(kept, camera=(np.cumsum(on) - 1)[kept.camera])

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return the mounts selected by a mask or indices."""
        return replace(
            self,
            camera=self.camera[rows],
            position=self.position[rows],
            angles=self.angles[rows],
            covariance=self.covariance[rows],
        )


class RelativeOrientations(Pairs):
    """Position and angles of one photograph in the image axes of another."""

    name: ClassVar[str] = "relative orientations"
    single: ClassVar[str] = "relative orientation"
    components: ClassVar[tuple[str, ...]] = ("X", "Y", "Z", "omega", "phi", "kappa")
    angles: ClassVar[tuple[str, ...]] = ("omega", "phi", "kappa")
    texts_of: ClassVar[str] = PHOTOGRAPH

    def linearise(self, values: Values) -> Linear:
        """Return t = M1 (X2 - X1) and the angles of M1 R2, minus the observed values.

        With R <- R exp([w]x) the derivatives of t are -M1, [t]x by X1, w1 and M1, 0 by X2, w2. The rotation
        M1 R2 changes by the small rotation w2 - R2' R1 w1.
        """
        M1, M2 = values.M[self.start], values.M[self.end]
        t = np.einsum("nab,nb->na", M1, values.position[self.end] - values.position[self.start])
        R = M1 @ np.swapaxes(M2, 1, 2)
        turned = (angles_from_rotation(R) - self.value[:, 3:] + np.pi) % (2 * np.pi) - np.pi
        by_turn = angle_jacobian(np.swapaxes(R, 1, 2))
        first, second = np.zeros((2, len(self), 6, 6))
        first[:, :3, :3], first[:, :3, 3:] = -M1, skew(t)
        first[:, 3:, 3:] = -by_turn @ np.swapaxes(R, 1, 2)
        second[:, :3, :3], second[:, 3:, 3:] = M1, by_turn
        return Linear(np.hstack([t - self.value[:, :3], turned]), (first, second))

    def mistakes(self) -> Mapping[str, Self]:
        """Return the orientations of exchanged photographs."""
        return {**super().mistakes(), "exchanged": replace(self, start=self.end, end=self.start)}


@dataclass(frozen=True)
class AntennaPositions(OfPhotographs, RowKind):
    """Positions of an antenna mounted on the camera."""

    name: ClassVar[str] = "antenna positions"
    single: ClassVar[str] = "antenna position"
    components: ClassVar[tuple[str, ...]] = ("X", "Y", "Z")
    texts: ClassVar[tuple[str, ...]] = ("image",)
    texts_of: ClassVar[str] = PHOTOGRAPH
    numbers: ClassVar[tuple[str, ...]] = ("lever_x", "lever_y", "lever_z")

    lever: FloatArray  # from the projection centre to the antenna, image axes, object unit, (n, 3)
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
        """Return the observations with other positions, (n, 3)."""
        return replace(self, position=values)

    def with_sigma(self, sigma: FloatArray) -> Self:
        """Return the observations with other standard deviations, (n, 3)."""
        return replace(self, sigma=sigma)

    def linearise(self, values: Values) -> Linear:
        """Return X0 + R lever - observed, and the derivatives I and -R [lever]x by X0, w."""
        R = np.swapaxes(values.M[self.image], 1, 2)
        computed = values.position[self.image] + np.einsum("nab,nb->na", R, self.lever)
        unit = np.broadcast_to(np.eye(3), (len(self), 3, 3))
        return Linear(computed - self.position, (np.concatenate([unit, -R @ skew(self.lever)], axis=2),))

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return the positions selected by a mask or indices."""
        return replace(
            self,
            image=self.image[rows],
            lever=self.lever[rows],
            position=self.position[rows],
            sigma=self.sigma[rows],
        )

    def shifted(self, by: FloatArray) -> Self:
        """Return the observations with a shift added to all positions, object unit, (3,)."""
        return replace(self, position=self.position + by)

    @classmethod
    def of_table(cls, indices: tuple[IntArray, ...], value: FloatArray, sigma: FloatArray) -> Self:
        """Return the observations of a table; the lever arms precede the values."""
        return cls(indices[0], value[:, :3], value[:, 3:], sigma)
