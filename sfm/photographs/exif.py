"""EXIF data of a photograph, checked before use: camera, sensor, time and satellite position.

Files that are too large, truncated, or of formats that must be converted first are refused before any pixels
are decoded.
"""

from __future__ import annotations

import io
import math
import re
import shlex
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import TiffImageFile

from sfm.model.conventions import FloatArray
from sfm.model.errors import PhotographError
from sfm.photographs.camera_files import (
    HEIF,
    INSTALL,
    CameraHeader,
    header_of,
    is_camera_file,
    missing_library,
)
from sfm.photographs.video_files import VIDEO, missing_av

# warnings.catch_warnings is not thread-safe, and several threads read photographs.
_PILLOW = Lock()
FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "PPM", "WEBP")  # Pillow's names; it tries no other formats
# WGS 84: semi-major axis, m, and flattening (NIMA TR8350.2, 2000).
SEMI_MAJOR_M, FLATTENING = 6_378_137.0, 1 / 298.257223563
ORIGIN_DECIMALS = 3  # of the degrees of an origin: 0.001 deg are 111 m
MAX_HEIGHT_M = 100_000.0  # a larger number is not the height of a camera
BELOW = (1, 3)  # GPSAltitudeRef: below sea level, below the reference of EXIF 3.0
MIN_SIGMA_M = 0.001  # no receiver on a camera is better; smaller numbers have another unit or mean unknown
MAX_SIGMA_M = 10_000.0  # the width of a cell of a telephone network; a larger number means unknown
VOID = "V"  # GPSStatus of a receiver without a fix
# Default standard deviations of a telephone under open sky, to the east, to the north and of the height, m.
# Source: van Diggelen and Enge (2015), ION GNSS+, for the plane; heights are twice as uncertain.
USUAL_SIGMAS_M = (5.0, 5.0, 10.0)
# Standard deviations of receivers for real-time kinematics in XMP data, m.
STATED_IN_XMP = re.compile(rb"RtkStd(Lon|Lat|Hgt)\s*(?:=\s*[\"']|>)\s*([0-9.eE+-]{1,20})")


@dataclass(frozen=True)
class SatellitePosition:
    """Position of the receiver when a photograph was taken."""

    latitude_deg: float
    """north of the equator, WGS 84"""
    longitude_deg: float
    """east of Greenwich, -180 to 180"""
    height_m: float
    """as stated, above the ellipsoid or sea level; NaN if not stated"""
    sigma_m: tuple[float, float, float]
    """stated standard deviations to the east, to the north and of the height, else NaN"""


# Limits of principal distance and pixel, mm; EXIF data beyond them describe no camera.
FOCAL_MM = (0.1, 1e5)
PIXEL_MM = (1e-5, 1.0)


@dataclass(frozen=True)
class Metadata:
    """Size and camera data in the file of a photograph; None if it does not state a value."""

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
    """width and height of a pixel from the focal plane resolution or the 35 mm equivalent, mm"""
    orientation: int
    """EXIF orientation, 1 = as stored; never applied to the pixels"""
    serial: str | None = None
    """serial number of the camera"""
    lens: str | None = None
    """model of the lens"""
    taken_px: tuple[int, int] | None = None
    """original width and height that the camera states, px"""
    taken: datetime | None = None
    """time of exposure by the clock of the camera"""
    position: SatellitePosition | None = None
    """position by satellite navigation"""
    several: bool = False
    """whether the file has further pictures of this size, which are not read"""


def read_metadata(path: str | Path) -> Metadata:
    """Read size and EXIF data of a photograph without decoding its pixels.

    Args:
        path: a photograph.

    Returns:
        The metadata; a file without EXIF data only gives its size.

    Raises:
        PhotographError: the file does not exist or is not a photograph.
    """
    path = Path(path)
    with opened_header(path, path) as image:
        size = stored_size(image)
        try:
            exif = image.getexif()
        except Exception:  # Pillow fails in many ways on damaged EXIF data, which are ignored
            exif = Image.Exif()
        camera, gps = _directory(exif, ExifTags.IFD.Exif), _directory(exif, ExifTags.IFD.GPSInfo)
        xmp = image.info.get("xmp", b"")
        several = False  # pictures of one size: no preview, no map of depth
        if isinstance(image, Image.Image) and image.format in ("PNG", "WEBP"):  # animated
            several = bool(getattr(image, "n_frames", 1) > 1)
        elif isinstance(image, Image.Image) and image.format in ("TIFF", "MPO"):
            first = image.size
            with suppress(Exception):  # there is none, or it is damaged
                image.seek(1)
                several = image.size == first
    focal = _between(camera.get(ExifTags.Base.FocalLength), FOCAL_MM)
    equivalent = _between(camera.get(ExifTags.Base.FocalLengthIn35mmFilm), FOCAL_MM)
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    width = _positive(camera.get(ExifTags.Base.ExifImageWidth))
    height = _positive(camera.get(ExifTags.Base.ExifImageHeight))
    taken = None
    with suppress(ValueError):  # cameras state no time zone
        text = _text(camera.get(ExifTags.Base.DateTimeOriginal))
        taken = datetime.strptime(text or "", "%Y:%m:%d %H:%M:%S")
        digits = _text(camera.get(ExifTags.Base.SubsecTimeOriginal)) or ""
        if digits.isdecimal():
            taken = taken.replace(microsecond=int(f"{digits:0<6.6}"))
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
        taken_px=(round(width), round(height)) if width and height else None,
        taken=taken,
        position=satellite_position(gps, xmp if isinstance(xmp, bytes) else b""),
        several=several,
    )


