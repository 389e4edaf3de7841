"""Calibration plates as targets: grids of dots with marks, checkerboards, and ChArUco boards.

Point `row * columns + column` is the dot or crossing in that row and column, both from 0, rows downwards and
columns to the right as the plate is printed. Marks are larger dots or rings among the dots and tell how a
photograph shows the plate, and which part of it. A plate of dots without marks must be seen whole, a
checkerboard may be cut by the border of the photograph on one of two opposite sides; how they are turned
follows from its colours (checkerboards with an odd number of rows and columns together) or is taken as
it stands in the photograph, since the plate looks alike turned by 180 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.targets.codes.cut_boards import name_cut_board
from sfm.targets.codes.lattice import Lattice, find_lattice
from sfm.targets.codes.tags import DICTIONARIES
from sfm.targets.fits.saddle import Saddles, measure_saddles

PLATES = ("grid", "checkerboard", "charuco")
UNCODED = -1
LARGER = 1.25  # times the dots around it, from which a dot is a mark
NEIGHBOURS = 2  # rows and columns about a dot that it is compared with
LEAST_DOTS = 9  # that show a plate
FLAGS = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE


@dataclass(frozen=True)
class PlateFamily:
    """A calibration plate."""

    name: str
    """one of PLATES"""
    rows: int
    """rows of dots, or of crossings inside a board"""
    columns: int
    """columns of the same"""
    marks: tuple[tuple[int, int], ...] = ()
    """row and column of the dots that are larger than the others, or rings"""
    dictionary: str = ""
    """tags of a ChArUco board, a name in tags.DICTIONARIES"""
    tag_share: float = 0.0
    """side of these tags, in squares"""

    @property
    def count(self) -> int:
        """Number of points."""
        return self.rows * self.columns

    def plane(self, pitch: float) -> FloatArray:
        """Return the points in the plane of the plate, x to the right, y up, z towards the camera, (n, 3)."""
        row, column = np.divmod(np.arange(self.count), self.columns)
        return np.stack([pitch * column, -pitch * row, np.zeros(self.count)], axis=1)


def name_dots(xy: FloatArray, radius: FloatArray, is_ring: BoolArray, plate: PlateFamily) -> IntArray:
    """Return which point of a plate each dot is, UNCODED where none, (k,).

    Args:
        xy: centres of the dots and of the insides of rings, px, (k, 2).
        radius: mean semi-axes, px, (k,).
        is_ring: which are insides of rings, (k,).
        plate: the plate.
    """
    code = np.full(len(xy), UNCODED)
    lattice = find_lattice(xy, ~is_ring)
    if lattice is None or len(lattice.rows) < LEAST_DOTS:
        return code
    own, ring = radius[lattice.rows], is_ring[lattice.rows]
    placed = _placed(lattice, ring | (own > LARGER * _usual_radius(lattice, own, ring)), plate)
    if placed is not None:
        code[lattice.rows] = placed
    return code


def find_crossings(
    photograph: AnyArray, plate: PlateFamily, *, scale: float, noise: float
) -> tuple[Saddles, IntArray]:
    """Find, name and measure the crossings of a checkerboard or ChArUco board in a photograph.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16.
        plate: the board.
        scale: largest intensity that the photograph can hold.
        noise: standard deviation of an intensity.

    Returns:
        The crossings, and which point of the plate each is.

    Source: OpenCV's finders (Duda and Frese 2018, for the checkerboard) for place and name; measured by
    `measure_saddles`.
    """
    grey = photograph if photograph.dtype == np.uint8 else cv2.convertScaleAbs(photograph, alpha=255 / scale)
    if plate.name == "charuco":
        xy, code = _charuco(grey, plate)
    else:
        xy, code = _checkerboard(grey, plate)
    saddles = measure_saddles(photograph, xy, _spacing(xy), noise=noise)
    good = np.isfinite(saddles.xy[:, 0])
    return saddles.select(good), code[good]


def refuse_unusable_plate(plate: PlateFamily) -> None:
    """Raise GeometryError where marks are not on the plate, or look alike turned by a quarter."""
    for row, column in plate.marks:
        if not (0 <= row < plate.rows and 0 <= column < plate.columns):
            raise GeometryError(
                f"mark [{row}, {column}] is not on a plate of {plate.rows} rows and {plate.columns} columns "
                "(counted from 0)"
            )
    marks = {(row, column) for row, column in plate.marks}
    for turn in (1, 2, 3) if marks else ():
        turned = [_turned(np.array([mark]), turn)[0] for mark in plate.marks]
        low = np.min(turned, axis=0) - np.min(plate.marks, axis=0)
        if {(int(r - low[0]), int(c - low[1])) for r, c in turned} == marks:
            raise GeometryError(
                f"the marks look alike turned by {90 * turn} degrees: they do not tell how a photograph "
                "shows the plate"
            )


def _usual_radius(lattice: Lattice, radius: FloatArray, is_ring: BoolArray) -> FloatArray:
    """Return the median radius of the dots about each place of a lattice, as perspective has it, (k,)."""
    dots = np.flatnonzero(~is_ring)
    usual = np.empty(len(radius))
    for k, place in enumerate(lattice.place):
        near = np.abs(lattice.place[dots] - place).max(axis=1) <= NEIGHBOURS
        usual[k] = np.median(radius[dots[near]]) if near.any() else np.inf
    return usual


def _placed(lattice: Lattice, is_mark: BoolArray, plate: PlateFamily) -> IntArray | None:
    """Return the point of the plate at each place of a lattice; None where the marks do not tell it."""
    if not plate.marks:
        return _placed_whole(lattice, plate)
    marks = np.array(plate.marks)
    found: list[IntArray] = []
    for turn in range(4):
        place = _turned(lattice.place, turn)
        if not is_mark.any():
            return None
        first = place[is_mark][0]
        for mark in marks:
            moved = place + mark - first
            inside = (moved >= 0).all(axis=1) & (moved < (plate.rows, plate.columns)).all(axis=1)
            code = moved[:, 0] * plate.columns + moved[:, 1]
            expected = np.isin(code, marks[:, 0] * plate.columns + marks[:, 1]) & inside
            if inside.all() and (expected == is_mark).all():
                found.append(code)
    return found[0] if len(found) == 1 else None


def _placed_whole(lattice: Lattice, plate: PlateFamily) -> IntArray | None:
    """Return the points of a plate without marks that is seen whole, turned as little as can be."""
    best: tuple[float, IntArray] | None = None
    for turn in range(4):
        place = _turned(lattice.place, turn)
        place = place - place.min(axis=0)
        if tuple(place.max(axis=0) + 1) != (plate.rows, plate.columns):
            continue
        x = lattice.xy[:, 0] - lattice.xy[:, 0].mean()
        upright = float(x @ (place[:, 1] - place[:, 1].mean()))  # columns to the right
        if best is None or upright > best[0]:
            best = upright, place[:, 0] * plate.columns + place[:, 1]
    return None if best is None else best[1]


def _turned(place: IntArray, quarters: int) -> IntArray:
    """Return rows and columns turned by quarters, (k, 2)."""
    row, column = place.T
    turned = ((row, column), (column, -row), (-row, -column), (-column, row))[quarters]
    return np.stack(turned, axis=1)


def _checkerboard(grey: AnyArray, plate: PlateFamily) -> tuple[FloatArray, IntArray]:
    """Return the crossings of a checkerboard and their points, upright or by the colours of its squares.

    A board that OpenCV does not find whole may be one that the border of the photograph cuts.
    """
    found, corners = cv2.findChessboardCornersSB(grey, (plate.columns, plate.rows), flags=FLAGS)
    if not found:
        return name_cut_board(grey, plate.rows, plate.columns)
    xy = np.asarray(corners, dtype=float).reshape(plate.rows, plate.columns, 2)
    across, down = xy[0, -1] - xy[0, 0], xy[-1, 0] - xy[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:  # seen from behind
        xy = xy[:, ::-1]
    turned = xy[::-1, ::-1]
    if (plate.rows + plate.columns) % 2:
        swap = _first_square(grey, xy) > _first_square(grey, turned)  # the first square is the dark one
    else:
        swap = (xy[0, -1] - xy[0, 0])[0] < 0
    xy = turned if swap else xy
    return xy.reshape(-1, 2), np.arange(plate.count)


def _first_square(grey: AnyArray, xy: FloatArray) -> float:
    """Return the intensity in the middle of the first square inside the crossings."""
    x, y = xy[:2, :2].reshape(-1, 2).mean(axis=0)
    return float(cv2.getRectSubPix(grey, (3, 3), (float(x), float(y))).mean())


def _charuco(grey: AnyArray, plate: PlateFamily) -> tuple[FloatArray, IntArray]:
    """Return the crossings of a ChArUco board and their points."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARIES[plate.dictionary]))
    board = cv2.aruco.CharucoBoard((plate.columns + 1, plate.rows + 1), 1.0, plate.tag_share, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
    if ids is None or len(ids) == 0:
        return np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
    return np.asarray(corners, dtype=float).reshape(-1, 2), np.asarray(ids).reshape(-1).astype(np.int64)


def _spacing(xy: FloatArray) -> FloatArray:
    """Return the distance of each crossing from the nearest other one, px, (k,)."""
    if len(xy) < 2:
        return np.zeros(len(xy))
    distance = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    np.fill_diagonal(distance, np.inf)
    return np.asarray(distance.min(axis=1))
