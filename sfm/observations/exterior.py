"""Exterior orientation known beforehand (satellite positions, a calibrated rig)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray, angles_from_rotation
from sfm.observations.kind import PHOTOGRAPH, Block, Kind, Linear, Values

if TYPE_CHECKING:
    from sfm.network import Estimate, Network

MIN_COS_PHI = 1e-8  # nearer to +-90 deg omega and kappa have no sigmas of their own


@dataclass(frozen=True)
class ExteriorObservations(Kind):
    """Exterior orientation known beforehand (satellite positions, a calibrated rig)."""

    name: ClassVar[str] = "exterior orientation"
    single: ClassVar[str] = "photograph"
    components: ClassVar[tuple[str, ...]] = ("X0", "Y0", "Z0", "omega", "phi", "kappa")

    image: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # index of the photograph,
    # (e,)
    position: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # X0, object unit, (e, 3)
    angles: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # omega, phi, kappa, rad, (e, 3)
    covariance: FloatArray = field(
        default_factory=lambda: np.zeros((0, 6, 6))
    )  # of X0, Y0, Z0, omega, phi, kappa; variance 0 = fixed, infinite = not observed, (e, 6, 6)

    def __len__(self) -> int:
        return len(self.image)

    def covariances(self) -> FloatArray:
        """Return the covariance of each, (n, d, d)."""
        return self.covariance

    @property
    def values(self) -> FloatArray:
        """X0 in the object unit and omega, phi, kappa in rad, (e, 6)."""
        return np.hstack([self.position, self.angles])

    def blocks(self) -> tuple[Block, ...]:
        """Return the photographs."""
        return (Block(PHOTOGRAPH, self.image),)

    def linearise(self, values: Values) -> Linear:
        """Return X0, omega, phi, kappa minus those observed, and the derivatives by X0, w."""
        M = values.M[self.image]
        angles = angles_from_rotation(np.swapaxes(M, 1, 2)) - self.angles
        turned = (angles + np.pi) % (2 * np.pi) - np.pi
        return Linear(
            np.hstack([values.position[self.image] - self.position, turned]), (exterior_jacobian(M),)
        )

    def names(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of the photographs."""
        return tuple(network.images[i] for i in self.image)

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of lengths, and rad."""
        return ((length_unit,) * 3 + ("rad",) * 3,) * len(self)

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


def angle_jacobian(M: FloatArray) -> FloatArray:
    """Return d (omega, phi, kappa) / d w of small rotations in the image axes, R <- R exp([w]x).

    Args:
        M: object to image axes, shape (m, 3, 3).

    Returns:
        Derivatives, shape (m, 3, 3); huge where phi is near +-90 deg and omega is not separable.
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
    """Return d (X0, omega, phi, kappa) / d (X0, w), see `angle_jacobian`, (m, 6, 6)."""
    J = np.zeros((len(M), 6, 6))
    J[:, :3, :3] = np.eye(3)
    J[:, 3:, 3:] = angle_jacobian(M)
    return J