def _directory(exif: Image.Exif, which: ExifTags.IFD) -> dict[int, Any]:
    """Return a directory of EXIF data by tag, empty if it is damaged."""
    try:
        return exif.get_ifd(which)
    except Exception:  # see `read_metadata`
        return {}


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
        scale = full / size[0]  # the resolution refers to the original picture
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


@dataclass(frozen=True)
class LocalSystem:
    """Axes to the east, to the north and up (WGS 84) at an origin of height 0."""

    latitude_deg: float
    longitude_deg: float

    def coordinates(
        self, latitude_deg: npt.ArrayLike, longitude_deg: npt.ArrayLike, height_m: npt.ArrayLike
    ) -> FloatArray:
        """Return east, north and up of positions, m, (k, 3).

        Args:
            latitude_deg: latitudes, deg, (k,).
            longitude_deg: longitudes, deg, (k,).
            height_m: heights above the ellipsoid, m, (k,).
        """
        origin = _geocentric(np.array([self.latitude_deg]), np.array([self.longitude_deg]), np.zeros(1))
        places = _geocentric(
            np.asarray(latitude_deg, float), np.asarray(longitude_deg, float), np.asarray(height_m, float)
        )
        phi, lam = math.radians(self.latitude_deg), math.radians(self.longitude_deg)
        axes = np.array(
            [
                [-math.sin(lam), math.cos(lam), 0.0],
                [-math.sin(phi) * math.cos(lam), -math.sin(phi) * math.sin(lam), math.cos(phi)],
                [math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam), math.sin(phi)],
            ]
        )
        return np.asarray((places - origin) @ axes.T)


def local_coordinates(positions: Sequence[SatellitePosition]) -> tuple[LocalSystem, FloatArray]:
    """Return a local system at the middle of positions, and their coordinates in it.

    The origin is the median position with rounded degrees, at height 0. Except for the curvature of the
    Earth, upward coordinates are therefore the stated heights.

    Args:
        positions: at least one position.

    Returns:
        The system, and east, north and up, m, (k, 3); up is NaN if no height is stated.
    """
    latitude = np.array([position.latitude_deg for position in positions])
    longitude = np.array([position.longitude_deg for position in positions])
    height = np.array([position.height_m for position in positions])
    x, y, z = np.median(_normals(latitude, longitude), axis=0)  # not affected by the date line
    origin = LocalSystem(
        round(math.degrees(math.atan2(z, math.hypot(x, y))), ORIGIN_DECIMALS) + 0.0,  # no -0
        round(math.degrees(math.atan2(y, x)), ORIGIN_DECIMALS) + 0.0,
    )
    known = np.isfinite(height)
    usual = float(np.median(height[known])) if known.any() else 0.0
    places = origin.coordinates(latitude, longitude, np.where(known, height, usual))
    places[~known, 2] = np.nan
    return origin, places


def satellite_position(gps: Mapping[int, Any], xmp: bytes = b"") -> SatellitePosition | None:
    """Return the position in the data of a photograph, or None.

    These are not positions: latitude and longitude 0, which writers use for unknown; numbers out of range;
    missing hemispheres; and receivers without a fix.

    Args:
        gps: GPS data of EXIF, by tag.
        xmp: XMP data, which may state standard deviations of real-time kinematics.

    Source: CIPA DC-008, Exif 2.32 and 3.0, GPS attribute information.
    """
    tag = ExifTags.GPS
    latitude = _degrees(gps.get(tag.GPSLatitude), gps.get(tag.GPSLatitudeRef), "NS", 90.0)
    longitude = _degrees(gps.get(tag.GPSLongitude), gps.get(tag.GPSLongitudeRef), "EW", 180.0)
    no_fix = _letter(gps.get(tag.GPSStatus)) == VOID
    if not (math.isfinite(latitude) and math.isfinite(longitude)) or no_fix or latitude == longitude == 0:
        return None
    height = _number(gps.get(tag.GPSAltitude))
    if not abs(height) <= MAX_HEIGHT_M:
        height = math.nan
    below = gps.get(tag.GPSAltitudeRef, 0)
    if (below[0] if isinstance(below, bytes) and below else below) in BELOW:
        height = -abs(height)
    stated = {axis: _number(value.decode()) for axis, value in STATED_IN_XMP.findall(xmp)}
    of_plane = _sigma(_number(gps.get(tag.GPSHPositioningError)))
    sigma = [_sigma(stated.get(axis, math.nan)) for axis in (b"Lon", b"Lat", b"Hgt")]
    east, north = (of_plane if math.isnan(of_axis) else of_axis for of_axis in sigma[:2])
    return SatellitePosition(latitude, longitude, height, (east, north, sigma[2]))


