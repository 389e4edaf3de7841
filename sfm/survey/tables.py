"""The tables that a survey file names (CSV): control, image points, exterior orientation, points.

They are read as untrusted: what they may hold is bounded before memory is taken for it, and every refusal
names the line and the column.
"""

from __future__ import annotations

import csv
import math
import sys
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray, rotation_from_angles
from sfm.errors import SurveyFileError

# Room for the largest networks that are adjusted here, some 300 MB of memory at most.
MAX_TABLE_BYTES = 500_000_000
MAX_ROWS = 5_000_000
MAX_LINE = 10_000  # characters
MAX_NAME = 500  # characters
MAX_NUMBER = 1e12  # no length, angle or pixel is larger; squares and products of larger ones overflow
MIN_SIGMA = 1e-9  # in any unit used here less than an atom
MAX_EXTENT_PER_SIGMA = 1e6  # no control is known to better than a millionth of its extent


@dataclass(frozen=True)
class PointTable:
    """Object points of control.csv or points.csv."""

    names: tuple[str, ...]  # (n,)
    xyz: FloatArray  # object unit, (n, 3)
    sigma: FloatArray  # standard deviations, 0 = fixed, object unit, (n, 3)


@dataclass(frozen=True)
class ExteriorTable:
    """Exterior orientations of images.csv."""

    names: tuple[str, ...]  # photographs, (m,)
    position: FloatArray  # projection centres X0, object unit, (m, 3)
    rotation: FloatArray  # R, image to object axes, (m, 3, 3)
    line: IntArray  # line of the file, (m,)


@dataclass(frozen=True)
class ImagePointTable:
    """Measured image points of image_points.csv, as they stand there."""

    image: tuple[str, ...]  # photograph of each row, (k,)
    point: tuple[str, ...]  # point of each row, (k,)
    xy: FloatArray  # px in the pixel frame or mm in the image frame, (k, 2)
    sigma: FloatArray | None  # standard deviations in the same unit, None if the table has none, (k, 2)
    unit: str  # px | mm
    line: IntArray  # line of the file, (k,)


def read_control(path: Path) -> PointTable:
    """Read known object points: id,X,Y,Z[,sX,sY,sZ]; no sigma or 0 means fixed.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number, a duplicate id, a negative sigma, or
            one that is so small beside the coordinates that its unit must be another.
    """
    table = _read(path, ("id",), ("X", "Y", "Z"), ("sX", "sY", "sZ"), aliases=(("point", "id"),))
    xyz, sigma = table.values[:, :3], table.values[:, 3:]
    if not sigma.size:
        sigma = np.zeros_like(xyz)
    columns = ("sX", "sY", "sZ")
    table.refuse(sigma, sigma < 0, columns, "0 (fixed) or more")
    extent = float(np.ptp(xyz, axis=0).max())
    table.refuse(
        sigma,
        (sigma > 0) & (sigma * MAX_EXTENT_PER_SIGMA < extent),
        columns,
        f"at least a millionth of the extent of the points, {extent:g}: coordinates and sigmas in one unit; "
        "0 for a fixed coordinate",
    )
    return PointTable(table.keys("id"), xyz, sigma)


def read_diameters(path: Path) -> tuple[tuple[str, ...], FloatArray]:
    """Read the diameters of targets: id,diameter.

    Returns:
        Names of the points, and the diameters of their targets, object unit, (n,).

    Raises:
        SurveyFileError: unreadable, wrong columns, not a positive number or a duplicate id.
    """
    table = _read(path, ("id",), ("diameter",), aliases=(("point", "id"),))
    table.refuse(table.values, table.values < MIN_SIGMA, ("diameter",), "more than 0")
    return table.keys("id"), table.values[:, 0]


def read_points(path: Path) -> PointTable:
    """Read approximate object points: point,X,Y,Z; points.csv of a result is welcome.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number or a duplicate point.
    """
    table = _read(
        path,
        ("point",),
        ("X", "Y", "Z"),
        aliases=(("id", "point"),),
        ignored=("sX", "sY", "sZ", "rays", "code"),
    )
    return PointTable(table.keys("point"), table.values, np.zeros_like(table.values))


