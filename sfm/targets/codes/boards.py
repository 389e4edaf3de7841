"""Boards as targets: checkerboards, whole or cut by the border, ChArUco boards and AprilGrids.

Crossings are saddles of the intensity: four sectors around a point that are alternately dark and bright. They
form a lattice. Its orientation follows from the colours of the squares, since the first square is dark. Of
the turns that look alike (see `PlateFamily.turns`), the one that is upright in the photograph is chosen.

A checkerboard may be partly outside the photograph. On each side of the lattice either the board ends,
because the next crossings would still be in the photograph, or the border cuts it. The crossings are named if
the board ends on at least one side in both directions, and the colours of the squares agree. A board whose
naming remains ambiguous is not used.

AprilGrids are rows of tags, numbered along the rows from the lower left, with black squares at their corners.
Tags and squares touch like the squares of a checkerboard, so the corners of tags are crossings. This hides
the tags from outline detectors. Regions darker than these contacts are therefore opened first, which
separates them, and the tags are read where their measured corners place them. Kalibr prints tags with a
border of two modules, other programs with one, and they are rotated differently. The rotation for which the
corners of all tags fit one plane is chosen.

Source: the determinant of the Hessian as detector of saddles, Chen and Zhang (2005), ICMIT; Kalibr
(github.com/ethz-asl/kalibr), calibration targets; Olson (2011), ICRA, for the tags.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy.special import erf

from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.targets.codes.dot_plates import Lattice, find_lattice
from sfm.targets.codes.plates import APRIL_BORDERS, MAX_OFF_PLACE, PlateFamily, quarter_turn
from sfm.targets.codes.tags import CORRECTED, WRONG_IN_BORDER, opencv_dictionary
from sfm.targets.fits.saddle import MAX_HALF_SPACINGS, SMOOTHED_PX, Saddles, measure_saddles, window_half
from sfm.targets.outlines import MIN_STEP, STEP_SIGMAS, as_bytes, estimate_noise

OPENED_PX = (1, 3, 5)  # sides of the window that opens dark regions
WINDOWS = (8, 24)  # sides of the threshold window, as divisors of the photograph's larger side
# Part of the intensity range in the window below which it is dark: half way to the level where squares touch.
DARK_FRACTION = 0.25
MIN_MODULE_PX = 2.0  # of a readable tag: less cannot separate one black module from one clear one (Nyquist)
SPACING = 0.2  # first estimate of the spacing of crossings, in sides of a tag
CELL_PX = 8  # side of a module where a tag is read
MIN_TAGS = 2  # tags needed to determine their rotation
SMOOTHING_PX = 2.0  # standard deviation of the smoothing before saddles are detected
# Minimum strength of a saddle relative to the saddle of this rank.
MIN_SADDLE, STRONG_RANK = 0.15, 20
APART_PX = 9  # side of the window in which a saddle must be the strongest
RADIUS_PX, DIRECTIONS = 5.0, 32  # of the circle on which the four sectors are counted
MIN_CROSSINGS = 12
BORDER_PX = 8.0  # crossings nearer to the border than this may be missed
SHARE_INSIDE = 0.6  # part of the next crossings that must be in the photograph for the board to end there
MIN_CONTRAST_SHARE = 0.15  # between dark and bright squares, of the intensity range of the photograph
FLAGS = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
# Larger side of the reduced photograph in which a checkerboard is searched first. It is found with squares of
# 9 px, in a tenth of the time that a photograph of 8 million px takes.
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
    """Find, name and measure the crossings of boards in a photograph; tags are read once for all boards.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16.
        plates: the boards.
        scale: largest intensity that the photograph can represent.
        noise: standard deviation of an intensity.

    Returns:
        The crossings of each board, and the plate point of each crossing.

    Source: OpenCV's finders (Duda and Frese 2018, for the checkerboard) for position and name; measured by
    `measure_saddles`.
    """
    grey = as_bytes(photograph, scale)
    grids = {plate.dictionary for plate in plates if plate.name == "aprilgrid"}
    tags = {dictionary: read_april_tags(grey, dictionary) for dictionary in grids}
    crossings = []
    for plate in plates:
        if plate.name == "aprilgrid":
            xy, code = name_corners(*tags[plate.dictionary], plate)
            half = windows_beside(xy, plate)
        elif plate.name == "charuco":
            xy, code = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
            for board in charuco_patterns(plate):
                corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
                if ids is not None and len(ids):  # empty for a board with its tags in the other squares
                    xy = np.asarray(corners, dtype=float).reshape(-1, 2)
                    code = np.asarray(ids).reshape(-1).astype(np.int64)
                    break
            half = min(MAX_HALF_SPACINGS, (1 - plate.tag_share) / 2) * _spacing(xy)  # up to the tags
        else:
            xy, code = _checkerboard(grey, plate)
            half = MAX_HALF_SPACINGS * _spacing(xy)
        saddles = measure_saddles(photograph, xy, half, noise=noise)
        if plate.name != "aprilgrid":  # their edges end between corners
            saddles = replace(saddles, xy=saddles.xy + bend_of_edges(saddles, code, plate, half))
        good = np.isfinite(saddles.xy[:, 0])
        crossings.append((saddles.select(good), code[good]))
    return crossings


def bend_of_edges(saddles: Saddles, code: IntArray, plate: PlateFamily, half_px: FloatArray) -> FloatArray:
    """Return what bent edges take from the measured crossings of a board, px, (k, 2).

    A crossing is measured where the tangents of its edges meet. With a curvature K, the tangent at a distance
    t along an edge passes the crossing at K t^2 / 2, and the mean over the window remains. K follows from the
    crossings before and behind, which lie K d^2 / 2 off the straight line. A lens of 190 degrees bends edges
    by 0.03 px in a window of 15 px.

    Args:
        saddles: the measured crossings, (k,).
        code: their numbers on the board, (k,).
        plate: the board.
        half_px: half sides of their windows, px, (k,).
    """
    at = np.full((plate.rows + 2, plate.columns + 2, 2), np.nan)  # with a rim
    row, column = np.divmod(code, plate.columns)
    at[row + 1, column + 1] = saddles.xy
    t2 = _mean_square_along(window_half(half_px), saddles.blur)
    normals, off = np.zeros((len(code), 2, 2)), np.zeros((len(code), 2))
    for axis, (down, across) in enumerate(((0, 1), (1, 0))):
        before, behind = np.roll(at, (down, across), axis=(0, 1)), np.roll(at, (-down, -across), axis=(0, 1))
        along = (behind - before) / 2
        normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
        # (1/d^2) of the offset, times the normal of length d
        curvature = (((before + behind) / 2 - at) * normal).sum(axis=-1) / np.hypot(
            *np.moveaxis(along, -1, 0)
        ) ** 3
        for side in (-1, 1):  # at the ends of a row that of the next crossing
            beside = np.roll(curvature, (side * down, side * across), axis=(0, 1))
            curvature = np.where(np.isfinite(curvature), curvature, beside)
        tangent = np.where(np.isfinite(along), along, np.where(np.isfinite(behind), behind - at, at - before))
        tangent = tangent[row + 1, column + 1]
        tangent /= np.hypot(*tangent.T)[:, None]
        normals[:, axis] = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        off[:, axis] = curvature[row + 1, column + 1] * t2
    known = np.isfinite(off).all(axis=1) & np.isfinite(normals).all(axis=(1, 2))
    shift = np.zeros((len(code), 2))
    shift[known] = np.linalg.solve(normals[known], off[known][..., None])[..., 0]
    return shift


def _mean_square_along(half: IntArray, blur: FloatArray) -> FloatArray:
    """Return the weighted mean square of distances along an edge from its crossing, px^2, (k,).

    Weights are those of the window, times the squared contrast of the edge, which is 0 at the crossing.
    """
    t = (np.arange(64) + 0.5) / 64 * (half[:, None] + 0.5)
    wide = np.hypot(np.where(np.isfinite(blur), blur, 0.0), SMOOTHED_PX)[:, None]
    weight = np.exp(-2 * (t / half[:, None]) ** 2) * erf(t / (np.sqrt(2) * wide)) ** 2
    return np.asarray((weight * t * t).sum(axis=1) / weight.sum(axis=1))


def _checkerboard(grey: AnyArray, plate: PlateFamily) -> tuple[FloatArray, IntArray]:
    """Return the crossings of a checkerboard and their points, upright or by the colours of its squares.

    Saddles of the reduced photograph that are the whole board need a sixth of the time of OpenCV's finder,
    which comes next. The search then allows for a board cut by the border, and then uses the full photograph
    if the squares are too small. OpenCV's older finder accepts boards without a white rim.
    """
    size = plate.columns, plate.rows
    small, scale = reduce_photograph(grey, REDUCED_PX)
    xy, code = name_cut_board(small, plate.rows, plate.columns)
    if len(code) == plate.count:
        return (xy[np.argsort(code)] + 0.5) / scale - 0.5, np.arange(plate.count)
    is_found, corners = cv2.findChessboardCornersSB(small, size, flags=FLAGS)
    if not is_found:
        xy, code = name_cut_board(grey, plate.rows, plate.columns)
        if len(code):
            return xy, code
        scale = 1.0
        if small is not grey:
            is_found, corners = cv2.findChessboardCornersSB(grey, size, flags=FLAGS)
    if not is_found:
        is_found, corners = cv2.findChessboardCorners(grey, size, flags=OLDER_FLAGS)
    if not is_found:
        return np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
    xy = ((np.asarray(corners, dtype=float) + 0.5) / scale - 0.5).reshape(plate.rows, plate.columns, 2)
    across, down = xy[0, -1] - xy[0, 0], xy[-1, 0] - xy[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:  # seen from behind
        xy = xy[:, ::-1]
    ways = [np.rot90(xy, k) for k in ((0, 2) if plate.rows != plate.columns else range(4))]
    step = len(ways) // (1 + len(plate.turns))  # between ways in which the first square has the same colour

    def first_square(turns: Sequence[FloatArray]) -> float:
        middles = [way[:2, :2].reshape(-1, 2).mean(axis=0) for way in turns]
        return float(
            np.mean([cv2.getRectSubPix(grey, (3, 3), (float(x), float(y))).mean() for x, y in middles])
        )

    alike = min((ways[k::step] for k in range(step)), key=first_square)  # it is dark
    xy = max(alike, key=lambda way: float((way[:, -1] - way[:, 0]).mean(axis=0)[0]))
    return xy.reshape(-1, 2), np.arange(plate.count)


def reduce_photograph(grey: AnyArray, largest_px: int) -> tuple[AnyArray, float]:
    """Return a photograph reduced to a maximum size, and its scale relative to the original."""
    scale = min(1.0, largest_px / max(grey.shape))
    if scale == 1.0:
        return grey, scale
    height, width = (max(1, round(scale * side)) for side in grey.shape)
    return np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)), scale


def charuco_patterns(plate: PlateFamily) -> list[cv2.aruco.CharucoBoard]:
    """Return the boards with these rows and columns: the tags begin in the second or in the first square.

    Tags beginning in the first square are those of OpenCV before 4.6, for an even number of rows of squares.
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


