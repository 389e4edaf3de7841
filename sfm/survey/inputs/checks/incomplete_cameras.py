"""Camera values that neither survey nor photographs state, listed together; pixels that are no squares."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from sfm.errors import PhotographError, SurveyFileError
from sfm.photographs.exif import Metadata, read_metadata
from sfm.remarks.remark import Remark, remark
from sfm.survey.inputs.photograph_list import PhotographList
from sfm.survey.inputs.settings import CameraSettings

UNLIKE_SQUARES = 0.005  # relative difference of the sides of a pixel; no sensor of a camera has it


def refuse_incomplete_cameras(
    settings: Sequence[CameraSettings], source: str, photographs: PhotographList
) -> None:
    """Raise SurveyFileError if the pixel size or principal distance of cameras is not known from anywhere.

    Args:
        settings: what the survey says of its cameras.
        source: what messages call the survey.
        photographs: whose EXIF data may say the rest.
    """
    lines = []
    for number, one in enumerate(settings):
        wanted = _wanted(one)
        paths = [photographs.paths[k] for k in np.flatnonzero(photographs.camera == number)]
        metadata = _readable(paths) if wanted else []
        missing = [
            key for key, attribute in wanted if metadata and not any(getattr(m, attribute) for m in metadata)
        ]
        if missing:
            lines.append(f"camera {one.name}: {' and '.join(missing)}")
    if lines:
        raise SurveyFileError(
            f"{source}: EXIF data of the photographs do not state what is needed of {'; '.join(lines)}"
        )


def unlike_squares(
    settings: Sequence[CameraSettings], pixels: Sequence[tuple[float, float]], free: Sequence[Sequence[str]]
) -> tuple[Remark, ...]:
    """Return a remark on each camera whose nominal sensor size makes pixels that are not square.

    Args:
        settings: what the survey says of its cameras; a pixel size that is stated is not looked at.
        pixels: width and height of a pixel of each, mm.
        free: parameters of each that are adjusted; with b1, or fx and fy, the photographs say the ratio.
    """
    remarks = []
    for one, (width, height), adjusted in zip(settings, pixels, free, strict=True):
        known = "b1" in adjusted or {"fx", "fy"} <= set(adjusted)
        ratio = width / height - 1
        if one.pixel_mm is None and not known and abs(ratio) >= UNLIKE_SQUARES:
            remarks.append(
                remark(
                    "pixels_not_square",
                    camera=one.name,
                    where="sensor_mm" if one.sensor_mm is not None else "EXIF data",
                    width=(1000 * width, "µm"),
                    height=(1000 * height, "µm"),
                    off=(100 * abs(ratio), "%"),
                    side=((width * height) ** 0.5, "mm"),
                )
            )
    return tuple(remarks)


def _wanted(one: CameraSettings) -> list[tuple[str, str]]:
    """Return (what to write, where EXIF data have it) of what a camera does not say."""
    said = {name for name, _ in (*one.fixed, *one.start, *one.weighted, *one.balanced)}
    wanted = []
    if one.pixel_mm is None and one.sensor_mm is None:
        wanted.append(("pixel_mm or sensor_mm", "pixel_mm"))
    if one.c_mm is None and not said & {"c", "fx", "f"}:
        wanted.append(("c_mm", "focal_mm"))
    return wanted


def _readable(paths: Sequence[Path]) -> list[Metadata]:
    """Return the metadata of the photographs that have some; the others are reported where they are read."""
    found = []
    for path in paths:
        with suppress(PhotographError, OSError):
            found.append(read_metadata(path))
    return found
