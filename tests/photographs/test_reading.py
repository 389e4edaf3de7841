"""Reading of photographs: formats, depths, orientation, damaged files, EXIF data."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from sfm.errors import PhotographError
from sfm.photographs.exif import read_metadata
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
