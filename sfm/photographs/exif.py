"""EXIF data of a photograph: its camera and sensor, its time and its place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

from sfm.photographs.file_checks import opened_header
from sfm.photographs.satellite_positions import SatellitePosition, satellite_position

# Beyond these EXIF data describe no camera: principal distance and pixel in mm.
FOCAL_MM = (0.1, 1e5)
PIXEL_MM = (1e-5, 1.0)


@dataclass(frozen=True)
class Metadata:
    """Size and camera as the file of a photograph states them; None where it does not."""

    size_px: tuple[int, int]
    """width and height as stored, px"""
    make: str | None
    """maker of the camera"""
    model: str | None
    """model of the camera"""
    focal_mm: float | None
    """focal length, mm"""
    focal_35mm: float | None
    """focal length of the same angle of view on 36 mm x 24 mm film, mm"""
    pixel_mm: tuple[float, float] | None
    """width and height of a pixel, from the resolution of the focal plane or the 35 mm equivalent, mm"""
    orientation: int
    """EXIF orientation, 1 = as stored; never applied to the pixels"""
    serial: str | None = None
    """serial number of the camera"""
    lens: str | None = None
    """model of the lens"""
    taken_px: tuple[int, int] | None = None
    """width and height as the camera states them, px"""
    taken: datetime | None = None
    """when, by the clock of the camera"""
    position: SatellitePosition | None = None
    """where, by satellite navigation"""


def read_metadata(path: str | Path) -> Metadata:
    """Read size and EXIF data of a photograph without decoding its pixels.

    Args:
        path: a photograph.

    Returns:
        The metadata; a file without EXIF data gives its size only.

    Raises:
        PhotographError: no such file or no photograph.
    """
    path = Path(path)
    with opened_header(path, path) as image:
        size = image.size
        try:
            exif = image.getexif()
        except Exception:  # damaged EXIF data, on which Pillow fails in many ways, are as good as none
            exif = Image.Exif()
        camera, gps = _directory(exif, ExifTags.IFD.Exif), _directory(exif, ExifTags.IFD.GPSInfo)
        xmp = image.info.get("xmp", b"")
    focal = _between(camera.get(ExifTags.Base.FocalLength), FOCAL_MM)
    equivalent = _between(camera.get(ExifTags.Base.FocalLengthIn35mmFilm), FOCAL_MM)
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    return Metadata(
        size_px=size,
        make=_text(exif.get(ExifTags.Base.Make)),
        model=_text(exif.get(ExifTags.Base.Model)) or _text(exif.get(ExifTags.Base.UniqueCameraModel)),
        focal_mm=focal,
        focal_35mm=equivalent,
        pixel_mm=_pixel_from_exif(size, camera, focal, equivalent),
        orientation=orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1,
        serial=_text(camera.get(ExifTags.Base.BodySerialNumber)),
        lens=_text(camera.get(ExifTags.Base.LensModel)),
        taken_px=_size_taken(camera),
        taken=_moment(camera),
        position=satellite_position(gps, xmp if isinstance(xmp, bytes) else b""),
    )


def _directory(exif: Image.Exif, which: ExifTags.IFD) -> dict[int, Any]:
    """Return a directory of EXIF data by tag, empty where it is damaged."""
    try:
        return exif.get_ifd(which)
    except Exception:  # see `read_metadata`
        return {}


def _moment(camera: Any) -> datetime | None:
    """Return when a photograph was taken, with the fraction of the second where it is stated."""
    text = _text(camera.get(ExifTags.Base.DateTimeOriginal))
    try:
        moment = datetime.strptime(text or "", "%Y:%m:%d %H:%M:%S")  # cameras know no zone
    except ValueError:
        return None
    digits = _text(camera.get(ExifTags.Base.SubsecTimeOriginal)) or ""
    return moment.replace(microsecond=int(f"{digits:0<6.6}")) if digits.isdecimal() else moment


def _size_taken(camera: Any) -> tuple[int, int] | None:
    width = _positive(camera.get(ExifTags.Base.ExifImageWidth))
    height = _positive(camera.get(ExifTags.Base.ExifImageHeight))
    return (round(width), round(height)) if width and height else None


def _pixel_from_exif(
    size: tuple[int, int], camera: Any, focal: float | None, equivalent: float | None
) -> tuple[float, float] | None:
    """Return width and height of a pixel in mm, None if the file does not state them."""
    unit = _positive(camera.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    unit_mm = {2.0: 25.4, 3.0: 10.0, 4.0: 1.0}.get(unit) if unit else None
    across = _positive(camera.get(ExifTags.Base.FocalPlaneXResolution))
    down = _positive(camera.get(ExifTags.Base.FocalPlaneYResolution))
    full = _positive(camera.get(ExifTags.Base.ExifImageWidth))
    width = height = None
    if unit_mm and across and down and full:
        scale = full / size[0]  # the resolution is that of the picture as taken
        width, height = unit_mm / across * scale, unit_mm / down * scale
    elif focal and equivalent:
        diagonal_mm = math.hypot(36.0, 24.0) * focal / equivalent
        width = height = diagonal_mm / math.hypot(*size)
    width, height = _between(width, PIXEL_MM), _between(height, PIXEL_MM)
    return (width, height) if width and height else None


def _positive(value: Any) -> float | None:
    """Return a positive finite number or None; EXIF writers use 0 and 0/0 for unknown."""
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _between(value: Any, limits: tuple[float, float]) -> float | None:
    """Return a number within limits or None."""
    number = _positive(value)
    return number if number is not None and limits[0] <= number <= limits[1] else None


def _text(value: Any) -> str | None:
    text = str(value).strip(" \0") if value is not None else ""
    return text or None
