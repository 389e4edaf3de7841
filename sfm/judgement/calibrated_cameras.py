"""Calibrated cameras with their interior orientation.

Interior orientation is listed in a user's terms: every parameter once, even if several photographs share it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.correlations import observed_part, projection_map
from sfm.adjustment.result import Adjustment, computed_once
from sfm.judgement.checks import root_mean_square
from sfm.judgement.survey_result import SeenPlate, SurveyResult
from sfm.model.camera import Camera, camera_families
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distortion.models import MODELS, Parameter, Role
from sfm.model.remarks.remark import of_kind


@dataclass(frozen=True)
class InteriorParameter:
    """A parameter of interior orientation, listed once even if several photographs share it."""

    owner: str  # camera, or group of photographs that share the parameter
    photographs: int  # number of photographs that share it
    parameter: Parameter
    value: float
    sigma: float  # NaN if it was not adjusted

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
        """Return the parameter over its standard deviation; None where 0 is no sensible value, as for c."""
        tested = self.sigma > 0 and self.parameter.has_null_hypothesis
        return abs(self.value) / self.sigma if tested else None


OF_CAMERA = (Role.FOCAL, Role.X0, Role.Y0)
CALIBRATION_FAILED = "calibration_failed"  # kind of remark


@dataclass(frozen=True)
class CalibratedCamera:
    """An adjusted camera; shared parameters appear once."""

    name: str
    parameters: tuple[InteriorParameter, ...]  # focal lengths and principal point
    projection_rms_px: float  # RMS projection uncertainty over the whole photograph, 1 sigma, px; infinite if
    # a parameter is not determined
    projection_largest_px: float  # its largest value, px; likewise
    observed_rms_px: float  # the RMS within the hull of the image points, px; likewise
    observed: float  # part of the photograph within the convex hull of all image points of the camera


def camera_is_result(adjustment: Adjustment, plates: tuple[SeenPlate, ...] = ()) -> bool:
    """Return whether a survey calibrates its cameras.

    It does if it adjusts at least as many camera parameters as unknown coordinates. The coordinates of a
    point are known if all three are given with a standard deviation below a pixel in its photographs.
    Points with standard deviations as small as those of a plate are practically fixed. The points of an
    additional plate are known relative to one another. The pose of such a plate is not a result, like the
    pose of a photograph. The plates include those used as control.
    """
    network, known = adjustment.network, np.zeros(len(adjustment.network.points), dtype=bool)
    if adjustment.datum != "control" or not adjustment.unknown_counts[1]:
        return False
    given, seen = network.control.complete, network.image_points.select(~adjustment.rejected)
    sigma = np.full(len(known), np.inf)
    for plate in plates:
        sigma[plate.points] = plate.sigma
    sigma[given.point] = np.sqrt(np.trace(given.covariance, axis1=1, axis2=2) / 3)
    c = np.array([camera.c_px for camera in adjustment.estimate.cameras])[network.camera[seen.image]]
    away = adjustment.estimate.points[seen.point] - adjustment.estimate.position[seen.image]
    known[seen.point[c * sigma[seen.point] < np.linalg.norm(away, axis=1)]] = True
    unknown = np.zeros(len(known), dtype=bool)
    unknown[seen.point] = True
    return bool(3 * (unknown & ~known).sum() <= adjustment.unknown_counts[1])


def calibrated_cameras(result: SurveyResult, interior: InteriorOrientation) -> tuple[CalibratedCamera, ...]:
    """Return the adjusted cameras of a survey that calibrates them; empty for other surveys.

    A camera whose c was held at a start value is omitted, as its projection uncertainty would be that of a
    camera with known c.
    """
    adjustment = result.adjustment
    remarks = of_kind(result.stage_remarks, CALIBRATION_FAILED)
    failed = {name for failure in remarks for name in failure.names("camera")}
    if not camera_is_result(adjustment, result.plates):
        return ()
    seen, calibrated = adjustment.network.image_points.select(~adjustment.rejected), []
    for f, family in enumerate(interior.families):
        if family.name in failed:
            continue
        projection = projection_of(adjustment, interior.family == f)
        parameters = tuple(
            parameter for parameter in family.parameters if parameter.parameter.role in OF_CAMERA
        )
        if projection is None and not any(np.isinf(parameter.sigma) for parameter in family.parameters):
            continue  # held
        rms = largest = inner = np.inf
        xy = seen.xy[(interior.family == f)[seen.image]]
        nodes = np.zeros((0, 2))
        if projection is not None:
            nodes = np.stack(np.meshgrid(*projection[:2]), axis=-1).reshape(-1, 2)
        area, inside = observed_part(xy, nodes)
        if projection is not None:
            sigma = projection[2]
            known = np.isfinite(sigma)
            rms = root_mean_square(sigma[known])
            largest = float(sigma[known].max()) if known.any() else np.nan
            inner = root_mean_square(sigma[known & inside.reshape(sigma.shape)])
        observed = area / float(np.prod(family.camera.size_px))
        calibrated.append(CalibratedCamera(family.name, parameters, rms, largest, inner, observed))
    return tuple(calibrated)


def projection_of(
    adjustment: Adjustment, photographs: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return the projection uncertainty of the camera that took some photographs, (m,).

    Returns:
        Columns (c,) and rows (r,) of a grid, px, and the standard deviation at its nodes, px, (r, c); None if
        the camera was held or is not determined.
    """
    network, seen = adjustment.network, adjustment.network.image_points.select(~adjustment.rejected)
    if not photographs.any():
        return None
    k = int(network.camera[photographs][0])  # the first of several cameras that share parameters
    camera, covariance = adjustment.estimate.cameras[k], adjustment.covariance.interior[k]
    if not len(covariance) or not np.isfinite(covariance).all() or not np.diagonal(covariance).any():
        return None
    return projection_map(camera, covariance, seen.xy[photographs[seen.image]])


