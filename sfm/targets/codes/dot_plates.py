"""Plates of dots: the lattice of dots in a photograph, and the plate point of each dot.

Dots form a lattice (see `find_lattice`). A placement puts it on the plate: rotated by quarter turns, or for
shifted rows in one of the bases of the lattice, and translated. With marks, every placement that overlaps the
plate has a likelihood. Dots have the size that perspective gives them, with errors; marks are larger by one
common ratio; and some dots may have any size (damage, shadows). The placement that is certain is chosen, and
dots beyond the plate get no name. Without marks the whole plate must be visible, with nothing beside it.
"""

from __future__ import annotations

import heapq
import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.targets.codes.plates import UNCODED, PlateFamily, quarter_turn
from sfm.targets.fits.outline_noise import BIWEIGHT, MAD, ROUNDS

MAX_OFF_FRACTION = 0.25  # of the spacing, maximum distance of a dot from its predicted position
MAX_BOX_RATIO = 1.2  # box of a lattice over its number of dots, below which no other lattice is tried
SEEDS = 8  # dots from which a lattice is tried to grow
MIN_SINE = 0.3  # of the angle between rows and columns
MIN_DOTS, MIN_BENT_DOTS = 9, 20  # dots needed for a plate, and for a quadratic trend of their sizes
MIN_SCATTER = 0.005  # of the logarithms of radii: smaller than the effect of printing
# Minimum probability that a dot has any size, uniform over a range of this many standard deviations. It is
# raised to the part of dots that are farther off than OUTLYING_SIGMAS. The same probability applies to a
# plate that is larger than its table.
STRANGE_PROBABILITY, RANGE_SIGMAS, OUTLYING_SIGMAS = 0.01, 50.0, 5.0
RING_SIGMAS = 10.0  # size assigned to a ring, in standard deviations, so that it never counts as a dot
MIN_CERTAINTY = 0.999  # minimum probability of the placement


def name_dots(xy: FloatArray, radius: FloatArray, is_ring: BoolArray, plate: PlateFamily) -> IntArray:
    """Return the plate point of each dot, UNCODED for none, (k,).

    Args:
        xy: centres of the dots and of the insides of rings, px, (k, 2).
        radius: mean semi-axes, px, (k,).
        is_ring: True for insides of rings, (k,).
        plate: the plate.
    """
    code = np.full(len(xy), UNCODED)
    lattice = find_lattice(xy, ~is_ring)
    if lattice is None or len(lattice.rows) < MIN_DOTS:
        return code
    if plate.marks:
        placed = _placed_by_marks(lattice, size_of_marks(lattice, radius, is_ring), plate)
    else:
        placed = _placed_whole(lattice, plate)
    if placed is not None:
        code[lattice.rows] = placed
    return code


def size_of_marks(lattice: Lattice, radius: FloatArray, is_ring: BoolArray) -> FloatArray:
    """Return by how much each dot of a lattice is larger than perspective predicts, in standard deviations.

    The trend of the logarithms of the radii is fitted by Tukey's biweight, from least absolute residuals.

    Args:
        lattice: the dots.
        radius: mean semi-axes of all dots and rings, px, (k,).
        is_ring: True for insides of rings, (k,); they count as RING_SIGMAS standard deviations larger.
    """
    log, ring = np.log(radius[lattice.rows]), is_ring[lattice.rows]
    place = lattice.place - lattice.place.mean(axis=0)
    row, column = (place / np.maximum(np.abs(place).max(axis=0), 1)).T
    trend = [np.ones(len(row)), row, column]
    if len(row) >= MIN_BENT_DOTS:
        trend += [row * row, row * column, column * column]
    design, weight = np.stack(trend, axis=1), (~ring).astype(float)
    for k in range(2 * ROUNDS):
        root = np.sqrt(weight)[:, None]
        larger = log - design @ np.linalg.lstsq(root * design, root[:, 0] * log, rcond=None)[0]
        scatter = max(MAD * float(np.median(np.abs(larger[~ring]))), MIN_SCATTER)
        if k < ROUNDS:
            weight = ~ring / np.maximum(np.abs(larger), MIN_SCATTER)
        else:
            weight = ~ring * np.maximum(1 - (larger / (BIWEIGHT * scatter)) ** 2, 0.0) ** 2
    return np.where(ring, RING_SIGMAS, np.clip(larger / scatter, -RANGE_SIGMAS / 2, RANGE_SIGMAS / 2))


def placements(lattice: Lattice, plate: PlateFamily) -> list[IntArray]:
    """Return the lattice as rows and columns of the plate in every possible orientation, each (k, 2).

    Columns of plates with shifted rows are counted in halves.
    """
    if not plate.is_shifted:
        return [quarter_turn(lattice.place, turn) for turn in range(4)]
    steps = [np.array(step) for step in ((1, 1), (1, -1), (0, 2), (2, 0))]
    steps += [-step for step in steps]
    return [
        lattice.place @ np.stack([down, across])
        for down, across in itertools.permutations(steps, 2)
        if across[1] * down[0] - across[0] * down[1] == 2  # neighbours, and right-handed like the lattice
    ]


