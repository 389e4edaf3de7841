"""Structural checks of the files of a COLMAP model before COLMAP opens them.

COLMAP silently reads a truncated cameras.bin and fills in what is missing, and requests all memory for an
empty points3D.bin. Text files are checked line by line, binary files record by record.

Source: COLMAP 4.2 documentation, "Output Format"; layout of rigs and frames as written by pycolmap 4.2.1.
"""

from __future__ import annotations

import re
import struct
from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adapters.reading.text_lines import Lines
from sfm.files.csv_tables import MAX_NUMBER, MAX_TABLE_BYTES
from sfm.files.plain_text import MAX_SIDE_PX
from sfm.model.conventions import FloatArray
from sfm.model.errors import SurveyFileError

FILES = ("cameras", "rigs", "frames", "images", "points3D")
OLDER = ("rigs", "frames")  # missing in models by COLMAP before version 3.12
# Number of parameters by the name of COLMAP's models, in the order of the model numbers
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
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}
PARAMETERS = tuple(MODELS.values())
POSE = "7d"  # quaternion and translation
MAX_ID = 2**32 - 1  # of cameras, rigs and photographs
MAX_POINT_ID = 2**64 - 1  # of points, frames and data; the largest means none


def check_model_files(folder: Path, *, text: bool) -> None:
    """Refuse a COLMAP model whose files are truncated or out of order, or contain impossible values.

    Args:
        folder: folder of the model.
        text: whether to check the text files or the binary ones.

    Raises:
        SurveyFileError: with the file and the line, or the byte of a binary file.
    """
    kind = "txt" if text else "bin"
    older = not any((folder / f"{name}.{kind}").is_file() for name in OLDER)
    for name in FILES:
        path = folder / f"{name}.{kind}"
        if not path.is_file():
            if older and name in OLDER:
                continue
            raise SurveyFileError(f"{path}: this file of the COLMAP model is missing")
        ids = _check_text(name, path) if text else _check_binary(name, path)
        number, count = np.unique(np.frombuffer(ids, dtype=np.uint64), return_counts=True)
        if (count > 1).any():
            raise SurveyFileError(f"{path}: {count.max()} {name} have the ID {number[count.argmax()]}")


def names_with_blanks(folder: Path) -> dict[int, str]:
    """Return the names of photographs with blanks by their IDs, from valid text files.

    COLMAP writes these names in full, but reads them only up to the first blank.
    """
    text = Lines.of(folder / "images.txt")
    names = {}
    while (line := text.maybe_line()) is not None:
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split(maxsplit=9)
        name = words[9].rstrip()
        if " " in name:
            names[int(words[0])] = name
        text.line()  # the line of its image points
    return names


def _check_text(name: str, path: Path) -> array[int]:
    """Check the lines of a file, and return the IDs of its cameras, photographs, ..."""
    text = Lines.of(path)
    ids, due = array("Q"), None
    while (line := text.maybe_line()) is not None:
        stated = re.match(r"# Number of \w+: (\d{1,20})(?!\d)", line)
        if stated:
            due = int(stated[1])
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split()
        _check_row(name, text, words)
        ids.append(int(words[0]))
    count = len(ids)
    if not text.ended:
        raise text.error("the last line is cut off")
    if due is None and not count:
        text.number = 1
        raise text.error("the file is empty")
    if due is not None and count != due:
        raise text.error(f"the file ends after {count} {name}, its header states {due}")
    return ids


