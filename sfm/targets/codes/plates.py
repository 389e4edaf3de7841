"""Calibration plates with their point numbers, and all code families by name.

Point `row * columns + column` is the dot or crossing in that row and column, both counted from 0, rows
downwards and columns to the right, as the plate is printed. Any side may be called the upper one, as long as
marks and any table of the points are counted from it.

The code families are those that a survey file, a target sheet or `find_targets` can name. To add one:

- a family of rings with a table needs only the table file;
- rings by the rule of `ring_patterns` need a row in `rings.RINGS`, all necklaces one in `rings.NECKLACES`;
- a dictionary of square tags needs a row in `tags.DICTIONARIES`, concentric rings one in `concentric.WIDTHS`;
- another kind of code needs a module beside these with a type for its families, a row below, and a row of
  `READINGS` in `sfm.targets.detect`: for numbers of measured dots, as rings, or points of its own, as tags.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.targets.codes.concentric import WIDTHS, ConcentricFamily, concentric_family
from sfm.targets.codes.rings import RING_NAMES, CodeFamily, read_code_table, ring_family
from sfm.targets.codes.tags import DICTIONARIES, TagFamily, tag_family

Family = CodeFamily | TagFamily | ConcentricFamily


class Grid(NamedTuple):
    """The arrangement of the dots of a plate."""

    shift: float
    """shift of every second row, in pitches"""
    apart: float
    """distance of rows, in pitches"""
    turns: int
    """turns in a full circle after which the arrangement looks alike"""


# The pitch is the distance of dots in a row; OpenCV uses half of it for its asymmetric grid.
GRIDS = {
    "grid": Grid(0.0, 1.0, 4),
    "asymmetric-grid": Grid(0.5, 0.5, 4),
    "hexagonal-grid": Grid(0.5, math.sqrt(3) / 2, 6),
}
BOARDS = ("checkerboard", "charuco", "aprilgrid")
TAGGED = ("charuco", "aprilgrid")
APRIL_BORDERS = (2, 1)  # modules of the black border of the tags of an AprilGrid, Kalibr's first
PLATES = (*GRIDS, *BOARDS)
UNCODED = -1
MAX_ROUNDING = 1e-6  # pitches, for rounding errors
# Maximum distance of a tag from its position by the homography of its board, in distances of tags or squares.
# Distortion of 5 % at the corners of a photograph filled by 8 x 8 tags leaves 0.1; a misread tag is off by 1.
MAX_OFF_PLACE = 0.15


@dataclass(frozen=True)
class PlateFamily:
    """A calibration plate."""

    name: str
    """one of PLATES"""
    rows: int
    """rows of dots, or of crossings inside a board; an AprilGrid has two rows of corners per row of tags"""
    columns: int
    """columns, likewise"""
    marks: tuple[tuple[int, int], ...] = ()
    """row and column of the dots that are larger than the others, or rings"""
    dictionary: str = ""
    """dictionary of the tags of a ChArUco board or AprilGrid, a name in tags.DICTIONARIES"""
    tag_share: float = 0.0
    """side of these tags, in squares or in distances from a tag to the next one"""
    first_tag: int = 0
    """number of the first tag"""
    first_point: int = 0
    """number of the first point, if the plate is in a group"""

    @property
    def count(self) -> int:
        """Number of points."""
        return self.rows * self.columns

    @property
    def last_tag(self) -> int:
        """Number of the last tag of a ChArUco board or AprilGrid."""
        size = (self.rows + 1) * (self.columns + 1) // 2
        return self.first_tag - 1 + (self.count // 4 if self.name == "aprilgrid" else size)

    @property
    def last_point(self) -> int:
        """Number of the last point."""
        return self.first_point + self.count - 1

    @property
    def is_shifted(self) -> bool:
        """Return whether every second row is shifted by half the pitch."""
        return self.name in GRIDS and GRIDS[self.name].shift > 0

    @cached_property
    def turns(self) -> tuple[IntArray, ...]:
        """The point numbers after each turn for which the plate looks alike, (n,); empty for most plates.

        The colours of its squares distinguish a checkerboard with an odd sum of rows and columns from the
        same board turned by 180 degrees. They distinguish one with an odd number of rows, and as many columns
        as rows, from the board turned by 90 degrees. Marks and tags distinguish every turn.
        """
        if self.marks or self.name in TAGGED:
            return ()
        fold = GRIDS[self.name].turns if self.name in GRIDS else 4
        points = self.plane(1.0)[:, :2] @ [1, 1j]
        points -= points.mean()
        numbers = []
        for turn in range(1, fold):
            away = np.abs(points[:, None] * np.exp(2j * np.pi * turn / fold) - points)
            number = away.argmin(axis=1)
            if away.min(axis=1).max() >= MAX_ROUNDING:
                continue
            row, column = np.divmod(number[[0, self.columns + 1]], self.columns)  # of the first square
            if self.name != "checkerboard" or int(row.min() + column.min()) % 2 == 0:  # keeps its colour
                numbers.append(number)
        return tuple(numbers)

    @property
    def is_ambiguous(self) -> bool:
        """Return whether the plate looks alike when turned, so that its points have no identity."""
        return len(self.turns) > 0

    @property
    def places(self) -> IntArray:
        """Row and column of the points, (n, 2); columns count halves if rows are shifted."""
        row, column = np.divmod(np.arange(self.count), self.columns)
        return np.stack([row, 2 * column + row % 2 if self.is_shifted else column], axis=1)

    def plane(self, pitch: float) -> FloatArray:
        """Return the points in the plane of the plate, x to the right, y up, z towards the camera, (n, 3)."""
        row, column = np.divmod(np.arange(self.count), self.columns)
        if self.name == "aprilgrid":
            x, y = (pitch * (k // 2 + k % 2 * self.tag_share) for k in (column, row))
            return np.stack([x, -y, np.zeros(self.count)], axis=1)
        grid = GRIDS.get(self.name, GRIDS["grid"])
        x, y = pitch * (column + grid.shift * (row % 2)), -pitch * grid.apart * row
        return np.stack([x, y, np.zeros(self.count)], axis=1)


@dataclass(frozen=True)
class PlateGroup:
    """Several plates fixed to one another; the point numbers of each follow those of the plates before it."""

    plates: tuple[PlateFamily, ...]


def plates_of(family: object) -> tuple[PlateFamily, ...]:
    """Return the plates of a code family; empty for other families."""
    if isinstance(family, PlateGroup):
        return family.plates
    return (family,) if isinstance(family, PlateFamily) else ()


def points_of_plates(family: object, code: IntArray) -> tuple[IntArray, ...]:
    """Return which points are on each plate.

    Args:
        family: code family of a survey.
        code: code of each point, -1 without one, (n,).
    """
    return tuple(
        np.flatnonzero((code >= plate.first_point) & (code <= plate.last_point))
        for plate in plates_of(family)
    )


def group_plates(plates: Sequence[PlateFamily]) -> PlateGroup:
    """Return plates as a group, with their point numbers in it.

    Raises:
        GeometryError: a plate looks alike when turned, so that it has no defined position among the others,
            or two plates cannot be distinguished.
    """
    first, grouped = 0, list[PlateFamily]()
    for plate in plates:
        if plate.is_ambiguous:
            raise GeometryError(
                f"a {plate.name} of {plate.rows} x {plate.columns} looks alike when it is turned, and has no "
                "place beside other plates: needed marks, tags, or an odd sum of rows and columns"
            )
        for other in grouped:
            if plate.name in TAGGED and other.name in TAGGED:
                apart = plate.first_tag > other.last_tag or other.first_tag > plate.last_tag
                alike = plate.dictionary == other.dictionary and not apart
            else:
                kinds = (tuple(GRIDS), ("checkerboard", "charuco"))
                alike = any(plate.name in names and other.name in names for names in kinds)
            if alike:  # a finder may take one for the other
                raise GeometryError(
                    f"{other.name} of {other.rows} x {other.columns} and {plate.name} of {plate.rows} x "
                    f"{plate.columns} are not distinguished: needed other tags, or a plate of another kind"
                )
        grouped.append(replace(plate, first_point=first))
        first += plate.count
    return PlateGroup(tuple(grouped))


def refuse_unusable_plate(plate: PlateFamily) -> None:
    """Raise GeometryError if marks are not on the plate, or look alike when it is turned."""
    for row, column in plate.marks:
        if not (0 <= row < plate.rows and 0 <= column < plate.columns):
            raise GeometryError(
                f"mark [{row}, {column}] is not on a plate of {plate.rows} rows and {plate.columns} columns "
                "(counted from 0)"
            )
    if not plate.marks:
        return
    marks = plate.plane(1.0)[[row * plate.columns + column for row, column in plate.marks], :2] @ [1, 1j]
    turns = GRIDS[plate.name].turns
    for turn in range(1, turns):
        turned = marks * np.exp(2j * np.pi * turn / turns)
        moved = turned - turned.mean() + marks.mean()
        if np.abs(moved[:, None] - marks).min(axis=1).max() < MAX_ROUNDING:
            raise GeometryError(
                f"the marks look alike turned by {360 * turn // turns} degrees: turn one, or mark another dot"
            )


def quarter_turn(place: IntArray, quarters: int) -> IntArray:
    """Return rows and columns rotated by quarter turns, (k, 2)."""
    row, column = place.T
    turned = ((row, column), (column, -row), (-row, -column), (-column, row))[quarters]
    return np.stack(turned, axis=1)


TargetFamily = Family | PlateFamily | PlateGroup  # a plate is not described by a name alone
FAMILIES: dict[str, Callable[[], Family | None]] = {
    **{name: partial(ring_family, name) for name in RING_NAMES},
    "none": lambda: None,
    **{name: partial(tag_family, name) for name in DICTIONARIES},
    **{name: partial(concentric_family, name) for name in WIDTHS},
}


def is_table(codes: str) -> bool:
    """Return whether the codes of a survey are the path of a table instead of a name."""
    return codes not in FAMILIES and codes not in PLATES


def code_family(codes: str | Family) -> Family | None:
    """Return the code family for a name or a table file; None for "none".

    Args:
        codes: a name in FAMILIES, the path of a table file, or a family, which is returned unchanged.

    Returns:
        The family, or None if targets are not coded.

    Raises:
        SurveyFileError: neither a known family nor a readable table.
    """
    if not isinstance(codes, str):
        return codes
    if codes in PLATES:
        raise SurveyFileError(f"codes {codes!r}, a plate with its rows and columns is needed (PlateFamily)")
    if codes in FAMILIES:
        return FAMILIES[codes]()
    if not os.path.exists(codes):
        raise SurveyFileError(f"codes: {codes!r} is neither one of {', '.join(FAMILIES)} nor a table file")
    return read_code_table(Path(codes))
