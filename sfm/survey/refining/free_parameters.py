"""Which interior parameters of a model are estimated anew, and which are held."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.camera import Camera
from sfm.distortion.models import Role
from sfm.errors import GeometryError
from sfm.network import Estimate, Network

MIN_PHOTOGRAPHS = 4  # of a camera whose principal point is freed
# What COLMAP calls the parameters of its models with one focal length, which are adjusted as brown_forward
COLMAP_NAMES = {"c": "f", "x0": "cx", "y0": "cy", "K1": "k1", "K2": "k2"}
OTHER_NAMES = ("K3", "K4", "P1", "P2", "b1", "b2")  # of brown_forward, which no COLMAP model of these has
FOCAL_NAMES = ("f", "fx", "fy")


def free_cameras(network: Network, estimate: Estimate, fixed: tuple[str, ...]) -> tuple[Camera, ...]:
    """Return the cameras with what is to be estimated freed; see `_freed`.

    Raises:
        GeometryError: a name to hold that is no parameter of any camera.
    """
    known = [name for camera in estimate.cameras for name in (*camera.names, *_colmap_names(camera))]
    for name in fixed:
        if name not in (*known, *FOCAL_NAMES):
            told = dict.fromkeys(
                one for camera in estimate.cameras for one in _colmap_names(camera) if one not in OTHER_NAMES
            )
            raise GeometryError(
                f"refine: parameter '{name}' is to be held, expected one of {', '.join(told)}"
            )
    photographs = np.bincount(network.camera[estimate.oriented], minlength=len(estimate.cameras))
    return tuple(
        _freed(camera, int(count), fixed) for camera, count in zip(estimate.cameras, photographs, strict=True)
    )


def _colmap_names(camera: Camera) -> tuple[str, ...]:
    """Return COLMAP's names of the parameters of a camera."""
    return tuple(COLMAP_NAMES.get(name, name) for name in camera.names)


def _freed(camera: Camera, photographs: int, fixed: tuple[str, ...]) -> Camera:
    """Free what the image points of a model determine, but for what is to be held.

    Principal distances and principal point, and the distortion that the model has. COLMAP holds the principal
    point unless it is told otherwise; held at a wrong place all photographs are turned to make up for it.

    Args:
        camera: of the model.
        photographs: oriented ones of it; fewer than MIN_PHOTOGRAPHS do not tell the principal point from a
            rotation.
        fixed: names of parameters to hold; f is fx and fy, too, and either of these the only f.
    """
    free = camera.free
    if not free.any():
        free = camera.plays(Role.RADIAL, Role.DENOMINATOR, Role.DECENTRING) & (camera.parameters != 0)
        free |= camera.plays(Role.FOCAL)
        if photographs >= MIN_PHOTOGRAPHS:
            free |= camera.plays(Role.X0, Role.Y0)
    held = np.isin(camera.names, fixed) | np.isin(_colmap_names(camera), fixed)
    focal = camera.plays(Role.FOCAL)
    if "f" in fixed or (focal.sum() == 1 and {"fx", "fy"} & set(fixed)):
        held |= focal
    return replace(camera, free=free & ~held)
