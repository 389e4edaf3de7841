"""Marks: image points that a person measured, one row a mark, in one text file.

    # kolinear marks 1
    # survey: NAME
    # sha256 PHOTOGRAPH: HEX           of each photograph with marks, as it was when they were measured
    # control: POINT,X,Y,Z,sX,sY,sZ    coordinates that the person states, object unit
    # scale bar: FROM,TO,LENGTH,SIGMA  lengths that the person states, object unit
    photograph,point,x_px,y_px,sxx_px2,sxy_px2,syy_px2,kind,by,state,when

`kind` is what was measured, `by` is "measured" or "hand", `when` is a time (ISO 8601, UTC). The state of a
mark is "accepted". A place that the person refused is a row too, so that it is not proposed again. The
covariance is that of the measurement, the noise of the photograph alone; sigma_px of the survey adds the
other errors, as it does to targets.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np

from sfm.files.csv_tables import read_comments, read_table
from sfm.files.plain_text import as_cell, csv_text, from_cell
from sfm.files.whole_files import whole_file
from sfm.model.errors import SurveyFileError
from sfm.survey.inputs.given_values import KnownPoints, Observations, ScaleBar

Kind = Literal["target", "ring", "saddle", "corner", "cross", "window", "hand"]
By = Literal["measured", "hand"]
State = Literal["accepted", "refused"]
KINDS: tuple[Kind, ...] = get_args(Kind)
TITLE = "kolinear marks 1"
TEXTS = ("photograph", "point", "kind", "by", "state", "when")
NUMBERS = ("x_px", "y_px", "sxx_px2", "sxy_px2", "syy_px2")
COLUMNS = (*TEXTS[:2], *NUMBERS, *TEXTS[2:])
COVARIANCES = NUMBERS[2:]


@dataclass(frozen=True)
class Mark:
    """An image point that a person measured, or a place that the person refused; a row of the file."""

    photograph: str
    point: str
    x: float  # px
    y: float  # px
    sxx: float  # variance of x, px^2
    sxy: float  # covariance of x and y, px^2
    syy: float  # variance of y, px^2
    kind: Kind
    by: By = "measured"
    state: State = "accepted"
    when: str = ""  # ISO 8601, UTC

    @property
    def key(self) -> tuple[str, str]:
        """Photograph and point."""
        return self.photograph, self.point

    @property
    def sigma(self) -> tuple[float, float]:
        """Standard deviations of x and y, px."""
        return self.sxx**0.5, self.syy**0.5

    @property
    def covariance(self) -> list[list[float]]:
        """Covariance of x and y, px^2, (2, 2)."""
        return [[self.sxx, self.sxy], [self.sxy, self.syy]]


@dataclass(frozen=True)
class StatedPoint:
    """Coordinates of a point that a person states."""

    xyz: tuple[float, float, float]  # object unit
    sigma: tuple[float, float, float]  # 0 = fixed, object unit


@dataclass(frozen=True)
class Marking:
    """Everything that a person marked in the photographs of a survey."""

    survey: str = ""
    marks: Mapping[tuple[str, str], Mark] = field(default_factory=lambda: MappingProxyType({}))
    refused: Mapping[tuple[str, str], Mark] = field(default_factory=lambda: MappingProxyType({}))
    control: Mapping[str, StatedPoint] = field(default_factory=lambda: MappingProxyType({}))
    bars: Mapping[tuple[str, str], ScaleBar] = field(default_factory=lambda: MappingProxyType({}))
    hashes: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))  # SHA-256 by photograph

    def with_mark(self, mark: Mark) -> Marking:
        """Return the marking with one more mark, in place of one of the same point and photograph."""
        refused = {key: row for key, row in self.refused.items() if key != mark.key}
        return replace(self, marks={**self.marks, mark.key: mark}, refused=refused)

    def with_refused(self, mark: Mark) -> Marking:
        """Return the marking with a place that was refused, and without a mark there."""
        marks = {key: row for key, row in self.marks.items() if key != mark.key}
        row = replace(mark, state="refused")
        return replace(self, marks=marks, refused={**self.refused, mark.key: row})

    def without(self, keys: Iterable[tuple[str, str]]) -> Marking:
        """Return the marking without marks and refusals of (photograph, point)."""
        gone = set(keys)
        marks, refused = (
            {key: row for key, row in rows.items() if key not in gone} for rows in (self.marks, self.refused)
        )
        return replace(self, marks=marks, refused=refused)

    def renamed(self, point: str, name: str, automatic: Collection[tuple[str, str]] = frozenset()) -> Marking:
        """Return the marking with another name of a point, in marks, control and bars.

        Args:
            point: the present name.
            name: the new one.
            automatic: image points that were measured automatically; their refusals keep the old name.
        """

        def of(old: str) -> str:
            return name if old == point else old

        def with_name(row: Mark) -> Mark:
            return replace(row, point=of(row.point))

        marks = {row.key: row for row in map(with_name, self.marks.values())}
        kept = (row if key in automatic else with_name(row) for key, row in self.refused.items())
        refused = {row.key: row for row in kept if row.key not in marks}
        bars = {
            (of(bar.start), of(bar.end)): ScaleBar(of(bar.start), of(bar.end), bar.length, bar.sigma)
            for bar in self.bars.values()
        }
        control = {of(old): stated for old, stated in self.control.items()}
        return replace(self, marks=marks, refused=refused, bars=bars, control=control)

    @property
    def points(self) -> tuple[str, ...]:
        """Names of the marked points, in the order of their first marks."""
        return tuple(dict.fromkeys(point for _, point in self.marks))

    @property
    def left_out(self) -> tuple[Mark, ...]:
        """The refused image points, without those that were marked again."""
        return tuple(row for key, row in self.refused.items() if key not in self.marks)

    def known_points(self) -> KnownPoints | None:
        """Return the stated coordinates as control; None without any."""
        if not self.control:
            return None
        stated = self.control.values()
        return KnownPoints.from_arrays(
            list(self.control), [point.xyz for point in stated], [point.sigma for point in stated]
        )


def now() -> str:
    """Return the time as marks state it, ISO 8601, UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def read_marks(path: Path) -> Marking:
    """Read a marks file.

    Raises:
        SurveyFileError: the file is not a marks file, or a value in it is wrong.
    """
    comments = read_comments(path)
    if not comments or comments[0][1] != TITLE:
        raise SurveyFileError(f"{path}: not a marks file, its first line must be '# {TITLE}'")
    survey, hashes = "", {}
    control: dict[str, StatedPoint] = {}
    bars: dict[tuple[str, str], ScaleBar] = {}
    for line, text in comments[1:]:
        is_hash = text.startswith("sha256 ")  # of a photograph, whose name may contain ": "
        key, _, value = text.rpartition(": ") if is_hash else text.partition(": ")
        cells = next(csv.reader([value]), [])
        if key == "survey":
            survey = value
        elif is_hash:
            hashes[key.removeprefix("sha256 ")] = value
        elif key == "control":
            name, *xyz = _stated(path, line, cells, 6)
            control[str(name)] = StatedPoint(
                (float(xyz[0]), float(xyz[1]), float(xyz[2])), (float(xyz[3]), float(xyz[4]), float(xyz[5]))
            )
        elif key == "scale bar":
            name, end, length, sigma = _stated(path, line, cells, 2, names=2)
            bars[str(name), str(end)] = ScaleBar(str(name), str(end), float(length), float(sigma))
    table = read_table(path, TEXTS, NUMBERS, may_be_empty=True)
    variance = table.values[:, 2:]
    table.refuse(variance[:, [0, 2]], variance[:, [0, 2]] <= 0, ("sxx_px2", "syy_px2"), "more than 0")
    impossible = variance[:, 1] ** 2 >= variance[:, 0] * variance[:, 2]
    table.refuse(variance[:, [1]], impossible[:, None], ("sxy_px2",), "a correlation below 1")
    marks: dict[tuple[str, str], Mark] = {}
    refused: dict[tuple[str, str], Mark] = {}
    for k, (photograph, point, kind, by, state, when) in enumerate(zip(*table.texts, strict=True)):
        for column, value, known in (
            ("kind", kind, KINDS),
            ("by", by, get_args(By)),
            ("state", state, get_args(State)),
        ):
            if value not in known:
                raise SurveyFileError(
                    f"{table.place(k)}: column {column} contains '{value}', needed one of {', '.join(known)}"
                )
        rows = marks if state == "accepted" else refused
        if (photograph, point) in rows:
            raise SurveyFileError(f"{table.place(k)}: point '{point}' in '{photograph}' is marked already")
        x, y, sxx, sxy, syy = table.values[k].tolist()
        rows[photograph, point] = Mark(photograph, point, x, y, sxx, sxy, syy, kind, by, state, when)
    return Marking(survey, marks, refused, control, bars, hashes)


