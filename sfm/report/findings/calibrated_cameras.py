"""The cameras of a calibration: what matters in a result whose points are given, as those of a plate.

Interior orientation as people ask for it: every parameter once, whoever shares it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.correlations import observed_part, projection_map
from sfm.adjustment.result import Adjustment
from sfm.camera import Camera, camera_families
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.distortion.models import MODELS, Parameter, Role
from sfm.report.findings.precision import root_mean_square
from sfm.result import SeenPlate, SurveyResult


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


OF_CAMERA = (Role.FOCAL, Role.X0, Role.Y0)
CALIBRATION_FAILED = "calibration_failed"  # kind of remark


@dataclass(frozen=True)
class CalibratedCamera:
    """An adjusted camera, shared parameters once."""

    name: str
    parameters: tuple[InteriorParameter, ...]  # focal lengths and principal point
    projection_rms_px: float  # projection uncertainty, 1 sigma, over the whole photograph, px; infinite where
    # a parameter is not determined
    projection_largest_px: float  # its largest value, px; likewise
    observed_rms_px: float  # projection uncertainty between the image points, px; likewise
    observed: float  # part of the photograph that the image points cover together, their convex hull


def camera_is_result(adjustment: Adjustment, plates: tuple[SeenPlate, ...] = ()) -> bool:
    """Return whether a survey calibrates its cameras: it adjusts as much of them as of unknown coordinates.

    The coordinates of a point are known if all three are given, to better than a pixel as its photographs
    see it. Standard deviations that small, as of a plate, differ from a fixed point in no way that matters.
    The points of a further plate are known to one another; its place is no more a result than that of a
    photograph.

    Args:
        adjustment: finished.
        plates: plates of the survey, with those that are control.
    """
    network, known = adjustment.network, np.zeros(len(adjustment.network.points), dtype=bool)
    if adjustment.datum != "control" or not adjustment.unknown_counts[1]:
        return False
    given, seen = network.control.complete, network.image_points.select(~adjustment.rejected)
    sigma = np.full(len(known), np.inf)
    for plate in plates:
        sigma[plate.points] = plate.sigma
    sigma[given.point] = np.sqrt(np.trace(given.covariance, axis1=1, axis2=2) / 3)
    c = np.array([one.c_px for one in adjustment.estimate.cameras])[network.camera[seen.image]]
    away = adjustment.estimate.points[seen.point] - adjustment.estimate.position[seen.image]
    known[seen.point[c * sigma[seen.point] < np.linalg.norm(away, axis=1)]] = True
    unknown = np.zeros(len(known), dtype=bool)
    unknown[seen.point] = True
    return bool(3 * (unknown & ~known).sum() <= adjustment.unknown_counts[1])


def calibrated_cameras(result: SurveyResult, interior: InteriorOrientation) -> tuple[CalibratedCamera, ...]:
    """Return the adjusted cameras of a survey that calibrates them; none of another survey.

    One whose c was held at a start value is not among them: its projection uncertainty would be that of a
    camera whose c is known.
    """
    adjustment = result.adjustment
    failed = {
        name for one in result.remarks if one.kind == CALIBRATION_FAILED for name in one.names("camera")
    }
    if not camera_is_result(adjustment, result.plates):
        return ()
    found = []
    for f, family in enumerate(interior.families):
        if family.name in failed:
            continue
        projection = projection_of(adjustment, interior.family == f)
        parameters = tuple(one for one in family.parameters if one.parameter.role in OF_CAMERA)
        if projection is None and not any(np.isinf(one.sigma) for one in family.parameters):
            continue  # held
        rms = largest = inner = np.inf
        seen = adjustment.network.image_points.select(~adjustment.rejected)
        xy = seen.xy[(interior.family == f)[seen.image]]
        places = np.zeros((0, 2))
        if projection is not None:
            places = np.stack(np.meshgrid(*projection[:2]), axis=-1).reshape(-1, 2)
        area, inside = observed_part(xy, places)
        if projection is not None:
            sigma = projection[2]
            known = np.isfinite(sigma)
            rms, largest = (
                root_mean_square(sigma[known]),
                float(sigma[known].max()) if known.any() else np.nan,
            )
            inner = root_mean_square(sigma[known & inside.reshape(sigma.shape)])
        found.append(
            CalibratedCamera(
                family.name, parameters, rms, largest, inner, area / float(np.prod(family.camera.size_px))
            )
        )
    return tuple(found)


def projection_of(
    adjustment: Adjustment, photographs: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return the projection uncertainty of the camera of some photographs.

    Args:
        adjustment: finished, with its covariance.
        photographs: which photographs, (m,).

    Returns:
        Columns (c,) and rows (r,) of a grid, px, and the standard deviation at its crossings, px, (r, c);
        None where the camera was held or is not determined.
    """
    network, seen = adjustment.network, adjustment.network.image_points.select(~adjustment.rejected)
    if not photographs.any():
        return None
    k = int(network.camera[photographs][0])  # of several that share parameters the first
    camera, covariance = adjustment.estimate.cameras[k], adjustment.covariance.interior[k]
    if not len(covariance) or not np.isfinite(covariance).all() or not np.diagonal(covariance).any():
        return None
    return projection_map(camera, covariance, seen.xy[photographs[seen.image]])


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
