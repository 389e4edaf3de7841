"""Ten kinds of folders that people have: the right shape from one command each, with the time it takes.

python -m pytest -m slow -s tests/products/drafting/test_ten_kinds.py
"""

from __future__ import annotations

import csv
import io
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from sfm.model.camera import camera_from_values
from sfm.photographs.reading import linearise_srgb
from sfm.survey.inputs.survey_file import read_survey_file
from tests.commands import kolinear
from tests.photographs.test_camera_files import exif_of, write_dng, write_heic
from tests.photographs.test_kinds_of_files import turned
from tests.surveys import code_centres
from tests.tables import rows_of
from tests.videos import rendered, write_video

pytestmark = pytest.mark.slow
Maker = Callable[[Path, Path], Path]  # from rendered photographs and an empty folder to what is run


def photographs(rendered_in: Path) -> list[Path]:
    return sorted(rendered_in.glob("part_*.jpg"))


def stripped(source: Path, folder: Path) -> Path:
    for path in photographs(source):
        shutil.copy(path, folder / path.name)
    return folder


def whatsapp(source: Path, folder: Path) -> Path:
    for k, path in enumerate(photographs(source)):
        Image.open(path).save(folder / f"IMG-20240511-WA{k + 14:04d}.jpeg", quality=80, progressive=True)
    return folder


def by_exif(source: Path, folder: Path) -> Path:
    """Some are held upright, which telephones state."""
    for k, path in enumerate(photographs(source)):
        Image.open(path).save(folder / path.name, quality=96, exif=turned((1, 6, 8, 3)[k % 4]))
    return folder


def upright(source: Path, folder: Path) -> Path:
    """A program has turned the pixels of half of them: that is another camera."""
    for k, path in enumerate(photographs(source)):
        image = Image.open(path)
        (image.transpose(Image.Transpose.ROTATE_90) if k % 2 else image).save(folder / path.name, quality=96)
    return folder


def heic(source: Path, folder: Path) -> Path:
    for k, path in enumerate(photographs(source)):
        write_heic(folder / f"IMG_{k + 101}.HEIC", np.asarray(Image.open(path).convert("RGB")), (1, 6)[k % 2])
    return folder


def dng(source: Path, folder: Path) -> Path:
    for k, path in enumerate(photographs(source)):
        write_dng(folder / f"DSC{k + 101:05d}.dng", linearise_srgb(np.asarray(Image.open(path).convert("L"))))
    return folder


def mixed_sizes(source: Path, folder: Path) -> Path:
    for k, path in enumerate(photographs(source)):
        image = Image.open(path)
        (image.resize((1200, 900), Image.Resampling.LANCZOS) if k % 3 == 2 else image).save(
            folder / path.name, quality=96
        )
    return folder


def video(source: Path, folder: Path) -> Path:
    """20 s by one camera, carried around the object with a stop."""
    turns = np.interp(np.arange(240), [0, 100, 130, 239], [0.0, 2.6, 2.6, 6.0])
    return write_video(folder / "VID_20240511_101112.mp4", rendered(turns), rate=12, rotation=-90)


def two_videos(source: Path, folder: Path) -> Path:
    """Of two cameras, one after the other."""
    other = camera_from_values("other", "brown", (720, 540), (0.01, 0.01), c_mm=8.0)
    write_video(folder / "phone.mp4", rendered(np.linspace(0, 5.5, 110)), rate=12)
    write_video(folder / "tablet.mov", rendered(np.linspace(6, 0.5, 110), of=other), rate=12)
    return folder


def images(source: Path, folder: Path) -> Path:
    (folder / "bracket" / "images").mkdir(parents=True)
    return stripped(source, folder / "bracket" / "images")


