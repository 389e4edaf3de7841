"""Positions of satellite navigation in EXIF and XMP data, and a local system of metres about them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import ExifTags

from sfm.conventions import FloatArray

# WGS 84: semi-major axis, m, and flattening (NIMA TR8350.2, 2000).
SEMI_MAJOR_M, FLATTENING = 6_378_137.0, 1 / 298.257223563
ORIGIN_DECIMALS = 3  # of the degrees of an origin: 0.001 deg are 111 m
MAX_HEIGHT_M = 100_000.0  # beyond it a number is no height of a camera
BELOW = (1, 3)  # GPSAltitudeRef: below sea level, below the reference of EXIF 3.0
MIN_SIGMA_M = 0.001  # no receiver on a camera is better, and smaller numbers are in another unit or unknown
VOID = "V"  # GPSStatus of a receiver without a fix
# Of a telephone under open sky, where it states none, to the east, to the north and of the height, m.
# Source: van Diggelen and Enge (2015), ION GNSS+, for the plane; heights are twice as uncertain.
USUAL_SIGMAS_M = (5.0, 5.0, 10.0)
# Standard deviations that receivers for real-time kinematics state in XMP data, m.
STATED_IN_XMP = re.compile(rb"RtkStd(Lon|Lat|Hgt)\s*(?:=\s*[\"']|>)\s*([0-9.eE+-]{1,20})")


@dataclass(frozen=True)
class SatellitePosition:
    """Where a receiver was when a photograph was taken."""

    latitude_deg: float
    """north of the equator, WGS 84"""
    longitude_deg: float
    """east of Greenwich, -180 to 180"""
    height_m: float
    """as stated, above the ellipsoid or sea level; NaN where it is not stated"""
    sigma_m: tuple[float, float, float]
    """standard deviations to the east, to the north and of the height that the receiver states, else NaN"""


@dataclass(frozen=True)
class LocalSystem:
    """Axes to the east, the north and upwards (WGS 84) at a place of height 0."""

    latitude_deg: float
    longitude_deg: float

    def coordinates(
        self, latitude_deg: npt.ArrayLike, longitude_deg: npt.ArrayLike, height_m: npt.ArrayLike
    ) -> FloatArray:
        """Return east, north and up of places, m, (k, 3).

        Args:
            latitude_deg: (k,).
            longitude_deg: (k,).
            height_m: above the ellipsoid, (k,).
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
    """Return a local system about positions and their coordinates in it.

    The origin is the median position with rounded degrees, at height 0, so that upward coordinates are the
    stated heights but for the curvature of the Earth.

    Args:
        positions: at least one.

    Returns:
        The system, and east, north and up, m, (k, 3); up is NaN where no height is stated.
    """
    latitude = np.array([one.latitude_deg for one in positions])
    longitude = np.array([one.longitude_deg for one in positions])
    height = np.array([one.height_m for one in positions])
    x, y, z = np.median(_normals(latitude, longitude), axis=0)  # knows of no date line
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
    """Return the position that the data of a photograph state; None where they state none.

    Latitude and longitude of 0, which writers use for unknown, numbers out of range, hemispheres that are not
    named and receivers without a fix are no position.

    Args:
        gps: the GPS data of EXIF, by tag.
        xmp: the XMP data, with the standard deviations of real-time kinematics, if they are stated.

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
    east, north = (of_plane if math.isnan(one) else one for one in sigma[:2])
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
    """Return degrees from degrees, minutes and seconds, NaN where they are none within +-most."""
    parts = value if isinstance(value, tuple | list) else (value,)
    numbers = [_number(one) for one in parts]
    if not 1 <= len(numbers) <= 3 or not all(one >= 0 for one in numbers):
        return math.nan
    degrees = sum(one / 60**k for k, one in enumerate(numbers))
    sign = {letters[0]: 1, letters[1]: -1}.get(_letter(hemisphere))
    return sign * degrees if sign and degrees <= most else math.nan


def _letter(value: Any) -> str:
    """Return the first letter of a text of EXIF, in capitals; some writers store bytes."""
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
    """Return a standard deviation, NaN where it is none; writers use 0 for unknown."""
    return value if value >= MIN_SIGMA_M else math.nan
