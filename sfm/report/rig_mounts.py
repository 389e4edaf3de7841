"""Rigs of a survey: the mounts of their cameras, and how well image points fit the epipolar geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.matching.epipolar import essential_matrices
from sfm.model.camera import tangents_from_pixel
from sfm.model.conventions import FloatArray, IntArray, angles_from_rotation

TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True)
class EpipolarDistances:
    """Distances of image points from the epipolar lines of the same points in the reference camera."""

    xy: FloatArray  # image points seen by both cameras at one moment, px, (k, 2)
    px: FloatArray  # their distances from the epipolar lines, (k,)

    @property
    def rms_px(self) -> float:
        """Root mean square distance, px; NaN without image points."""
        return float(np.sqrt(np.mean(self.px**2))) if len(self.px) else float("nan")


@dataclass(frozen=True)
class Mount:
    """A camera in the axes of its rig, which are the image axes of the reference camera."""

    camera: str
    base: float  # distance from the projection centre of the reference camera, object unit
    base_sigma: float
    position: FloatArray  # X, Y, Z of the projection centre, object unit, (3,)
    position_sigma: FloatArray  # (3,)
    rotation_deg: FloatArray  # omega, phi, kappa of R from image axes to rig axes, deg, (3,)
    rotation_sigma_deg: FloatArray  # (3,)
    epipolar: EpipolarDistances | None  # None if image points are planned

    @property
    def values(self) -> tuple[tuple[str, float, float, bool], ...]:
        """Name, value, standard deviation, and whether it is a length, of base, position and rotation."""
        names = ("X", "Y", "Z"), ("omega", "phi", "kappa")
        position = zip(names[0], self.position.tolist(), self.position_sigma.tolist(), strict=True)
        rotation = zip(names[1], self.rotation_deg.tolist(), self.rotation_sigma_deg.tolist(), strict=True)
        lengths = [(name, value, sigma, True) for name, value, sigma in position]
        angles = [(name, value, sigma, False) for name, value, sigma in rotation]
        return (("base", self.base, self.base_sigma, True), *lengths, *angles)


@dataclass(frozen=True)
class Rig:
    """A rig: its reference camera, the mounts of the others, and how often it was used."""

    name: str
    reference: str
    mounts: tuple[Mount, ...]
    moments: int  # with photographs of at least two cameras


def rigs_of(a: Adjustment, *, planned: bool = False) -> tuple[Rig, ...]:
    """Return the rigs of an adjustment, without epipolar distances if it is planned."""
    mounts, moment = a.estimate.mounts, a.network.moment
    if mounts is None or moment is None:
        return ()
    rigs = []
    for rig, (reference, *others_on) in mounts.by_rig().items():
        of_rig = np.isin(a.network.camera, [reference, *others_on])
        others = tuple(
            _mount(a, k, None if planned else _epipolar(a, reference, k, moment)) for k in others_on
        )
        shared = int((np.bincount(moment[of_rig]) > 1).sum())
        rigs.append(Rig(rig, a.estimate.cameras[reference].name, others, shared))
    return tuple(rigs)


def _epipolar(a: Adjustment, reference: int, camera: int, moment: IntArray) -> EpipolarDistances:
    """Return the distances of image points from epipolar lines of the reference camera of their rig.

    Source: Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2020), sec. 4.3.2 (coplanarity).
    """
    mounts, k = a.estimate.mounts, a.network.image_points
    assert mounts is not None
    rows = [np.flatnonzero(~a.rejected & (a.network.camera[k.image] == of)) for of in (reference, camera)]
    keys = [moment[k.image[of_camera]] * len(a.network.points) + k.point[of_camera] for of_camera in rows]
    _, *common = np.intersect1d(keys[0], keys[1], return_indices=True)
    first, second = (of_camera[at] for of_camera, at in zip(rows, common, strict=True))
    d1, d2 = (
        np.column_stack([tangents_from_pixel(a.estimate.cameras[of], k.xy[at]), -np.ones(len(at))])
        for of, at in ((reference, first), (camera, second))
    )
    pair = [reference, camera]
    (E,) = essential_matrices(mounts.position[pair], mounts.rotation[pair], np.array([[0, 1]]))
    line = d1 @ E.T
    away = np.einsum("ka,ka->k", line, d2) / np.maximum(np.hypot(line[:, 0], line[:, 1]), TINY)
    known = np.isfinite(away)
    return EpipolarDistances(k.xy[second][known], a.estimate.cameras[camera].c_px * away[known])


def _mount(a: Adjustment, camera: int, epipolar: EpipolarDistances | None) -> Mount:
    mounts, Q = a.estimate.mounts, a.covariance.mounts[camera]
    assert mounts is not None
    X = mounts.position[camera]
    base = float(np.linalg.norm(X))
    along = X / max(base, TINY)
    sigma = np.sqrt(np.maximum(np.diagonal(Q), 0.0))
    return Mount(
        a.estimate.cameras[camera].name,
        base,
        float(np.sqrt(max(along @ Q[:3, :3] @ along, 0.0))),
        X,
        sigma[:3],
        np.degrees(angles_from_rotation(mounts.rotation[camera])),
        np.degrees(sigma[3:]),
        epipolar,
    )
