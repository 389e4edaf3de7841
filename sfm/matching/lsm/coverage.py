"""Windows that cover photographs: of how many pixels, and those that do not overlap.

Windows that overlap measure the same pixels twice, and their errors have these in common: a result would
be reported too precise, and no residual shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.kernels.options import compiled
from sfm.network import ImagePoints

# Ratio of precisions for the same pixels up to which the windows that are preferred are taken.
MAX_COST_RATIO = 1.1
MAX_SHARED_FRACTION = 0.15  # part of the pixels of a point, or of a window, that others may have measured
SAMPLES = np.linspace(-0.42, 0.42, 6)  # of a window at which it is asked what is covered, in its sides


@dataclass(frozen=True)
class Windows:
    """Windows of least squares matching."""

    side_px: int  # odd
    model: str = "affine"  # or shift, with the linear part of its warp from the plane of the surface


def first_alike(costs: Sequence[tuple[Windows, float]]) -> Windows:
    """Return the first windows that are about as precise as the best for the same pixels.

    The standard deviation of a window's place falls with its side, the number of windows with the square of
    that: for noise alone all together leave the same. Where larger ones leave more, the surface is not plane
    over them.

    Args:
        costs: windows and the standard deviation that their rays leave together, the preferred ones first.
    """
    best = min(cost for _, cost in costs)
    return next(windows for windows, cost in costs if cost <= MAX_COST_RATIO * best)


class CoveredPixels:
    """Which pixels of photographs have been measured, a bit each."""

    def __init__(self, shapes: Sequence[tuple[int, ...]]) -> None:
        """Nothing is covered yet of photographs of these shapes (height, width)."""
        self.shapes = [shape[:2] for shape in shapes]
        self._bits = [np.zeros((height, -(-width // 8)), np.uint8) for height, width in self.shapes]

    def pixels(self, image: int) -> AnyArray:
        """Return a photograph with 1 where it is covered, uint8, (H, W)."""
        return np.unpackbits(self._bits[image], axis=1, count=self.shapes[image][1])

    def cover(self, image: IntArray, xy: FloatArray, side_px: FloatArray) -> None:
        """Cover squares, given by photograph (k,), middle (px, (k, 2)) and side (px, (k,))."""
        sizes = np.array([shape[::-1] for shape in self.shapes])[image]
        first = np.clip(np.rint(xy - side_px[:, None] / 2 + 0.5).astype(np.int64), 0, sizes)
        behind = np.clip(np.rint(xy + side_px[:, None] / 2 + 0.5).astype(np.int64), 0, sizes)
        for i, (x0, y0), (x1, y1) in zip(image.tolist(), first.tolist(), behind.tolist(), strict=True):
            row = np.zeros(8 * self._bits[i].shape[1], np.uint8)
            row[x0:x1] = 1
            self._bits[i][y0:y1] |= np.packbits(row)

    def free_middles(self, image: int, side_px: int) -> BoolArray:
        """Return which pixels of a photograph are middles of squares with few covered pixels, (H, W)."""
        shared = cv2.boxFilter(self.pixels(image), cv2.CV_32F, (side_px, side_px))
        return np.asarray(shared <= MAX_SHARED_FRACTION)

    def is_free(self, image: int, xy: FloatArray, side_px: float) -> BoolArray:
        """Return which squares of a photograph have few covered pixels, (k,).

        Args:
            image: index of the photograph.
            xy: middles of the squares, px, (k, 2).
            side_px: their side.
        """
        height, width = self.shapes[image]
        col = np.rint(xy[:, :1] + side_px * SAMPLES).astype(np.int64).clip(0, width - 1)[:, None, :]
        row = np.rint(xy[:, 1:] + side_px * SAMPLES).astype(np.int64).clip(0, height - 1)[:, :, None]
        covered = (self._bits[image][row, col >> 3] >> (7 - (col & 7)).astype(np.uint8)) & 1
        return np.asarray(covered.mean(axis=(1, 2)) <= MAX_SHARED_FRACTION)


def points_apart(seen: ImagePoints, fits: BoolArray, side_px: float, *, n_points: int) -> BoolArray:
    """Choose points, those with the most rays first, whose windows share few of their pixels, (n,).

    Args:
        seen: image points.
        fits: which of them count, (k,).
        side_px: of the windows.
        n_points: number of points.
    """
    kept = np.zeros(n_points, dtype=bool)
    rows = np.flatnonzero(fits)
    if not len(rows):
        return kept
    count = np.bincount(seen.point[rows], minlength=n_points)
    order = np.argsort(-count, kind="stable")
    rows = rows[np.argsort(seen.point[rows], kind="stable")]
    cells = np.floor(seen.xy[rows] / side_px).astype(np.int64)
    cells -= cells.min(axis=0) - 1  # with a free one on each side, so that neighbours have different numbers
    columns, lines = cells.max(axis=0) + 2
    cell = (seen.image[rows] * lines + cells[:, 1]) * columns + cells[:, 0]
    first = np.concatenate([[0], np.cumsum(count)])
    _keep_apart(order, first, seen.xy[rows] / side_px, cell, np.unique(cell), int(columns), kept)
    return kept


@compiled
def _keep_apart(
    order: IntArray,
    first: IntArray,
    xy: AnyArray,
    cell: IntArray,
    cells: IntArray,
    columns: int,
    kept: BoolArray,
) -> None:
    """Mark points in this order whose windows, of side 1, share few of their pixels with those marked before.

    Args:
        order: points, the first to be kept first, (n,).
        first: the first ray of each point, and the end, (n + 1,).
        xy: middles of the windows, point by point, in sides, (k, 2).
        cell: number of the square of side 1 that each is in, (k,).
        cells: these numbers, sorted, (c,).
        columns: squares of a line: the number of a neighbour is by 1, `columns` or both larger or smaller.
        kept: filled, (n,).
    """
    latest = np.full(len(cells), -1)  # window kept in each square
    before = np.full(len(xy), -1)  # that was kept there before
    for point in order:
        begin, end = first[point], first[point + 1]
        shared, most = 0.0, MAX_SHARED_FRACTION * (end - begin)
        for k in range(begin, end):
            for line in (-columns, 0, columns):
                at = np.searchsorted(cells, cell[k] + line - 1)
                while at < len(cells) and cells[at] <= cell[k] + line + 1:
                    other = latest[at]
                    while other >= 0:
                        wide, high = 1 - abs(xy[k, 0] - xy[other, 0]), 1 - abs(xy[k, 1] - xy[other, 1])
                        shared += max(wide, 0.0) * max(high, 0.0)
                        other = before[other]
                    at += 1
            if shared > most:
                break
        if shared > most or begin == end:
            continue
        kept[point] = True
        for k in range(begin, end):
            at = np.searchsorted(cells, cell[k])
            before[k], latest[at] = latest[at], k
