"""HEIF and raw files are read as JPEG files are: as stored, with metadata, in the tone curve of sRGB."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from sfm.model.conventions import AnyArray
from sfm.model.errors import PhotographError, SurveyFileError
from sfm.photographs import camera_files
from sfm.photographs.exif import read_metadata
from sfm.photographs.reading import linearise_srgb, read_for_display, read_photograph
from sfm.products.drafting.draft import draft_survey
from tests.commands import kolinear
from tests.surveys import pictures
from tests.tables import rows_of

pillow_heif = pytest.importorskip("pillow_heif")
pytest.importorskip("rawpy")
KINDS = {2: (1, "B"), 3: (2, "H"), 4: (4, "I")}  # of TIFF values: bytes, format


def colours() -> AnyArray:
    """A picture that no turn or mirror leaves as it is."""
    picture = np.zeros((64, 96, 3), np.uint8)
    picture[:32, :48], picture[32:, :48], picture[32:, 48:] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    return picture


def exif_of(orientation: int = 1) -> bytes:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation], exif[ExifTags.Base.Make] = orientation, "Maker"
    exif[ExifTags.Base.Model] = "Phone 7"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = 4.25
    return exif.tobytes()


def write_heic(path: Path, picture: AnyArray, orientation: int = 1) -> Path:
    """Write a lossless HEIF file whose decoder turns it as a telephone's."""
    height, width = picture.shape[:2]
    mode = {2: "L", 3: "RGB", 4: "RGBA"}[picture.ndim if picture.ndim == 2 else picture.shape[2]]
    mode += ";16" if picture.dtype == np.uint16 else ""
    file = pillow_heif.from_bytes(mode, (width, height), picture.tobytes())
    if picture.dtype == np.uint8:  # which writes how it is turned
        pillow_heif.register_heif_opener()
        try:
            image = Image.fromarray(picture)
            image.save(path, format="HEIF", quality=-1, chroma=444, exif=exif_of(orientation))
        finally:
            Image.OPEN.pop("HEIF", None)
    else:
        file.save(path, quality=-1, chroma=444)
    return path


def write_dng(path: Path, light: AnyArray, orientation: int = 1) -> Path:
    """Write a raw file of linear light, (H, W), uint16, through a filter of red, green, green and blue."""
    height, width = light.shape
    entries: list[tuple[int, int, bytes | Sequence[int]]] = [
        (254, 4, [0]),
        (256, 4, [width]),
        (257, 4, [height]),
        (258, 3, [16]),
        (259, 3, [1]),
        (262, 3, [32803]),
        (271, 2, b"Maker\0"),
        (272, 2, b"Camera 9\0"),
        (273, 4, [0]),
        (274, 3, [orientation]),
        (277, 3, [1]),
        (278, 4, [height]),
        (279, 4, [light.size * 2]),
        (33421, 3, [2, 2]),
        (33422, 1, b"\0\1\1\2"),
        (34665, 4, [0]),
        (50706, 1, b"\1\4\0\0"),
        (50708, 2, b"Maker Camera 9\0"),
        (50721, 10, [v for m in np.eye(3, dtype=int).ravel() for v in (int(m), 1)]),
        (50728, 5, [1, 1] * 3),
        (50778, 3, [21]),
    ]
    sub = [(37386, 5, [50, 1]), (40962, 4, [width - 8]), (40963, 4, [height - 4])]
    first = 8 + 2 + 12 * len(entries) + 4
    more, at, pictures_at = b"", first + 2 + 12 * len(sub) + 4, 0

    def directory(rows: Sequence[tuple[int, int, bytes | Sequence[int]]], data: int) -> bytes:
        nonlocal more
        block = struct.pack("<H", len(rows))
        for tag, kind, values in rows:
            if tag == 34665:
                values = [first]
            if tag == 273:
                values = [data]
            if isinstance(values, bytes):
                count, content = len(values), values
            else:
                count = len(values) // 2 if kind in (5, 10) else len(values)
                form = {3: "H", 4: "I", 5: "I", 10: "i"}[kind]
                content = struct.pack(f"<{len(values)}{form}", *values)
            if len(content) > 4:
                place, more = at + len(more), more + content + b"\0" * (len(content) % 2)
                content = struct.pack("<I", place)
            block += struct.pack("<HHI", tag, kind if kind != 1 else 1, count) + content.ljust(4, b"\0")
        return block + b"\0\0\0\0"

    for _ in range(2):  # the place of the pixels is known after the first time
        more = b""
        blocks = directory(entries, pictures_at) + directory(sub, 0)
        pictures_at = at + len(more)
    path.write_bytes(b"II*\0\x08\0\0\0" + blocks + more + light.astype("<u2").tobytes())
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_heif_file_is_read_as_stored(orientation: int, tmp_path: Path) -> None:
    """As a JPEG; its decoder alone would give upright photographs another camera."""
    path = write_heic(tmp_path / "Bild 1 ü.HEIC", colours(), orientation)
    found = read_metadata(path)
    assert (found.size_px, found.orientation) == ((96, 64), orientation)
    assert (found.make, found.model, found.focal_mm) == ("Maker", "Phone 7", 4.25)
    for k, channel in enumerate(("red", "green", "blue")):
        read = read_photograph(path, channel=channel)
        assert read.dtype == np.uint8
        np.testing.assert_allclose(read.astype(int), colours()[:, :, k], atol=3)
    np.testing.assert_allclose(read_for_display(path).astype(int), colours()[:, :, ::-1], atol=3)
    assert read_for_display(path, shrink=4).shape == (16, 24, 3)
    grey = cv2.cvtColor(colours(), cv2.COLOR_RGB2GRAY).astype(int)
    np.testing.assert_allclose(read_photograph(path).astype(int), grey, atol=3)


