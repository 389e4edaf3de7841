"""Which interior parameters of a model are estimated anew, and which are held."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.camera import Camera
from sfm.distortion.models import Role
from sfm.errors import GeometryError
from sfm.network import Estimate, Network

MIN_PHOTOGRAPHS = 4  # of a camera whose principal point is freed
FOCAL_NAMES = ("f", "fx", "fy")  # each of which holds both, where one of them is a camera's only one
FIRST_RADIAL = {"k": "k1"}  # another name of the only coefficient


def free_cameras(network: Network, estimate: Estimate, fixed: tuple[str, ...]) -> tuple[Camera, ...]:
    """Return the cameras with what is to be estimated freed; see `_freed`.

    Raises:
        GeometryError: a name to hold that is no parameter of any camera.
    """
    known = dict.fromkeys(name for camera in estimate.cameras for name in camera.names)
    for name in fixed:
        if name not in (*known, *_other_names(tuple(known)), *FOCAL_NAMES):
            raise GeometryError(
                f"refine: parameter '{name}' is to be held, expected one of {', '.join(known)}"
            )
    photographs = np.bincount(network.camera[estimate.oriented], minlength=len(estimate.cameras))
    return tuple(
        _freed(camera, int(count), fixed) for camera, count in zip(estimate.cameras, photographs, strict=True)
    )


def _other_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return what parameters are called in models with more of them."""
    return tuple(FIRST_RADIAL.get(name, name) for name in names)


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
        distortion = camera.plays(Role.RADIAL, Role.DENOMINATOR, Role.DECENTRING, Role.PRISM)
        free = distortion & (camera.parameters != 0)
        free |= camera.plays(Role.FOCAL)
        if photographs >= MIN_PHOTOGRAPHS:
            free |= camera.plays(Role.X0, Role.Y0)
    held = np.isin(camera.names, fixed) | np.isin(_other_names(camera.names), fixed)
    focal = camera.plays(Role.FOCAL)
    if "f" in fixed or (focal.sum() == 1 and {"fx", "fy"} & set(fixed)):
        held |= focal
    return replace(camera, free=free & ~held)
