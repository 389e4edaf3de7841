"""The tables that a survey file names (CSV): control, image points, exterior orientation, points."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.conventions import BoolArray, FloatArray, rotation_from_angles
from sfm.errors import SurveyFileError

MAX_TABLE_BYTES = 500_000_000  # some 5 million image points; bounded before any memory is taken


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


@dataclass(frozen=True)
class ImagePointTable:
    """Measured image points of image_points.csv, as they stand there."""

    image: tuple[str, ...]  # photograph of each row, (k,)
    point: tuple[str, ...]  # point of each row, (k,)
    xy: FloatArray  # px in the pixel frame or mm in the image frame, (k, 2)
    sigma: FloatArray | None  # standard deviations in the same unit, None if the table has none, (k, 2)
    unit: str  # px | mm


def read_control(path: Path) -> PointTable:
    """Read known object points: id,X,Y,Z[,sX,sY,sZ]; no sigma or 0 means fixed.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number, negative sigma or a duplicate id.
    """
    table = _read(path, ("id", "X", "Y", "Z"), ("sX", "sY", "sZ"), aliases=(("point", "id"),))
    sigma = table.numbers(("sX", "sY", "sZ")) if "sX" in table.header else np.zeros((len(table.rows), 3))
    table.refuse(sigma < 0, ("sX", "sY", "sZ"), "0 (fixed) or more")
    return PointTable(table.keys("id"), table.numbers(("X", "Y", "Z")), sigma)


def read_points(path: Path) -> PointTable:
    """Read approximate object points: point,X,Y,Z; points.csv of a result is welcome.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number or a duplicate point.
    """
    table = _read(
        path,
        ("point", "X", "Y", "Z"),
        aliases=(("id", "point"),),
        ignored=("sX", "sY", "sZ", "rays", "code"),
    )
    xyz = table.numbers(("X", "Y", "Z"))
    return PointTable(table.keys("point"), xyz, np.zeros_like(xyz))


def read_exterior(path: Path) -> ExteriorTable:
    """Read exterior orientations: image,X,Y,Z,omega_deg,phi_deg,kappa_deg; images.csv of a result is welcome.

    Raises:
        SurveyFileError: unreadable, wrong columns, not a finite number or a duplicate image.
    """
    angles = ("omega_deg", "phi_deg", "kappa_deg")
    ignored = ("camera", "sX", "sY", "sZ", *(f"s{name}" for name in angles), "points", "rms_px")
    table = _read(path, ("image", "X", "Y", "Z", *angles), ignored=ignored)
    rotation = [rotation_from_angles(*row) for row in np.radians(table.numbers(angles))]
    return ExteriorTable(
        table.keys("image"), table.numbers(("X", "Y", "Z")), np.reshape(rotation, (-1, 3, 3))
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
    required = ("image", "point", f"x_{unit}", f"y_{unit}")
    table = _read(path, required, sigmas, ignored=("vx_px", "vy_px", "rejected"))
    sigma = None
    if sigmas[0] in table.header:
        sigma = table.numbers(sigmas)
        table.refuse(sigma <= 0, sigmas, "more than 0")
    image, point = table.texts("image"), table.texts("point")
    table.refuse_duplicates(tuple(zip(image, point, strict=True)), ("image", "point"))
    return ImagePointTable(image, point, table.numbers(required[2:]), sigma, unit)


@dataclass(frozen=True)
class _Table:
    """Rows of a CSV file as text, with what is needed to say where something is wrong."""

    path: Path
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]  # line of each row in the file

    def texts(self, column: str) -> tuple[str, ...]:
        """Return a column of names; an empty one is refused."""
        at = self.header.index(column)
        values = tuple(row[at].strip() for row in self.rows)
        for value, line in zip(values, self.lines, strict=True):
            if not value:
                raise SurveyFileError(f"{self.path}, line {line}: column {column} is empty, a name is needed")
            if not value.isprintable():
                raise SurveyFileError(
                    f"{self.path}, line {line}: column {column} holds {value!r:.60}, needed plain characters"
                )
        return values

    def keys(self, column: str) -> tuple[str, ...]:
        """Return a column of names that are all different."""
        values = self.texts(column)
        self.refuse_duplicates(values, (column,))
        return values

    def numbers(self, columns: tuple[str, ...]) -> FloatArray:
        """Return columns of finite numbers, shape (rows, columns)."""
        at = [self.header.index(column) for column in columns]
        values = np.empty((len(self.rows), len(columns)))
        for k, row in enumerate(self.rows):
            for c, index in enumerate(at):
                try:
                    values[k, c] = float(row[index])
                except ValueError:
                    values[k, c] = math.nan
        for k, c in np.argwhere(~np.isfinite(values))[:1]:
            raise SurveyFileError(
                f"{self.path}, line {self.lines[k]}: column {columns[c]} holds {self.rows[k][at[c]]!r:.60}, "
                "a finite number is needed"
            )
        return values

    def refuse(self, wrong: BoolArray, columns: tuple[str, ...], needed: str) -> None:
        """Raise SurveyFileError for the first value of a mask (rows, columns)."""
        for k, c in np.argwhere(wrong)[:1]:
            value = self.rows[k][self.header.index(columns[c])].strip()
            raise SurveyFileError(
                f"{self.path}, line {self.lines[k]}: column {columns[c]} holds {value}, needed {needed}"
            )

    def refuse_duplicates(self, keys: tuple[object, ...], columns: tuple[str, ...]) -> None:
        """Raise SurveyFileError if a key comes twice."""
        if len(set(keys)) == len(keys):
            return
        first: dict[object, int] = {}
        for key, line in zip(keys, self.lines, strict=True):
            if key in first:
                names = key if isinstance(key, tuple) else (key,)
                what = ", ".join(f"{c} '{name}'" for c, name in zip(columns, names, strict=True))
                raise SurveyFileError(f"{self.path}, line {line}: {what} stands on line {first[key]} already")
            first[key] = line


def _read_header(path: Path) -> tuple[str, ...]:
    """Return the names of the columns."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            return tuple(name.strip() for name in next(csv.reader([file.readline(10_000)]), []))
    except OSError as error:
        raise SurveyFileError(f"{path}: the table cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise SurveyFileError(f"{path}, line 1: not a CSV table in UTF-8") from error


def _read(
    path: Path,
    required: tuple[str, ...],
    optional: tuple[str, ...] = (),
    *,
    aliases: tuple[tuple[str, str], ...] = (),
    ignored: tuple[str, ...] = (),
) -> _Table:
    """Read a CSV file whose header names its columns.

    Args:
        path: the file, UTF-8, comma separated, `.` as decimal sign.
        required: columns that must be there.
        optional: columns that come all together or not at all.
        aliases: (other name, name) of columns.
        ignored: further columns that may be there.
    """
    header = tuple(dict(aliases).get(name, name) for name in _read_header(path))
    shape = ",".join(required) + (f"[,{','.join(optional)}]" if optional else "")
    for name in header:
        if header.count(name) > 1:
            raise SurveyFileError(f"{path}, line 1: column {name!r:.60} stands twice in the header")
        if name not in (*required, *optional, *ignored):
            raise SurveyFileError(f"{path}, line 1: unknown column {name!r:.60}, needed {shape}")
    given = [name for name in optional if name in header]
    for name in (*required, *(optional if given else ())):
        if name not in header:
            raise SurveyFileError(f"{path}, line 1: no column {name}, needed {shape}")
    if path.stat().st_size > MAX_TABLE_BYTES:
        raise SurveyFileError(f"{path}: {path.stat().st_size} bytes, at most {MAX_TABLE_BYTES} are read")
    rows, lines = [], []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            next(reader)
            for row in reader:
                if not any(cell.strip() for cell in row):
                    continue
                if len(row) != len(header):
                    raise SurveyFileError(
                        f"{path}, line {reader.line_num}: {len(row)} columns, the header has {len(header)}"
                    )
                rows.append(tuple(row))
                lines.append(reader.line_num)
    except OSError as error:
        raise SurveyFileError(f"{path}: the table cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SurveyFileError(f"{path}: not a text file in UTF-8") from error
    except csv.Error as error:
        raise SurveyFileError(f"{path}, line {reader.line_num}: not a CSV table: {error}") from error
    if not rows:
        raise SurveyFileError(f"{path}: no rows below the header, at least one is needed")
    return _Table(path, header, tuple(rows), tuple(lines))
