"""Reading of photographs and of what their EXIF data say about the camera."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
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
# Photographs are read as untrusted: what they claim to be is bounded before memory is taken for it.
FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "PPM", "WEBP")  # by the names of Pillow, which finds none unasked
Image.init()
MAX_FILE_BYTES = 2**30
MAX_PIXELS = 250_000_000  # the largest aerial scans; digital backs have 151 million
# A larger picture in fewer bytes is a decompression bomb; one sole grey value is 250 px per byte in a JPEG.
BOMB_PIXELS, BOMB_PX_PER_BYTE = 16_000_000, 500
MAX_SCANNED_PIXELS = 2_500_000_000  # pixels times scans of a progressive JPEG, some 20 s of decoding
# Beyond these what EXIF data say is no camera: principal distance and pixel in mm.
FOCAL_MM = (0.1, 1e5)
PIXEL_MM = (1e-5, 1.0)


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
    with _opened(path, io.BytesIO(data)) as header:
        size = header.size
    _refuse_bomb(path, size, data)
    colour = cv2.IMREAD_GRAYSCALE if channel == "luminance" else cv2.IMREAD_COLOR
    try:
        image = cv2.imdecode(
            np.frombuffer(data, np.uint8), colour | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        )
    except cv2.error:
        image = None
    if image is None:
        raise PhotographError(f"{path.name}: not a photograph that can be decoded ({len(data)} bytes)")
    if image.shape[1::-1] != size:
        found = f"{image.shape[1]} x {image.shape[0]}"
        raise PhotographError(f"{path.name}: {found} px, its header says {size[0]} x {size[1]}")
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
    with _opened(path, path) as image:
        size = image.size
        try:
            exif = image.getexif()
            camera = exif.get_ifd(ExifTags.IFD.Exif)
        except Exception:  # damaged EXIF data, over which Pillow stumbles in many ways, are as good as none
            exif, camera = Image.Exif(), {}
    focal = _between(camera.get(ExifTags.Base.FocalLength), FOCAL_MM)
    equivalent = _between(camera.get(ExifTags.Base.FocalLengthIn35mmFilm), FOCAL_MM)
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    return Metadata(
        size_px=size,
        make=_text(exif.get(ExifTags.Base.Make)),
        model=_text(exif.get(ExifTags.Base.Model)),
        focal_mm=focal,
        focal_35mm=equivalent,
        pixel_mm=_pixel_from_exif(size, camera, focal, equivalent),
        orientation=orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1,
    )


def _pixel_from_exif(
    size: tuple[int, int], camera: Any, focal: float | None, equivalent: float | None
) -> tuple[float, float] | None:
    """Return width and height of a pixel in mm, None if the file does not tell."""
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


@contextmanager
def _opened(path: Path, source: Path | io.BytesIO) -> Iterator[Image.Image]:
    """Open the header of a photograph; nothing is decoded.

    Raises:
        PhotographError: no such file, no photograph of a known format, or one that claims to be too large.
    """
    with _PILLOW, warnings.catch_warnings(action="ignore"):
        try:
            if source is path and path.exists() and not path.is_file():  # reading a pipe would never end
                raise PhotographError(f"{path.name}: not a file, a photograph is needed")
            image = _unbounded_open(source)
        except PhotographError:
            raise
        except Exception as error:  # Pillow stumbles over damaged headers in many ways
            raise PhotographError(f"{path.name}: {_reason(path, error)}") from error
        with image:
            if image.width * image.height > MAX_PIXELS:
                raise PhotographError(
                    f"{path.name}: {image.width} x {image.height} px; "
                    f"photographs of at most {MAX_PIXELS / 1e6:.0f} million pixels are read"
                )
            yield image


def _unbounded_open(source: Path | io.BytesIO) -> Image.Image:
    """Open a header without Pillow's own limit, which is below that of aerial scans."""
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None
    try:
        return Image.open(source, formats=FORMATS)
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def _refuse_bomb(path: Path, size: tuple[int, int], data: bytes) -> None:
    """Refuse a file that claims far more pixels than its bytes can hold, or that takes too long to decode."""
    pixels = size[0] * size[1]
    if pixels > BOMB_PIXELS and pixels > BOMB_PX_PER_BYTE * len(data):
        raise PhotographError(
            f"{path.name}: {size[0]} x {size[1]} px in {len(data)} bytes is no photograph; "
            f"a file of that size has at least {pixels // BOMB_PX_PER_BYTE} bytes"
        )
    scans = data.count(b"\xff\xda") if data.startswith(b"\xff\xd8") else 1
    if scans * pixels > MAX_SCANNED_PIXELS:
        raise PhotographError(f"{path.name}: a JPEG of {scans} scans; save it as a baseline JPEG")


def _read_bytes(path: Path) -> bytes:
    try:
        if path.exists() and not path.is_file():  # reading a pipe would never end
            raise PhotographError(f"{path.name}: not a file, a photograph is needed")
        if path.stat().st_size > MAX_FILE_BYTES:
            raise PhotographError(
                f"{path.name}: {path.stat().st_size} bytes, at most {MAX_FILE_BYTES} are read"
            )
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
        complete = _png_is_whole(data)
    else:
        return  # the decoder itself refuses truncated TIFF files
    if not complete:
        raise PhotographError(f"{path.name}: the file is truncated, its end is missing ({len(data)} bytes)")


def _png_is_whole(data: bytes) -> bool:
    """Whether the chunks of a PNG lie within the file; OpenCV takes memory for what they claim."""
    at = 8
    while at + 12 <= len(data):
        kind = data[at + 4 : at + 8]
        at += 12 + int.from_bytes(data[at : at + 4], "big")
        if kind == b"IEND":
            return at <= len(data)
    return False


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
