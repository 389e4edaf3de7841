"""Calibration of cameras as a product: what a survey of photographs says about each of its cameras.

For every adjusted camera: uncertainty of projection, the region in which it is known, what its model leaves
over, leaner and wider models, differences between halves of the photographs, and the next poses. For the
object: its shape from the image points alone, against the given one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.quality.correlations import observed_part
from sfm.adjustment.result import Adjustment
from sfm.judgement.calibrated_cameras import InteriorParameter, interior_parameters
from sfm.judgement.hypotheses.hypotheses import contradicted_parameters, free_network
from sfm.judgement.survey_result import SurveyResult
from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera, angle_between, camera_families, outermost_reached, rays_from_pixel
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distributions import level_of_single
from sfm.model.errors import GeometryError
from sfm.model.remarks.remark import Remark, kinds_of, of_kind, remark
from sfm.model.similarity import fit_similarity
from sfm.products.calibration.crossvalidation import CrossValidation, cross_validate
from sfm.products.calibration.models import Alternative, compare_models
from sfm.products.calibration.poses import NextPoses, corners_of, next_poses
from sfm.products.calibration.projection import ProjectionUncertainty, grid_of, projection_uncertainty
from sfm.products.calibration.residual_field import ResidualField, residual_field
from sfm.products.calibration.splined import SplinedCalibration, spline_camera

# Sigma of projection over the smallest one, beyond which the camera counts as extrapolated: mrcal's picture
# of a region, and three times the error is nine times the weight of a point.
KNOWN_FACTOR = 3.0
# Remarks on a camera that was held although the photographs contradict it or do not determine it.
NOT_ADJUSTED = ("calibration_failed", "interior_held", "held_parameter")
MIN_SHAPE = 4  # points of the object; three have the shape of any others but for their distances


@dataclass(frozen=True)
class CameraCalibration:
    """What is known about one camera."""

    camera: Camera
    photographs: int
    xy: FloatArray  # its accepted image points, px, (k, 2)
    known: ProjectionUncertainty
    near: float  # nearest, median and farthest distance of its image points, object unit
    usual: float
    far: float
    parameters: tuple[InteriorParameter, ...]
    field: ResidualField
    alternatives: tuple[Alternative, ...]
    demanded: tuple[str, ...]  # held parameters that the image points contradict
    next: NextPoses
    splined: SplinedCalibration | None = None  # where the model is insufficient, if the photographs bear it

    @property
    def name(self) -> str:
        """Name of the camera."""
        return self.camera.name

    @property
    def middle(self) -> FloatArray:
        """Middle of the format, px, (1, 2)."""
        return (np.array([self.camera.size_px]) - 1) / 2

    @property
    def corners(self) -> FloatArray:
        """Corners of the format, or the outermost places on its diagonals that it reaches, px, (4, 2)."""
        return corners_of(self.camera, self.xy)

    @property
    def degrees(self) -> tuple[float, float, float]:
        """Angles of view along rows, columns and diagonal, up to where the camera reaches, degrees."""
        width, height = np.array(self.camera.size_px) - 0.5
        x, y = self.camera.principal_point_px - 0.5
        ends = ((-0.5, y), (width, y)), ((x, -0.5), (x, height)), ((-0.5, -0.5), (width, height))
        angles = []
        for pair in ends:
            rays = rays_from_pixel(self.camera, outermost_reached(self.camera, np.array(pair), self.xy))
            angles.append(float(np.degrees(angle_between(rays[0], rays[1]))))
        return angles[0], angles[1], angles[2]

    @property
    def missing(self) -> tuple[str, ...]:
        """Parameters that the photographs demand in addition to those that were adjusted."""
        borne = [alternative for alternative in self.alternatives if alternative.added and alternative.borne]
        names = [name for alternative in borne for name in alternative.parameters]
        return tuple(dict.fromkeys([*names, *self.demanded]))

    def is_insufficient(self, level: float) -> bool:
        """Return whether the residuals contradict the model.

        They depend on the place in the format by more than chance, and either by more than the camera is
        known to far away, or a further parameter of the model explains them.

        Args:
            level: probability of calling a model that fits insufficient.
        """
        if not self.field.whole < level:
            return False
        wider = any(alternative.added and alternative.borne for alternative in self.alternatives)
        xy, inside = self.known_region(np.inf)
        sigma = self.known.sigma_at(xy[inside], np.inf)
        return wider or bool(self.field.rms_px >= np.sqrt((sigma**2).mean()))

    def known_region(self, distance: float) -> tuple[FloatArray, BoolArray]:
        """Return places of a grid over the format, px, (n, 2), and where the camera is known, (n,).

        It is known between its image points, where sigma is at most KNOWN_FACTOR times the smallest one.

        Args:
            distance: object unit, or infinity.
        """
        xy = np.stack(np.meshgrid(*grid_of(self.camera)), axis=-1).reshape(-1, 2)
        sigma = self.known.sigma_at(xy, distance)
        inside = observed_part(self.xy, xy)[1] & np.isfinite(sigma)
        if inside.any():
            inside &= sigma <= KNOWN_FACTOR * float(sigma[inside].min())
        return xy, inside


@dataclass(frozen=True)
class ObjectShape:
    """Points of the object from the image points alone, fitted by a similarity to their given coordinates."""

    points: IntArray  # indices in the network, (n,)
    given: FloatArray  # coordinates, object unit, (n, 3)
    difference: FloatArray  # found minus given, object unit, (n, 3)
    sigma: FloatArray  # standard deviations of the found coordinates, object unit, (n, 3)

    @property
    def flat(self) -> bool:
        """Whether the given points lie in a plane."""
        size = np.linalg.svd(self.given - self.given.mean(axis=0), compute_uv=False)
        return bool(size[2] < 1e-9 * size[0])

    @property
    def off_plane(self) -> tuple[FloatArray, FloatArray]:
        """Differences across the plane of the given points and their sigmas, object unit, (n,) each."""
        normal = np.linalg.svd(self.given - self.given.mean(axis=0))[2][2]
        return self.difference @ normal, np.sqrt((self.sigma**2) @ normal**2)

    @property
    def significant(self) -> BoolArray:
        """Which points differ by more than chance explains, by three standard deviations, (n,)."""
        return np.asarray((np.abs(self.difference) > 3 * self.sigma).any(axis=1))


@dataclass(frozen=True)
class Calibration:
    """The calibrated cameras of a survey."""

    result: SurveyResult
    distances: tuple[float, ...]  # of the pictures and figures, object unit, the last one infinite
    cameras: tuple[CameraCalibration, ...]
    validation: CrossValidation
    shape: ObjectShape | None  # None without given coordinates of the object
    level: float  # of the tests of halves and of residuals, which share the false alarm
    remarks: tuple[Remark, ...]  # of the survey, and on the calibration


@checked_arguments()
def calibrate(result: SurveyResult, distances: Sequence[float] = ()) -> Calibration:
    """Return what a survey says about its cameras.

    Args:
        result: result of the survey.
        distances: distances of points from the camera, object unit; that of the object if not given. Infinity
            is always one of them.

    Raises:
        GeometryError: a distance that is not positive, or no camera was adjusted and no remark of the result
            says why, as those of NOT_ADJUSTED do.

    Source: `sfm.products.calibration.projection` and the other modules of this room.
    """
    for distance in distances:
        if not distance > 0:
            raise GeometryError(f"distance {distance:g}, expected more than 0")
    adjustment = result.adjustment
    demanded = contradicted_parameters(adjustment)
    network, lenses = adjustment.network, adjustment.estimate.cameras
    _, family = camera_families(lenses, network.camera)
    measured = np.unique(network.camera[network.image_points.image[~adjustment.rejected]])
    # of cameras with common parameters, the first that has image points
    first = measured[np.unique(family[measured], return_index=True)[1]]
    cameras = tuple(_camera_of(adjustment, k, demanded) for k in first.tolist() if lenses[k].free.any())
    if not cameras and not of_kind(result.remarks, *NOT_ADJUSTED):
        raise GeometryError(
            f"survey {result.survey}: no camera was adjusted, so that nothing is calibrated; free its "
            "parameters, or give more photographs"
        )
    finite = sorted({d for d in distances if np.isfinite(d)})
    if not finite and cameras:
        finite = [float(np.median([camera.usual for camera in cameras]))]
    validation = cross_validate(adjustment)
    level = level_of_single(adjustment.levels.family, max(len(validation.differences), len(cameras), 1))
    cameras = tuple(_with_splined(adjustment, camera, level) for camera in cameras)
    remarks = (*result.remarks, *_remarks(result, cameras, validation, level))
    return Calibration(
        result,
        (*finite, np.inf),
        cameras,
        validation,
        _shape_of(adjustment),
        level,
        remarks,
    )


def _camera_of(adjustment: Adjustment, k: int, demanded: Sequence[tuple[str, str]]) -> CameraCalibration:
    """Return what is known about a camera."""
    network, estimate = adjustment.network, adjustment.estimate
    camera = estimate.cameras[k]
    seen = network.image_points.select(~adjustment.rejected)
    seen = seen.select(network.camera[seen.image] == k)
    away = np.linalg.norm(estimate.points[seen.point] - estimate.position[seen.image], axis=1)
    near, usual, far = np.quantile(away, (0.0, 0.5, 1.0))
    owners = {camera.owner_of(s) for s in range(len(camera.names))}
    return CameraCalibration(
        camera,
        len(np.unique(seen.image)),
        seen.xy,
        projection_uncertainty(adjustment, k),
        float(near),
        float(usual),
        float(far),
        tuple(parameter for parameter in interior_parameters(adjustment) if parameter.owner in owners),
        residual_field(adjustment, k),
        compare_models(adjustment, k),
        tuple(name for owner, name in demanded if owner in owners),
        next_poses(adjustment, k),
    )


def _with_splined(adjustment: Adjustment, camera: CameraCalibration, level: float) -> CameraCalibration:
    """Return a calibration with a splined camera, if its model is insufficient and no parameter mends it."""
    if not camera.is_insufficient(level):
        return camera
    names = [lens.name for lens in adjustment.estimate.cameras]
    try:
        splined = spline_camera(adjustment, names.index(camera.name))
    except (GeometryError, np.linalg.LinAlgError):
        return camera
    wider = [alternative for alternative in camera.alternatives if alternative.added and alternative.borne]
    mended = max((alternative.gain - alternative.price for alternative in wider), default=0.0)
    return replace(camera, splined=splined) if splined.gain - splined.price > mended else camera


def _remarks(
    result: SurveyResult,
    cameras: Sequence[CameraCalibration],
    validation: CrossValidation,
    level: float,
) -> Iterator[Remark]:
    """Yield the remarks on halves that differ or are not there, and on models that are insufficient."""
    told = {"distortion_not_described", "held_parameter"} & set(kinds_of(result.remarks))
    for camera in cameras:
        halves = validation.clearest(camera.name)
        if halves is None and camera.photographs > 1:  # else photographs have parameters of their own
            yield remark("halves_missing", camera=camera.name, photographs=camera.photographs)
        elif halves is not None and halves.probability < level:
            yield remark(
                "halves_differ",
                camera=camera.name,
                division=halves.division,
                difference=(halves.rms_px, "px"),
                times=halves.ratio,
                p=halves.probability,
            )
        if camera.is_insufficient(level) and "distortion_not_described" not in told:
            yield remark(
                "model_insufficient",
                camera=camera.name,
                field=(camera.field.rms_px, "px"),
                p=camera.field.whole,
            )
        elif camera.missing and not told:
            yield remark("parameters_missing", camera=camera.name, parameters=camera.missing)


def _shape_of(adjustment: Adjustment) -> ObjectShape | None:
    """Return the shape of the object by its image points alone; None without given points to compare."""
    given = adjustment.network.control.complete
    if len(given) < MIN_SHAPE or adjustment.datum != "control":
        return None
    try:
        free = free_network(adjustment)
    except np.linalg.LinAlgError:
        return None
    if free is None or not free.converged or free.undetermined:
        return None
    place = {name: j for j, name in enumerate(free.network.points)}
    rows = [(j, place[adjustment.network.points[j]]) for j in given.point.tolist()
            if adjustment.network.points[j] in place]  # fmt: skip
    index = np.array([j for j, _ in rows], dtype=np.int64)
    found = np.array([k for _, k in rows], dtype=np.int64)
    xyz = given.xyz[np.isin(given.point, index)]
    known = np.isfinite(free.estimate.points[found]).all(axis=1)
    if known.sum() < MIN_SHAPE:
        return None
    index, found, xyz = index[known], found[known], xyz[known]
    try:
        onto = fit_similarity(free.estimate.points[found], xyz)
    except GeometryError:
        return None
    covariance = onto.scale**2 * onto.rotation @ free.covariance.points[found] @ onto.rotation.T
    sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    return ObjectShape(index, xyz, onto.apply(free.estimate.points[found]) - xyz, sigma)