def test_heif_files_of_all_modes_are_read(tmp_path: Path) -> None:
    ramp = np.linspace(0, 65535, 64 * 96).reshape(64, 96).astype(np.uint16)
    deep = read_photograph(write_heic(tmp_path / "deep.heic", np.dstack([ramp] * 3)))
    assert deep.dtype == np.uint16 and np.abs(deep.astype(int) - ramp).max() < 200, "10 bit"
    grey = (ramp >> 8).astype(np.uint8)
    for name, picture in (("grey", grey), ("alpha", np.dstack([*[grey] * 3, np.full_like(grey, 40)]))):
        read = read_photograph(write_heic(tmp_path / f"{name}.heif", picture), channel="red")
        np.testing.assert_allclose(read.astype(int), grey, atol=2)


@pytest.mark.parametrize("orientation", [1, 6])
def test_a_raw_file_is_developed_as_stored_with_the_tone_curve_of_srgb(
    orientation: int, tmp_path: Path
) -> None:
    y, x = np.mgrid[:80, :120]
    light = (4000 + 250 * x + 150 * y).astype(np.uint16)
    path = write_dng(tmp_path / "a.dng", light, orientation)
    found = read_metadata(path)
    assert (found.size_px, found.orientation, found.taken_px) == ((120, 80), orientation, (120, 80))
    assert (found.make, found.model, found.focal_mm) == ("Maker", "Camera 9", 50.0)
    read = read_photograph(path, channel="green")
    assert read.dtype == np.uint16
    again = linearise_srgb(read)[4:-4, 4:-4] / light[4:-4, 4:-4]
    np.testing.assert_allclose(again, np.median(again), rtol=0.01)
    assert 0.9 < np.median(again) < 1.1, "no automatic brightness"
    assert read_for_display(path, shrink=2).shape == (40, 60, 3)


@pytest.mark.parametrize("suffix", [".heic", ".dng"])
def test_damaged_files_are_refused(suffix: str, tmp_path: Path) -> None:
    whole = (write_heic if suffix == ".heic" else write_dng)(
        tmp_path / f"a{suffix}", colours() if suffix == ".heic" else np.full((80, 120), 900, np.uint16)
    ).read_bytes()
    for name, data in (("half", whole[: len(whole) // 2]), ("other", b"no photograph"), ("none", b"")):
        path = tmp_path / f"{name}{suffix}"
        path.write_bytes(data)
        with pytest.raises(PhotographError, match=f"{name}{suffix}: "):
            read_photograph(path)
    with pytest.raises(PhotographError, match="no such file"):
        read_metadata(tmp_path / f"absent{suffix}")


@pytest.mark.parametrize("suffix", [".heic", ".dng"])
def test_a_folder_becomes_a_result(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for k, picture in enumerate(pictures()):
        path = folder / f"IMG_{k}{suffix}"
        grey = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
        if suffix == ".heic":
            write_heic(path, np.dstack([grey] * 3), orientation=(1, 6, 3)[k % 3])
        else:
            write_dng(path, linearise_srgb(grey), orientation=(1, 6, 3)[k % 3])
    Image.fromarray(np.full((20, 30), 90, np.uint8)).save(folder / "IMG_0.jpg")
    assert ("IMG_0" + suffix, "of the same exposure as IMG_0.jpg") in draft_survey(folder).left_out
    (folder / "IMG_0.jpg").unlink()
    monkeypatch.chdir(tmp_path)
    assert kolinear("run", "photos") == 0
    assert len(rows_of(Path("out/photos/images.csv"))) == len(pictures())


def test_without_the_extra_one_line_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.HEIC").write_bytes(b"")
    (tmp_path / "b.nef").write_bytes(b"")
    monkeypatch.setattr(camera_files, "is_installed", lambda _: False)
    for name, library in (("a.HEIC", "pillow-heif"), ("b.nef", "rawpy")):
        with pytest.raises(PhotographError, match=rf"{name}: .*{library}.*kolinear\[photographs\]"):
            read_photograph(tmp_path / name)
    with pytest.raises(SurveyFileError, match=r"kolinear\[photographs\]"):
        draft_survey(tmp_path)
    assert kolinear("run", tmp_path) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
