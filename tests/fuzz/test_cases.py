"""Damaged and hostile files, a few of each kind; the long run is `python -m tests.fuzz.run`."""

from __future__ import annotations

import io
import random
import struct
import time
import zlib
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from sfm.model.errors import KolinearError, PhotographError
from sfm.photographs.exif import BOMB_PX_PER_BYTE, read_metadata
from sfm.photographs.reading import read_photograph
from sfm.survey.inputs.given_values import read_image_points
from sfm.survey.inputs.survey import read_survey
from tests.fuzz.cases import Seed, make_seeds, mutated, run_case

SHORT = settings(
    max_examples=60,
    deadline=10_000,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    database=None,
)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[Seed, ...]]:
    folder = tmp_path_factory.mktemp("good")
    return folder, make_seeds(folder)


class _NeverFar(random.Random):
    """Chance under which nothing that is read is worked on further, which is for the long run."""

    def random(self) -> float:
        return max(0.25, super().random())


@pytest.mark.parametrize(
    "kind", ["surveys", "tables", "codes", "photographs", "models", "results", "cameras", "folders", "rows"]
)
@given(number=st.integers(min_value=0, max_value=2**32))
@SHORT
def test_mutated_files_are_read_or_refused(
    good: tuple[Path, tuple[Seed, ...]], kind: str, number: int
) -> None:
    folder, seeds = good
    rng = _NeverFar(number)
    seed = rng.choice([seed for seed in seeds if seed.kind == kind])
    assert run_case(seed, mutated(seed, rng), folder, rng) == ""


@given(text=st.text(max_size=300))
@SHORT
def test_any_text_as_survey_or_table(tmp_path: Path, text: str) -> None:
    path = tmp_path / "any"
    for content in (text, "[survey]\n" + text, "image,point,x_px,y_px\n" + text):
        path.write_text(content, encoding="utf-8", errors="surrogatepass", newline="")
        for read in (read_survey, read_image_points):
            with pytest.raises(KolinearError) if content is text else suppress(KolinearError):
                read(path)


@given(
    data=st.binary(max_size=300),
    start=st.sampled_from([b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\0"]),
)
@SHORT
def test_any_bytes_as_photograph(tmp_path: Path, data: bytes, start: bytes) -> None:
    path = tmp_path / "any.jpg"
    path.write_bytes(start + data)
    for read in (read_metadata, read_photograph):
        with suppress(KolinearError):
            read(path)


def png(width: int, height: int, rows: bytes) -> bytes:
    """Return a grey PNG that claims a size, whatever its rows hold."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("width", "height", "match"),
    [
        (100_000, 100_000, r"photographs of at most 250 million pixels are read"),
        (15_000, 16_000, r"15000 x 16000 px in \d+ bytes is not a photograph"),
        (2**31 - 1, 2**31 - 1, r"."),
    ],
)
def test_decompression_bombs_are_refused_before_they_open(
    tmp_path: Path, width: int, height: int, match: str
) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(png(width, height, zlib.compress(bytes(100_000))))
    begun = time.perf_counter()
    with pytest.raises(PhotographError, match=match):
        read_photograph(path)
    assert time.perf_counter() - begun < 1.0


def test_a_bomb_within_a_jpeg_header_is_refused(tmp_path: Path) -> None:
    data = bytearray(cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", 60_000, 60_000)
    (tmp_path / "a.jpg").write_bytes(data)
    for read in (read_photograph, read_metadata):
        with pytest.raises(PhotographError, match="at most 250 million pixels"):
            read(tmp_path / "a.jpg")
    data[at : at + 4] = struct.pack(">HH", 15_000, 15_000)
    (tmp_path / "a.jpg").write_bytes(data)
    with pytest.raises(PhotographError, match=f"at least {15_000**2 // BOMB_PX_PER_BYTE} bytes"):
        read_photograph(tmp_path / "a.jpg")


def test_a_jpeg_of_endless_scans_is_refused(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((2000, 3000), np.uint8)).save(buffer, "JPEG", progressive=True)
    data = buffer.getvalue()
    scan = data.rindex(b"\xff\xda")
    (tmp_path / "a.jpg").write_bytes(data[:scan] + data[scan:-2] * 500 + b"\xff\xd9")
    with pytest.raises(PhotographError, match=r"a JPEG of \d+ scans"):
        read_photograph(tmp_path / "a.jpg")
    (tmp_path / "a.jpg").write_bytes(data)
    assert read_photograph(tmp_path / "a.jpg").shape == (2000, 3000)


def test_a_png_chunk_larger_than_the_file_is_refused(tmp_path: Path) -> None:
    data = bytearray(png(64, 48, zlib.compress(bytes(48 * 65))))
    (tmp_path / "a.png").write_bytes(data)
    assert read_photograph(tmp_path / "a.png").shape == (48, 64)
    at = data.index(b"IDAT") - 4
    data[at : at + 4] = struct.pack(">I", 2**31 - 1)  # for which OpenCV takes 2 GiB
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(PhotographError, match="truncated"):
        read_photograph(tmp_path / "a.png")
