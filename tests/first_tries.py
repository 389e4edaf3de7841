"""What people get wrong at the first try, and the messages they get; `python -m tests.first_tries` prints it.

Every try is a survey or a command with one mistake; `tests/cli/test_first_tries.py` checks the answers.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from sfm.cli.app import app
from sfm.model.errors import KolinearError
from sfm.model.network import ImagePoints
from tests.surveys import observed_text, write_observed_survey, write_photograph_survey
from tests.synthetic import make_network, seed_of

CAMERA = ("--c-mm", "24", "--sensor-width-mm", "36", "--width-px", "6000")


@dataclass(frozen=True)
class Answer:
    """What a command printed and how it ended."""

    code: int
    text: str


@dataclass(frozen=True)
class Try:
    """A first try with one mistake."""

    name: str
    mistake: str
    words: Callable[[Path], tuple[str, ...]]  # writes what is needed into a folder, returns the command
    code: int  # with which it should end
    told: tuple[str, ...]  # what must be in the answer
    photographs: bool = False  # whether any are measured, which takes seconds


def answer(one: Try, folder: Path) -> Answer:
    """Run a try in a separate folder."""
    words = one.words(folder)
    found = CliRunner().invoke(app, list(words))
    if isinstance(found.exception, KolinearError):
        return Answer(2, f"kolinear: {found.exception}\n")
    return Answer(found.exit_code, found.output)


def _photographs(folder: Path, **changed: str) -> tuple[str, ...]:
    """Write a survey of rendered photographs with lines of its file replaced; return the command."""
    path = write_photograph_survey(folder / "s", "s")
    text = path.read_text(encoding="utf-8")
    for key, value in changed.items():
        line = next(line for line in text.splitlines() if line.startswith(f"{key} ="))
        text = text.replace(line, value)
    path.write_text(text, encoding="utf-8")
    return "run", str(path), "--out", str(folder / "out")


def _image_points(
    folder: Path, seen: ImagePoints, *, free: str = '["c"]', fixed: str = ""
) -> tuple[str, ...]:
    """Write a survey of image points; return the command."""
    folder = folder / "s"
    folder.mkdir()
    lines = ["image,point,x_px,y_px"]
    lines += [
        f"image {i + 1},{j + 1},{x!r},{y!r}"
        for i, j, (x, y) in zip(seen.image, seen.point, seen.xy.tolist(), strict=True)
    ]
    (folder / "image_points.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    text = observed_text("s", "m").replace('free = ["c"]', f"free = {free}")
    (folder / "survey.toml").write_text(text + fixed, encoding="utf-8")
    return "adjust", str(folder / "survey.toml"), "--out", str(folder.parent / "out")


def _halves(images: int, lost: int) -> ImagePoints:
    """Return image points of photographs whose last ones share two points with the others."""
    network, _ = make_network(seed_of("first try: halves"), images=images, points=40, free=())
    seen = network.image_points
    first = seen.image < images - lost
    return seen.select(np.where(first, seen.point < 22, seen.point >= 20))


def _alone(images: int, lost: int) -> ImagePoints:
    """Return image points of photographs of which the last ones see nothing that another sees."""
    seen = _halves(images, lost)
    own = np.where(seen.image < images - lost, True, seen.point % lost == seen.image - (images - lost))
    return seen.select(own)


def _held(folder: Path) -> tuple[str, ...]:
    network, _ = make_network(seed_of("first try: held"), images=10, points=40)
    words = _image_points(folder, network.image_points, free="[]")
    path = Path(words[1])
    text = path.read_text(encoding="utf-8")
    kept = [line for line in text.splitlines() if not line.startswith("fixed")]
    path.write_text("\n".join(kept) + "\n", encoding="utf-8")
    return words


def _few(folder: Path) -> tuple[str, ...]:
    network, _ = make_network(seed_of("first try: four codes"), images=2, points=4, free=())
    return _image_points(folder, network.image_points)


def _missing(folder: Path) -> tuple[str, ...]:
    return _photographs(folder, pixel_mm="", c_mm="")


def _unit(folder: Path) -> tuple[str, ...]:
    path = write_observed_survey(folder / "s", "s")
    path.write_text(path.read_text().replace('unit = "m"', 'unit = "metres"'), encoding="utf-8")
    return "adjust", str(path)


def _poses(folder: Path) -> Path:
    """Write poses as RealityCapture does."""
    path = folder / "s" / "poses.csv"
    path.parent.mkdir()
    path.write_text("#name,x,y,alt,heading,pitch,roll,f,px,py\na.jpg,1,2,3,0,90,0,24,0,0\n", encoding="utf-8")
    return path


TRIES = (
    Try(
        "nothing said of the camera", "[[camera]] without free, c_mm 7 % wrong",
        lambda folder: _photographs(folder, free="", c_mm="c_mm = 8.6"), 0,
        ("were adjusted, as 6 photographs determine them",), photographs=True,
    ),
    Try(
        "a held camera", "free = [] and no distortion, of a lens that distorts by 40 px",
        _held, 1,
        ("contradict the held values of c, x0, y0, K1, K2", "Calibrate the camera again, or free"),
    ),
    Try(
        "a nominal sensor size", "sensor_mm = [6.45, 4.8] in place of 6.4 x 4.8, free = [\"c\"]",
        lambda folder: _photographs(folder, pixel_mm="sensor_mm = [6.45, 4.8]"), 0,
        ("% off squares", "or free b1"), photographs=True,
    ),
    Try(
        "polarity", 'polarity = "bright" of dark targets',
        lambda folder: _photographs(folder, polarity='polarity = "bright"'), 2,
        ("polarity = 'dark' reads",), photographs=True,
    ),
    Try(
        "family of codes", 'codes = "ring20" of ring14',
        lambda folder: _photographs(folder, codes='codes = "ring20"'), 2,
        ("codes = 'ring14' reads",), photographs=True,
    ),
    Try(
        "missing keys", "neither c_mm nor pixel_mm, photographs without EXIF data",
        _missing, 2, ("camera small: pixel_mm or sensor_mm and c_mm",),
    ),
    Try(
        "two photographs", "4 common points and free camera parameters",
        _few, 1, ("4 common points in 2 photographs",),
    ),
    Try(
        "no overlap", "4 of 10 photographs share two points with the others",
        lambda folder: _image_points(folder, _halves(10, 4)), 0,
        ("are not connected to the 6 oriented photographs", "with only points 21, 22 in common"),
    ),
    Try(
        "most photographs lost", "7 of 12 photographs see nothing that another sees",
        lambda folder: _image_points(folder, _alone(12, 7)), 1,
        ("7 of 12 photographs are not in the result.",),
    ),
    Try(
        "an unknown ending", "kolinear convert SURVEY x.dxf",
        lambda folder: ("convert", str(folder), str(folder / "x.dxf")), 2,
        ("unknown ending .dxf, expected .xml, .ply, .laz",),
    ),
    Try(
        "poses to a format of points", "kolinear convert poses.csv points.csv",
        lambda folder: ("convert", str(_poses(folder)), str(folder / "points.csv")), 2,
        ("format points-csv needs coordinates in the object, but no point has",),
    ),
    Try(
        "a coordinate system of photographs", "kolinear convert poses.csv model --to colmap --crs EPSG:25832",
        lambda folder: (
            "convert", str(_poses(folder)), str(folder / "m"), "--to", "colmap", "--crs", "EPSG:25832",
        ), 2,
        ("--crs: format colmap has photographs; only formats of points are transformed",),
    ),
    Try(
        "a distance without unit", "kolinear plan target-size --distance 3, in m",
        lambda folder: ("plan", "target-size", "--distance", "3", *CAMERA), 2,
        ("not larger than the principal distance",),
    ),
    Try("a unit in words", 'unit = "metres"', _unit, 2, ("found 'metres', needed one of 'km', 'm'",)),
)  # fmt: skip


def main() -> int:
    """Print every try, its answer and whether it is the one that it should be."""
    wrong = 0
    for one in TRIES:
        with tempfile.TemporaryDirectory() as folder:
            found = answer(one, Path(folder))
        right = found.code == one.code and all(words in found.text for words in one.told)
        wrong += not right
        print(f"## {one.name}: {one.mistake}")
        print(found.text.replace(folder, "...").rstrip())
        print(
            f"-> exit code {found.code}{'' if right else f', NOT as it should be: {one.code}, {one.told}'}\n"
        )
    return wrong


if __name__ == "__main__":
    sys.exit(main())
