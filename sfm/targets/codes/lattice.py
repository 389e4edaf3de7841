"""Rows and columns of dots in a photograph, grown from dot to dot as the plate is seen in perspective."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray

MAX_OFF_FRACTION = 0.25  # of the spacing, within which a dot must be where its neighbours predict it
MAX_BOX_RATIO = 1.2  # times its dots, the places in the box of a lattice that needs no other beside it
SEEDS = 8  # dots that are tried to begin with
MIN_SINE = 0.3  # of the angle between rows and columns


@dataclass(frozen=True)
class Lattice:
    """Dots in rows and columns; which row is the first, and which way they run, is arbitrary."""

    rows: IntArray  # index of each dot that is in it, (k,)
    place: IntArray  # row and column, right-handed as in the photograph (x right, y down), (k, 2)
    xy: FloatArray  # px, (k, 2)

    @property
    def box(self) -> int:
        """Number of places between the first and last row and column."""
        return int((np.ptp(self.place, axis=0) + 1).prod())


def find_lattice(xy: FloatArray, is_dot: BoolArray) -> Lattice | None:
    """Return the largest and most compact lattice that grows from a dot near the middle; None without any.

    Where a neighbour is missing, rows may be taken for diagonals, which makes a lattice of a longer box.

    Args:
        xy: centres, px, (k, 2).
        is_dot: what the lattice grows along; others take a place in it and end it there, (k,).
    """
    dots = np.flatnonzero(is_dot)
    if len(dots) < 4:
        return None
    middle = np.median(xy[dots], axis=0)
    best: Lattice | None = None
    for seed in dots[np.argsort(np.hypot(*(xy[dots] - middle).T))][:SEEDS].tolist():
        steps = _first_steps(xy, seed)
        if steps is None:
            continue
        found = _grown(xy, is_dot, seed, *steps)
        if best is None or (len(found.rows), -found.box) > (len(best.rows), -best.box):
            best = found
        if len(best.rows) > len(dots) / 2 and best.box < MAX_BOX_RATIO * len(best.rows):
            break
    return best


def _first_steps(xy: FloatArray, seed: int) -> tuple[FloatArray, FloatArray] | None:
    """Return the steps from a dot to the next column and row: two neighbours with one opposite each."""
    away = xy - xy[seed]
    order = np.argsort(np.hypot(*away.T))[1:9]
    steps = [
        away[k]
        for k in order
        if np.hypot(*(away[order] + away[k]).T).min() < MAX_OFF_FRACTION * np.hypot(*away[k])  # its opposite
    ]
    for other in steps[1:]:
        first = steps[0]
        cross = first[0] * other[1] - first[1] * other[0]
        if abs(cross) > MIN_SINE * np.hypot(*first) * np.hypot(*other):
            return (first, other) if cross > 0 else (first, -other)
    return None


def _grown(xy: FloatArray, is_dot: BoolArray, seed: int, across: FloatArray, down: FloatArray) -> Lattice:
    """Grow a lattice from a dot: from each to its four neighbours, those that are predicted best first."""
    place = {seed: (0, 0)}
    taken = {(0, 0): seed}
    waiting: list[tuple[float, int, int, int, FloatArray, FloatArray]] = []
    counter = 0

    def look_from(k: int, across: FloatArray, down: FloatArray) -> None:
        nonlocal counter
        row, column = place[k]
        for d_row, d_column, step in ((0, 1, across), (0, -1, -across), (1, 0, down), (-1, 0, -down)):
            if (row + d_row, column + d_column) in taken:
                continue
            away = np.hypot(*(xy - xy[k] - step).T)
            j = int(np.argmin(away))
            error = float(away[j] / np.hypot(*step))
            if error < MAX_OFF_FRACTION and j not in place:
                counter += 1
                heapq.heappush(waiting, (error, counter, k, j, across, down))

    look_from(seed, across, down)
    while waiting:
        _, _, k, j, across, down = heapq.heappop(waiting)
        if j in place:
            continue
        step = xy[j] - xy[k]
        # which of the four steps it was, and the same step as it is here
        options = ((0, 1, across), (0, -1, -across), (1, 0, down), (-1, 0, -down))
        d_row, d_column, _ = min(options, key=lambda one: float(np.hypot(*(one[2] - step))))
        where = place[k][0] + d_row, place[k][1] + d_column
        if where in taken:
            continue
        place[j], taken[where] = where, j
        if not is_dot[j]:
            continue
        if d_column:
            across = d_column * step
        else:
            down = d_row * step
        look_from(j, across, down)
    rows = np.array(list(place), dtype=np.int64)
    return Lattice(rows, np.array([place[int(k)] for k in rows]), xy[rows])
