"""The fronts of a multifrontal factorisation: groups of photographs and what each of them is joined with.

A front is the full matrix of the photographs of a group of nested dissection and of those, eliminated later,
that share object points with the group or with what was eliminated before it. All photographs that see an
object point are in one front, that of the first of them to be eliminated, so an object point adds to one
full matrix only, and takes all it needs of the inverse from one.

Source: Duff and Reid (1983), ACM Trans. Math. Softw. 9(3); Liu (1992), SIAM Review 34(1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from sfm.adjustment.engine.collinearity import Observations
from sfm.adjustment.engine.solvers.dissection import dissect
from sfm.conventions import AnyArray, IntArray
from sfm.kernels.options import kernel

BYTES = 8.0  # of a number in double precision


@dataclass(frozen=True)
class Front:
    """A group of photographs that are eliminated together."""

    photographs: IntArray  # own ones, then those joined with them that are eliminated later
    own: int  # how many are its own
    children: tuple[int, ...]  # fronts that leave something to it
    parent: int  # front that takes what is left of it; -1: nothing is left
    into: IntArray  # places among the photographs of the parent of those that are not its own
    points: IntArray  # object points that add to it
    rows: IntArray  # exterior unknowns of its photographs


@dataclass(frozen=True)
class Fronts:
    """The fronts of a network in the order of elimination."""

    fronts: tuple[Front, ...]
    halves: tuple[int, int]  # fronts before the first, and between both, need nothing of one another
    local: AnyArray  # place of the photograph of each image point in the front of its object point, (k,)

    @property
    def operations(self) -> float:
        """Operations of the factorisation, products and sums counted each."""
        return float(sum(_operations(6.0 * f.own, 6.0 * len(f.photographs)) for f in self.fronts))

    def bytes(self, border: int, vectors: float) -> float:
        """Memory of factor and inverse at the peak: what is kept, what waits for a parent, the front at work.

        Args:
            border: unknowns beside the exterior orientation.
            vectors: bytes of the vectors with which null vectors are sought.
        """
        half, end = self.halves
        first, second = self._eliminating(range(half), {}), self._eliminating(range(half, end), {})
        last = self._eliminating(range(end, len(self.fronts)), first.waiting | second.waiting)
        factor = first.kept + second.kept + last.kept
        factoring = max(first.peak + second.peak, first.kept + second.kept + last.peak)  # both halves at once
        columns = BYTES * 6 * sum(front.own for front in self.fronts) * border
        return max(factoring, factor + vectors, factor + self._inverting() + 2 * columns) + 2 * columns

    def _eliminating(self, some: range, waiting: dict[int, float]) -> _Memory:
        """Return the memory that takes the elimination of some fronts; waiting is what others have left."""
        waiting = dict(waiting)
        kept = peak = 0.0
        space = max((_bytes(self.fronts[g])[0] for g in some), default=0.0)
        for g in some:
            front = self.fronts[g]
            _, own, rest = _bytes(front)
            for child in front.children:
                del waiting[child]
            peak = max(peak, space + kept + sum(waiting.values()) + own + rest)
            waiting[g] = rest
            kept += own
        return _Memory(kept, peak, waiting)

    def _inverting(self) -> float:
        """Return the memory of the inverse of all fronts, from the last on, at its peak."""
        kept: dict[int, float] = {}
        needed = [len(front.children) for front in self.fronts]
        peak = before = 0.0
        for g in range(len(self.fronts) - 1, -1, -1):
            matrix, own, _ = _bytes(self.fronts[g])
            # the front, as it is and scaled, and what is left of the one before
            peak = max(peak, sum(kept.values()) + 2 * matrix + own + before)
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
    """Memory, bytes, that the elimination of some fronts takes."""

    kept: float  # by the factor
    peak: float
    waiting: dict[int, float]  # what fronts leave to parents that are not among them


def _bytes(front: Front) -> tuple[float, float, float]:
    """Return the memory of the matrix of a front, of its part of the factor and of what it leaves."""
    own, size = 6 * front.own, 6 * len(front.photographs)
    return BYTES * size**2, BYTES * own * size, BYTES * (size - own) ** 2


def fronts_of(observations: Observations, graph: csr_matrix) -> Fronts:
    """Return the fronts of a network.

    Args:
        observations: image points.
        graph: an element wherever two photographs share an object point, symmetric, (m, m).
    """
    m, n = graph.shape[0], len(observations.start) - 1
    order = dissect(graph)
    begins = np.concatenate([[0], np.cumsum([len(group) for group in order.groups])])
    photograph = np.concatenate(order.groups)
    place = np.empty(m, dtype=np.int64)
    place[photograph] = np.arange(m)
    earliest = np.full(n, m)
    np.minimum.at(earliest, observations.point, place[observations.image])
    points = np.argsort(earliest, kind="stable")
    cuts = np.searchsorted(earliest[points], begins)
    later: list[list[IntArray]] = [[] for _ in order.groups]  # places that children bring
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
    local = np.empty(len(observations.image), dtype=np.int32)
    where = np.empty(m, dtype=np.int32)
    fronts = []
    for g, (group, parent) in enumerate(zip(order.groups, order.parents, strict=True)):
        own = photograph[members[g]]
        into = np.searchsorted(members[parent], members[g][len(group) :])
        added = points[cuts[g] : cuts[g + 1]]
        where[own] = np.arange(len(own))
        _place(observations, added, where, local)
        rows = (6 * own[:, None] + np.arange(6)).ravel()
        fronts.append(Front(own, len(group), tuple(children[g]), parent, into, added, rows))
    return Fronts(tuple(fronts), _halves(order.parents), local)


def _halves(parents: list[int]) -> tuple[int, int]:
    """Return where two parts end of which neither needs the other; fronts behind them need both."""
    last = len(parents) - 1
    tops = [g for g, parent in enumerate(parents) if parent == -1]
    if len(tops) > 1:
        return tops[len(tops) // 2 - 1] + 1, last + 1
    below = [g for g, parent in enumerate(parents) if parent == last]
    return (below[len(below) // 2 - 1] + 1 if len(below) > 1 else 0), last


def _operations(own: float, size: float) -> float:
    """Operations that eliminate some of the unknowns of a symmetric matrix."""
    rest = size - own
    return own**3 / 3 + own**2 * rest + own * rest**2


@kernel
def _place(observations: Observations, points: IntArray, where: AnyArray, local: AnyArray) -> None:
    for j in points:
        for o in range(observations.start[j], observations.start[j + 1]):
            local[o] = where[observations.image[o]]
