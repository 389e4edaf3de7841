"""Products of full rows Y' of the object points, for networks in which most photographs see most points.

Source: Foerstner and Wrobel (2016), sec. 15.2; Golub and Van Loan (2013), sec. 1.3 (products by blocks).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sfm.adjustment.engine.accumulate import Blocks
from sfm.adjustment.engine.collinearity import Observations
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.conventions import FloatArray
from sfm.kernels.options import compiled
from sfm.kernels.threads import at_once

CHUNK = 1_000_000  # numbers of rows Y' that are multiplied at a time, at least
LEAST = 500  # and rows; fewer would slow down a product
ROWS = 2  # rows for each unknown, if they are summed: that would take longer than forming products otherwise
HALVED = 200**2  # elements of the matrix from which its halves are formed by themselves
TRIANGLE_PARTS = 4  # stretches of columns of a triangular matrix; 5/8 of the work of a full one


def rows_of(
    blocks: Blocks,
    layout: Unknowns,
    scale: FloatArray,
    dtype: type,
    begin: int = 0,
    end: int | None = None,
    *,
    summed: bool = False,
) -> Iterator[tuple[int, FloatArray]]:
    """Yield rows Y' times scale, some object points at a time: the first point, and (3 points, reduced).

    The next rows take the place of the last ones. Begins and ends with object points begin and end, if given.
    Of those whose products are summed there are more at a time.
    """
    end, width = len(blocks.y) if end is None else end, layout.reduced
    space: FloatArray = np.empty((rows_at_a_time(end - begin, width, summed=summed), width), dtype=dtype)
    points = len(space) // 3
    for first in range(begin, end, points):
        rows = space[: 3 * min(points, end - first)]
        _fill(layout.observations, blocks.Y, blocks.Y_interior, scale, first, rows)
        yield first, rows


def rows_at_a_time(points: int, width: int, *, summed: bool = False) -> int:
    """Return how many of the rows Y' of some object points are formed at a time; width is their length."""
    least = ROWS * width if summed else LEAST
    return 3 * max(min(points, max(least, CHUNK // width) // 3 + 1), 1)


def subtract_square(rows: FloatArray, product: FloatArray, S: FloatArray) -> None:
    """Take rows' rows off the lower triangle of S.

    Both triangles of its halves are formed in one thread, the square between them, which is as many
    operations, in another: numpy's product lets other threads run.

    Args:
        rows: some rows Y' of object points, (3 points, reduced).
        product: space for the product, (reduced, reduced).
        S: what it is taken off, row-major, (reduced, reduced).
    """
    half = S.shape[0] // 2
    left, right = rows[:, :half], rows[:, half:]

    def subtract(a: FloatArray, b: FloatArray, row: int, column: int) -> None:
        own = slice(row, row + a.shape[1]), slice(column, column + b.shape[1])
        np.matmul(a.T, b, out=product[own])
        S[own] -= product[own]

    def triangles() -> None:
        subtract(left, left, 0, 0)
        subtract(right, right, half, half)

    if S.size < HALVED:
        subtract(rows, rows, 0, 0)
    else:
        at_once(triangles, lambda: subtract(right, left, half, 0))


def times_triangle(rows: FloatArray, W: FloatArray) -> FloatArray:
    """Return rows W, W upper triangular, some columns at a time to leave out most of the zeros.

    Args:
        rows: some rows Y' of object points, (3 points, reduced).
        W: upper triangular, (reduced, reduced).
    """
    product = np.empty_like(rows)
    width = -(-W.shape[0] // TRIANGLE_PARTS)
    for start in range(0, W.shape[0], width):
        end = min(start + width, W.shape[0])
        np.matmul(rows[:, :end], W[:end, start:end], out=product[:, start:end])
    return product


def multiply_rows(left: FloatArray, right: FloatArray, core: FloatArray) -> None:
    """Fill the product of the three rows of each object point by themselves, (points, 3, 3)."""
    shape = (-1, 3, left.shape[1])
    np.matmul(left.reshape(shape), np.swapaxes(right.reshape(shape), 1, 2), out=core)


@compiled
def pick_columns(
    observations: Observations, products: FloatArray, start: int, YQ: FloatArray, YQ_border: FloatArray
) -> None:
    """Take the columns of the photographs that see each point, and those of the border."""
    first = 6 * len(observations.camera)
    for h in range(len(products) // 3):
        j = start + h
        for p in range(3):
            for o in range(observations.start[j], observations.start[j + 1]):
                for q in range(6):
                    YQ[o, p, q] = products[3 * h + p, 6 * observations.image[o] + q]
            for q in range(YQ_border.shape[2]):
                YQ_border[j, p, q] = products[3 * h + p, first + q]


@compiled
def _fill(
    observations: Observations,
    Y: FloatArray,
    Y_interior: FloatArray,
    scale: FloatArray,
    first: int,
    rows: FloatArray,
) -> None:
    start = 6 * len(observations.camera)
    for h in range(len(rows) // 3):
        j = first + h
        rows[3 * h : 3 * h + 3] = 0.0
        for o in range(observations.start[j], observations.start[j + 1]):
            c = 6 * observations.image[o]
            for p in range(3):
                for q in range(6):
                    rows[3 * h + p, c + q] += Y[o, p, q] * scale[c + q]
        for p in range(3):
            for q in range(Y_interior.shape[2]):
                rows[3 * h + p, start + q] = Y_interior[j, p, q] * scale[start + q]
