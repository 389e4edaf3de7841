"""Interior orientation as people ask for it: every parameter once, whoever shares it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.camera import Camera, camera_families
from sfm.conventions import FloatArray, IntArray
from sfm.distortion.models import MODELS, Parameter


@dataclass(frozen=True)
class InteriorParameter:
    """A parameter of interior orientation as people ask for it: once, whoever shares it."""

    owner: str  # camera, or group of photographs that have it in common
    photographs: int  # how many have it
    parameter: Parameter
    value: float
    sigma: float  # NaN where it was not adjusted

    @property
    def name(self) -> str:
        """Name of the parameter."""
        return self.parameter.name

    @property
    def unit(self) -> str:
        """Unit of the parameter."""
        return self.parameter.unit

    @property
    def t(self) -> float | None:
        """The parameter over its standard deviation; None where 0 is no sensible value, as for c."""
        tested = self.sigma > 0 and self.parameter.has_null_hypothesis
        return abs(self.value) / self.sigma if tested else None


@dataclass(frozen=True)
class CameraFamily:
    """Cameras that share parameters, or a single camera."""

    name: str
    camera: Camera  # the first of them
    parameters: tuple[InteriorParameter, ...]  # that all of them have in common
    photographs: int  # that have them


@dataclass(frozen=True)
class InteriorOrientation:
    """Interior orientation of all cameras."""

    parameters: tuple[InteriorParameter, ...]  # every one once, common ones first, without those fixed at 0
    families: tuple[CameraFamily, ...]
    single: tuple[InteriorParameter, ...]  # parameters of single photographs and groups
    sigmas: tuple[FloatArray, ...]  # of all parameters of each camera, NaN where not adjusted, (p,)
    family: IntArray  # index of the family of cameras that each photograph was taken with, (m,)

    @property
    def models(self) -> tuple[str, ...]:
        """The camera models."""
        return tuple(sorted({family.camera.model for family in self.families}))


def interior_of(adjustment: Adjustment) -> InteriorOrientation:
    """Return the interior orientation of an adjustment."""
    parameters, listed = interior_parameters(adjustment), families(adjustment)
    common = {
        name: tuple(one for one in parameters if one.owner == name) for name in (name for name, _ in listed)
    }
    return InteriorOrientation(
        parameters,
        tuple(
            CameraFamily(
                name, camera, common[name], max((one.photographs for one in common[name]), default=0)
            )
            for name, camera in listed
        ),
        tuple(one for one in parameters if one.owner not in common),
        tuple(adjustment.interior_sigma(a) for a in range(len(adjustment.estimate.cameras))),
        family_of_photographs(adjustment),
    )


def interior_parameters(adjustment: Adjustment) -> tuple[InteriorParameter, ...]:
    """Return every parameter of interior orientation once, common ones first, those fixed at 0 left out."""
    network = adjustment.network
    used = np.bincount(network.camera, minlength=len(adjustment.estimate.cameras))
    found: dict[tuple[str, str, int], InteriorParameter] = {}
    for a, camera in enumerate(adjustment.estimate.cameras):
        sigma = adjustment.interior_sigma(a)
        for s, parameter in enumerate(MODELS[camera.model].parameters):
            value = float(camera.parameters[s])
            if not camera.free[s] and value == 0:
                continue
            owner = camera.owner_of(s)
            key = (owner, parameter.name, -1 if camera.group_of(s) else a)
            known = found.get(key)
            count = int(used[a]) + (known.photographs if known else 0)
            found[key] = InteriorParameter(owner, count, parameter, value, float(sigma[s]))
    common = {name for name, _ in families(adjustment)}
    return tuple(sorted(found.values(), key=lambda one: one.owner not in common))


def families(adjustment: Adjustment) -> tuple[tuple[str, Camera], ...]:
    """Return the name of each family of cameras that share parameters, and the first camera of it."""
    cameras = adjustment.estimate.cameras
    names, family = camera_families(cameras, adjustment.network.camera)
    return tuple((name, cameras[int(np.argmax(family == f))]) for f, name in enumerate(names))


def family_of_photographs(adjustment: Adjustment) -> IntArray:
    """Return the index of the family of cameras that each photograph was taken with, (m,)."""
    network = adjustment.network
    return camera_families(adjustment.estimate.cameras, network.camera)[1][network.camera]
