"""The cameras of a survey with their start values, from the survey file and the photographs."""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence

import numpy as np

from sfm.camera import Camera, base_name, camera_from_values
from sfm.conventions import IntArray
from sfm.display import counted
from sfm.distortion.balanced import from_balanced
from sfm.errors import PhotographError, SurveyFileError
from sfm.photographs.exif import Metadata
from sfm.survey.inputs.given import StartCameras
from sfm.survey.inputs.settings import CameraSettings

MAX_PIXEL_MM = 1000.0  # side of a pixel; of models without a size it is 1 mm
MIN_VIEW_DEG, MAX_VIEW_DEG = 0.5, 170.0  # diagonal, of a central projection; lenses have 1 to 140
COMMON_VIEW_DEG = 10.0, 120.0  # of nearly all cameras: by which the unit is guessed
MAX_PIXEL_RATIO = 10.0  # of its sides; anamorphic lenses and line scanners stay below 3


def camera_of_image(cameras: Sequence[CameraSettings], image: str, source: str) -> int:
    """Return the index of the camera whose glob an image name matches.

    Args:
        cameras: of the survey.
        image: the name.
        source: what messages call the survey.

    Raises:
        SurveyFileError: no camera, or more than one.
    """
    if len(cameras) == 1 and cameras[0].images is None:
        return 0
    matches = [
        index
        for index, camera in enumerate(cameras)
        if any(fnmatch.fnmatchcase(image, glob) for glob in camera.images or ())
    ]
    if len(matches) != 1:
        globs = ", ".join(f"{c.name} {', '.join(map(repr, c.images or ()))}" for c in cameras)
        many = "no camera" if not matches else f"{counted(len(matches), 'camera')}"
        raise SurveyFileError(f"{source}: image '{image}' matches the glob of {many}: {globs}")
    return matches[0]


def start_cameras(
    settings: Sequence[CameraSettings],
    source: str,
    metadata: tuple[Metadata, ...] = (),
    camera: IntArray | None = None,
    names: tuple[str, ...] = (),
    given: StartCameras | None = None,
) -> tuple[Camera, ...]:
    """Return the cameras with their start values, in the order of the survey file.

    Args:
        settings: of the cameras in the survey; what they leave out is taken from the photographs.
        source: what messages call the survey.
        metadata: size and EXIF data of the readable photographs, (m,); none with [observations].
        camera: index of the camera of each photograph, (m,).
        names: names of the photographs, (m,).
        given: start values of [approximate] for parameters that are adjusted freely, before all others.

    Raises:
        PhotographError: photographs of one camera differ in size from one another or from size_px.
        SurveyFileError: size, pixel size or principal distance is not known from anywhere, or they make a
            field of view that no lens has.
    """
    index = np.zeros(0, dtype=np.int64) if camera is None else camera
    cameras = []
    for number, one in enumerate(settings):
        photographs = [k for k in range(len(metadata)) if index[k] == number]
        size = _common_size(one, [(names[k], metadata[k].size_px) for k in photographs])
        where = f"{source}: camera {one.name}"
        if size is None:
            raise SurveyFileError(f"{where}: size_px = [width, height] is needed, there is no photograph")
        pixel, focal = one.pixel_mm, one.c_mm
        if one.sensor_mm is not None:
            pixel = one.sensor_mm[0] / size[0], one.sensor_mm[1] / size[1]
        known = dict(from_balanced(one.balanced)) if one.balanced else {}
        known |= {**dict(one.fixed), **{name: value for name, (value, _) in one.weighted}}
        known |= dict(one.start) | free_start_values(one, one.name, given)
        if pixel is None:
            pixel = next((metadata[k].pixel_mm for k in photographs if metadata[k].pixel_mm), None)
        if focal is None:
            focal = known.get("c") or next(
                (metadata[k].focal_mm for k in photographs if metadata[k].focal_mm), None
            )
        if pixel is None:
            raise SurveyFileError(
                f"{where}: EXIF data of the photographs do not state the pixel size; "
                "needed pixel_mm or sensor_mm"
            )
        if max(pixel) > min(MAX_PIXEL_MM, MAX_PIXEL_RATIO * min(pixel)):
            raise SurveyFileError(
                f"{where}: a pixel of {pixel[0]:g} x {pixel[1]:g} mm, expected sides of at most "
                f"{MAX_PIXEL_MM:g} mm that differ by a factor of at most {MAX_PIXEL_RATIO:g}"
            )
        if focal is None:
            focal = next((known[name] * pixel[0] for name in ("fx", "f") if name in known), None)
        if focal is None:
            raise SurveyFileError(
                f"{where}: EXIF data of the photographs do not state the focal length; needed c_mm"
            )
        _refuse_implausible_view(where, size, pixel, focal)
        cameras.append(
            camera_from_values(
                one.name,
                one.model,
                size,
                pixel,
                c_mm=focal,
                free=one.may_be_free,
                values=tuple(known.items()),
            )
        )
    return tuple(cameras)


