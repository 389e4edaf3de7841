"""Photographs of another size under one camera: they get a separate camera, or are left out and reported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from glob import escape
from pathlib import Path

import numpy as np

from sfm.errors import PhotographError
from sfm.photographs.exif import read_metadata
from sfm.remarks.remark import Remark, remark
from sfm.result import FailedImage
from sfm.survey.inputs.photograph_list import PhotographList
from sfm.survey.inputs.settings import CameraSettings
from sfm.survey.inputs.survey import Survey

MIN_OWN = 3  # photographs of one size that a separate camera is worth
# Relative difference of the ratio of the sides of a photograph that was resampled.
MAX_ASPECT_DIFFERENCE = 0.005
RESAMPLED, UPRIGHT, CROPPED = "resampled", "stored upright", "cropped or from another sensor"

Size = tuple[int, int]


@dataclass(frozen=True)
class OtherSizes:
    """A survey whose cameras have photographs of one size each."""

    survey: Survey
    files: PhotographList
    left_out: tuple[FailedImage, ...]
    remarks: tuple[Remark, ...]  # one for each new camera


def separate_sizes(survey: Survey, files: PhotographList) -> OtherSizes:
    """Give photographs of another size than the others of their camera a separate camera.

    A few of them, and those whose camera is held at values that another part of the sensor does not have, are
    left out.

    Args:
        survey: its cameras.
        files: its photographs; those that cannot be read stay with their camera.
    """
    sizes = [_size(path) for path in files.paths]
    cameras, owner = list(survey.cameras), files.camera.copy()
    left: dict[int, Remark] = {}
    remarks = []
    for number, camera in enumerate(survey.cameras):
        counted: dict[Size, list[int]] = {}
        for k in np.flatnonzero(files.camera == number).tolist():
            if (size := sizes[k]) is not None:
                counted.setdefault(size, []).append(k)
        main = _main_size(camera, counted)
        if main is None:
            continue
        for size, rows in sorted(counted.items()):
            if size == main:
                continue
            what = _kind(size, main)
            held = _held(camera) and what != RESAMPLED
            if len(rows) < MIN_OWN or held:
                reason = remark(
                    "photograph_outside_calibration" if held else "photograph_of_other_size",
                    camera=camera.name,
                    size=f"{size[0]} x {size[1]} px",
                    usual=f"{main[0]} x {main[1]} px",
                    what=what,
                    needed=MIN_OWN,
                )
                left |= dict.fromkeys(rows, reason)
                continue
            names = [files.names[k] for k in rows]
            cameras.append(_resized(camera, size, main, what, names))
            owner[rows] = len(cameras) - 1
            remarks.append(
                remark(
                    "camera_by_size",
                    photographs=names,
                    camera=camera.name,
                    new=cameras[-1].name,
                    size=f"{size[0]} x {size[1]} px",
                    usual=f"{main[0]} x {main[1]} px",
                    what=what,
                )
            )
    if not left and not remarks:
        return OtherSizes(survey, files, (), ())
    kept = [k for k in range(len(files)) if k not in left]
    return OtherSizes(
        replace(survey, cameras=tuple(cameras)),
        PhotographList(
            tuple(files.names[k] for k in kept),
            tuple(files.paths[k] for k in kept),
            owner[kept],
            files.folder,
        ),
        tuple(FailedImage(files.names[k], why) for k, why in sorted(left.items())),
        tuple(remarks),
    )


def _size(path: Path) -> Size | None:
    try:
        return read_metadata(path).size_px
    except PhotographError:  # reported where it is measured
        return None


def _main_size(camera: CameraSettings, counted: dict[Size, list[int]]) -> Size | None:
    """Return the size of a camera: that of the survey if a photograph has it, else the most frequent."""
    if camera.size_px in counted:
        return camera.size_px
    if camera.size_px is not None or not counted:
        return None
    return max(counted, key=lambda size: (len(counted[size]), -counted[size][0]))


def _kind(size: Size, main: Size) -> str:
    if size == main[::-1]:
        return UPRIGHT
    ratio = (size[0] / size[1]) / (main[0] / main[1])
    return RESAMPLED if abs(ratio - 1) < MAX_ASPECT_DIFFERENCE else CROPPED


def _held(camera: CameraSettings) -> bool:
    """Return whether a camera is held at given values, which belong to its whole photograph."""
    return bool(camera.fixed or camera.weighted or (camera.states_free and not camera.may_be_free))


def _resized(
    camera: CameraSettings, size: Size, main: Size, what: str, names: Sequence[str]
) -> CameraSettings:
    """Return the settings of a camera for photographs of another size of the same sensor."""
    pixel = camera.pixel_mm
    if camera.sensor_mm is not None:
        pixel = camera.sensor_mm[0] / main[0], camera.sensor_mm[1] / main[1]
    if pixel is not None and what == RESAMPLED:
        pixel = pixel[0] * main[0] / size[0], pixel[1] * main[1] / size[1]
    if pixel is not None and what == UPRIGHT:
        pixel = pixel[::-1]
    return camera.model_copy(
        update={
            "name": f"{camera.name} {size[0]}x{size[1]}",
            "images": tuple(escape(name) for name in names),
            "size_px": None,
            "sensor_mm": None,
            "pixel_mm": pixel,
        }
    )
