"""The distortion model of cameras where the survey does not state it: central perspective or fisheye.

A fisheye lens shows equal angles about equally long. Where its photographs are wide, no polynomial on equal
tangents describes it, and what a survey of them gives is bent: the image points decide.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sfm.adjustment.hypotheses.alternatives import ALPHA
from sfm.camera import Camera, camera_from_values
from sfm.errors import GeometryError
from sfm.orientation.incremental.growth import residual_lengths
from sfm.orientation.incremental.sequence import FINAL_TOLERANCE_PX, Orientation
from sfm.remarks.remark import remark
from sfm.survey.inputs.measurements import Measurements
from sfm.survey.inputs.survey import Survey
from sfm.survey.orientation import orient_survey

FISHEYE = "opencv_fisheye"
# c over half the diagonal, of a central perspective, below which the corner is more than 45 degrees off the
# axis: there equal angles and equal tangents are apart by more than a tenth of the half diagonal.
WIDE_C = 1.0
# Share of the image points with a central perspective from which nothing else is tried.
MIN_FITTING_FRACTION = 0.9


def orient_with_models(survey: Survey, measured: Measurements) -> tuple[Survey, Measurements, Orientation]:
    """Orient a survey, with the fisheye model for cameras whose model is open if that is likelier.

    Args:
        survey: states the models of its cameras, or does not.
        measured: all image points that have a name.

    Returns:
        The survey with the models that were taken, the start values of its cameras, and the orientation.

    Raises:
        GeometryError: as of `orient_survey`.
    """
    found, failure = None, None
    texture = survey.tie_points is not None
    unsaid = [a for a, one in enumerate(survey.cameras) if texture and not one.states_model]
    try:
        found = orient_survey(survey, measured)
    except GeometryError as error:
        failure = error
    likelihood, fitting = (-math.inf, 0) if found is None else _fit(measured, found)
    few = fitting < MIN_FITTING_FRACTION * len(measured.network.image_points)
    wide = [a for a in unsaid if found is None or few or _is_wide(found.estimate.cameras[a])]
    if not wide:
        if found is None:
            raise failure or GeometryError("orientation: none")
        return survey, measured, found
    cameras, starts = list(survey.cameras), list(measured.cameras)
    for a in wide:
        cameras[a] = cameras[a].model_copy(update={"model": FISHEYE})
        known = starts[a] if found is None else found.estimate.cameras[a]
        starts[a] = _as_fisheye(known, cameras[a].may_be_free)
    other_survey = replace(survey, cameras=tuple(cameras))
    other_measured = replace(measured, cameras=tuple(starts))
    try:
        other = orient_survey(other_survey, other_measured)
    except GeometryError:
        if found is None:
            raise failure or GeometryError("orientation: none") from None
        return survey, measured, found
    search = len(wide) * (math.log(2 * len(measured.network.image_points)) / 2 + math.log(1 / ALPHA))
    likelihood_of_other, fitting_other = _fit(other_measured, other)
    if found is not None and likelihood_of_other <= likelihood + search:
        return survey, measured, found
    taken = tuple(
        remark(
            "fisheye_taken",
            camera=cameras[a].name,
            fitting=fitting_other,
            total=len(measured.network.image_points),
            before=fitting,
        )
        for a in wide
    )
    return other_survey, other_measured, replace(other, remarks=(*other.remarks, *taken))


def _is_wide(camera: Camera) -> bool:
    """Return whether a central perspective with the camera's c reaches far off the axis."""
    return bool(camera.c_px < WIDE_C * np.hypot(*camera.size_px) / 2)


def _as_fisheye(camera: Camera, free: tuple[str, ...]) -> Camera:
    """Return start values of the fisheye model with the same c, the principal point in the middle."""
    pixel = (float(camera.pixel_mm[0]), float(camera.pixel_mm[1]))
    c_mm = camera.c_px * float(np.mean(pixel))
    return camera_from_values(camera.name, FISHEYE, camera.size_px, pixel, c_mm=c_mm, free=free)


def _fit(measured: Measurements, found: Orientation) -> tuple[float, int]:
    """Return ln of the likelihood of all image points, and how many of them fit.

    Points that do not fit are spread evenly over the format.
    """
    length = residual_lengths(measured.network, found.estimate)
    fits = length <= FINAL_TOLERANCE_PX
    count, fitting = len(length), int(fits.sum())
    outlier = -math.log(float(np.prod(found.estimate.cameras[0].size_px)))
    variance = max(float((length[fits] ** 2).sum()) / (2 * max(fitting, 1)), np.finfo(float).tiny)
    return fitting * (-math.log(2 * math.pi * variance) - 1) + (count - fitting) * outlier, fitting