def _check_row(name: str, text: Lines, words: list[str]) -> None:
    """Check one data line, and for a photograph the line of image points after it."""
    if name == "cameras":
        if len(words) < 4 or words[1] not in MODELS:
            raise text.error("a camera is CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        if len(words) != 4 + MODELS[words[1]]:
            raise text.error(f"{len(words) - 4} parameters, model {words[1]} has {MODELS[words[1]]}")
        text.whole_of(words[0], 0, MAX_ID, "CAMERA_ID")
        for word, what in zip(words[2:4], ("WIDTH", "HEIGHT"), strict=True):
            text.whole_of(word, 1, MAX_SIDE_PX, what)
        if _numbers(text, words[4:])[0] <= 0:
            raise text.error(f"focal length {words[4]}, it must be positive")
    elif name == "images":
        if len(words) < 10:
            raise text.error(f"{len(words)} words, an image is ID, quaternion, translation, CAMERA_ID, NAME")
        text.whole_of(words[0], 0, MAX_ID, "IMAGE_ID")
        _pose(text, words[1:8])
        text.whole_of(words[8], 0, MAX_ID, "CAMERA_ID")
        points = text.line().split()
        if len(points) % 3:
            raise text.error(f"{len(points)} words, image points are X Y POINT3D_ID")
        for k in range(0, len(points), 3):
            _numbers(text, points[k : k + 2])
            text.whole_of(points[k + 2], -1, MAX_POINT_ID, "POINT3D_ID")
    elif name == "points3D":
        if len(words) < 8 or len(words) % 2:
            raise text.error(
                f"{len(words)} words, a point is ID, X Y Z, R G B, ERROR, (IMAGE_ID POINT2D_IDX)..."
            )
        text.whole_of(words[0], 0, MAX_POINT_ID, "POINT3D_ID")
        _numbers(text, words[1:4])
        for word in words[4:7]:
            text.whole_of(word, 0, 255, "a colour")
        _numbers(text, words[7:8])
        for word in words[8:]:
            text.whole_of(word, 0, MAX_ID, "a number of the track")
    elif name == "frames":
        count = text.whole_of(words[9], 0, MAX_ID, "NUM_DATA_IDS") if len(words) > 9 else 0
        if len(words) != 10 + 3 * count:
            raise text.error(
                f"{len(words)} words, a frame is ID, RIG_ID, quaternion, translation, "
                "NUM_DATA_IDS, (SENSOR_TYPE SENSOR_ID DATA_ID)..."
            )
        for word in (*words[:2], *words[11::3], *words[12::3]):
            text.whole_of(word, 0, MAX_POINT_ID, "an ID")
        _pose(text, words[2:9])
    else:
        _check_rig(text, words)


def _check_rig(text: Lines, words: list[str]) -> None:
    """Check a rig: ID, NUM_SENSORS, reference sensor, then type, number and any pose of each other sensor."""
    form = "a rig is RIG_ID NUM_SENSORS REF_TYPE REF_ID (SENSOR_TYPE SENSOR_ID HAS_POSE [pose])..."
    if len(words) < 2:
        raise text.error(f"{len(words)} words, {form}")
    text.whole_of(words[0], 0, MAX_ID, "RIG_ID")
    sensors = text.whole_of(words[1], 0, MAX_ID, "NUM_SENSORS")
    at = 2 + 2 * bool(sensors)
    for _ in range(sensors - 1):
        if len(words) < at + 3:
            break
        has_pose = text.whole_of(words[at + 2], 0, 1, "HAS_POSE")
        if has_pose and len(words) >= at + 10:
            _pose(text, words[at + 3 : at + 10])
        at += 3 + 7 * has_pose
    else:
        if len(words) == at:
            return
    raise text.error(f"{len(words)} words for {sensors} sensors, {form}")


def _numbers(text: Lines, words: list[str]) -> list[float]:
    return [text.number_of(word) for word in words]


def _pose(text: Lines, words: list[str]) -> None:
    """Check quaternion and translation."""
    if not any(_numbers(text, words)[:4]):
        raise text.error("a quaternion of zeros is not a rotation")


def _check_binary(name: str, path: Path) -> array[int]:
    """Check the records of a file, and return the IDs of its cameras, photographs, ..."""
    data = _Bytes.of(path)
    (count,) = data.take("Q")
    ids = array("Q")
    for _ in range(count):
        if name == "cameras":
            number, model, width, height = data.take("IiQQ")
            if not 0 <= model < len(PARAMETERS):
                raise data.error(f"camera model {model}, expected 0 to {len(PARAMETERS) - 1}")
            if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
                raise data.error(
                    f"photographs of {width} x {height} px, needed 1 to {MAX_SIDE_PX} on each side"
                )
            if data.numbers(f"{PARAMETERS[model]}d")[0] <= 0:
                raise data.error("a focal length that is not positive")
        elif name == "images":
            (number,) = data.take("I")
            data.numbers(POSE)
            data.take("I")
            data.skip_name()
            (points,) = data.take("Q")
            data.image_points(points)
        elif name == "points3D":
            (number,) = data.take("Q")
            data.numbers("3d")
            *_, track = data.take("3BdQ")
            data.skip(8 * track)
        elif name == "rigs":
            number, sensors = data.take("II")
            if sensors:
                data.take("iI")
            for _ in range(sensors - 1):
                *_, has_pose = data.take("iIB")
                data.skip(56 * bool(has_pose))
        else:
            number, _ = data.take("II")
            data.numbers(POSE)
            (measured,) = data.take("I")
            data.skip(16 * measured)
        ids.append(number)
    if data.at != len(data.content):
        raise data.error(f"{len(data.content) - data.at} bytes after the last of {count} {name}")
    return ids


@dataclass
class _Bytes:
    """A binary file and the current position in it."""

    path: Path
    content: bytes
    at: int = 0

    @classmethod
    def of(cls, path: Path) -> _Bytes:
        try:
            size = path.stat().st_size
            if size > MAX_TABLE_BYTES:
                raise SurveyFileError(f"{path}: {size} bytes, at most {MAX_TABLE_BYTES} are read")
            return cls(path, path.read_bytes())
        except OSError as error:
            raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error

    def error(self, message: str) -> SurveyFileError:
        return SurveyFileError(f"{self.path}, byte {self.at}: {message}")

    def take(self, layout: str) -> tuple[Any, ...]:
        start = self.at
        self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self.content, start)

    def numbers(self, layout: str) -> tuple[float, ...]:
        """Read numbers that must be finite and of reasonable size.

        Raises:
            SurveyFileError: a number is not finite or too large.
        """
        values = self.take(layout)
        for value in values:
            if not abs(value) <= MAX_NUMBER:
                raise self.error(f"the number {value:g} before this position, needed at most {MAX_NUMBER:g}")
        return values

    def image_points(self, count: int) -> None:
        """Skip image points (x, y and the number of their object point) after checking x and y.

        Raises:
            SurveyFileError: a coordinate is not finite or too large.
        """
        start = self.at
        self.skip(24 * count)
        xy = np.frombuffer(self.content, "<f8", 3 * count, start).reshape(-1, 3)[:, :2]
        if not (np.abs(xy) <= MAX_NUMBER).all():
            raise self.error(f"image points before this position, needed numbers of at most {MAX_NUMBER:g}")

    def skip(self, count: int) -> None:
        if self.at + count > len(self.content):
            raise self.error(f"the file ends here, {count} more bytes were expected")
        self.at += count

    def skip_name(self) -> None:
        end = self.content.find(b"\0", self.at)
        if end < 0:
            raise self.error("the file ends in the name of a photograph")
        self.at = end + 1


def camera_rows(path: Path) -> list[tuple[int, str, tuple[int, int], FloatArray]]:
    """Return the cameras of cameras.txt or cameras.bin alone, after checking the file.

    Args:
        path: the file; one that ends in .bin is binary.

    Returns:
        Number, COLMAP's model, size (px) and parameters (n,) of each camera.

    Raises:
        SurveyFileError: the file is truncated or out of order, or has impossible values.
    """
    rows = []
    if path.suffix.lower() == ".bin":
        _check_binary("cameras", path)
        data = _Bytes.of(path)
        names = tuple(MODELS)
        for _ in range(data.take("Q")[0]):
            number, model, width, height = data.take("IiQQ")
            params = np.array(data.numbers(f"{PARAMETERS[model]}d"))
            rows.append((int(number), names[model], (int(width), int(height)), params))
        return rows
    _check_text("cameras", path)
    text = Lines.of(path)
    while (line := text.maybe_line()) is not None:
        words = line.split()
        if words and not line.startswith("#"):
            params = np.array([float(word) for word in words[4:]])
            rows.append((int(words[0]), words[1], (int(words[2]), int(words[3])), params))
    return rows
