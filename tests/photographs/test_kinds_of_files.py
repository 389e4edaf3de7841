"""Photographs as people have them are read as stored: turned, deep, grey, of print, transparent, animated."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from sfm.model.conventions import AnyArray
from sfm.model.errors import PhotographError, SurveyFileError
from sfm.photographs.exif import read_metadata
from sfm.photographs.reading import read_for_display, read_photograph
from sfm.products.drafting.draft import draft_survey
from sfm.survey.inputs.survey_file import read_survey_file
from tests.commands import kolinear
from tests.surveys import NOISE, code_centres, pictures
from tests.synthetic import seed_of
from tests.tables import rows_of

Writer = Callable[[AnyArray, Path], object]
y, x = np.mgrid[:64, :96]
# no turn or mirror leaves it as it is
COLOURS = np.stack(
    [np.where(x < 48, 200, 60) + y // 4, np.where(y < 32, 180, 50) + x // 6, 90 + x // 8], axis=-1
).astype(np.uint8)


def turned(orientation: int) -> Image.Exif:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    return exif


def bigtiff(picture: AnyArray, path: Path) -> None:
    """Write a BigTIFF file that states that it is turned."""
    height, width, _ = picture.shape
    entries = [(256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, 1), (262, 3, 2), (273, 4, 400),
               (274, 3, 6), (277, 3, 3), (278, 4, height), (279, 4, picture.size)]  # fmt: skip
    block = struct.pack("<2sHHHQQ", b"II", 43, 8, 0, 16, len(entries))
    for tag, kind, value in entries:
        stored = struct.pack("<HHQ", tag, kind, 3 if tag == 258 else 1)
        block += stored + (
            struct.pack("<3H2x", 8, 8, 8)
            if tag == 258
            else struct.pack("<H6x" if kind == 3 else "<I4x", value)
        )
    path.write_bytes((block + bytes(8)).ljust(400, b"\0") + picture.tobytes())


def further(picture: AnyArray, path: Path, **options: object) -> None:
    """Write a file of two pictures of one size."""
    Image.fromarray(picture).save(
        path, save_all=True, append_images=[Image.fromarray(255 - picture)], **options
    )


def transparent(picture: AnyArray) -> Image.Image:
    """Return a picture that is transparent to the right."""
    alpha = np.full(picture.shape[:2], 255, np.uint8)
    alpha[:, alpha.shape[1] // 2 :] = 40
    return Image.fromarray(np.dstack([picture, alpha]))


KINDS: dict[str, tuple[str, Writer]] = {
    "CMYK": (".jpg", lambda p, path: Image.fromarray(p).convert("CMYK").save(path, quality=100)),
    "CMYK TIFF": (".tif", lambda p, path: Image.fromarray(p).convert("CMYK").save(path)),
    "palette": (".png", lambda p, path: Image.fromarray(p).quantize(256).save(path)),
    "transparent": (".png", lambda p, path: transparent(p).save(path)),
    "transparent TIFF": (".tif", lambda p, path: transparent(p).save(path)),
    "animated PNG": (".png", further),
    "animated WebP": (".webp", lambda p, path: further(p, path, lossless=True)),
    "pages": (".tiff", further),
    "stereo": (".jpg", lambda p, path: further(p, path, format="MPO", quality=100, subsampling=0)),
    "BigTIFF": (".tif", bigtiff),
    "16 bit": (".png", lambda p, path: cv2.imwrite(str(path), p[:, :, ::-1].astype(np.uint16) * 257)),
    "16 bit TIFF": (".tif", lambda p, path: cv2.imwrite(str(path), p[:, :, ::-1].astype(np.uint16) * 257)),
}  # fmt: skip
SEVERAL = ("animated PNG", "animated WebP", "pages", "stereo")


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_has_the_intensities_that_it_stores(kind: str, tmp_path: Path) -> None:
    suffix, write = KINDS[kind]
    path = tmp_path / f"a{suffix}"
    write(COLOURS, path)
    grey = cv2.cvtColor(COLOURS, cv2.COLOR_RGB2GRAY).astype(int)
    read = read_photograph(path)
    assert read.dtype == (np.uint16 if "16 bit" in kind else np.uint8)
    np.testing.assert_allclose(read / np.iinfo(read.dtype).max * 255, grey, atol=2)
    np.testing.assert_allclose(read_for_display(path).astype(int), COLOURS[:, :, ::-1], atol=4)
    found = read_metadata(path)
    assert found.size_px == (96, 64)
    assert found.several == (kind in SEVERAL)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_no_file_is_turned(suffix: str, orientation: int, tmp_path: Path) -> None:
    """OpenCV turns TIFF files: photographs held upright and level would have two interior orientations."""
    grey = cv2.cvtColor(COLOURS, cv2.COLOR_RGB2GRAY)
    for name, picture in (("colour", COLOURS), ("grey", grey), ("deep", grey.astype(np.uint16) * 257)):
        if name == "deep" and suffix in (".jpg", ".webp"):
            continue
        path = tmp_path / f"{name}{suffix}"
        Image.fromarray(picture).save(path, exif=turned(orientation), quality=100, lossless=True)
        assert (read_metadata(path).size_px, read_metadata(path).orientation) == ((96, 64), orientation)
        read = read_photograph(path)
        np.testing.assert_allclose(read / np.iinfo(read.dtype).max * 255, grey, atol=2)
        assert read_for_display(path).shape == (64, 96, 3)
        assert read_for_display(path, shrink=2).shape == (32, 48, 3)


def test_a_grey_photograph_stored_with_white_as_zero_is_not_inverted(tmp_path: Path) -> None:
    grey = cv2.cvtColor(COLOURS, cv2.COLOR_RGB2GRAY)
    path = tmp_path / "scan.tif"
    Image.fromarray(255 - grey).save(path)
    data = bytearray(path.read_bytes())
    at = data.index(struct.pack("<HHIH", 262, 3, 1, 1))
    struct.pack_into("<H", data, at + 8, 0)
    path.write_bytes(data)
    np.testing.assert_array_equal(read_photograph(path), grey)


def test_a_folder_of_many_kinds_is_one_camera_with_the_right_shape(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    rng = seed_of("kinds")
    kinds = ("CMYK TIFF", "16 bit TIFF", "animated WebP", "transparent", "pages")
    for k, picture in enumerate(pictures()):
        noisy = np.clip(np.rint(picture + NOISE * rng.standard_normal(picture.shape)), 0, 255).astype(
            np.uint8
        )
        if k < len(kinds):
            suffix, write = KINDS[kinds[k]]
            write(np.dstack([noisy] * 3), folder / f"IMG_{k}{suffix}")
        else:
            Image.fromarray(noisy).save(folder / f"IMG_{k}.tif", exif=turned(6))
    (folder / "a.gif").write_bytes(b"GIF89a")
    monkeypatch.chdir(tmp_path)
    assert kolinear("run", "photos") == 0
    told = capsys.readouterr()
    assert "left out: IMG_4.tiff: its further pictures, as only the first" in told.err
    assert "IMG_2.webp: its further" in told.err and "IMG_0.tif" not in told.err
    assert "a.gif: a GIF file, which is not read" in told.err
    assert len(read_survey_file(Path("out/photos.toml")).cameras) == 1
    rows = {row["id"]: row for row in rows_of(Path("out/photos/points.csv")) if row["id"].isdigit()}
    found = np.array([[float(row[axis]) for axis in "XYZ"] for row in rows.values()])
    true = np.array([code_centres()[int(name)] for name in rows])
    sizes = [np.linalg.norm(points[:, None] - points, axis=2) for points in (found, true)]
    assert len(rows) == 20
    np.testing.assert_allclose(*(size / size.mean() for size in sizes), atol=5e-4)


@pytest.mark.parametrize("name", ["a.gif", "a.jxl", "a.jp2"])
def test_kinds_that_are_not_read_are_named_with_the_remedy(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"some")
    with pytest.raises(PhotographError, match=r"which is not read; convert"):
        read_photograph(tmp_path / name)
    with pytest.raises(SurveyFileError, match=r"which is not read; convert"):
        draft_survey(tmp_path)