def _placed_by_marks(lattice: Lattice, size: FloatArray, plate: PlateFamily) -> IntArray | None:
    """Return the plate points at the positions of a lattice; None if the marks leave them uncertain."""
    table = _table(plate)
    marked = np.zeros(plate.count + 1, dtype=bool)
    marked[[row * plate.columns + column for row, column in plate.marks]] = True
    placed: list[tuple[float, IntArray]] = []
    outlying = float((np.abs(size) > OUTLYING_SIGMAS).sum() - len(plate.marks)) / len(size)
    strange = max(STRANGE_PROBABILITY, outlying)
    plain = _log_likelihood(size, strange)
    for place in placements(lattice, plate):
        low, high = place.min(axis=0), place.max(axis=0)
        for offset in itertools.product(*(range(-high[k], table.shape[k] - low[k]) for k in range(2))):
            code = _codes(place + np.array(offset), table)
            here = marked[code]
            if not here.any() or (code != UNCODED).sum() < max(MIN_DOTS, len(code) / 2):
                continue
            larger = max(float(np.median(size[here])), 0.0)
            gain = float((_log_likelihood(size[here] - larger, strange) - plain[here]).sum())
            if (code == UNCODED).any():  # plates are rarely larger than stated
                gain += math.log(STRANGE_PROBABILITY)
            placed.append((gain, code))
    if not placed:
        return None
    best, code = max(placed, key=lambda option: option[0])
    all_of_them = sum(math.exp(gain - best) for gain, _ in placed) + math.exp(-best)  # or no mark is visible
    return code if 1 / all_of_them > MIN_CERTAINTY else None


def _placed_whole(lattice: Lattice, plate: PlateFamily) -> IntArray | None:
    """Return the points of a whole visible plate without marks, in the most upright orientation."""
    table = _table(plate)
    best: tuple[float, IntArray] | None = None
    for place in placements(lattice, plate):
        place = place - place.min(axis=0)
        if tuple(place.max(axis=0) + 1) != table.shape:
            continue
        code = _codes(place, table)
        if (code == UNCODED).any():
            continue
        x = lattice.xy[:, 0] - lattice.xy[:, 0].mean()
        upright = float(x @ place[:, 1])  # largest if columns run to the right
        if best is None or upright > best[0]:
            best = upright, code
    return None if best is None else best[1]


def _table(plate: PlateFamily) -> IntArray:
    """Return the point at each row and column (half columns for shifted rows), UNCODED for none."""
    places = plate.places
    table = np.full(places.max(axis=0) + 1, UNCODED)
    table[places[:, 0], places[:, 1]] = np.arange(plate.count)
    return table


def _codes(place: IntArray, table: IntArray) -> IntArray:
    """Return the points at rows and columns, UNCODED outside the plate, (k,)."""
    inside = ((place >= 0) & (place < table.shape)).all(axis=1)
    code = np.full(len(place), UNCODED)
    code[inside] = table[place[inside, 0], place[inside, 1]]
    return code


def rings_among(polarity: IntArray) -> BoolArray:
    """Return which circles are insides of rings: those of the minority polarity, (k,)."""
    return np.asarray(polarity != (1 if (polarity > 0).sum() > len(polarity) / 2 else -1))


def _log_likelihood(z: FloatArray, strange: float) -> FloatArray:
    """Return log densities of normal deviates, if a given part of them may have any size."""
    normal = np.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
    return np.asarray(np.log((1 - strange) * normal + strange / RANGE_SIGMAS))


@dataclass(frozen=True)
class Lattice:
    """Dots in rows and columns; the first row and the directions are arbitrary."""

    rows: IntArray  # index of each dot in the lattice, (k,)
    place: IntArray  # row and column, right-handed as in the photograph (x right, y down), (k, 2)
    xy: FloatArray  # px, (k, 2)

    @property
    def box(self) -> int:
        """Number of positions in the bounding box of rows and columns."""
        return int((np.ptp(self.place, axis=0) + 1).prod())

    def by_shortest_box(self) -> Lattice:
        """Return the lattice with diagonals as rows or columns where these make its box smaller.

        A board that is tilted by more than 45 degrees has diagonals that are shorter than its rows.
        """
        sheared = (np.array([[1, k], [0, 1]]) for k in (1, -1))
        others = [replace(self, place=self.place @ S) for shear in sheared for S in (shear, shear.T)]
        best = min(others, key=lambda lattice: lattice.box)
        return best.by_shortest_box() if best.box < self.box else self


def find_lattice(xy: FloatArray, is_dot: BoolArray) -> Lattice | None:
    """Return the largest and most compact lattice that grows from a dot near the middle; None without any.

    If a neighbour is missing, rows may be mistaken for diagonals, which gives a lattice with a longer box.

    Args:
        xy: centres, px, (k, 2).
        is_dot: circles along which the lattice grows; others occupy a position and end it there, (k,).
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
        lattice = _grown(xy, is_dot, seed, *steps)
        if best is None or (len(lattice.rows), -lattice.box) > (len(best.rows), -best.box):
            best = lattice
        if len(best.rows) > len(dots) / 2 and best.box < MAX_BOX_RATIO * len(best.rows):
            break
    return best


def _first_steps(xy: FloatArray, seed: int) -> tuple[FloatArray, FloatArray] | None:
    """Return the steps from a dot to the next column and row: two neighbours, each with an opposite one."""
    away = xy - xy[seed]
    order = np.argsort(np.hypot(*away.T))[1:9]
    steps = [
        away[k]
        for k in order
        if np.hypot(*(away[order] + away[k]).T).min() < MAX_OFF_FRACTION * np.hypot(*away[k])  # opposite dot
    ]
    for other in steps[1:]:
        first = steps[0]
        cross = first[0] * other[1] - first[1] * other[0]
        if abs(cross) > MIN_SINE * np.hypot(*first) * np.hypot(*other):
            return (first, other) if cross > 0 else (first, -other)
    return None


def _grown(xy: FloatArray, is_dot: BoolArray, seed: int, across: FloatArray, down: FloatArray) -> Lattice:
    """Grow a lattice from a dot to the four neighbours of each dot, best predicted ones first."""
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
        # find which of the four steps it was, and update that step
        options = ((0, 1, across), (0, -1, -across), (1, 0, down), (-1, 0, -down))
        d_row, d_column, _ = min(options, key=lambda option: float(np.hypot(*(option[2] - step))))
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
