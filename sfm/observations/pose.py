"""Position and angles known beforehand: what photographs and mounts of cameras have in common."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from sfm.conventions import FloatArray, angles_from_rotation
from sfm.observations.kind import Kind, Linear, Values

if TYPE_CHECKING:
    from sfm.network import Estimate

MIN_COS_PHI = 1e-8  # nearer to +-90 deg omega and kappa have no separate sigmas


class PoseObservations(Kind):
    """Positions and angles of n things known beforehand; a kind adds the index of each."""

    position: FloatArray  # X0, object unit, (n, 3)
    angles: FloatArray  # omega, phi, kappa, rad, (n, 3)
    covariance: FloatArray  # of both; variance 0 = fixed, infinite = not observed, (n, 6, 6)

    @abstractmethod
    def poses(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return X0, (n, 3), and the rotations into the image axes, (n, 3, 3), at some values."""

    def __len__(self) -> int:
        return len(self.position)

    def covariances(self) -> FloatArray:
        """Return the covariance of each, (n, 6, 6)."""
        return self.covariance

    @property
    def values(self) -> FloatArray:
        """X0 in the object unit and omega, phi, kappa in rad, (n, 6)."""
        return np.hstack([self.position, self.angles])

    def linearise(self, values: Values) -> Linear:
        """Return X0, omega, phi, kappa minus those observed, and the derivatives by X0, w."""
        position, M = self.poses(values)
        angles = angles_from_rotation(np.swapaxes(M, 1, 2)) - self.angles
        turned = (angles + np.pi) % (2 * np.pi) - np.pi
        return Linear(np.hstack([position - self.position, turned]), (exterior_jacobian(M),))

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of lengths, and rad."""
        return ((length_unit,) * 3 + ("rad",) * 3,) * len(self)


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
