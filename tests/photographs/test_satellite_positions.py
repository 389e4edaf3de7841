"""Positions of satellite navigation: what EXIF and XMP data state, what is no position, local coordinates."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from sfm.photographs.exif import (
    LocalSystem,
    SatellitePosition,
    local_coordinates,
    read_metadata,
    satellite_position,
)

GPS: dict[int, Any] = {1: "N", 2: (52.0, 30.0, 36.0), 3: "E", 4: (13.0, 24.0, 18.0), 5: b"\x00", 6: 34.5}
DJI = b'<rdf drone-dji:RtkStdLon="0.011" drone-dji:RtkStdLat="0.012" drone-dji:RtkStdHgt="0.025"/>'


def test_position_and_time_of_a_photograph(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8825).update(GPS)
    exif.get_ifd(0x8769).update({0x9003: "2026:11:26 13:05:09", 0x9291: "25"})
    path = tmp_path / "a.jpg"
    Image.new("L", (64, 48)).save(path, exif=exif, xmp=DJI)
    metadata = read_metadata(path)
    assert metadata.position is not None
    assert (metadata.position.latitude_deg, metadata.position.longitude_deg) == pytest.approx((52.51, 13.405))
    assert metadata.position.height_m == 34.5 and metadata.position.sigma_m == (0.011, 0.012, 0.025)
    assert metadata.taken == datetime(2026, 11, 26, 13, 5, 9, 250_000)


@pytest.mark.parametrize(
    ("changed", "latitude", "longitude", "height"),
    [
        ({1: "S", 3: "W"}, -52.51, -13.405, 34.5),
        ({5: b"\x01"}, 52.51, 13.405, -34.5),  # below sea level
        ({5: b"\x03"}, 52.51, 13.405, -34.5),  # EXIF 3.0
        ({5: b"\x02"}, 52.51, 13.405, 34.5),
        ({2: (52.0, 30.6, 0.0), 1: b"N\x00"}, 52.51, 13.405, 34.5),
        ({6: IFDRational(0, 0)}, 52.51, 13.405, np.nan),
        ({6: None}, 52.51, 13.405, np.nan),
        ({6: 1e9}, 52.51, 13.405, np.nan),
        ({4: (0.0, 0.0, 0.0)}, 52.51, 0.0, 34.5),  # Greenwich
    ],
)
def test_hemispheres_and_heights(
    changed: dict[int, Any], latitude: float, longitude: float, height: float
) -> None:
    found = satellite_position(GPS | changed)
    assert found is not None
    assert (found.latitude_deg, found.longitude_deg) == pytest.approx((latitude, longitude))
    assert found.height_m == pytest.approx(height, nan_ok=True)


@pytest.mark.parametrize(
    "changed",
    [
        {2: (IFDRational(0, 0),) * 3},
        {2: (52.0, 30.0, IFDRational(0, 0))},
        {2: ()},
        {2: "52 north"},
        {2: (52.0, -30.0, 0.0)},
        {2: (91.0, 0.0, 0.0)},
        {4: (181.0, 0.0, 0.0)},
        {1: None},
        {3: "?"},
        {9: "V"},
        {2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)},
    ],
)
def test_what_is_no_position(changed: dict[int, Any]) -> None:
    assert satellite_position(GPS | changed) is None and satellite_position({}) is None


def test_standard_deviations_that_receivers_state() -> None:
    def sigma(gps: dict[int, Any], xmp: bytes = b"") -> tuple[float, float, float]:
        found = satellite_position(GPS | gps, xmp)
        assert found is not None
        return found.sigma_m

    assert np.isnan(sigma({})).all()
    assert sigma({31: 4.7}) == pytest.approx((4.7, 4.7, np.nan), nan_ok=True)
    assert np.isnan(sigma({31: 1e-9})).all() and np.isnan(sigma({31: -5.0})).all()
    assert sigma({31: 4.7}, DJI) == (0.011, 0.012, 0.025)
    zero = b"<drone-dji:RtkStdLon>0.0</drone-dji:RtkStdLon><drone-dji:RtkStdHgt>0.03</drone-dji:RtkStdHgt>"
    assert sigma({31: IFDRational(0, 0)}, zero) == pytest.approx((np.nan, np.nan, 0.03), nan_ok=True)


def at(latitude: float, longitude: float, height: float = 0.0) -> SatellitePosition:
    return SatellitePosition(latitude, longitude, height, (np.nan, np.nan, np.nan))


def test_distances_in_the_local_system_are_those_on_the_ellipsoid() -> None:
    # a degree of the meridian at 45 deg has 111,131.7 m, of the parallel 78,846.8 m (radii M and N cos phi)
    here = LocalSystem(45.0, 7.0)
    places = here.coordinates([45.0005, 44.9995, 45.0, 45.0], [7.0, 7.0, 7.0005, 6.9995], [0, 0, 0, 0])
    assert places[0, 1] - places[1, 1] == pytest.approx(111.1317, abs=1e-3)
    assert places[2, 0] - places[3, 0] == pytest.approx(78.8468, abs=1e-3)
    np.testing.assert_allclose(here.coordinates([45.0], [7.0], [-420.0]), [[0, 0, -420]], atol=1e-6)


@pytest.mark.parametrize(("latitude", "longitude"), [(-36.8485, 179.9999), (64.1, -179.99995), (-12.3, 5.0)])
def test_the_date_line_and_the_southern_half_are_places_like_others(
    latitude: float, longitude: float
) -> None:
    east = (longitude + 0.0003 + 180) % 360 - 180
    origin, places = local_coordinates(
        [at(latitude, longitude), at(latitude, east), at(latitude + 0.0001, longitude, np.nan)]
    )
    assert abs(origin.latitude_deg - latitude) <= 0.0006
    x, y, _ = (places[1:] - places[0]).T
    assert x[0] == pytest.approx(0.0003 * 111_320 * np.cos(np.radians(latitude)), rel=0.005)
    assert y[1] == pytest.approx(11.1, abs=0.1) and abs(x[1]) < 0.01
    assert np.isnan(places[2, 2]) and np.isfinite(places[:2]).all()


def test_one_position_far_off_does_not_move_the_origin() -> None:
    near = [at(52.51 + 1e-5 * k, 13.4, 30.0) for k in range(5)]
    assert local_coordinates([*near, at(-33.0, 151.0)])[0] == local_coordinates(near)[0]


def test_the_origin_has_no_negative_zero() -> None:
    origin, _ = local_coordinates([at(-1e-5, -1e-5)])
    assert str(origin.latitude_deg) == str(origin.longitude_deg) == "0.0"
