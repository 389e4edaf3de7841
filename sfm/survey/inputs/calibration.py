"""A survey with the interior orientation of an earlier result, held as it was found there."""

from __future__ import annotations

from dataclasses import replace

from sfm.camera import Camera
from sfm.errors import SurveyFileError
from sfm.survey.inputs.settings import CameraSettings
from sfm.survey.inputs.survey import Survey


def with_calibration(survey: Survey, cameras: tuple[Camera, ...], source: str) -> Survey:
    """Return the survey with its cameras held at a calibration.

    A camera of the survey takes that of its name; if the calibration has one camera only, all take it.

    Args:
        survey: whose cameras are to be held; what it says of them besides photographs and name is not used.
        cameras: of an earlier result.
        source: what messages call that result.

    Raises:
        SurveyFileError: no camera of that name among several, or photographs of another size.
    """
    return replace(survey, cameras=tuple(_held(one, cameras, survey, source) for one in survey.cameras))


def _held(
    settings: CameraSettings, cameras: tuple[Camera, ...], survey: Survey, source: str
) -> CameraSettings:
    named = [camera for camera in cameras if camera.name == settings.name]
    if not named and len(cameras) > 1:
        raise SurveyFileError(
            f"{survey.source}: camera {settings.name} is not in {source}, expected one of "
            f"{', '.join(camera.name for camera in cameras)}"
        )
    camera = (named or list(cameras))[0]
    if settings.size_px is not None and settings.size_px != camera.size_px:
        raise SurveyFileError(
            f"{survey.source}: camera {settings.name} has {settings.size_px[0]} x {settings.size_px[1]} px, "
            f"{camera.name} of {source} {camera.size_px[0]} x {camera.size_px[1]} px"
        )
    return CameraSettings(
        name=settings.name,
        images=settings.images,
        size_px=camera.size_px,
        pixel_mm=(float(camera.pixel_mm[0]), float(camera.pixel_mm[1])),
        model=camera.model,
        free=(),
        fixed=tuple(zip(camera.names, camera.parameters.tolist(), strict=True)),
    )
