"""Reading of photographs and of what their EXIF data say about the camera."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np
from PIL import ExifTags, Image

from sfm.conventions import AnyArray
from sfm.errors import PhotographError

# What is wrong with a file is said by PhotographError; OpenCV's warnings on private TIFF tags help nobody.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

# warnings.catch_warnings is not safe in threads, and photographs are read in several.
_PILLOW = Lock()

CHANNELS = ("luminance", "red", "green", "blue")


@dataclass(frozen=True)
class Metadata:
    """What a photograph's file says about its size and camera; None where it is silent."""

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


def read_photograph(path: str | Path, *, channel: str = "luminance") -> AnyArray:
    """Read one photograph as stored: never turned by its EXIF orientation, all bits kept.

    Args:
        path: JPEG, TIFF, PNG or another format that OpenCV reads.
        channel: luminance (Rec. 601), red, green or blue; grey photographs are the same in all.

    Returns:
        Intensities, shape (H, W), uint8 or uint16.

    Raises:
        PhotographError: no such file, no photograph, truncated, or neither 8 nor 16 bit.
    """
    path = Path(path)
    if channel not in CHANNELS:
        raise PhotographError(f"{path.name}: channel {channel!r} is none of {', '.join(CHANNELS)}")
    data = _read_bytes(path)
    _refuse_truncated(path, data)
    colour = cv2.IMREAD_GRAYSCALE if channel == "luminance" else cv2.IMREAD_COLOR
    try:
        image = cv2.imdecode(
            np.frombuffer(data, np.uint8), colour | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        )
    except cv2.error:
        image = None
    if image is None:
        raise PhotographError(f"{path.name}: not a photograph that can be decoded ({len(data)} bytes)")
    if image.dtype not in (np.uint8, np.uint16):
        raise PhotographError(f"{path.name}: found {image.dtype} intensities, needed 8 or 16 bit")
    if image.ndim == 3:
        image = np.ascontiguousarray(image[:, :, {"blue": 0, "green": 1, "red": 2}[channel]])
    return image


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
    try:
        with _PILLOW, warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            size = image.size
            exif = image.getexif()
            camera = exif.get_ifd(ExifTags.IFD.Exif)
    except (OSError, ValueError, SyntaxError) as error:
        raise PhotographError(f"{path.name}: {_reason(path, error)}") from error
    focal = _positive(camera.get(ExifTags.Base.FocalLength))
    equivalent = _positive(camera.get(ExifTags.Base.FocalLengthIn35mmFilm))
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    return Metadata(
        size_px=size,
        make=_text(exif.get(ExifTags.Base.Make)),
        model=_text(exif.get(ExifTags.Base.Model)),
        focal_mm=focal,
        focal_35mm=equivalent,
        pixel_mm=_pixel_from_exif(size, camera, focal, equivalent),
        orientation=orientation if orientation in range(1, 9) else 1,
    )


def _pixel_from_exif(
    size: tuple[int, int], camera: Any, focal: float | None, equivalent: float | None
) -> tuple[float, float] | None:
    """Return width and height of a pixel in mm, None if the file does not tell."""
    unit_mm = {2: 25.4, 3: 10.0, 4: 1.0}.get(camera.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    across = _positive(camera.get(ExifTags.Base.FocalPlaneXResolution))
    down = _positive(camera.get(ExifTags.Base.FocalPlaneYResolution))
    full = camera.get(ExifTags.Base.ExifImageWidth)
    if unit_mm and across and down and full:
        scale = full / size[0]  # the resolution is that of the picture as taken
        return unit_mm / across * scale, unit_mm / down * scale
    if focal and equivalent:
        diagonal_mm = math.hypot(36.0, 24.0) * focal / equivalent
        pixel = diagonal_mm / math.hypot(*size)
        return pixel, pixel
    return None


def _read_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PhotographError(f"{path.name}: {_reason(path, error)}") from error
    if not data:
        raise PhotographError(f"{path.name}: the file is empty")
    return data


def _reason(path: Path, error: Exception) -> str:
    if not path.exists():
        return f"no such file in {path.parent}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return "not a photograph that can be decoded"


def _refuse_truncated(path: Path, data: bytes) -> None:
    """Refuse JPEG and PNG files whose end is missing; OpenCV would return them half grey."""
    if data.startswith(b"\xff\xd8"):
        at = 2
        while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:  # segments before the scan
            if data[at + 1] == 0xFF:  # fill byte
                at += 1
            else:
                at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        # Inside a scan 0xff is always followed by 0 or a restart marker, so this is the end of the image.
        complete = data.find(b"\xff\xd9", at) >= 0
    elif data.startswith(b"\x89PNG\r\n\x1a\n"):
        complete = data.rfind(b"IEND") >= 0
    else:
        return  # the decoder itself refuses truncated TIFF files
    if not complete:
        raise PhotographError(f"{path.name}: the file is truncated, its end is missing ({len(data)} bytes)")


def _positive(value: Any) -> float | None:
    """Return a positive finite number or None; EXIF writers use 0 and 0/0 for unknown."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _text(value: Any) -> str | None:
    text = str(value).strip(" \0") if value is not None else ""
    return text or None
