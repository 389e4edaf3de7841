"""Checkerboards of which a photograph shows a part: named by the borders of the board that it does show.

Crossings are saddles of the intensity: four sectors about a point that are dark and bright by turns. They
make a lattice. On each side of it the board ends where the next crossings would still be in the photograph,
or the photograph cuts it. A board that ends on one side at least in both directions is named, with the
colours of its squares; one whose naming stays uncertain is not.

Source: the determinant of the Hessian as detector of saddles, Chen and Zhang (2005), ICMIT.
"""

from __future__ import annotations

import cv2
import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.targets.codes.lattice import Lattice, find_lattice
from sfm.targets.codes.plates import quarter_turn

SMOOTHING_PX = 2.0
# Saddles below this share of the strong ones are none; the strong ones are those of this rank.
MIN_SADDLE, STRONG_RANK = 0.15, 20
APART_PX = 9  # side of the window in which a saddle is the strongest
RADIUS_PX, DIRECTIONS = 5.0, 32  # of the circle on which the four sectors are counted
MIN_CROSSINGS = 12
BORDER_PX = 8.0  # what is nearer to the border than this need not be found
SHARE_INSIDE = 0.6  # of the next crossings are in the photograph where the board ends
MIN_CONTRAST_SHARE = 0.15  # between dark and bright squares, of the range of the photograph


def name_cut_board(grey: AnyArray, rows: int, columns: int) -> tuple[FloatArray, IntArray]:
    """Return the crossings of a checkerboard that is seen in part and which of the board they are.

    Args:
        grey: photograph, uint8, shape (H, W).
        rows: rows of crossings of the whole board.
        columns: columns of the same.

    Returns:
        Places, px, (k, 2), and numbers row * columns + column, (k,); none where they are not certain.
    """
    none = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
    xy = find_saddles(grey)
    lattice = find_lattice(xy, np.ones(len(xy), dtype=bool)) if len(xy) >= MIN_CROSSINGS else None
    if lattice is None or len(lattice.rows) < MIN_CROSSINGS:
        return none
    dark = _dark_squares(grey, lattice)
    if dark is None:
        return none
    found: list[tuple[int, IntArray]] = []
    for turn in range(4):
        turned = quarter_turn(lattice.place, turn)
        turned = turned - turned.min(axis=0)
        ends = board_ends(lattice.xy, turned, grey.shape)
        size = turned.max(axis=0) + 1
        offsets = [_offset(int(size[k]), (rows, columns)[k], ends[k]) for k in range(2)]
        if offsets[0] is None or offsets[1] is None:
            continue
        moved = turned + np.array(offsets)
        if (moved[dark].min(axis=1).sum(axis=1) % 2 == 0).all():  # the first square of the board is dark
            found.append((turn, moved[:, 0] * columns + moved[:, 1]))
    if len(found) == 2 and (found[0][0] - found[1][0]) % 4 == 2:  # it looks alike upside down
        found = [one for one in found if _is_upright(lattice.xy, one[1] % columns)]
    return (lattice.xy, found[0][1]) if len(found) == 1 else none


def find_saddles(grey: AnyArray) -> FloatArray:
    """Return the places about which four sectors are dark and bright by turns, whole px, (k, 2)."""
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
    places = np.stack([column, row], axis=1)[strong].astype(np.float64)
    return np.asarray(places[_has_four_sectors(smooth, places)])


def _has_four_sectors(smooth: AnyArray, xy: FloatArray) -> BoolArray:
    """Return about which places the intensity crosses its mean on a circle four times, (k,)."""
    t = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    x = (xy[:, :1] + RADIUS_PX * np.cos(t)).astype(np.float32)
    y = (xy[:, 1:] + RADIUS_PX * np.sin(t)).astype(np.float32)
    ring = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    above = ring > (ring.max(axis=1, keepdims=True) + ring.min(axis=1, keepdims=True)) / 2
    return np.asarray((above != np.roll(above, 1, axis=1)).sum(axis=1) == 4)


def _dark_squares(grey: AnyArray, lattice: Lattice) -> IntArray | None:
    """Return the crossings at the corners of the dark squares, (m, 4); None where squares are all alike."""
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
    even, odd = (float(np.median(one)) for one in value)
    return None if abs(even - odd) < MIN_CONTRAST_SHARE * np.ptp(grey) else np.array(squares[int(even > odd)])


def board_ends(xy: FloatArray, place: IntArray, shape: tuple[int, ...]) -> list[tuple[bool, bool]]:
    """Return for rows and columns whether the board ends before the first and behind the last of them."""
    height, width = shape[:2]
    at = {(int(r), int(c)): k for k, (r, c) in enumerate(place)}
    found = []
    for axis in range(2):
        both = []
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
            both.append(bool(inside) and float(np.mean(inside)) > SHARE_INSIDE)
        found.append((both[0], both[1]))
    return found


def _offset(seen: int, whole: int, ends: tuple[bool, bool]) -> int | None:
    """Return which row or column of the board is the first that is seen; None where that is not certain."""
    before, behind = ends
    if seen == whole:
        return 0
    if seen > whole or before == behind:
        return None
    return 0 if before else whole - seen


def _is_upright(xy: FloatArray, column: IntArray) -> bool:
    """Whether columns run to the right."""
    return float((xy[:, 0] - xy[:, 0].mean()) @ (column - column.mean())) > 0
