"""Sums over the pairs of rays of each object point, where a product of full rows would mostly multiply zeros.

Y Y' and Y' Q need only the blocks of photographs that share a point. They are summed tile by tile: TILE
photographs by as many others, which stay in the cache while all object points add to them.

Source: Brown (1976), Photogramm. Eng. Remote Sens. 42(8); tiles: Golub and Van Loan (2013), sec. 1.5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sfm.adjustment.engine.collinearity import Observations
from sfm.conventions import FloatArray, IntArray
from sfm.kernels.blocks import add_product, subtract_pair
from sfm.kernels.options import kernel
from sfm.kernels.threads import at_once

TILE = 48  # photographs; 6 x 6 numbers for each pair of a tile fill most of a cache of 1 MB


@dataclass(frozen=True)
class Pairs:
    """Where the rays of each object point lie among the tiles of photographs."""

    cut: IntArray  # image point of object point j that is the first in tile i or behind it, (n, tiles + 1)

    @property
    def tiles(self) -> int:
        """Number of tiles of photographs."""
        return int(self.cut.shape[1]) - 1


def pairs_of(observations: Observations) -> Pairs:
    """Return where the rays of each object point lie among the tiles of photographs."""
    tiles = -(-observations.poses // TILE)
    cut = np.empty((len(observations.start) - 1, tiles + 1), dtype=np.int64)
    _cut(observations, cut)
    return Pairs(cut)


def subtract_squares(
    pairs: Pairs, observations: Observations, Y: FloatArray, Y_interior: FloatArray, S: FloatArray
) -> None:
    """Take Y Y' and Y_interior Y_interior' off the lower triangle of S, row-major.

    Args:
        pairs: places of the rays.
        observations: image points.
        Y: rows Y' of each image point by X0, w of its photograph, (k, 3, 6).
        Y_interior: rows Y' of each object point by the interior unknowns, (n, 3, i).
        S: at least 6 m + i rows and columns.
    """
    flat = S.reshape(-1)
    first, inner = 6 * observations.poses, Y_interior.shape[2]

    def subtract(row: int, column: int) -> None:
        _subtract_tile(row, column, pairs.cut, observations, Y, flat, len(S))

    _halves(subtract, [(row, column) for row in range(pairs.tiles) for column in range(row + 1)])
    subtract_border(observations, Y, Y_interior, S[first : first + inner])
    flat_interior = Y_interior.reshape(3 * len(Y_interior), inner)
    S[first : first + inner, first : first + inner] -= flat_interior.T @ flat_interior


def times_inverse(
    pairs: Pairs, observations: Observations, Y: FloatArray, Q: FloatArray, border: FloatArray, YQ: FloatArray
) -> None:
    """Fill YQ with the rows Y'Q of each image point by X0, w of its photograph, (k, 3, 6).

    Args:
        pairs: places of the rays.
        observations: image points.
        Y: rows Y' of each image point by X0, w of its photograph, (k, 3, 6).
        Q: symmetric matrix, row-major, (reduced, reduced).
        border: rows Y' of each object point by the interior unknowns, (n, 3, i).
        YQ: what is filled.
    """
    _border_times(observations, border, Q[6 * observations.poses :], YQ)

    def add(row: int, _: int) -> None:
        for column in range(pairs.tiles):
            _add_tile(row, column, pairs.cut, observations, Y, Q.reshape(-1), len(Q), YQ)

    _halves(add, [(row, row) for row in range(pairs.tiles)])


def _halves(work: Callable[[int, int], None], tiles: list[tuple[int, int]]) -> None:
    """Work on every other tile in one thread, on the rest in another."""

    def on(part: list[tuple[int, int]]) -> None:
        for tile in part:
            work(*tile)

    at_once(lambda: on(tiles[::2]), lambda: on(tiles[1::2]))


@kernel
def _cut(observations: Observations, cut: IntArray) -> None:
    for j in range(len(cut)):
        o = observations.start[j]
        for tile in range(cut.shape[1]):
            while o < observations.start[j + 1] and observations.pose[o] < tile * TILE:
                o += 1
            cut[j, tile] = o


@kernel
def _subtract_tile(
    row: int,
    column: int,
    cut: IntArray,
    observations: Observations,
    Y: FloatArray,
    flat: FloatArray,
    stride: int,
) -> None:
    """Take Y Y' off the blocks of the photographs of one tile by those of another that is not behind it."""
    for j in range(len(cut)):
        for s in range(cut[j, row], cut[j, row + 1]):
            at = 6 * observations.pose[s] * stride
            for t in range(cut[j, column], min(cut[j, column + 1], s + 1)):
                subtract_pair(flat, at + 6 * observations.pose[t], stride, Y, s, t)
                if (
                    observations.pose[s] == observations.pose[t] and s != t
                ):  # a point measured twice in a photograph
                    subtract_pair(flat, at + 6 * observations.pose[t], stride, Y, t, s)


@kernel
def subtract_border(observations: Observations, Y: FloatArray, Y_interior: FloatArray, S: FloatArray) -> None:
    """Take Y_interior Y' off the rows S of the interior unknowns."""
    for j in range(len(Y_interior)):
        for o in range(observations.start[j], observations.start[j + 1]):
            column = 6 * observations.pose[o]
            for c in range(len(S)):
                z0, z1, z2 = Y_interior[j, 0, c], Y_interior[j, 1, c], Y_interior[j, 2, c]
                for q in range(6):
                    S[c, column + q] -= z0 * Y[o, 0, q] + z1 * Y[o, 1, q] + z2 * Y[o, 2, q]


@kernel
def _add_tile(
    row: int,
    column: int,
    cut: IntArray,
    observations: Observations,
    Y: FloatArray,
    flat: FloatArray,
    stride: int,
    YQ: FloatArray,
) -> None:
    """Add to Y'Q of the image points of one tile of photographs what those of another bring."""
    for j in range(len(cut)):
        for s in range(cut[j, row], cut[j, row + 1]):
            for t in range(cut[j, column], cut[j, column + 1]):
                at = 6 * observations.pose[t] * stride + 6 * observations.pose[s]
                add_product(YQ, s, Y, t, flat, at, stride)


@kernel
def _border_times(observations: Observations, Y_interior: FloatArray, Q: FloatArray, YQ: FloatArray) -> None:
    """Fill YQ with what the rows Y_interior of the interior unknowns bring; Q their rows, (i, reduced)."""
    for j in range(len(Y_interior)):
        for o in range(observations.start[j], observations.start[j + 1]):
            column = 6 * observations.pose[o]
            for p in range(3):
                for q in range(6):
                    total = 0.0
                    for c in range(Y_interior.shape[2]):
                        total += Y_interior[j, p, c] * Q[c, column + q]
                    YQ[o, p, q] = total
