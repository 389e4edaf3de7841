"""Fronts of a multifrontal factorisation: their order, their sizes, and sums over pairs of rays.

Nested dissection orders the photographs so that elimination causes little fill. In its graph, photographs
that share object points are neighbours. A few of them, the separator, split the others into two halves
without a common point. The halves are eliminated first, each split again in the same way, and the separator
last. For a block of m photographs the factor has about m log m elements and takes m^1.5 operations; a band
matrix takes m^1.5 and m^2.

The separator follows from distances in the graph, measured from four photographs at its far ends. Photographs
are ordered by the difference of two distances, or of two sums of distances. This splits a block across its
diagonals or along its sides.

A front is a full matrix. Its rows are a group of photographs from this dissection, and all later photographs
that are connected to the group or to groups eliminated before it. All photographs that see an object point
are in the front of the first of them to be eliminated. So an object point adds to one full matrix only, and
one front contains all elements of the inverse that it needs.

`Pairs` is for sums over the pairs of rays of each object point, where a product of full rows would mostly
multiply zeros. Y Y' and Y' Q need only the blocks of photographs that share a point. These are summed in
tiles of TILE x TILE photographs, which stay in the cache while all object points add to them.

Source: Duff and Reid (1983), ACM Trans. Math. Softw. 9(3); Liu (1992), SIAM Review 34(1); George (1973), SIAM
J. Numer. Anal. 10(2); George and Liu (1981), Computer Solution of Large Sparse Positive Definite Systems, ch.
8; Brown (1976), Photogramm. Eng. Remote Sens. 42(8); tiles: Golub and Van Loan (2013), sec. 1.5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from sfm.adjustment.engine.collinearity import Observations
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled, kernel
from sfm.runtime.small_algebra import add_product, subtract_pair
from sfm.runtime.threads import at_once

TILE = 48  # photographs; 6 x 6 numbers for each pair in a tile fill most of a 1 MB cache
LEAF = 32  # number of photographs that are not split further
SMOOTHED = 4  # rounds in which each photograph takes the mean of its neighbours, since distances are coarse
MAX_SEPARATOR = 0.5  # share of the photographs above which a separator saves nothing
BYTES = 8.0  # size of a number in double precision


@dataclass(frozen=True)
class Front:
    """A group of photographs that are eliminated together."""

    photographs: IntArray  # pivots, then connected photographs that are eliminated later
    pivots: int  # number of photographs that it eliminates
    children: tuple[int, ...]  # fronts that pass their remainder to it
    parent: int  # front that receives its remainder; -1: nothing remains
    into: IntArray  # positions of its remaining photographs among those of the parent
    points: IntArray  # object points that add to it
    rows: IntArray  # exterior unknowns of its photographs


@dataclass(frozen=True)
class Fronts:
    """The fronts of a network in the order of elimination."""

    fronts: tuple[Front, ...]
    halves: tuple[int, int]  # ends of two ranges of fronts, from 0 on, that do not depend on each other
    local: AnyArray  # position of each image point's photograph in the front of its object point, (k,)

    @property
    def operations(self) -> float:
        """Number of operations of the factorisation, counting products and sums."""
        sizes = ((6.0 * f.pivots, 6.0 * (len(f.photographs) - f.pivots)) for f in self.fronts)
        return float(sum(pivots**3 / 3 + pivots**2 * rest + pivots * rest**2 for pivots, rest in sizes))

    def bytes(self, border: int, vectors: float) -> float:
        """Return the peak memory of factor and inverse, bytes.

        It includes the factor, remainders that wait for a parent, and the current front.

        Args:
            border: number of unknowns other than exterior orientation.
            vectors: bytes of the vectors used to find null vectors.
        """
        half, end = self.halves
        first, second = (
            self._elimination_bytes(range(half), {}),
            self._elimination_bytes(range(half, end), {}),
        )
        last = self._elimination_bytes(range(end, len(self.fronts)), first.waiting | second.waiting)
        factor = first.kept + second.kept + last.kept
        factoring = max(first.peak + second.peak, first.kept + second.kept + last.peak)  # both halves at once
        columns = BYTES * 6 * sum(front.pivots for front in self.fronts) * border
        return max(factoring, factor + vectors, factor + self._inversion_bytes() + 2 * columns) + 2 * columns

    def _elimination_bytes(self, fronts: range, waiting: dict[int, float]) -> _Memory:
        """Return the memory for eliminating some fronts; `waiting` are remainders of other fronts, bytes."""
        waiting = dict(waiting)
        kept = peak = 0.0
        space = max((_bytes(self.fronts[g])[0] for g in fronts), default=0.0)
        for g in fronts:
            front = self.fronts[g]
            _, factor, rest = _bytes(front)
            for child in front.children:
                del waiting[child]
            peak = max(peak, space + kept + sum(waiting.values()) + factor + rest)
            waiting[g] = rest
            kept += factor
        return _Memory(kept, peak, waiting)

    def _inversion_bytes(self) -> float:
        """Return the peak memory of the inverse of all fronts, computed from the last to the first, bytes."""
        kept: dict[int, float] = {}
        needed = [len(front.children) for front in self.fronts]
        peak = before = 0.0
        for g in range(len(self.fronts) - 1, -1, -1):
            matrix, factor, _ = _bytes(self.fronts[g])
            # the front, unscaled and scaled, and the previous front
            peak = max(peak, sum(kept.values()) + 2 * matrix + factor + before)
            before = matrix
            parent = self.fronts[g].parent
            if parent >= 0:
                needed[parent] -= 1
                if needed[parent] == 0:
                    del kept[parent]
            if needed[g]:
                kept[g] = matrix
        return peak


class _Memory(NamedTuple):
    """Memory for eliminating some fronts, bytes."""

    kept: float  # the factor
    peak: float
    waiting: dict[int, float]  # remainders for parents that are not among these fronts


def _bytes(front: Front) -> tuple[float, float, float]:
    """Return the memory of the matrix of a front, of its part of the factor and of its remainder, bytes."""
    pivots, size = 6 * front.pivots, 6 * len(front.photographs)
    return BYTES * size**2, BYTES * pivots * size, BYTES * (size - pivots) ** 2


def fronts_of(observations: Observations, graph: csr_matrix, last: int | None = None) -> Fronts:
    """Return the fronts of a network.

    Args:
        observations: image points.
        graph: nonzero where two photographs share an object point, symmetric, (m, m).
        last: how many photographs, at the end of the numbers, form the last front, which may be none; any
            may if it is not given.
    """
    m, n = graph.shape[0], len(observations.start) - 1
    order = dissect(graph if last is None else graph[: m - last, : m - last])
    if last is not None:
        order = _before(order, m, last)
    begins = np.concatenate([[0], np.cumsum([len(group) for group in order.groups])])
    photograph = np.concatenate(order.groups)
    place = np.empty(m, dtype=np.int64)
    place[photograph] = np.arange(m)
    earliest = np.full(n, m)
    np.minimum.at(earliest, observations.point, place[observations.pose])
    points = np.argsort(earliest, kind="stable")
    cuts = np.searchsorted(earliest[points], begins)
    later: list[list[IntArray]] = [[] for _ in order.groups]  # places from children
    children: list[list[int]] = [[] for _ in order.groups]
    members = []
    for g, group in enumerate(order.groups):
        joined = [place[graph.indices[graph.indptr[i] : graph.indptr[i + 1]]] for i in group]
        seen = np.unique(np.concatenate(joined + later[g]))
        rest = seen[seen >= begins[g + 1]]
        members.append(np.concatenate([np.arange(begins[g], begins[g + 1]), rest]))
        if order.parents[g] >= 0:
            later[order.parents[g]].append(rest)
            children[order.parents[g]].append(g)
    local = np.empty(len(observations.pose), dtype=np.int32)
    where = np.empty(m, dtype=np.int32)
    fronts = []
    for g, (group, parent) in enumerate(zip(order.groups, order.parents, strict=True)):
        in_front = photograph[members[g]]
        into = np.searchsorted(members[parent], members[g][len(group) :])
        added = points[cuts[g] : cuts[g + 1]]
        where[in_front] = np.arange(len(in_front))
        _place(observations, added, where, local)
        rows = (6 * in_front[:, None] + np.arange(6)).ravel()
        fronts.append(Front(in_front, len(group), tuple(children[g]), parent, into, added, rows))
    # ends of two ranges of fronts that do not depend on each other; later fronts need both
    last = len(order.parents) - 1
    tops = [g for g, parent in enumerate(order.parents) if parent == -1]
    below = [g for g, parent in enumerate(order.parents) if parent == last]
    if len(tops) > 1:
        halves = tops[len(tops) // 2 - 1] + 1, last + 1
    else:
        halves = (below[len(below) // 2 - 1] + 1 if len(below) > 1 else 0), last
    return Fronts(tuple(fronts), halves, local)


@kernel
def _place(observations: Observations, points: IntArray, where: AnyArray, local: AnyArray) -> None:
    for j in points:
        for o in range(observations.start[j], observations.start[j + 1]):
            local[o] = where[observations.pose[o]]


class Dissection(NamedTuple):
    """Groups of photographs in the order of elimination: two halves before the separator between them."""

    groups: list[IntArray]  # photographs of each group
    parents: list[int]  # group of the next separator after each group; -1: none


def dissect(graph: csr_matrix) -> Dissection:
    """Return the groups into which nested dissection splits photographs.

    Args:
        graph: nonzero where two photographs share an object point, symmetric, (m, m).
    """
    order = Dissection([], [])
    _eliminate(graph, np.arange(graph.shape[0]), order)
    return order


def _before(order: Dissection, m: int, last: int) -> Dissection:
    """Return the groups with a further one after all others, of the last photographs."""
    root = len(order.groups)
    parents = [root if parent < 0 else parent for parent in order.parents]
    return Dissection([*order.groups, np.arange(m - last, m)], [*parents, -1])


def _eliminate(graph: csr_matrix, photographs: IntArray, order: Dissection) -> list[int]:
    """Append the groups of some photographs to `order`, given their graph; return groups without a parent."""
    halves = split(graph) if len(photographs) > LEAF else None
    if halves is None:
        order.groups.append(photographs)
        order.parents.append(-1)
        return [len(order.groups) - 1]
    tops: list[int] = []
    for half in halves[:2]:
        members = np.flatnonzero(half)
        tops += _eliminate(graph[members][:, members], photographs[members], order)
    separator = photographs[halves[2]]
    if len(separator) == 0:
        return tops
    order.groups.append(separator)
    order.parents.append(-1)
    for top in tops:
        order.parents[top] = len(order.groups) - 1
    return [len(order.groups) - 1]


def split(graph: csr_matrix) -> tuple[BoolArray, BoolArray, BoolArray] | None:
    """Return two halves and the separator between them; None if no small separator is found.

    Args:
        graph: nonzero where two photographs share an object point, symmetric, (m, m).

    Returns:
        Which photographs belong to each, (m,).
    """
    m = graph.shape[0]
    rows, columns = np.repeat(np.arange(m), np.diff(graph.indptr)), graph.indices
    best: tuple[BoolArray, BoolArray, BoolArray] | None = None
    for way in _ways(graph).T:
        first = np.zeros(m, dtype=bool)
        first[np.argsort(way, kind="stable")[: m // 2]] = True
        cut = first[rows] & ~first[columns]
        for edge, half in ((rows[cut], first), (columns[cut], ~first)):
            separator = np.zeros(m, dtype=bool)
            separator[edge] = True
            if best is None or separator.sum() < best[2].sum():
                best = half & ~separator, ~half, separator
    if best is None or best[2].sum() > MAX_SEPARATOR * m or not (best[0].any() and best[1].any()):
        return None
    return best


def halve(graph: csr_matrix, weight: FloatArray) -> BoolArray:
    """Return the half of a graph that has the fewest edges to the other half, (m,).

    Nodes at the same place are divided at random, not by their order: photographs of one place by no time.

    Args:
        graph: as in `split`, of two nodes or more.
        weight: of each node; the halves have the same weight, to one node, (m,).
    """
    m = graph.shape[0]
    rows, columns = np.repeat(np.arange(m), np.diff(graph.indptr)), graph.indices
    halves, mixed = np.zeros((4, m), dtype=bool), np.random.default_rng(m).permutation(m)
    for half, way in zip(halves, _ways(graph).T, strict=True):
        order = np.lexsort((mixed, np.round(way, 9)))
        count = int(np.searchsorted(np.cumsum(weight[order]), weight.sum() / 2, side="right"))
        half[order[: min(max(count, 1), m - 1)]] = True
    return np.asarray(halves[np.argmin([(half[rows] & ~half[columns]).sum() for half in halves])])


def _ways(graph: csr_matrix) -> FloatArray:
    """Return four coordinates by which photographs can be ordered, (m, 4)."""
    indptr, indices = graph.indptr.astype(np.int64), graph.indices.astype(np.int64)
    a = distances(indptr, indices, int(distances(indptr, indices, 0).argmax()))
    b = distances(indptr, indices, int(a.argmax()))
    c = distances(indptr, indices, int(np.minimum(a, b).argmax()))
    d = distances(indptr, indices, int(c.argmax()))
    ways = np.stack([a - b, c - d, a + c - b - d, a + d - b - c], axis=1).astype(float)
    joined = csr_matrix((np.ones(len(indices)), indices, indptr), shape=graph.shape)
    for _ in range(SMOOTHED):
        ways = (joined @ ways) / np.maximum(np.diff(indptr), 1)[:, None]
    return np.asarray(ways)


@compiled
def distances(indptr: IntArray, indices: IntArray, start: int) -> IntArray:
    """Return the number of steps from one node to each node, (m,); m for nodes that cannot be reached.

    Args:
        indptr: index of the first neighbour of each node, and the end, (m + 1,).
        indices: neighbours of all nodes.
        start: node where the steps begin.
    """
    m = len(indptr) - 1
    distance = np.full(m, m)
    queue = np.empty(m, dtype=np.int64)
    queue[0], distance[start] = start, 0
    taken, end = 0, 1
    while taken < end:
        node = queue[taken]
        taken += 1
        for k in range(indptr[node], indptr[node + 1]):
            other = indices[k]
            if distance[other] == m:
                distance[other] = distance[node] + 1
                queue[end] = other
                end += 1
    return distance


@dataclass(frozen=True)
class Pairs:
    """Positions of the rays of each object point among the tiles of photographs."""

    cut: IntArray  # first image point of object point j in tile i or a later tile, (n, tiles + 1)

    @property
    def tiles(self) -> int:
        """Number of tiles of photographs."""
        return int(self.cut.shape[1]) - 1


def pairs_of(observations: Observations) -> Pairs:
    """Return the positions of the rays of each object point among the tiles of photographs.

    Args:
        observations: image points.
    """
    tiles = -(-observations.poses // TILE)
    cut = np.empty((len(observations.start) - 1, tiles + 1), dtype=np.int64)
    _cut(observations, cut)
    return Pairs(cut)


def subtract_squares(
    pairs: Pairs, observations: Observations, Y: FloatArray, Y_interior: FloatArray, S: FloatArray
) -> None:
    """Subtract Y Y' from the lower triangle of S, including the rows of interior unknowns.

    Args:
        pairs: positions of the rays.
        observations: image points.
        Y: rows Y' of each image point, for X0, w of its pose, (k, 3, 6).
        Y_interior: rows Y' of each object point, for the interior unknowns, (n, 3, i).
        S: matrix to subtract from, row-major, with at least 6 m + i rows and columns.
    """
    flat = S.reshape(-1)
    first, inner = 6 * observations.poses, Y_interior.shape[2]

    def subtract(row: int, column: int) -> None:
        _subtract_tile(row, column, pairs.cut, observations, Y, flat, len(S))

    _in_two_threads(subtract, [(row, column) for row in range(pairs.tiles) for column in range(row + 1)])
    subtract_border(observations, Y, Y_interior, S[first : first + inner])
    flat_interior = Y_interior.reshape(3 * len(Y_interior), inner)
    S[first : first + inner, first : first + inner] -= flat_interior.T @ flat_interior


def times_inverse(
    pairs: Pairs, observations: Observations, Y: FloatArray, Q: FloatArray, border: FloatArray, YQ: FloatArray
) -> None:
    """Fill YQ with the rows Y'Q of each image point, for X0, w of its pose.

    Args:
        pairs: positions of the rays.
        observations: image points.
        Y: rows Y' of each image point, for X0, w of its pose, (k, 3, 6).
        Q: symmetric matrix, row-major, (reduced, reduced).
        border: rows Y' of each object point, for the interior unknowns, (n, 3, i).
        YQ: array to fill, (k, 3, 6).
    """
    _border_times(observations, border, Q[6 * observations.poses :], YQ)

    def add(row: int, _: int) -> None:
        for column in range(pairs.tiles):
            _add_tile(row, column, pairs.cut, observations, Y, Q.reshape(-1), len(Q), YQ)

    _in_two_threads(add, [(row, row) for row in range(pairs.tiles)])


def _in_two_threads(work: Callable[[int, int], None], tiles: list[tuple[int, int]]) -> None:
    """Process every other tile in one thread and the rest in another."""

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
    """Subtract Y Y' from the blocks between photographs of one tile and of the same or an earlier tile."""
    for j in range(len(cut)):
        for s in range(cut[j, row], cut[j, row + 1]):
            at = 6 * observations.pose[s] * stride
            for t in range(cut[j, column], min(cut[j, column + 1], s + 1)):
                subtract_pair(flat, at + 6 * observations.pose[t], stride, Y, s, t)
                # a point measured twice in a photograph
                if observations.pose[s] == observations.pose[t] and s != t:
                    subtract_pair(flat, at + 6 * observations.pose[t], stride, Y, t, s)