def _refuse_implausible_view(
    where: str, size: tuple[int, int], pixel: tuple[float, float], focal: float
) -> None:
    """Raise SurveyFileError if no lens has such a field of view: a length is in another unit."""
    diagonal = float(np.hypot(size[0] * pixel[0], size[1] * pixel[1]))

    def view_deg(pixel_factor: float, focal_factor: float) -> float:
        return float(np.degrees(2 * np.arctan(pixel_factor * diagonal / (2 * focal_factor * abs(focal)))))

    view = view_deg(1.0, 1.0)
    if MIN_VIEW_DEG <= view <= MAX_VIEW_DEG:
        return
    likely = [
        f"{name} in {unit}"
        for unit, factor in (("µm", 1e-3), ("m", 1e3), ("inch", 25.4))
        for name, factors in (("pixel_mm", (factor, 1.0)), ("c_mm", (1.0, factor)))
        if COMMON_VIEW_DEG[0] <= view_deg(*factors) <= COMMON_VIEW_DEG[1]
    ]
    raise SurveyFileError(
        f"{where}: pixels of {pixel[0]:g} x {pixel[1]:g} mm and c = {focal:g} mm make a field of view of "
        f"{view:.3g} degrees, expected {MIN_VIEW_DEG:g} to {MAX_VIEW_DEG:g}; "
        f"{' or '.join(likely) or 'a length in another unit than mm'}?"
    )


def free_start_values(settings: CameraSettings, name: str, given: StartCameras | None) -> dict[str, float]:
    """Return the start values of [approximate] for what is free of a camera, by parameter.

    Args:
        settings: state what is free.
        name: of the camera in the table, or of one of its photographs or groups with separate values.
        given: the table, None without.
    """
    values = given.of(name) if given is not None else {}
    return {parameter: value for parameter, value in values.items() if parameter in settings.may_be_free}


def refuse_unknown_cameras(settings: Sequence[CameraSettings], given: StartCameras | None) -> None:
    """Raise SurveyFileError if start values are of a camera that is not in the survey.

    Values of a photograph or group begin with the name of its camera.
    """
    for row, name in enumerate(given.camera if given is not None else ()):
        if given is not None and not base_name(name, (one.name for one in settings)):
            raise SurveyFileError(
                f"{given.table.place(row)}: camera '{name}' is not in the survey, expected one of "
                f"{', '.join(one.name for one in settings)}"
            )


def _common_size(
    settings: CameraSettings, sizes: list[tuple[str, tuple[int, int]]]
) -> tuple[int, int] | None:
    """Return the size of all photographs of one camera, None if nothing determines it."""
    size, source = settings.size_px, "size_px"
    for name, found in sizes:
        if size is None:
            size, source = found, f"'{name}'"
        elif found != size:
            raise PhotographError(
                f"camera {settings.name}: photograph '{name}' has {found[0]} x {found[1]} px, {source} "
                f"{size[0]} x {size[1]} px; photographs of one camera have one size"
            )
    return size