def _geocentric(latitude_deg: FloatArray, longitude_deg: FloatArray, height_m: FloatArray) -> FloatArray:
    """Return Cartesian coordinates from the centre of the Earth, m, (k, 3)."""
    normal = _normals(latitude_deg, longitude_deg)
    e2 = FLATTENING * (2 - FLATTENING)
    N = SEMI_MAJOR_M / np.sqrt(1 - e2 * normal[:, 2] ** 2)  # radius of curvature in the prime vertical
    return np.asarray(normal * (N + height_m)[:, None] - np.outer(e2 * N * normal[:, 2], [0, 0, 1]))


def _normals(latitude_deg: FloatArray, longitude_deg: FloatArray) -> FloatArray:
    """Return unit vectors normal to the ellipsoid, (k, 3)."""
    phi, lam = np.radians(latitude_deg), np.radians(longitude_deg)
    return np.column_stack([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])


def _degrees(value: Any, hemisphere: Any, letters: str, most: float) -> float:
    """Return degrees from degrees, minutes and seconds, NaN if they are invalid or beyond +-most."""
    parts = value if isinstance(value, tuple | list) else (value,)
    numbers = [_number(part) for part in parts]
    if not 1 <= len(numbers) <= 3 or not all(number >= 0 for number in numbers):
        return math.nan
    if not all(number <= 60 for number in numbers[1:]):  # 60 is what rounding makes of 59.9999
        return math.nan
    degrees = sum(number / 60**k for k, number in enumerate(numbers))
    sign = {letters[0]: 1, letters[1]: -1}.get(_letter(hemisphere))
    return sign * degrees if sign and degrees <= most else math.nan


def _letter(value: Any) -> str:
    """Return the first letter of an EXIF text as a capital; some writers store bytes."""
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else str(value or "")
    return text[:1].upper()


def _number(value: Any) -> float:
    """Return a finite number or NaN; writers use 0/0 for unknown."""
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return math.nan
    return number if math.isfinite(number) else math.nan


def _sigma(value: float) -> float:
    """Return a standard deviation, NaN if no receiver has it; writers use 0 or a huge number for unknown."""
    return value if MIN_SIGMA_M <= value <= MAX_SIGMA_M else math.nan


Image.init()
# Kinds of files that must be converted first, by their endings.
UNREAD = {".avif": "an AVIF file", ".gif": "a GIF file", ".jp2": "a JPEG 2000 file", ".jxl": "a JPEG XL file"}
MAX_FILE_BYTES = 2**30
MAX_PIXELS = 250_000_000  # the largest aerial scans; digital backs have 151 million
# A larger picture in fewer bytes is a decompression bomb; a JPEG of a single grey value has 250 px per byte.
BOMB_PIXELS, BOMB_PX_PER_BYTE = 16_000_000, 500
MAX_SCANNED_PIXELS = 2_500_000_000  # pixels times scans of a progressive JPEG: about 20 s of decoding


def read_bytes(path: Path) -> bytes:
    """Return the content of a photograph's file.

    Raises:
        PhotographError: the file does not exist, is empty, must be converted first, or is too large.
    """
    _refuse_unconverted(path)
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


def conversion_of(path: Path) -> str:
    """Return, by its ending, what kind of file must be converted first, and how; empty for other files."""
    if library := missing_library(path):
        kind = "HEIF" if path.suffix.lower() in HEIF else "raw"
        return f"a {kind} file, which is read with {library}, and it is not installed: {INSTALL}"
    if unread := UNREAD.get(path.suffix.lower()):
        return f"{unread}, which is not read; convert all at full size and quality to JPEG or PNG"
    if path.suffix.lower() in VIDEO:
        if missing_av():
            return f"a video, whose frames are read with PyAV, and it is not installed: {INSTALL}"
        return f"a video; kolinear init {shlex.quote(str(path))} writes its frames as photographs beside it"
    return ""


