"""In what order photographs are eliminated so that little is filled in: nested dissection of their graph.

Photographs that share object points are neighbours. A few of them, the separator, split the others into two
halves without a common point; the halves are eliminated first, each split again in the same way, and the
separator last. For a block of m photographs the factor has of the order of m log m elements and takes m^1.5
operations, where a band takes m^1.5 and m^2.

Where to split is told by distances in the graph from four photographs at its far ends: by the difference of
two of them, or of two sums of two, as a block is split across its diagonals or along its sides.

Source: George (1973), SIAM J. Numer. Anal. 10(2); George and Liu (1981), Computer Solution of Large Sparse
Positive Definite Systems, ch. 8.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.kernels.options import compiled

LEAF = 32  # photographs that are not split any further
SMOOTHED = 4  # times that a photograph takes the mean of its neighbours, since steps are coarse
MAX_SEPARATOR = 0.5  # share of the photographs; a separator with more of them saves nothing


class Dissection(NamedTuple):
    """Groups of photographs in the order of their elimination: halves before the separator between them."""

    groups: list[IntArray]  # photographs of each group
    parents: list[int]  # group of the separator next behind each one; -1: none


def dissect(graph: csr_matrix) -> Dissection:
    """Return the groups into which nested dissection splits photographs.

    Args:
        graph: an element wherever two photographs share an object point, symmetric, (m, m).
    """
    order = Dissection([], [])
    _eliminate(graph, np.arange(graph.shape[0]), order)
    return order


def _eliminate(graph: csr_matrix, photographs: IntArray, order: Dissection) -> list[int]:
    """Append the groups of some photographs, and return those without a parent; graph is theirs alone."""
    halves = _split(graph) if len(photographs) > LEAF else None
    if halves is None:
        order.groups.append(photographs)
        order.parents.append(-1)
        return [len(order.groups) - 1]
    tops: list[int] = []
    for half in halves[:2]:
        own = np.flatnonzero(half)
        tops += _eliminate(graph[own][:, own], photographs[own], order)
    separator = photographs[halves[2]]
    if len(separator) == 0:
        return tops
    order.groups.append(separator)
    order.parents.append(-1)
    for top in tops:
        order.parents[top] = len(order.groups) - 1
    return [len(order.groups) - 1]


def _split(graph: csr_matrix) -> tuple[BoolArray, BoolArray, BoolArray] | None:
    """Return two halves and the separator between them; None where no small one is found."""
    m = graph.shape[0]
    rows, columns = np.repeat(np.arange(m), np.diff(graph.indptr)), graph.indices
    best: tuple[BoolArray, BoolArray, BoolArray] | None = None
    for way in _directions(graph).T:
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


def _directions(graph: csr_matrix) -> FloatArray:
    """Return four ways to order photographs, (m, 4)."""
    indptr, indices = graph.indptr.astype(np.int64), graph.indices.astype(np.int64)
    a = distances(indptr, indices, int(distances(indptr, indices, 0).argmax()))
    b = distances(indptr, indices, int(a.argmax()))
    c = distances(indptr, indices, int(np.minimum(a, b).argmax()))
    d = distances(indptr, indices, int(c.argmax()))
    ways = np.stack([a - b, c - d, a + c - b - d, a + d - b - c], axis=1).astype(float)
    joined = csr_matrix((np.ones(len(indices)), indices, indptr), shape=graph.shape)
    for _ in range(SMOOTHED):
        ways = (joined @ ways) / np.maximum(np.diff(indptr), 1)[:, None]
    return ways


@compiled
def distances(indptr: IntArray, indices: IntArray, start: int) -> IntArray:
    """Return how many steps each node is from one of them, the number of nodes where none leads there.

    Args:
        indptr: where the neighbours of each node begin, and the end, (m + 1,).
        indices: neighbours.
        start: the node.
    """
    m = len(indptr) - 1
    found = np.full(m, m)
    queue = np.empty(m, dtype=np.int64)
    queue[0], found[start] = start, 0
    taken, end = 0, 1
    while taken < end:
        node = queue[taken]
        taken += 1
        for k in range(indptr[node], indptr[node + 1]):
            other = indices[k]
            if found[other] == m:
                found[other] = found[node] + 1
                queue[end] = other
                end += 1
    return found
