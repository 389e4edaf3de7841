"""Where the cameras of rigs are mounted: base and angles from the reference camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.camera import tangents_from_pixel
from sfm.conventions import FloatArray, IntArray, angles_from_rotation


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
    epipolar_xy: FloatArray  # image points that the reference camera saw at the same moment, px, (k, 2)
    epipolar_px: FloatArray  # their distances from the epipolar lines of its image points, px, (k,)

    @property
    def epipolar_rms_px(self) -> float:
        """Root mean square distance of image points from their epipolar lines, px; NaN without any."""
        return float(np.sqrt(np.mean(self.epipolar_px**2))) if len(self.epipolar_px) else float("nan")

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
        others = tuple(_mount(a, reference, k, moment) for k in others_on)
        shared = int((np.bincount(moment[of_rig]) > 1).sum())
        found.append(Rig(rig, a.estimate.cameras[reference].name, others, shared))
    return tuple(found)


def _epipolar(a: Adjustment, reference: int, camera: int, moment: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return image points of a camera and their distances from epipolar lines of its reference camera, px.

    With the directions d1, d2 in the axes of each camera, the base b in those of the rig and the rotation R
    of the camera into them, the line of d1 is n d2 = 0 with n = R'(b x d1).

    Source: Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2020), sec. 4.3.2 (coplanarity).
    """
    mounts, k = a.estimate.mounts, a.network.image_points
    assert mounts is not None
    rows = {}
    for of in (reference, camera):
        used = np.flatnonzero(~a.rejected & (a.network.camera[k.image] == of))
        rows[of] = dict(zip(zip(moment[k.image[used]], k.point[used], strict=True), used, strict=True))
    common = sorted(rows[reference].keys() & rows[camera].keys())
    pairs = np.array([(rows[reference][key], rows[camera][key]) for key in common], dtype=np.int64)
    first, second = pairs.reshape(-1, 2).T
    d1, d2 = (
        np.column_stack([tangents_from_pixel(a.estimate.cameras[of], k.xy[at]), -np.ones(len(at))])
        for of, at in ((reference, first), (camera, second))
    )
    n = np.cross(mounts.position[camera], d1) @ mounts.rotation[camera]
    away = np.einsum("ka,ka->k", n, d2) / np.maximum(np.hypot(n[:, 0], n[:, 1]), np.finfo(float).tiny)
    known = np.isfinite(away)
    return k.xy[second][known], a.estimate.cameras[camera].c_px * away[known]


def _mount(a: Adjustment, reference: int, camera: int, moment: IntArray) -> Mount:
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
        *_epipolar(a, reference, camera, moment),
    )