def _refuse_unconverted(path: Path) -> None:
    """Refuse files that must be converted first; of some raw files the small preview would be read."""
    if words := conversion_of(path):
        raise PhotographError(f"{path.name}: {words}")


@contextmanager
def opened_header(path: Path, source: Path | io.BytesIO) -> Iterator[Image.Image | CameraHeader]:
    """Open the header of a photograph without decoding pixels.

    Args:
        path: path of the photograph, for its ending and error messages.
        source: the same path, or the content of the file.

    Raises:
        PhotographError: the file does not exist, has no known format, or claims to be too large.
    """
    _refuse_unconverted(path)
    if is_camera_file(path):
        if source is path and path.exists() and not path.is_file():  # reading a pipe would never end
            raise PhotographError(f"{path.name}: not a file, a photograph is needed")
        with _PILLOW, warnings.catch_warnings(action="ignore"):
            try:
                header = header_of(path, source)
            except Exception as error:  # the libraries fail on damaged files in many ways
                raise PhotographError(f"{path.name}: {_reason(path, error)}") from error
        _refuse_large(path, header.size)
        yield header
        return
    with _PILLOW, warnings.catch_warnings(action="ignore"):
        # Pillow's limit is below the size of aerial scans
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            if source is path and path.exists() and not path.is_file():  # reading a pipe would never end
                raise PhotographError(f"{path.name}: not a file, a photograph is needed")
            image = Image.open(source, formats=FORMATS)
        except PhotographError:
            raise
        except Exception as error:  # Pillow fails on damaged headers in many ways
            raise PhotographError(f"{path.name}: {_reason(path, error)}") from error
        finally:
            Image.MAX_IMAGE_PIXELS = limit
        with image:
            _refuse_large(path, image.size)
            yield image


def stored_size(header: Image.Image | CameraHeader) -> tuple[int, int]:
    """Return the width and height as stored, px; Pillow gives those of a turned TIFF file as it is shown.

    Args:
        header: of `opened_header`.
    """
    size = header.size
    if isinstance(header, TiffImageFile) and header.tag_v2.get(ExifTags.Base.Orientation, 1) > 4:
        width, height = header.tag_v2[ExifTags.Base.ImageWidth], header.tag_v2[ExifTags.Base.ImageLength]
        return int(width), int(height)
    return size


def _refuse_large(path: Path, size: tuple[int, int]) -> None:
    if size[0] * size[1] > MAX_PIXELS:
        raise PhotographError(
            f"{path.name}: {size[0]} x {size[1]} px; "
            f"photographs of at most {MAX_PIXELS / 1e6:.0f} million pixels are read"
        )


def refuse_bomb(path: Path, size: tuple[int, int], data: bytes) -> None:
    """Refuse a file that claims far more pixels than its bytes can contain, or that takes too long to decode.

    Args:
        path: path of the photograph, for error messages.
        size: width and height in its header, px.
        data: content of the file.

    Raises:
        PhotographError: more pixels than the bytes can contain, or too many scans.
    """
    pixels = size[0] * size[1]
    if pixels > BOMB_PIXELS and pixels > BOMB_PX_PER_BYTE * len(data):
        raise PhotographError(
            f"{path.name}: {size[0]} x {size[1]} px in {len(data)} bytes is not a photograph; "
            f"a file of that size has at least {pixels // BOMB_PX_PER_BYTE} bytes"
        )
    scans = data.count(b"\xff\xda") if data.startswith(b"\xff\xd8") else 1
    if scans * pixels > MAX_SCANNED_PIXELS:
        raise PhotographError(f"{path.name}: a JPEG of {scans} scans; save it as a baseline JPEG")


def refuse_truncated(path: Path, data: bytes) -> None:
    """Refuse JPEG and PNG files whose end is missing; OpenCV would return them half grey.

    Args:
        path: path of the photograph, for the error message.
        data: content of the file.

    Raises:
        PhotographError: the end is missing.
    """
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
        at, kind = 8, b""  # all chunks are within the file; OpenCV allocates memory for their claims
        while at + 12 <= len(data) and kind != b"IEND":
            kind = data[at + 4 : at + 8]
            at += 12 + int.from_bytes(data[at : at + 4], "big")
        complete = kind == b"IEND" and at <= len(data)
    else:
        return  # the decoder itself refuses truncated TIFF files
    if not complete:
        raise PhotographError(f"{path.name}: the file is truncated, its end is missing ({len(data)} bytes)")


def _reason(path: Path, error: Exception) -> str:
    if not path.exists():
        return f"no such file in {path.parent}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return "not a photograph that can be decoded"