def read_exterior(path: Path) -> ExteriorTable:
    """Read exterior orientations: image,X,Y,Z,omega_deg,phi_deg,kappa_deg; images.csv of a result is welcome.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number or a duplicate image.
    """
    angles = ("omega_deg", "phi_deg", "kappa_deg")
    ignored = ("camera", "sX", "sY", "sZ", *(f"s{name}" for name in angles), "points", "rms_px")
    table = _read(path, ("image",), ("X", "Y", "Z", *angles), ignored=ignored)
    rotation = [rotation_from_angles(*row) for row in np.radians(table.values[:, 3:])]
    return ExteriorTable(
        table.keys("image"), table.values[:, :3], np.reshape(rotation, (-1, 3, 3)), table.line
    )


def read_image_points(path: Path) -> ImagePointTable:
    """Read image points: image,point,x_px,y_px[,sx_px,sy_px] or image,point,x_mm,y_mm[,sx_mm,sy_mm].

    image_points.csv of a result is welcome; its residuals and rejections are passed over, everything is
    taken as measured.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number, a sigma that is not positive, or the
            same point twice in one image.
    """
    unit = "mm" if "x_mm" in _read_header(path) else "px"
    sigmas = (f"sx_{unit}", f"sy_{unit}")
    table = _read(
        path, ("image", "point"), (f"x_{unit}", f"y_{unit}"), sigmas, ignored=("vx_px", "vy_px", "rejected")
    )
    xy, sigma = table.values[:, :2], table.values[:, 2:]
    table.refuse(sigma, sigma < MIN_SIGMA, sigmas, f"more than 0, at least {MIN_SIGMA:g}")
    image, point = table.texts
    table.refuse_duplicates(tuple(zip(image, point, strict=True)), ("image", "point"))
    return ImagePointTable(image, point, xy, sigma if sigma.size else None, unit, table.line)


@dataclass(frozen=True)
class _Table:
    """Columns of a CSV file, with what is needed to say where something is wrong."""

    path: Path
    names: tuple[str, ...]  # of the columns of text
    texts: tuple[tuple[str, ...], ...]  # one tuple per column of text
    values: FloatArray  # columns of numbers, (rows, columns)
    line: IntArray  # line of each row in the file, (rows,)

    def keys(self, column: str) -> tuple[str, ...]:
        """Return a column of names that are all different."""
        values = self.texts[self.names.index(column)]
        self.refuse_duplicates(values, (column,))
        return values

    def refuse(self, values: FloatArray, wrong: BoolArray, columns: tuple[str, ...], needed: str) -> None:
        """Raise SurveyFileError for the first value of a mask, both (rows, columns)."""
        for k, c in np.argwhere(wrong)[:1]:
            where = f"{self.path}, line {self.line[k]}: column {columns[c]}"
            raise SurveyFileError(f"{where} holds {values[k, c]:g}, needed {needed}")

    def refuse_duplicates(self, keys: tuple[object, ...], columns: tuple[str, ...]) -> None:
        """Raise SurveyFileError if a key comes twice."""
        if len(set(keys)) == len(keys):
            return
        first: dict[object, int] = {}
        for key, line in zip(keys, self.line.tolist(), strict=True):
            if key in first:
                names = key if isinstance(key, tuple) else (key,)
                what = ", ".join(f"{c} '{name}'" for c, name in zip(columns, names, strict=True))
                raise SurveyFileError(f"{self.path}, line {line}: {what} stands on line {first[key]} already")
            first[key] = line


def _read(
    path: Path,
    texts: tuple[str, ...],
    numbers: tuple[str, ...],
    optional: tuple[str, ...] = (),
    *,
    aliases: tuple[tuple[str, str], ...] = (),
    ignored: tuple[str, ...] = (),
) -> _Table:
    """Read a CSV file whose header names its columns.

    Args:
        path: the file, UTF-8, comma separated, `.` as decimal sign.
        texts: columns of names.
        numbers: columns of numbers.
        optional: columns of numbers that come all together or not at all.
        aliases: (other name, name) of columns.
        ignored: further columns that may be there.
    """
    header = tuple(dict(aliases).get(name, name) for name in _read_header(path))
    wanted = (*texts, *numbers)
    shape = ",".join(wanted) + (f"[,{','.join(optional)}]" if optional else "")
    for name in header:
        if header.count(name) > 1:
            raise SurveyFileError(f"{path}, line 1: column {name!r:.60} stands twice in the header")
        if name not in (*wanted, *optional, *ignored):
            raise SurveyFileError(f"{path}, line 1: unknown column {name!r:.60}, needed {shape}")
    if any(name in header for name in optional):
        numbers = (*numbers, *optional)
    for name in (*texts, *numbers):
        if name not in header:
            raise SurveyFileError(f"{path}, line 1: no column {name}, needed {shape}")
    text_at = [header.index(name) for name in texts]
    number_at = [header.index(name) for name in numbers]
    columns: list[list[str]] = [[] for _ in texts]
    values, lines = array("d"), array("q")
    for line, row in _rows(path, len(header)):
        where = f"{path}, line {line}"
        if len(lines) == MAX_ROWS:
            raise SurveyFileError(f"{where}: more than {MAX_ROWS} rows, no more are read")
        for column, at, name in zip(columns, text_at, texts, strict=True):
            column.append(_name(row[at], f"{where}: column {name}"))
        for at, name in zip(number_at, numbers, strict=True):
            values.append(_number(row[at], f"{where}: column {name}"))
        lines.append(line)
    if not lines:
        raise SurveyFileError(f"{path}: no rows below the header, at least one is needed")
    return _Table(
        path,
        texts,
        tuple(tuple(column) for column in columns),
        np.array(values).reshape(len(lines), len(numbers)),
        np.array(lines, dtype=np.int64),
    )


