"""AprilGrids: tags in rows, numbered along them from the lower left, and black squares at their corners.

A tag and the squares at its corners touch as squares of a checkerboard do, so that its corners are crossings.
That hides the tags from finders of outlines: regions darker than where they touch are opened first, which
parts them, and the tags are read where their measured corners place them. Kalibr prints tags with a border
of two modules, other programs with one, and turned in different ways: the turn in which the corners of all
tags are those of one plane is taken.

Source: Kalibr (github.com/ethz-asl/kalibr), calibration targets; Olson (2011), ICRA, for the tags.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from sfm.conventions import AnyArray, FloatArray, IntArray
from sfm.targets.codes.plates import APRIL_BORDERS, MAX_OFF_PLACE, PlateFamily
from sfm.targets.codes.tags import CORRECTED, WRONG_IN_BORDER, opencv_dictionary
from sfm.targets.fits.saddle import MAX_HALF_SPACINGS, measure_saddles
from sfm.targets.outlines import MIN_STEP, STEP_SIGMAS, estimate_noise

OPENED_PX = (1, 3, 5)  # sides of the window that opens dark regions
WINDOWS = (8, 24)  # of the threshold, parts of the larger side of the photograph
# Of the range of intensities in the window, below which it is dark: midway to the half where squares touch.
DARK_FRACTION = 0.25
MIN_MODULE_PX = 2.0  # of a tag that is read: no less separates one black module from one clear one (Nyquist)
SPACING = 0.2  # of the side of a tag, between crossings at first
CELL_PX = 8  # side of a module where a tag is read
MIN_TAGS = 2  # that show how tags are turned


def read_april_tags(grey: AnyArray, dictionary: str) -> tuple[IntArray, FloatArray]:
    """Return numbers (t,) and corners (t, 4, 2), px, of tags that squares touch, with the border most have.

    Args:
        grey: intensities, uint8, (H, W).
        dictionary: of the tags, a name in tags.DICTIONARIES.

    Returns:
        Tags that were read once; their corners from any one on, the same of all tags.
    """
    modules = opencv_dictionary(dictionary).markerSize + 2 * min(APRIL_BORDERS)
    quads = _unique(np.array(list(_outlines(grey, MIN_MODULE_PX * modules))).reshape(-1, 4, 2))
    side = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2).min(axis=1)
    xy = measure_saddles(
        grey, quads.reshape(-1, 2), np.repeat(MAX_HALF_SPACINGS * SPACING * side, 4), noise=1.0
    ).xy
    quads = np.where(np.isfinite(xy), xy, quads.reshape(-1, 2)).reshape(-1, 4, 2)
    best: list[tuple[int, FloatArray]] = []
    for border in APRIL_BORDERS:
        read = [_read(grey, quad, opencv_dictionary(dictionary), border) for quad in quads]
        tags = [(number, np.roll(quad, turn, axis=0))
                for quad, (number, turn) in zip(quads, read, strict=True) if number >= 0]  # fmt: skip
        best = max(best, tags, key=len)
    number = np.array([one for one, _ in best], dtype=np.int64)
    values, first, times = np.unique(number, return_index=True, return_counts=True)
    corners = np.array([quad for _, quad in best]).reshape(-1, 4, 2)
    return values[times == 1], corners[first[times == 1]]


def _outlines(grey: AnyArray, min_side_px: float) -> Iterator[FloatArray]:
    """Return the corners of dark regions of four sides, clockwise, px, each (4, 2).

    How straight sides are is judged as OpenCV does where it looks for tags.
    """
    smooth = cv2.GaussianBlur(grey, (3, 3), 0)
    min_range = max(STEP_SIGMAS * estimate_noise(grey), 255 * MIN_STEP)
    straight = cv2.aruco.DetectorParameters().polygonalApproxAccuracyRate
    for part in WINDOWS:
        window = max(grey.shape) // part | 1
        around = np.ones((window, window), np.uint8)
        low, high = (
            cv2.erode(smooth, around).astype(np.float32),
            cv2.dilate(smooth, around).astype(np.float32),
        )
        dark = ((smooth < low + DARK_FRACTION * (high - low)) & (high - low > min_range)).astype(np.uint8)
        for side in OPENED_PX:
            opened = cv2.morphologyEx(dark, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
            for outline in cv2.findContours(opened, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
                length = cv2.arcLength(outline, True)
                if length < 4 * min_side_px:
                    continue
                quad = cv2.approxPolyDP(outline, straight * length, True).reshape(-1, 2)
                if len(quad) == 4 and cv2.isContourConvex(quad) and cv2.contourArea(quad) > min_side_px**2:
                    clockwise = cv2.contourArea(quad, True) > 0  # y runs down
                    yield (quad if clockwise else quad[::-1]).astype(float)


def _unique(quads: FloatArray) -> FloatArray:
    """Return quadrangles without those about the middle of an earlier one of the same size."""
    kept: list[FloatArray] = []
    middles = np.zeros((0, 3))
    for quad in quads:
        middle = np.append(quad.mean(axis=0), np.sqrt(abs(cv2.contourArea(quad.astype(np.float32)))))
        if (np.abs(middles - middle).max(axis=1, initial=0) > SPACING * middle[2]).all():
            kept.append(quad)
            middles = np.vstack([middles, middle])
    return np.array(kept).reshape(-1, 4, 2)


def _read(grey: AnyArray, quad: FloatArray, dictionary: cv2.aruco.Dictionary, border: int) -> tuple[int, int]:
    """Return the number of a tag and its turn in quarters, -1 where it has none."""
    m = dictionary.markerSize + 2 * border
    end = m * CELL_PX - 0.5
    square = np.array([[-0.5, -0.5], [end, -0.5], [end, end], [-0.5, end]], dtype=np.float32)
    H = cv2.getPerspectiveTransform(quad.astype(np.float32), square)
    flat = cv2.warpPerspective(grey, H, (m * CELL_PX, m * CELL_PX)).reshape(m, CELL_PX, m, CELL_PX)
    level = flat[:, CELL_PX // 4 : -CELL_PX // 4, :, CELL_PX // 4 : -CELL_PX // 4].mean(axis=(1, 3))
    inner = np.zeros((m, m), dtype=bool)
    inner[border:-border, border:-border] = True
    dark, bright = float(np.median(level[~inner])), float(np.quantile(level[inner], 0.9))
    white = level > (dark + bright) / 2
    if bright <= dark or white[~inner].mean() > WRONG_IN_BORDER:
        return -1, 0
    bits = white[border:-border, border:-border].astype(np.uint8)
    found, number, turn = dictionary.identify(bits, CORRECTED)
    return (int(number), int(turn)) if found else (-1, 0)


def name_corners(number: IntArray, quads: FloatArray, plate: PlateFamily) -> tuple[FloatArray, IntArray]:
    """Return the corners of the tags of a grid, px, (k, 2), and which point of it each is, (k,).

    Args:
        number: of the tags in a photograph, (t,).
        quads: their corners, px, (t, 4, 2), from any one on, the same of all tags.
        plate: the grid.
    """
    count = plate.rows * plate.columns // 4
    on_plate = (number >= plate.first_tag) & (number < plate.first_tag + count)
    number, quads = number[on_plate] - plate.first_tag, quads[on_plate]
    none = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
    if len(number) < MIN_TAGS:
        return none
    across = plate.columns // 2
    row, column = plate.rows // 2 - 1 - number // across, number % across
    # upper left, upper right, lower right, lower left
    corner = 2 * np.stack([row, column], axis=1)[:, None] + np.array([[0, 0], [0, 1], [1, 1], [1, 0]])
    code = corner[..., 0] * plate.columns + corner[..., 1]
    plane = plate.plane(1.0)[:, :2]
    best, named = MAX_OFF_PLACE, none
    for turn in range(4):
        xy, true = np.roll(quads, turn, axis=1).reshape(-1, 2), plane[code.ravel()]
        H, _ = cv2.findHomography(xy, true, cv2.LMEDS)
        if H is None:
            continue
        off = np.hypot(*(cv2.perspectiveTransform(xy[None], H)[0] - true).T)
        if float(np.median(off)) < best:
            near = (off.reshape(-1, 4) < MAX_OFF_PLACE).all(axis=1).repeat(4)
            best, named = float(np.median(off)), (xy[near], code.ravel()[near])
    return named


def windows_beside(xy: FloatArray, plate: PlateFamily) -> FloatArray:
    """Return half sides of windows at the corners of tags, four of each in turn, px, (k,).

    They see a part of the square, and of the tag no more than the narrowest border.
    """
    quads = xy.reshape(-1, 4, 2)
    side = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2)
    module = 1 / (opencv_dictionary(plate.dictionary).markerSize + 2 * min(APRIL_BORDERS))
    part = min(MAX_HALF_SPACINGS * (1 / plate.tag_share - 1), min(APRIL_BORDERS) * module)
    return np.asarray(part * np.minimum(side, np.roll(side, -1, axis=1)).ravel())