def name_cut_board(grey: AnyArray, rows: int, columns: int) -> tuple[FloatArray, IntArray]:
    """Return the crossings of a checkerboard that is partly visible, and their numbers on the board.

    Args:
        grey: photograph, uint8, shape (H, W).
        rows: rows of crossings of the whole board.
        columns: columns of crossings of the whole board.

    Returns:
        Positions, px, (k, 2), and numbers row * columns + column, (k,); empty if the numbers are ambiguous.
    """
    none = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
    lattice = _lattice_of_saddles(grey)
    if lattice is None:
        return none
    dark = _dark_squares(grey, lattice)
    if dark is None:
        return none
    numberings: list[tuple[int, IntArray]] = []
    for turn in range(4):
        turned = quarter_turn(lattice.place, turn)
        turned = turned - turned.min(axis=0)
        ends = board_ends(lattice.xy, turned, grey.shape)
        size = turned.max(axis=0) + 1
        offsets = []  # of the first visible row and column; none if it is ambiguous
        for seen, of_board, (before, behind) in zip(size.tolist(), (rows, columns), ends, strict=True):
            if seen == of_board:
                offsets.append(0)
            elif seen < of_board and before != behind:
                offsets.append(0 if before else of_board - seen)
        if len(offsets) < 2:
            continue
        moved = turned + np.array(offsets)
        if (moved[dark].min(axis=1).sum(axis=1) % 2 == 0).all():  # the first square of the board is dark
            numberings.append((turn, moved[:, 0] * columns + moved[:, 1]))
    if len(numberings) == 2 and (numberings[0][0] - numberings[1][0]) % 4 == 2:  # it looks alike upside down
        x = lattice.xy[:, 0] - lattice.xy[:, 0].mean()
        numberings = [
            (turn, number)
            for turn, number in numberings
            if float(x @ (number % columns - (number % columns).mean())) > 0  # columns run to the right
        ]
    return (lattice.xy, numberings[0][1]) if len(numberings) == 1 else none