def _rows(path: Path, columns: int) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of every row below the header that is not empty."""
    with _opened(path) as file:
        reader = csv.reader(_lines(path, file))
        try:
            next(reader, None)
            for row in reader:
                if not any(cell.strip() for cell in row):
                    continue
                if len(row) != columns:
                    raise SurveyFileError(
                        f"{path}, line {reader.line_num}: {len(row)} columns, the header has {columns}"
                    )
                yield reader.line_num, row
        except UnicodeDecodeError as error:
            raise SurveyFileError(
                f"{path}: not a text file in UTF-8 (after line {reader.line_num})"
            ) from error
        except csv.Error as error:
            raise SurveyFileError(f"{path}, line {reader.line_num}: not a CSV table: {error}") from error
        except OSError as error:
            raise SurveyFileError(f"{path}: the table cannot be read: {error.strerror}") from error


def _lines(path: Path, file: TextIO) -> Iterator[str]:
    """Yield the lines of a file, none longer than a line can be, and not more than twice the rows."""
    for number in range(1, 2 * MAX_ROWS):
        line = file.readline(MAX_LINE + 1)
        if not line:
            return
        if len(line) > MAX_LINE:
            raise SurveyFileError(f"{path}, line {number}: more than {MAX_LINE} characters, not a CSV table")
        yield line
    raise SurveyFileError(f"{path}: more than {2 * MAX_ROWS} lines, no more are read")


def _read_header(path: Path) -> tuple[str, ...]:
    """Return the names of the columns."""
    with _opened(path) as file:
        try:
            return tuple(name.strip() for name in next(csv.reader(_lines(path, file)), []))
        except (UnicodeDecodeError, csv.Error) as error:
            raise SurveyFileError(f"{path}, line 1: not a CSV table in UTF-8") from error
        except OSError as error:
            raise SurveyFileError(f"{path}: the table cannot be read: {error.strerror}") from error


def _opened(path: Path) -> TextIO:
    """Open a table that is a file of bearable size."""
    try:
        if path.exists() and not path.is_file():  # reading a pipe would never end
            raise SurveyFileError(f"{path}: not a file, a CSV table is needed")
        if path.stat().st_size > MAX_TABLE_BYTES:
            raise SurveyFileError(f"{path}: {path.stat().st_size} bytes, at most {MAX_TABLE_BYTES} are read")
        return path.open(encoding="utf-8-sig", newline="")
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SurveyFileError(f"{path}: the table cannot be read: {reason}") from error


def _name(cell: str, where: str) -> str:
    """Return a name; one that is empty, very long or holds control characters is refused."""
    name = cell.strip()
    if not name:
        raise SurveyFileError(f"{where} is empty, a name is needed")
    if len(name) > MAX_NAME or any(ord(c) < 32 or 127 <= ord(c) < 160 for c in name):
        raise SurveyFileError(
            f"{where} holds {name!r:.60}, needed plain text of at most {MAX_NAME} characters"
        )
    return sys.intern(name)


def _number(cell: str, where: str) -> float:
    """Return a number as programs write it; Python's own float() takes 1_0 and digits of all scripts, too."""
    text = cell.strip()
    try:
        value = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SurveyFileError(f"{where} holds {cell!r:.60}, a finite number is needed")
    if abs(value) > MAX_NUMBER:
        raise SurveyFileError(f"{where} holds {text:.60}, needed a number of at most {MAX_NUMBER:g}")
    return value
