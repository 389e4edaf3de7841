"""Positions of satellite navigation for the tests: places in metres, and photographs that state them."""

from __future__ import annotations

import math
from pathlib import Path

from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from sfm.photographs.exif import SatellitePosition

M_PER_DEG_EQUATOR = (111_319.49, 110_574.28)  # of a degree of longitude and of latitude
UNKNOWN = (math.nan, math.nan, math.nan)


def at(
    east: float, north: float, up: float, sigma_m: tuple[float, float, float] = UNKNOWN
) -> SatellitePosition:
    """Return the position so many metres from where the equator meets the date line."""
    longitude = (east / M_PER_DEG_EQUATOR[0]) % 360 - 180
    return SatellitePosition(north / M_PER_DEG_EQUATOR[1], longitude, up, sigma_m)


def state_position(path: Path, position: SatellitePosition) -> None:
    """Write a position into the EXIF data of a photograph, to a hundredth of a millimetre."""

    def dms(degrees: float) -> tuple[IFDRational, ...]:
        seconds = round(abs(degrees) * 3600 * 1e6)
        whole, rest = divmod(seconds, 3600 * 10**6)
        return IFDRational(whole), IFDRational(rest // (60 * 10**6)), IFDRational(rest % (60 * 10**6), 10**6)

    exif = Image.Exif()
    exif[0x010F] = "Maker"
    exif.get_ifd(0x8825).update(
        {
            1: "N" if position.latitude_deg >= 0 else "S",
            2: dms(position.latitude_deg),
            3: "E" if position.longitude_deg >= 0 else "W",
            4: dms(position.longitude_deg),
            5: b"\x00" if position.height_m >= 0 else b"\x01",
            6: IFDRational(round(abs(position.height_m) * 1e5), 10**5),
        }
    )
    with Image.open(path) as image:
        image.load()
    image.save(path, exif=exif)