@dataclass(frozen=True)
class CameraFamily:
    """Cameras that share parameters, or a single camera."""

    name: str
    camera: Camera  # the first of them
    parameters: tuple[InteriorParameter, ...]  # common to all of them
    photographs: int  # number of photographs with these parameters


@dataclass(frozen=True)
class InteriorOrientation:
    """Interior orientation of all cameras."""

    parameters: tuple[InteriorParameter, ...]  # each once, common ones first, without those fixed at 0
    families: tuple[CameraFamily, ...]
    single: tuple[InteriorParameter, ...]  # parameters of single photographs and of groups
    sigmas: tuple[FloatArray, ...]  # of all parameters of each camera, NaN if not adjusted, (p,)
    family: IntArray  # index of the camera family of each photograph, (m,)

    @property
    def models(self) -> tuple[str, ...]:
        """The camera models."""
        return tuple(sorted({family.camera.model for family in self.families}))


@computed_once
def interior_of(adjustment: Adjustment) -> InteriorOrientation:
    """Return the interior orientation of an adjustment."""
    parameters, listed = interior_parameters(adjustment), families(adjustment)
    names, of_families = {name for name, _ in listed}, []
    for name, camera in listed:
        common = tuple(parameter for parameter in parameters if parameter.owner == name)
        photographs = max((parameter.photographs for parameter in common), default=0)
        of_families.append(CameraFamily(name, camera, common, photographs))
    return InteriorOrientation(
        parameters,
        tuple(of_families),
        tuple(parameter for parameter in parameters if parameter.owner not in names),
        tuple(adjustment.interior_sigma(a) for a in range(len(adjustment.estimate.cameras))),
        family_of_photographs(adjustment),
    )


def interior_parameters(adjustment: Adjustment) -> tuple[InteriorParameter, ...]:
    """Return every parameter of interior orientation once, common ones first, without those fixed at 0."""
    network = adjustment.network
    used = np.bincount(network.camera, minlength=len(adjustment.estimate.cameras))
    listed: dict[tuple[str, str, int], InteriorParameter] = {}
    for a, camera in enumerate(adjustment.estimate.cameras):
        sigma = adjustment.interior_sigma(a)
        for s, parameter in enumerate(MODELS[camera.model].parameters):
            value = float(camera.parameters[s])
            if not camera.free[s] and value == 0:
                continue
            owner = camera.owner_of(s)
            key = (owner, parameter.name, -1 if camera.group_of(s) else a)
            known = listed.get(key)
            count = int(used[a]) + (known.photographs if known else 0)
            listed[key] = InteriorParameter(owner, count, parameter, value, float(sigma[s]))
    common = {name for name, _ in families(adjustment)}
    return tuple(sorted(listed.values(), key=lambda parameter: parameter.owner not in common))


def families(adjustment: Adjustment) -> tuple[tuple[str, Camera], ...]:
    """Return the name and the first camera of each family of cameras that share parameters."""
    cameras = adjustment.estimate.cameras
    names, family = camera_families(cameras, adjustment.network.camera)
    return tuple((name, cameras[int(np.argmax(family == f))]) for f, name in enumerate(names))


def family_of_photographs(adjustment: Adjustment) -> IntArray:
    """Return the index of the camera family of each photograph, (m,)."""
    network = adjustment.network
    return camera_families(adjustment.estimate.cameras, network.camera)[1][network.camera]
