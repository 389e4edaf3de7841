"""Boards as targets: the crossings of checkerboards, ChArUco boards and AprilGrids, and which they are.

A checkerboard may be cut by the border of the photograph on one of two opposite sides. How it is turned
follows from its colours, the first square being the dark one. Of the turns that look alike (see
`PlateFamily.turns`) the one that is upright in the photograph is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from sfm.conventions import AnyArray, FloatArray, IntArray
from sfm.targets.codes.april_grids import name_corners, read_april_tags, windows_beside
from sfm.targets.codes.cut_boards import name_cut_board
from sfm.targets.codes.plates import PlateFamily
from sfm.targets.codes.tags import opencv_dictionary
from sfm.targets.fits.saddle import MAX_HALF_SPACINGS, Saddles, measure_saddles
from sfm.targets.outlines import as_bytes

FLAGS = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
# Larger side of the photograph in which a checkerboard is sought first. Squares of 9 px are found there, in a
# tenth of the time that a photograph of 8 million px takes.
REDUCED_PX = 800
OLDER_FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK


def find_crossings(
    photograph: AnyArray, plate: PlateFamily, *, scale: float, noise: float
) -> tuple[Saddles, IntArray]:
    """Find, name and measure the crossings of a board in a photograph; see `find_boards`."""
    return find_boards(photograph, (plate,), scale=scale, noise=noise)[0]


def find_boards(
    photograph: AnyArray, plates: Sequence[PlateFamily], *, scale: float, noise: float
) -> list[tuple[Saddles, IntArray]]:
    """Find, name and measure the crossings of boards in a photograph; tags of several are read once.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16.
        plates: the boards.
        scale: largest intensity that the photograph can hold.
        noise: standard deviation of an intensity.

    Returns:
        The crossings of each, and which point of the plate each is.

    Source: OpenCV's finders (Duda and Frese 2018, for the checkerboard) for place and name; measured by
    `measure_saddles`.
    """
    grey = as_bytes(photograph, scale)
    grids = {plate.dictionary for plate in plates if plate.name == "aprilgrid"}
    tags = {dictionary: read_april_tags(grey, dictionary) for dictionary in grids}
    found = []
    for plate in plates:
        if plate.name == "aprilgrid":
            xy, code = name_corners(*tags[plate.dictionary], plate)
            half = windows_beside(xy, plate)
        elif plate.name == "charuco":
            xy, code = _charuco(grey, plate)
            half = min(MAX_HALF_SPACINGS, (1 - plate.tag_share) / 2) * _spacing(xy)  # as far as tags begin
        else:
            xy, code = _checkerboard(grey, plate)
            half = MAX_HALF_SPACINGS * _spacing(xy)
        saddles = measure_saddles(photograph, xy, half, noise=noise)
        good = np.isfinite(saddles.xy[:, 0])
        found.append((saddles.select(good), code[good]))
    return found


def _checkerboard(grey: AnyArray, plate: PlateFamily) -> tuple[FloatArray, IntArray]:
    """Return the crossings of a checkerboard and their points, upright or by the colours of its squares.

    Sought in the reduced photograph first, then as one that the border may cut; in the photograph as it is
    where squares are too small for that. OpenCV's older finder takes boards without a white rim.
    """
    size = plate.columns, plate.rows
    small, scale = reduced(grey, REDUCED_PX)
    found, corners = cv2.findChessboardCornersSB(small, size, flags=FLAGS)
    if not found:
        xy, code = name_cut_board(grey, plate.rows, plate.columns)
        if len(code):
            return xy, code
        scale = 1.0
        if small is not grey:
            found, corners = cv2.findChessboardCornersSB(grey, size, flags=FLAGS)
    if not found:
        found, corners = cv2.findChessboardCorners(grey, size, flags=OLDER_FLAGS)
    if not found:
        return np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
    xy = ((np.asarray(corners, dtype=float) + 0.5) / scale - 0.5).reshape(plate.rows, plate.columns, 2)
    across, down = xy[0, -1] - xy[0, 0], xy[-1, 0] - xy[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:  # seen from behind
        xy = xy[:, ::-1]
    ways = [np.rot90(xy, k) for k in ((0, 2) if plate.rows != plate.columns else range(4))]
    step = len(ways) // (1 + len(plate.turns))  # between those in which the first square has one colour
    alike = min((ways[k::step] for k in range(step)), key=lambda some: _first_squares(grey, some))
    xy = max(alike, key=lambda way: float((way[:, -1] - way[:, 0]).mean(axis=0)[0]))
    return xy.reshape(-1, 2), np.arange(plate.count)


def reduced(grey: AnyArray, largest_px: int) -> tuple[AnyArray, float]:
    """Return a photograph of at most this size, and its size in parts of that of the photograph."""
    scale = min(1.0, largest_px / max(grey.shape))
    if scale == 1.0:
        return grey, scale
    height, width = (max(1, round(scale * side)) for side in grey.shape)
    return np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)), scale


def _first_squares(grey: AnyArray, ways: Sequence[FloatArray]) -> float:
    """Return the mean intensity in the middle of the first square inside the crossings, in some turns."""
    middles = [way[:2, :2].reshape(-1, 2).mean(axis=0) for way in ways]
    return float(np.mean([cv2.getRectSubPix(grey, (3, 3), (float(x), float(y))).mean() for x, y in middles]))


def _charuco(grey: AnyArray, plate: PlateFamily) -> tuple[FloatArray, IntArray]:
    """Return the crossings of a ChArUco board and their points."""
    for board in charuco_patterns(plate):
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
        if ids is not None and len(ids):  # none are found on a board whose tags are elsewhere
            code = np.asarray(ids).reshape(-1).astype(np.int64)
            return np.asarray(corners, dtype=float).reshape(-1, 2), code
    return np.zeros((0, 2)), np.zeros(0, dtype=np.int64)


def charuco_patterns(plate: PlateFamily) -> list[cv2.aruco.CharucoBoard]:
    """Return the boards of these rows and columns: the tags begin in the second square, or in the first.

    The latter is that of OpenCV before 4.6 where rows of squares are even in number.
    """
    size = plate.columns + 1, plate.rows + 1
    numbers = plate.first_tag + np.arange(size[0] * size[1] // 2)
    boards = []
    for is_older in (False, True) if size[1] % 2 == 0 else (False,):
        board = cv2.aruco.CharucoBoard(
            size, 1.0, plate.tag_share, opencv_dictionary(plate.dictionary), numbers
        )
        board.setLegacyPattern(is_older)
        boards.append(board)
    return boards


def _spacing(xy: FloatArray) -> FloatArray:
    """Return the distance of each crossing from the nearest other one, px, (k,)."""
    if len(xy) < 2:
        return np.zeros(len(xy))
    distance = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    np.fill_diagonal(distance, np.inf)
    return np.asarray(distance.min(axis=1))
