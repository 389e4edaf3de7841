"""Reading of photographs: formats, depths, orientation, damaged files, EXIF data."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from sfm.model.errors import PhotographError
from sfm.photographs.exif import (
    LocalSystem,
    SatellitePosition,
    local_coordinates,
    read_metadata,
    satellite_position,
)
from sfm.photographs.reading import read_photograph

WIDTH, HEIGHT = 96, 64


def ramp(dtype: type = np.uint8) -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return ((x * 2 + y) * (np.iinfo(dtype).max // 300)).astype(dtype)


def save(path: Path, image: np.ndarray) -> Path:
    ok, data = cv2.imencode(path.suffix, image)
    assert ok
    path.write_bytes(data.tobytes())
    return path


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_all_bits_are_kept(tmp_path: Path, dtype: type, suffix: str) -> None:
    image = ramp(dtype)
    read = read_photograph(save(tmp_path / f"Größe mit Leerzeichen{suffix}", image))
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, image)


def test_channels_of_a_colour_photograph(tmp_path: Path) -> None:
    image = np.stack([ramp() // 4, ramp() // 2, ramp()], axis=-1)  # blue, green, red
    path = save(tmp_path / "colour.png", image)
    for k, channel in enumerate(("blue", "green", "red")):
        np.testing.assert_array_equal(read_photograph(path, channel=channel), image[:, :, k])
    grey = 0.299 * image[:, :, 2] + 0.587 * image[:, :, 1] + 0.114 * image[:, :, 0]
    np.testing.assert_allclose(read_photograph(path), grey, atol=1.0)
    with pytest.raises(PhotographError, match="channel 'infrared', expected one of luminance, red"):
        read_photograph(path, channel="infrared")


def test_orientation_is_reported_and_never_applied(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    exif[0x010F], exif[0x0110] = "Maker", "Model 1\0"
    path = tmp_path / "turned.jpg"
    Image.fromarray(ramp()).save(path, exif=exif)
    assert read_photograph(path).shape == (HEIGHT, WIDTH)
    assert read_photograph(path, channel="green").shape == (HEIGHT, WIDTH)
    metadata = read_metadata(path)
    assert metadata.orientation == 6
    assert metadata.size_px == (WIDTH, HEIGHT)
    assert (metadata.make, metadata.model) == ("Maker", "Model 1")


def test_exif_of_the_camera(tmp_path: Path) -> None:
    exif = Image.Exif()
    camera = exif.get_ifd(0x8769)
    camera[0x920A], camera[0xA405] = 24.0, 36
    path = tmp_path / "a.jpg"
    Image.fromarray(ramp()).save(path, exif=exif)
    metadata = read_metadata(path)
    assert (metadata.focal_mm, metadata.focal_35mm) == (24.0, 36.0)
    assert metadata.pixel_mm is not None
    # 24 mm seen as 36 mm: the diagonal is 2/3 of that of 36 mm x 24 mm
    assert metadata.pixel_mm[0] * np.hypot(WIDTH, HEIGHT) == pytest.approx(np.hypot(36, 24) * 2 / 3)

    camera[0xA20E], camera[0xA20F], camera[0xA210], camera[0xA002] = 2000.0, 4000.0, 3, 2 * WIDTH
    Image.fromarray(ramp()).save(path, exif=exif)
    pixel = read_metadata(path).pixel_mm
    # 2000 per cm = 0.005 mm, in a copy reduced to half of the size
    assert pixel == pytest.approx((0.01, 0.005))


def test_without_exif_only_the_size_is_known(tmp_path: Path) -> None:
    metadata = read_metadata(save(tmp_path / "a.png", ramp()))
    assert metadata.size_px == (WIDTH, HEIGHT)
    assert metadata.focal_mm is metadata.focal_35mm is metadata.pixel_mm is metadata.make is None
    assert metadata.orientation == 1


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize("part", [0.1, 0.6, 0.95])
def test_truncated_files_are_refused(
    tmp_path: Path, suffix: str, part: float, capfd: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8)
    path = save(tmp_path / f"cut{suffix}", noise)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * part)])
    with pytest.raises(PhotographError, match=r"cut\.\w+: (the file is truncated|not a photograph)"):
        read_photograph(path)
    assert capfd.readouterr().err == ""


def test_the_thumbnail_does_not_hide_a_truncated_jpeg(tmp_path: Path) -> None:
    thumbnail = cv2.imencode(".jpg", ramp()[:16, :16])[1].tobytes()
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    data = cv2.imencode(".jpg", ramp())[1].tobytes()
    path = tmp_path / "a.jpg"
    path.write_bytes(data[:2] + segment + data[2:])
    assert read_photograph(path).shape == (HEIGHT, WIDTH)
    path.write_bytes((data[:2] + segment + data[2:])[:-40])
    with pytest.raises(PhotographError, match="truncated"):
        read_photograph(path)


def test_what_is_no_photograph_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.jpg").write_text("no picture")
    (tmp_path / "empty.jpg").write_bytes(b"")
    save(tmp_path / "float.tiff", ramp().astype(np.float32))
    for read in (read_photograph, read_metadata):
        with pytest.raises(PhotographError, match=r"absent\.jpg: no such file"):
            read(tmp_path / "absent.jpg")
        with pytest.raises(PhotographError, match=r"text\.jpg: not a photograph"):
            read(tmp_path / "text.jpg")
    with pytest.raises(PhotographError, match="the file is empty"):
        read_photograph(tmp_path / "empty.jpg")
    with pytest.raises(PhotographError, match="found float32 intensities, expected 8 or 16 bit"):
        read_photograph(tmp_path / "float.tiff")


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
        {2: (52.0, 99.0, 0.0)},
        {4: (13.0, 24.0, 61.0)},
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
    huge = b"<drone-dji:RtkStdHgt>1e300</drone-dji:RtkStdHgt>"
    assert sigma({31: 4.7}, huge) == pytest.approx((4.7, 4.7, np.nan), nan_ok=True)
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