def find_filled_board(grey: AnyArray) -> Lattice | None:
    """Return the crossings of a checkerboard in a photograph (uint8), if they fill rows and columns.

    Neighbours are predicted from one another, so a wide-angle lens may bend the board.
    """
    lattice = _lattice_of_saddles(grey)
    if lattice is None or len(lattice.rows) < lattice.box:
        return None
    return None if _dark_squares(grey, lattice) is None else lattice


def _lattice_of_saddles(grey: AnyArray) -> Lattice | None:
    """Return the lattice of the crossings of a photograph (uint8); None of fewer than a board has."""
    xy = find_saddles(grey)
    lattice = find_lattice(xy, np.ones(len(xy), dtype=bool)) if len(xy) >= MIN_CROSSINGS else None
    return lattice.by_shortest_box() if lattice is not None and len(lattice.rows) >= MIN_CROSSINGS else None


def find_saddles(grey: AnyArray) -> FloatArray:
    """Return positions with four alternately dark and bright sectors around them, px, (k, 2).

    They are where parabolas through the strengths beside the strongest pixel are highest, to about 0.1 px.
    """
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTHING_PX)
    xx, yy = cv2.Sobel(smooth, cv2.CV_32F, 2, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 2)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1)
    saddle = np.maximum(np.asarray(xy * xy - xx * yy), 0)
    highest = cv2.dilate(saddle, np.ones((APART_PX, APART_PX), np.uint8))
    row, column = np.nonzero((saddle == highest) & (saddle > 0))
    value = saddle[row, column]
    if len(value) < STRONG_RANK:
        return np.zeros((0, 2))
    strong = value > MIN_SADDLE * np.sort(value)[-STRONG_RANK]
    row, column = row[strong], column[strong]
    candidates = np.stack([column, row], axis=1).astype(np.float64)
    around = np.pad(saddle, 1, mode="edge")
    for axis, (right, below) in enumerate(((1, 0), (0, 1))):
        before = around[row + 1 - below, column + 1 - right]
        behind = around[row + 1 + below, column + 1 + right]
        bend = 2.0 * saddle[row, column] - before - behind
        bent = bend > 0
        candidates[bent, axis] += (behind - before)[bent] / (2.0 * bend[bent])
    # the intensity crosses its mean four times on a circle around a saddle
    t = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    x = (candidates[:, :1] + RADIUS_PX * np.cos(t)).astype(np.float32)
    y = (candidates[:, 1:] + RADIUS_PX * np.sin(t)).astype(np.float32)
    ring = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    above = ring > (ring.max(axis=1, keepdims=True) + ring.min(axis=1, keepdims=True)) / 2
    return np.asarray(candidates[(above != np.roll(above, 1, axis=1)).sum(axis=1) == 4])


