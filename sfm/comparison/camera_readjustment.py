"""A calibrated camera in another model: a new adjustment of the same image points, where they are there.

Models do not convert exactly. First the curve of the other model is fitted to that of the camera, over the
region of its image points or, where these are unknown, over the photograph, see
`sfm.comparison.camera_conversion`. Of the forms that a file can store, the leanest with as many radial terms
as the camera uses is taken; if its misfit is above the limit, the next one with more. Then the image points
of the calibration are adjusted again with it, so that exterior orientations, points and mounts take their
part of the difference, and the camera has a covariance.

The misfit is the difference of both cameras over the region of the image points, after the rotation that it
implies, see `sfm.comparison.camera_difference`. A new adjustment whose misfit is above the limit where that
of the curve is not was drawn elsewhere by contradictions among its observations; then the curve is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.comparison.camera_conversion import convert_camera, corresponding_free
from sfm.comparison.camera_difference import compare_cameras
from sfm.comparison.solutions import reprojection
from sfm.model.camera import Camera
from sfm.model.camera_file import CameraFile, cameras_of
from sfm.model.distortion.models import MODELS, WIDE_ANGLE, Role
from sfm.model.errors import GeometryError, KolinearError, SurveyFileError
from sfm.model.solution import Solution

LIMIT_PX = 0.05  # RMS misfit up to which a camera is converted without being asked; a half of usual sigma0


class Form(Protocol):
    """A model of which all parameters but some, which must be 0, can be stored."""

    @property
    def model(self) -> str:
        """Name of the model."""

    @property
    def held(self) -> tuple[str, ...]:
        """Parameters that must be 0."""


@dataclass(frozen=True)
class Readjusted:
    """A camera in another model, and how far it differs from the former one."""

    former: Camera
    camera: Camera
    rms_px: float  # RMS length of the difference over the region of the image points, px
    max_px: float  # its largest length there, px
    adjusted: bool  # whether the image points were adjusted again; otherwise the curve was fitted

    @property
    def model(self) -> str:
        """The new model, with the parameters that it leaves out where it is the former one."""
        if self.camera.model != self.former.model:
            return self.camera.model
        gone = (self.camera.parameters == 0) & (self.former.parameters != 0)
        names = ", ".join(np.array(self.camera.names)[gone].tolist())
        return f"{self.camera.model} without {names}" if names else self.camera.model

    @property
    def words(self) -> str:
        """The conversion in words."""
        how = "image points adjusted again" if self.adjusted else "curve fitted"
        return (
            f"camera {self.camera.name}: {self.former.model} to {self.model}, {how}, "
            f"misfit {self.rms_px:.4f} px RMS, {self.max_px:.4f} px at most"
        )


def readjust_cameras(
    file: CameraFile, stored: Callable[[Camera], Camera | None], forms: Sequence[Form]
) -> tuple[CameraFile, tuple[Readjusted, ...]]:
    """Return cameras in forms that a file can store, and the conversions of those that were not.

    Args:
        file: the cameras, with the result that calibrated them where it is known.
        stored: returns a camera as it is stored without conversion, None if it is not.
        forms: the forms of the file, those with fewest parameters first.

    Raises:
        GeometryError: the distortion of a camera cannot be inverted over its photographs.
        SurveyFileError: no form suits the lens.
    """
    cameras, covariance, mounts = list(file.cameras), list(file.covariance), file.mounts
    curves: dict[int, tuple[Readjusted, Form]] = {}
    for k, camera in enumerate(file.cameras):
        same = stored(camera)
        if same is None:
            curves[k] = _fitted(camera, file, forms)
            cameras[k], covariance[k] = curves[k][0].camera, None
        elif same is not camera:
            cameras[k], covariance[k] = same, None
    conversions = {k: curve for k, (curve, _) in curves.items()}
    if curves and file.solution is not None:
        freed = {}  # the parameters that correspond to the free ones of the former camera
        for curve, form in curves.values():
            free = corresponding_free(curve.former, curve.camera.model)
            free &= ~np.isin(curve.camera.names, form.held)
            freed[curve.camera.name] = replace(curve.camera, free=free, shared=())
        anew = adjusted_with(file.solution, freed)
        of_anew = None if anew is None else cameras_of(anew.solution)
        if of_anew is not None:
            adjusted = {
                k: _difference(
                    curve.former, of_anew.cameras[of_anew.index(curve.camera.name)], file, adjusted=True
                )
                for k, curve in conversions.items()
            }
            if all(adjusted[k].rms_px <= max(LIMIT_PX, curve.rms_px) for k, curve in conversions.items()):
                conversions, mounts = adjusted, mounts and of_anew.mounts
                for k, conversion in adjusted.items():
                    row = of_anew.index(conversion.camera.name)
                    cameras[k], covariance[k] = conversion.camera, of_anew.covariance[row]
    changed = replace(file, cameras=tuple(cameras), covariance=tuple(covariance), mounts=mounts)
    return changed, tuple(conversions.values())


def _fitted(camera: Camera, file: CameraFile, forms: Sequence[Form]) -> tuple[Readjusted, Form]:
    """Return the curve of a camera in the leanest form within the limit, else of the smallest misfit."""
    radial = int((camera.plays(Role.RADIAL, Role.DENOMINATOR) & (camera.parameters != 0)).sum())
    alike = [form for form in forms if (MODELS[form.model] in WIDE_ANGLE) == camera.wide_angle] or [*forms]
    most = max(map(_radial_terms, alike))
    seen = file.image_points(camera.name)
    region = None if seen is None or not len(seen) else np.concatenate([seen.min(axis=0), seen.max(axis=0)])
    best: tuple[Readjusted, Form] | None = None
    reason = ""
    for form in (form for form in alike if _radial_terms(form) >= min(radial, most)):
        try:
            converted = convert_camera(camera, form.model, held=form.held, region_px=region).camera
            curve = _difference(camera, converted, file, adjusted=False)
        except KolinearError as error:
            reason = reason or str(error)
            continue
        if best is None or curve.rms_px < best[0].rms_px:
            best = curve, form
        if curve.rms_px <= LIMIT_PX:
            break
    if best is None:
        models = ", ".join(dict.fromkeys(form.model for form in alike))
        raise SurveyFileError(
            f"camera {camera.name}: {camera.model} cannot be converted to {models}: {reason}"
        )
    return best


def _radial_terms(form: Form) -> int:
    """Return how many coefficients of radial distortion a form has."""
    names = MODELS[form.model].names_of(Role.RADIAL, Role.DENOMINATOR)
    return len([name for name in names if name not in form.held])


def adjusted_with(solution: Solution, cameras: dict[str, Camera]) -> Adjustment | None:
    """Return a new adjustment of a result with other cameras; None if it does not determine them.

    Args:
        solution: the result, without its rejected image points.
        cameras: cameras by name, with the parameters free that were.
    """
    network, estimate = solution.network, solution.estimate
    if not len(network.image_points) or not all(camera.free.any() for camera in cameras.values()):
        return None
    start = replace(estimate, cameras=tuple(cameras.get(camera.name, camera) for camera in estimate.cameras))
    kind = solution.datum if solution.datum != "control" or len(network.control) else ""
    try:
        anew = adjust(network, start, datum=kind or "free", reject="none")
    except GeometryError:
        return None
    fixed = anew.estimate.cameras
    sound = all(np.isfinite(camera.parameters).all() for camera in fixed)
    return anew if anew.converged and sound and not anew.undetermined else None


def _difference(former: Camera, camera: Camera, file: CameraFile, *, adjusted: bool) -> Readjusted:
    """Return the conversion with the difference of both cameras where image points are."""
    seen = file.image_points(former.name)
    difference = compare_cameras(former, camera, seen_px=(seen, None))
    return Readjusted(former, camera, difference.rms_px, difference.largest_px, adjusted)


def residuals_px(solution: Solution) -> tuple[float, ...]:
    """Return the root mean square residual of an image coordinate of each camera of a result, px.

    Args:
        solution: the result; NaN for cameras without image points.
    """
    network = solution.network
    v = reprojection(network, solution.estimate)
    seen, estimate = network.image_points, solution.estimate
    of = network.camera[seen.image[estimate.oriented[seen.image] & estimate.determined[seen.point]]]
    return tuple(
        float(np.sqrt(np.mean(v[of == k] ** 2))) if (of == k).any() else float("nan")
        for k in range(len(estimate.cameras))
    )