def everything(source: Path, folder: Path) -> Path:
    """With what lies about in folders of a camera and a computer."""
    for path in photographs(source):
        Image.open(path).save(folder / path.name, quality=96, exif=exif_of())
        (folder / f"{path.stem}.xmp").write_text("<x/>")
        (folder / f"{path.stem}.mov").write_bytes(b"a live photograph")
    for name in (
        ".DS_Store",
        "Thumbs.db",
        "notes.txt",
        "sheet.pdf",
        "IMG_1.AAE",
        "._part_01.jpg",
        "walk.mp4",
    ):
        (folder / name).write_bytes(b"some")
    cv2.imwrite(str(folder / "Screenshot 2024-05-11.png"), np.full((300, 200), 90, np.uint8))
    (folder / "broken.jpg").write_bytes((folder / "part_01.jpg").read_bytes()[:9000])
    (folder / "edited").mkdir()
    shutil.copy(folder / "part_02.jpg", folder / "edited" / "part_02 (1).jpg")
    return folder


KINDS: dict[str, tuple[Maker, str, int]] = {
    "EXIF stripped": (stripped, "EXIF_stripped", 1),
    "WhatsApp": (whatsapp, "WhatsApp", 1),
    "turned by EXIF": (by_exif, "turned_by_EXIF", 1),
    "turned by a program": (upright, "turned_by_a_program", 2),
    "HEIC": (heic, "HEIC", 1),
    "DNG": (dng, "DNG", 1),
    "mixed sizes": (mixed_sizes, "mixed_sizes", 2),
    "video": (video, "VID_20240511_101112", 1),
    "two videos": (two_videos, "two_videos", 2),
    "images": (images, "bracket", 1),
    "and other files": (everything, "and_other_files", 1),
}


def deviation(found: dict[str, np.ndarray], true: dict[str, np.ndarray]) -> float:
    """Return the RMS difference of distances between coded points, relative to their mean."""
    names = sorted(set(found) & set(true))
    assert len(names) >= 18
    sizes = []
    for points in (found, true):
        xyz = np.array([points[name] for name in names])
        size = np.linalg.norm(xyz[:, None] - xyz, axis=2)
        sizes.append(size / size.mean())
    return float(np.sqrt(np.square(sizes[0] - sizes[1]).mean()))


@pytest.mark.parametrize("kind", KINDS)
def test_the_right_result_from_one_command(
    kind: str,
    demo_photographs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    make, name, cameras = KINDS[kind]
    monkeypatch.chdir(tmp_path)
    (tmp_path / kind).mkdir()
    given = make(demo_photographs, tmp_path / kind)
    begun = time.perf_counter()
    code = kolinear("run", os.path.relpath(given))
    seconds = time.perf_counter() - begun
    told = capsys.readouterr()
    result = Path("out") / name
    assert code == 0, told.err + told.out
    rows = [row for row in rows_of(result / "points.csv") if row["id"].isdigit()]
    found = {row["id"]: np.array([float(row[axis]) for axis in "XYZ"]) for row in rows}
    if "vid" in kind:
        true = {str(code): place for code, place in code_centres().items()}
    else:
        text = (demo_photographs / "truth_points.csv").read_text(encoding="utf-8")
        true = {
            row["code"]: np.array([float(row[axis]) for axis in "XYZ"])
            for row in csv.DictReader(io.StringIO(text))
        }
    away = deviation(found, true)
    survey = read_survey_file(Path("out") / f"{name}.toml")
    pictures = len(rows_of(result / "images.csv"))
    with capsys.disabled():
        lines = [line for line in told.out.splitlines() if line.startswith(("! ", "  ")) and line[2] != " "]
        figures = (
            f"{pictures} | {len(survey.cameras)} | {1e6 * away:.0f} ppm | {len(lines)} | {seconds:.0f} s"
        )
        print(f"\n| {kind} | {figures} |")
        if os.environ.get("KINDS_TOLD"):
            print(told.err + told.out)
    assert away < 1e-3
    assert len(survey.cameras) == cameras
    if kind == "and other files":
        assert "broken.jpg: the file is truncated" in told.err
        assert "Screenshot 2024-05-11.png: the only one" in told.err
        assert "walk.mp4: a video beside photographs" in told.err and "part_03.mov" not in told.err
        assert ".DS_Store" not in told.err and "._part" not in told.err + told.out
    if "turned by a program" in kind:
        assert "unnamed-1 (6 of 1600 x 1200 px), unnamed-2 (6 of 1200 x 1600 px)" in told.err
