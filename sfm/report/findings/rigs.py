"""Where the cameras of rigs are mounted: base and angles from the reference camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, angles_from_rotation


@dataclass(frozen=True)
class Mount:
    """A camera in the axes of its rig, which are the image axes of the reference camera."""

    camera: str
    base: float  # distance from the projection centre of the reference camera, object unit
    base_sigma: float
    position: FloatArray  # X, Y, Z of the projection centre, object unit, (3,)
    position_sigma: FloatArray  # (3,)
    rotation_deg: FloatArray  # omega, phi, kappa of R, image axes to those of the rig, deg, (3,)
    rotation_sigma_deg: FloatArray  # (3,)

    @property
    def values(self) -> tuple[tuple[str, float, float, bool], ...]:
        """Name, value, standard deviation, and whether it is a length, of base, position and rotation."""
        names = ("X", "Y", "Z"), ("omega", "phi", "kappa")
        position = zip(names[0], self.position.tolist(), self.position_sigma.tolist(), strict=True)
        rotation = zip(names[1], self.rotation_deg.tolist(), self.rotation_sigma_deg.tolist(), strict=True)
        return (
            ("base", self.base, self.base_sigma, True),
            *((name, value, sigma, True) for name, value, sigma in position),
            *((name, value, sigma, False) for name, value, sigma in rotation),
        )


@dataclass(frozen=True)
class Rig:
    """A rig: its reference camera, the mounts of the others, and how often it was used."""

    name: str
    reference: str
    mounts: tuple[Mount, ...]
    moments: int  # with photographs of two cameras at least


def rigs_of(a: Adjustment) -> tuple[Rig, ...]:
    """Return the rigs of an adjustment."""
    mounts, moment = a.estimate.mounts, a.network.moment
    if mounts is None or moment is None:
        return ()
    found = []
    for rig, (reference, *others_on) in mounts.by_rig().items():
        of_rig = np.isin(a.network.camera, [reference, *others_on])
        others = tuple(_mount(a, k) for k in others_on)
        shared = int((np.bincount(moment[of_rig]) > 1).sum())
        found.append(Rig(rig, a.estimate.cameras[reference].name, others, shared))
    return tuple(found)


def _mount(a: Adjustment, camera: int) -> Mount:
    mounts, Q = a.estimate.mounts, a.covariance.mounts[camera]
    assert mounts is not None
    X = mounts.position[camera]
    base = float(np.linalg.norm(X))
    along = X / max(base, np.finfo(float).tiny)
    sigma = np.sqrt(np.maximum(np.diagonal(Q), 0.0))
    return Mount(
        a.estimate.cameras[camera].name,
        base,
        float(np.sqrt(max(along @ Q[:3, :3] @ along, 0.0))),
        X,
        sigma[:3],
        np.degrees(angles_from_rotation(mounts.rotation[camera])),
        np.degrees(sigma[3:]),
    )
