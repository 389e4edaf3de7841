"""Cameras of a model that could be one: named by a test of their adjusted values, and joined on request.

Programs that find no EXIF data make a camera for each photograph, whose principal distances then compensate
for distances.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 3.1 (test of equal means).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.model.camera import Camera
from sfm.model.conventions import IntArray
from sfm.model.display import counted, listed
from sfm.model.distributions import chi2_isf
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network

MAX_NAMED = 5  # cameras in a line


@dataclass(frozen=True)
class LikeCameras:
    """Cameras of one size and lens model, and whether their adjusted values are those of one camera."""

    names: tuple[str, ...]
    size_px: tuple[int, int]
    statistic: float  # weighted sum of squares of their values about the common ones
    limit: float  # that one camera exceeds with the probability of a false alarm

    def __str__(self) -> str:
        """Return the line for people."""
        width, height = self.size_px
        cameras = f"{counted(len(self.names), 'camera')} of {width} x {height} px"
        figures = f"chi-square {self.statistic:.4g}, one camera stays below {self.limit:.4g}"
        if self.statistic <= self.limit:
            return (
                f"{cameras} could be one ({figures}): --one-camera joins {listed(self.names, most=MAX_NAMED)}"
            )
        return (
            f"{cameras} differ more than one camera would ({figures}); if one took all photographs with one "
            "zoom and focus, --one-camera joins them"
        )


def groups_of(cameras: Sequence[Camera], estimate: Estimate) -> list[list[int]]:
    """Return the cameras of one size, pixel and lens model that are on no rig, in groups of two or more."""
    rigs = ("",) * len(cameras) if estimate.mounts is None else estimate.mounts.rig
    groups: dict[object, list[int]] = {}
    for k, camera in enumerate(cameras):
        if not rigs[k]:
            key = (camera.model, tuple(camera.size_px), tuple(camera.pixel_mm.tolist()))
            groups.setdefault(key, []).append(k)
    return [group for group in groups.values() if len(group) > 1]


def like_cameras(a: Adjustment, false_alarm: float) -> tuple[LikeCameras, ...]:
    """Return the cameras that could be one, tested by the parameters that are free in all of a group.

    The covariances between two cameras are left out.

    Args:
        a: adjustment with its covariance.
        false_alarm: probability that one camera is called several, for all groups together.
    """
    like = []
    groups = groups_of(a.estimate.cameras, a.estimate)
    for group in groups:
        cameras = [a.estimate.cameras[k] for k in group]
        common = np.logical_and.reduce([camera.free for camera in cameras])
        if not common.any():
            continue
        values, weights = [], []
        for k, camera in zip(group, cameras, strict=True):
            on = np.flatnonzero(common[camera.free])
            C = a.covariance.interior[k][np.ix_(on, on)]
            if not (np.diagonal(C) > 0).all():
                break
            values.append(camera.parameters[common])
            weights.append(np.linalg.inv(C))
        else:
            P = np.array(weights)
            mean = np.linalg.solve(P.sum(axis=0), np.einsum("kij,kj->i", P, np.array(values)))
            off = np.array(values) - mean
            statistic = float(np.einsum("ki,kij,kj->", off, P, off))
            limit = float(chi2_isf(false_alarm / len(groups), (len(group) - 1) * int(common.sum())))
            like.append(
                LikeCameras(tuple(camera.name for camera in cameras), cameras[0].size_px, statistic, limit)
            )
    return tuple(like)


def join_cameras(network: Network, estimate: Estimate) -> tuple[Network, Estimate, IntArray]:
    """Return a model with one camera for those of one size, pixel and lens model.

    Its values are the means over the photographs; which are free follows from the first.

    Returns:
        Network, estimate, and the new camera of each old one, (a,).

    Raises:
        GeometryError: no two cameras could be one.
    """
    groups = groups_of(estimate.cameras, estimate)
    if not groups:
        raise GeometryError(
            f"--one-camera: {counted(len(estimate.cameras), 'camera')}, of which no two have the same size, "
            "pixel and lens model and are on no rig"
        )
    first = np.arange(len(estimate.cameras))
    cameras = list(estimate.cameras)
    photographs = np.bincount(network.camera[estimate.oriented], minlength=len(cameras)).astype(float)
    for group in groups:
        first[group] = group[0]
        weights = photographs[group] if photographs[group].any() else None
        values = np.average([cameras[k].parameters for k in group], axis=0, weights=weights)
        cameras[group[0]] = replace(cameras[group[0]], parameters=values)
    kept, owner = np.unique(first, return_inverse=True)
    mounts = estimate.mounts
    if mounts is not None:
        mounts = mounts.select(np.isin(np.arange(len(cameras)), kept))
    joined = replace(estimate, cameras=tuple(cameras[k] for k in kept.tolist()), mounts=mounts)
    return replace(network, camera=owner[network.camera]), joined, owner
