"""Files of a COLMAP model checked for their structure before COLMAP opens them.

COLMAP reads a truncated cameras.bin without a word and fills in what is missing, and asks for all memory on
an empty points3D.bin. Text files are checked line by line, binary ones record by record.

Source: COLMAP 4.2 documentation, "Output Format"; layout of rigs and frames as written by pycolmap 4.2.1.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adapters.lines import Lines
from sfm.errors import SurveyFileError

FILES = ("cameras", "rigs", "frames", "images", "points3D")
OLDER = ("rigs", "frames")  # models of COLMAP before version 3.12 have none
# Number of parameters by COLMAP's model number and name
PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16)
MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}
POSE = "7d"  # quaternion and translation


def check_model_files(folder: Path) -> None:
    """Refuse a COLMAP model whose files are truncated or out of order.

    Args:
        folder: of the model, binary or text.

    Raises:
        SurveyFileError: what is wrong, with file and line, or byte for binary files.
    """
    kind = "bin" if (folder / "cameras.bin").is_file() else "txt"
    for name in FILES:
        path = folder / f"{name}.{kind}"
        if not path.is_file():
            if name in OLDER:
                continue
            raise SurveyFileError(f"{path}: this file of the COLMAP model is missing")
        if kind == "bin":
            _check_binary(name, path)
        else:
            _check_text(name, path)


def _check_text(name: str, path: Path) -> None:
    text = Lines.of(path)
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error
    text.number = len(text.lines)
    if raw and not raw.endswith(b"\n"):
        raise text.error("the last line is cut off")
    count, due, text.number = 0, None, 0
    while text.number < len(text.lines):
        line = text.line()
        stated = re.match(r"# Number of \w+: (\d+)", line)
        if stated:
            due = int(stated[1])
        if not line.strip() or line.startswith("#"):
            continue
        _check_row(name, text, line.split())
        count += 1
    if due is None and not count:
        text.number = 1
        raise text.error("the file is empty")
    if due is not None and count != due:
        raise text.error(f"the file ends after {count} {name}, its header says {due}")


def _check_row(name: str, text: Lines, words: list[str]) -> None:
    """Check one line of data, and for photographs the line of image points that follows it."""
    if name == "cameras":
        if len(words) < 4 or words[1] not in MODELS:
            raise text.error("a camera is CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        if len(words) != 4 + MODELS[words[1]]:
            raise text.error(f"{len(words) - 4} parameters, model {words[1]} has {MODELS[words[1]]}")
        _numbers(text, [words[0], *words[2:]])
    elif name == "images":
        if len(words) < 10:
            raise text.error(f"{len(words)} words, an image is ID, quaternion, translation, CAMERA_ID, NAME")
        _numbers(text, words[:9])
        points = text.line().split()
        if len(points) % 3:
            raise text.error(f"{len(points)} words, image points are X Y POINT3D_ID")
        _numbers(text, points)
    elif name == "points3D":
        if len(words) < 8 or len(words) % 2:
            raise text.error(
                f"{len(words)} words, a point is ID, X Y Z, R G B, ERROR, (IMAGE_ID POINT2D_IDX)..."
            )
        _numbers(text, words)
    elif len(words) < 2:
        raise text.error(f"{len(words)} words in a line of {name}")


def _numbers(text: Lines, words: list[str]) -> None:
    for word in words:
        text.number_of(word)


def _check_binary(name: str, path: Path) -> None:
    data = _Bytes(path, path.read_bytes())
    (count,) = data.take("Q")
    for _ in range(count):
        if name == "cameras":
            _, model, _, _ = data.take("IiQQ")
            if not 0 <= model < len(PARAMETERS):
                raise data.error(f"camera model {model}, there are 0 to {len(PARAMETERS) - 1}")
            data.skip(8 * PARAMETERS[model])
        elif name == "images":
            data.take("I" + POSE + "I")
            data.skip_name()
            (points,) = data.take("Q")
            data.skip(24 * points)
        elif name == "points3D":
            *_, track = data.take("Q3d3BdQ")
            data.skip(8 * track)
        elif name == "rigs":
            _, sensors = data.take("II")
            if sensors:
                data.take("iI")
            for _ in range(sensors - 1):
                *_, has_pose = data.take("iIB")
                data.skip(56 * bool(has_pose))
        else:
            *_, measured = data.take("II" + POSE + "I")
            data.skip(16 * measured)
    if data.at != len(data.content):
        raise data.error(f"{len(data.content) - data.at} bytes after the last of {count} {name}")


@dataclass
class _Bytes:
    """A binary file and how far it is read."""

    path: Path
    content: bytes
    at: int = 0

    def error(self, message: str) -> SurveyFileError:
        return SurveyFileError(f"{self.path}, byte {self.at}: {message}")

    def take(self, layout: str) -> tuple[Any, ...]:
        start = self.at
        self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self.content, start)

    def skip(self, count: int) -> None:
        if self.at + count > len(self.content):
            raise self.error(f"the file ends here, {count} more bytes were due")
        self.at += count

    def skip_name(self) -> None:
        end = self.content.find(b"\0", self.at)
        if end < 0:
            raise self.error("the file ends in the name of a photograph")
        self.at = end + 1