def _dark_squares(grey: AnyArray, lattice: Lattice) -> IntArray | None:
    """Return the crossings at the corners of dark squares, (m, 4); None if all squares look alike."""
    at = {(int(r), int(c)): k for k, (r, c) in enumerate(lattice.place)}
    squares: list[list[list[int]]] = [[], []]
    value: list[list[float]] = [[], []]
    for r, c in at:
        corners = [at[r + i, c + j] for i in (0, 1) for j in (0, 1) if (r + i, c + j) in at]
        if len(corners) == 4:
            x, y = lattice.xy[corners].mean(axis=0)
            squares[(r + c) % 2].append(corners)
            value[(r + c) % 2].append(float(grey[round(y), round(x)]))
    if not value[0] or not value[1]:
        return None
    even, odd = (float(np.median(values)) for values in value)
    return None if abs(even - odd) < MIN_CONTRAST_SHARE * np.ptp(grey) else np.array(squares[int(even > odd)])


def board_ends(xy: FloatArray, place: IntArray, shape: tuple[int, ...]) -> list[tuple[bool, bool]]:
    """Return for rows and columns whether the board ends before the first and after the last of them."""
    height, width = shape[:2]
    at = {(int(r), int(c)): k for k, (r, c) in enumerate(place)}
    ends = []
    for axis in range(2):
        of_axis = []
        for outermost, inwards in ((0, 1), (int(place[:, axis].max()), -1)):
            inside = []
            for k in np.flatnonzero(place[:, axis] == outermost):
                before = place[k].copy()
                before[axis] += inwards
                j = at.get((int(before[0]), int(before[1])))
                if j is not None:
                    x, y = 2 * xy[k] - xy[j]
                    inside.append(
                        BORDER_PX < x < width - 1 - BORDER_PX and BORDER_PX < y < height - 1 - BORDER_PX
                    )
            of_axis.append(bool(inside) and float(np.mean(inside)) > SHARE_INSIDE)
        ends.append((of_axis[0], of_axis[1]))
    return ends