@kernel
def subtract_border(observations: Observations, Y: FloatArray, Y_interior: FloatArray, S: FloatArray) -> None:
    """Subtract Y_interior Y' from the rows of the interior unknowns.

    Args:
        observations: image points.
        Y: rows Y' of each image point, (k, 3, 6).
        Y_interior: rows Y' of each object point, (n, 3, i).
        S: rows to subtract from, (i, reduced).
    """
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
    """Add the contribution of the image points of one tile of photographs to Y'Q of those of another."""
    for j in range(len(cut)):
        for s in range(cut[j, row], cut[j, row + 1]):
            for t in range(cut[j, column], cut[j, column + 1]):
                at = 6 * observations.pose[t] * stride + 6 * observations.pose[s]
                add_product(YQ, s, Y, t, flat, at, stride)


@kernel
def _border_times(observations: Observations, Y_interior: FloatArray, Q: FloatArray, YQ: FloatArray) -> None:
    """Fill YQ with the contribution of the interior unknowns; Q has their rows, (i, reduced)."""
    for j in range(len(Y_interior)):
        for o in range(observations.start[j], observations.start[j + 1]):
            column = 6 * observations.pose[o]
            for p in range(3):
                for q in range(6):
                    total = 0.0
                    for c in range(Y_interior.shape[2]):
                        total += Y_interior[j, p, c] * Q[c, column + q]
                    YQ[o, p, q] = total