def _stated(path: Path, line: int, cells: Sequence[str], count: int, names: int = 1) -> list[str | float]:
    """Return the names and numbers of a comment."""
    try:
        values = [float(cell) for cell in cells[names:]]
        if len(values) == count and np.isfinite(values).all() and all(cells[:names]):
            return [*map(from_cell, cells[:names]), *values]
    except ValueError:
        pass
    raise SurveyFileError(f"{path}, line {line}: needed {names} name(s) and {count} numbers")


def write_marks(path: Path, marking: Marking) -> None:
    """Write a marks file, completely or not at all.

    Args:
        path: the file; an earlier one is replaced, which the caller knows to be a marks file.
        marking: its content.

    Raises:
        OutputError: the file cannot be written.
        SurveyFileError: a mark is not one that `read_marks` reads.
    """
    marks = (*marking.marks.values(), *marking.refused.values())
    for mark in marks:
        finite = all(map(math.isfinite, (mark.x, mark.y, mark.sxx, mark.sxy, mark.syy)))
        if not (finite and mark.sxx > 0 and mark.syy > 0 and mark.sxy**2 < mark.sxx * mark.syy):
            raise SurveyFileError(f"mark of '{mark.point}' in '{mark.photograph}': no place with a precision")
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")

    def comment(key: str, *cells: object) -> None:
        text.write(f"# {key}: ")
        rows.writerow([as_cell(cell) if isinstance(cell, str) else repr(cell) for cell in cells])

    text.write(f"# {TITLE}\n# survey: {marking.survey}\n")
    marked = {photograph for photograph, _ in (*marking.marks, *marking.refused)}
    for name, value in sorted(marking.hashes.items()):
        if name in marked:
            text.write(f"# sha256 {name}: {value}\n")
    for name, stated in marking.control.items():
        comment("control", name, *stated.xyz, *stated.sigma)
    for bar in marking.bars.values():
        comment("scale bar", bar.start, bar.end, bar.length, bar.sigma)
    table = csv_text(COLUMNS, map(attrgetter(*(attribute.name for attribute in fields(Mark))), marks))
    with whole_file(path, "the marks file", replaces=True) as part:
        part.write_text(text.getvalue() + table, encoding="utf-8", newline="")


def image_points_of(marking: Marking, path: Path, sigma_px: float) -> Observations | None:
    """Return the accepted marks as given image points of a survey; None without any.

    Args:
        marking: the content of a marks file.
        path: this file, for error messages.
        sigma_px: standard deviation of an image coordinate besides the noise of the photograph, px.
    """
    marks = tuple(marking.marks.values())
    if not marks:
        return None
    C = np.array([mark.covariance for mark in marks])
    C[[mark.by == "measured" for mark in marks]] += sigma_px**2 * np.eye(2)
    given = Observations.from_arrays(
        [mark.photograph for mark in marks],
        [mark.point for mark in marks],
        [[mark.x, mark.y] for mark in marks],
        np.sqrt(C[:, range(2), range(2)]),
    )
    between = C[:, 0, 1] if C[:, 0, 1].any() else None
    return replace(given, covariance=between, table=replace(given.table, path=path))