def read_april_tags(grey: AnyArray, dictionary: str) -> tuple[IntArray, FloatArray]:
    """Return numbers (t,) and corners (t, 4, 2), px, of tags touched by squares, with the commonest border.

    Args:
        grey: intensities, uint8, (H, W).
        dictionary: dictionary of the tags, a name in tags.DICTIONARIES.

    Returns:
        Tags that were read exactly once; their corners start at any corner, the same for all tags.
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
    number = np.array([tag for tag, _ in best], dtype=np.int64)
    values, first, times = np.unique(number, return_index=True, return_counts=True)
    corners = np.array([quad for _, quad in best]).reshape(-1, 4, 2)
    return values[times == 1], corners[first[times == 1]]


def _outlines(grey: AnyArray, min_side_px: float) -> Iterator[FloatArray]:
    """Yield the corners of dark regions with four sides, clockwise, px, each (4, 2).

    The tolerance for straight sides is OpenCV's for detecting tags.
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
    """Return quadrilaterals without those that have about the centre and size of an earlier one."""
    kept: list[FloatArray] = []
    middles = np.zeros((0, 3))
    for quad in quads:
        middle = np.append(quad.mean(axis=0), np.sqrt(abs(cv2.contourArea(quad.astype(np.float32)))))
        if (np.abs(middles - middle).max(axis=1, initial=0) > SPACING * middle[2]).all():
            kept.append(quad)
            middles = np.vstack([middles, middle])
    return np.array(kept).reshape(-1, 4, 2)


def _read(grey: AnyArray, quad: FloatArray, dictionary: cv2.aruco.Dictionary, border: int) -> tuple[int, int]:
    """Return the number of a tag and its rotation in quarter turns; the number is -1 if it has none."""
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
    is_read, number, turn = dictionary.identify(bits, CORRECTED)
    return (int(number), int(turn)) if is_read else (-1, 0)


def name_corners(number: IntArray, quads: FloatArray, plate: PlateFamily) -> tuple[FloatArray, IntArray]:
    """Return the corners of the tags of a grid, px, (k, 2), and the grid point of each corner, (k,).

    Args:
        number: numbers of the tags in a photograph, (t,).
        quads: their corners, px, (t, 4, 2), starting at any corner, the same for all tags.
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
    """Return half sides of windows at the corners of tags, four per tag in order, px, (k,).

    A window covers part of the square, and of the tag at most the narrowest border.
    """
    quads = xy.reshape(-1, 4, 2)
    side = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2)
    module = 1 / (opencv_dictionary(plate.dictionary).markerSize + 2 * min(APRIL_BORDERS))
    part = min(MAX_HALF_SPACINGS * (1 / plate.tag_share - 1), min(APRIL_BORDERS) * module)
    return np.asarray(part * np.minimum(side, np.roll(side, -1, axis=1)).ravel())
