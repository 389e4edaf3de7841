"""Multifrontal solver: factors the reduced normal matrix front by front, for photographs with few neighbours.

The matrix

    S = (A C; C' D)     A: exterior orientation, block by block; D: interior unknowns and kept points

is factored as A = L L' and D - C' A^-1 C. A is never assembled. Each front (`fronts`) sums the terms of its
object points, adds the remainders of its children, eliminates its pivots and passes the remainder to its
parent. The motions that the datum leaves open, and any further null vectors, are held by adding 1 to one
diagonal element for each. Since g is free of the null space, these unknowns get dx = 0 and nothing else
changes: a minimal constraint.

Null vectors of a matrix that is never assembled are found by subspace iteration. The matrix is factored with
a small shift of its diagonal. Repeated solutions amplify the directions that the observations leave open, and
the Rayleigh-Ritz method selects those with eigenvalue 0. They carry the rounding of an almost singular
factor. One step with the factor in which they are held reduces it to the rounding of the matrix itself, like
that of an eigenvalue decomposition.

Source: Duff and Reid (1983), ACM Trans. Math. Softw. 9(3); Liu (1992), SIAM Review 34(1); Foerstner and
Wrobel (2016), sec. 15.2.4 and 4.5; Golub and Van Loan (2013), Matrix Computations, sec. 8.2.4 and 8.1;
Wilkinson (1965), The Algebraic Eigenvalue Problem, ch. 9 (inverse iteration).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, Self, TypeVar

import numpy as np
from scipy.linalg import cho_factor, eigh, qr
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf

from sfm.adjustment.datum import Motions
from sfm.adjustment.engine.collinearity import Observations
from sfm.adjustment.engine.normals import Equations, NormalEquations
from sfm.adjustment.engine.solvers import protocol
from sfm.adjustment.engine.solvers.dense import NULL, WEAK_PIVOT
from sfm.adjustment.engine.solvers.fronts import BYTES, Front, Fronts, subtract_border
from sfm.adjustment.engine.solvers.multifrontal_factor import EliminatedFront, MultifrontalFactor
from sfm.adjustment.engine.solvers.protocol import Factor
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.runtime.compiling import kernel
from sfm.runtime.small_algebra import subtract_pair
from sfm.runtime.threads import at_once

SHIFT = 1e-10  # share of the diagonal added to find null vectors; far above rounding, far below weak ones
STEPS = 12  # steps of the iteration; each amplifies null vectors by eigenvalue / SHIFT
FIRST_SOUGHT = 8  # vectors in the first search; their number is doubled while all of them are null
COPIES = 6  # copies of these vectors at a time: before and after a product or solution, scaled, orthonormal


class Border(NamedTuple):
    """Scaled parts of the reduced normal matrix outside the exterior orientation."""

    C: FloatArray  # (6 m, i + 3 s)
    D: FloatArray  # (i + 3 s, i + 3 s)


@dataclass(frozen=True)
class MultifrontalSolver:
    """Solver with the reduced normal matrix as a tree of fronts."""

    layout: Unknowns
    fronts: Fronts

    @property
    def has_coarse(self) -> bool:
        """Whether an intermediate step takes less time in single precision: never."""
        return False

    @property
    def bytes(self) -> float:
        """Peak memory of the factor and its inverse, bytes."""
        layout = self.layout
        return self.fronts.bytes(layout.reduced - layout.pose_free.size, search_bytes(layout))

    def factor(
        self, equations: Equations, motions: Motions, *, damped: bool = False, coarse: bool = False
    ) -> MultifrontalFactor | None:
        """Return the factored reduced normal equations; arguments as in `Solver.factor`.

        Raises:
            GeometryError: the factor would not fit in memory.
        """
        protocol.refuse_what_does_not_fit(
            self.bytes, f"the unknowns of {len(self.layout.pose_free)} photographs"
        )
        first = self.layout.pose_free.size
        border = border_of(equations, equations.scale[:first], equations.scale[first:])
        border.D[np.diag_indices_from(border.D)] += equations.damping

        def factor_with(added: FloatArray) -> MultifrontalFactor | None:
            return self._factor_with(equations, border, added)

        return factor_with_null_space(factor_with, equations, motions, damped=damped)

    def _factor_with(
        self, equations: Equations, border: Border, added: FloatArray
    ) -> MultifrontalFactor | None:
        """Return the factor with `added` on the diagonal; None if it is not positive definite."""
        layout, fronts, scale = self.layout, self.fronts, equations.scale
        first = layout.pose_free.size
        eliminated = eliminate_fronts(layout.observations, fronts, equations, scale, added[:first])
        if eliminated is None:
            return None
        weak = any(front.weakest**2 < WEAK_PIVOT for front in eliminated)
        none = np.zeros((layout.reduced, 0))
        factor = MultifrontalFactor(layout, fronts, scale, eliminated, border.C, none)
        X, corner = np.zeros((first, 0)), border.D + np.diag(added[first:])
        if len(border.D):
            X = factor.solve_exterior(border.C)
            try:
                corner, _ = cho_factor(corner - border.C.T @ X)
            except np.linalg.LinAlgError:
                return None
            weak = weak or bool(np.diagonal(corner).min() ** 2 < WEAK_PIVOT)
        return factor.with_border(X, corner, weak=weak)


def border_of(equations: Equations, s: FloatArray, sb: FloatArray) -> Border:
    """Return the scaled border and corner, with Y Y' subtracted and without damping.

    Args:
        equations: normal equations.
        s: scale of each exterior unknown, (6 m,).
        sb: scale of each other reduced unknown, (i + 3 s,).
    """
    b, parts = equations.blocks, equations.parts
    inner = b.Y_interior.shape[2]
    C, D = parts.border.T.copy(), parts.corner.copy()
    subtract_border(equations.layout.observations, b.Y, b.Y_interior, C[:inner])
    interior = b.Y_interior.reshape(3 * len(b.y), inner)
    D[:inner, :inner] -= interior.T @ interior
    C = C.T
    C *= s[:, None] * sb
    D *= sb[:, None] * sb
    return Border(C, D)


class HeldFactor(Factor, Protocol):
    """A factor that states whether a pivot is weak, and takes the null vectors that it holds."""

    @property
    def weak(self) -> bool:
        """Whether a pivot is near 0."""

    def with_further(self, further: FloatArray) -> Self:
        """Return the factor with the null vectors that the datum does not explain, (reduced, e)."""


F = TypeVar("F", bound=HeldFactor)


def factor_with_null_space(
    factor_with: Callable[[FloatArray], F | None],
    equations: NormalEquations,
    motions: Motions,
    *,
    damped: bool,
) -> F | None:
    """Return a factor that holds the motions and all further null vectors; None if there is none.

    Args:
        factor_with: returns the factor with some numbers added to the scaled diagonal, (reduced,).
        equations: normal equations.
        motions: null vectors that are motions.
        damped: whether the equations are damped; then no further null vectors are sought.
    """
    Q = motions.orthonormal(equations.scale)

    def held(vectors: FloatArray, shift: float = 0.0) -> F | None:
        added = np.full(len(Q), shift)
        added[_separating_rows(vectors)] += 1.0
        return factor_with(added)

    factor = held(Q)
    if damped or not (factor is None or factor.weak):
        return factor
    del factor  # only one factor at a time fits in memory
    shifted = held(Q, SHIFT)
    if shifted is None:
        return held(Q)
    further = null_vectors(shifted, equations, Q)
    del shifted
    if further.shape[1] == 0:
        return held(Q)
    # held together with the motions, so that no unknown is chosen for two null vectors
    factor = held(np.hstack([Q, further]))
    return None if factor is None else factor.with_further(refined(further, factor, equations, Q))


def eliminate_fronts(
    observations: Observations,
    fronts: Fronts,
    equations: Equations,
    scale: FloatArray,
    added: FloatArray,
) -> list[EliminatedFront] | None:
    """Eliminate all fronts; None if one is not positive definite.

    Args:
        observations: image points.
        fronts: the fronts in the order of elimination.
        equations: normal equations.
        scale: scale of each exterior unknown, (6 m,).
        added: numbers to add to the scaled diagonal, (6 m,).
    """
    return eliminate_below(observations, fronts, len(fronts.fronts), equations, scale, added, {})


def eliminate_below(
    observations: Observations,
    fronts: Fronts,
    end: int,
    equations: Equations,
    scale: FloatArray,
    added: FloatArray,
    left: dict[int, FloatArray],
) -> list[EliminatedFront] | None:
    """Eliminate the fronts before `end`, and leave their remainders for the others in `left`."""
    eliminated: list[EliminatedFront | None] = [None] * end
    own = fronts.fronts[:end]

    def eliminate(begin: int, stop: int) -> bool:
        space = np.empty(max((36 * len(front.photographs) ** 2 for front in own[begin:stop]), default=0))
        for g in range(begin, stop):
            front = own[g]
            F = sum_front(observations, fronts, front, equations, scale, space)
            each = np.arange(6 * front.pivots)
            F[each, each] += equations.damping + added[front.rows[each]]  # the scaled diagonal of U is 1
            for child in front.children:  # in this order for any number of threads
                extend(left.pop(child), own[child].into, F)
            pivots = 6 * front.pivots
            U, info = dpotrf(F[:pivots, :pivots].T.copy(order="F"), lower=0, clean=1, overwrite_a=1)
            if info != 0:
                return False
            rest = F[pivots:, pivots:].copy()
            K = F[pivots:, :pivots].copy()
            if len(K):
                K = dtrsm(1.0, U, K.T, trans_a=1, overwrite_b=1).T
                rest = dsyrk(-1.0, K.T, beta=1.0, c=rest.T, trans=1, overwrite_c=1).T
            eliminated[g], left[g] = EliminatedFront(U.T, K, float(np.diagonal(U).min())), rest
        return True

    half, stop = (min(place, end) for place in fronts.halves)
    halves = at_once(lambda: eliminate(0, half), lambda: eliminate(half, stop))
    if not (all(halves) and eliminate(stop, end)):
        return None
    return [front for front in eliminated if front is not None]


def sum_front(
    observations: Observations,
    fronts: Fronts,
    front: Front,
    equations: Equations,
    scale: FloatArray,
    space: FloatArray,
) -> FloatArray:
    """Return the scaled lower triangle of a front without remainders of children, (6 f, 6 f).

    Args:
        observations: image points.
        fronts: all fronts.
        front: one of them.
        equations: normal equations.
        scale: scale of each exterior unknown, (6 m,).
        space: memory for it, at least 36 f^2.
    """
    b, size = equations.blocks, 6 * len(front.photographs)
    F = space[: size**2].reshape(size, size)
    F.fill(0.0)
    _sum_front(
        observations, b.U, b.Y, front.photographs[: front.pivots], front.points, fronts.local,
        scale[front.rows], F.reshape(-1),
    )  # fmt: skip
    return F


def _separating_rows(vectors: FloatArray) -> IntArray:
    """Return as many rows as there are vectors, chosen so that the vectors are well separated there."""
    if vectors.shape[1] == 0:
        return np.zeros(0, dtype=np.int64)
    _, _, pivots = qr(vectors.T, mode="economic", pivoting=True)
    return np.asarray(pivots[: vectors.shape[1]], dtype=np.int64)


@kernel
def _sum_front(
    observations: Observations,
    U: FloatArray,
    Y: FloatArray,
    pivots: IntArray,
    points: IntArray,
    local: AnyArray,
    scale: FloatArray,
    flat: FloatArray,
) -> None:
    """Fill the lower triangle with U of the pivots minus Y Y' of the object points, scaled."""
    size = len(scale)
    for i in range(len(pivots)):
        for q in range(6):
            for p in range(q + 1):
                flat[(6 * i + q) * size + 6 * i + p] = U[pivots[i], q, p]
    for j in points:
        for s in range(observations.start[j], observations.start[j + 1]):
            row = 6 * local[s]
            for t in range(observations.start[j], observations.start[j + 1]):
                if local[t] <= local[s]:  # twice where a point is measured twice in a photograph
                    subtract_pair(flat, row * size + 6 * local[t], size, Y, s, t)
    for row in range(size):
        for column in range(row + 1):
            flat[row * size + column] *= scale[row] * scale[column]


@kernel
def extend(rest: FloatArray, into: IntArray, F: FloatArray) -> None:
    """Add the lower triangle of the remainder of a front to its parent.

    Args:
        rest: the remainder, (6 r, 6 r).
        into: positions of its photographs in the parent, (r,).
        F: matrix of the parent.
    """
    for i in range(len(into)):
        for k in range(i + 1):
            for q in range(6):
                row, other = F[6 * into[i] + q], rest[6 * i + q]
                for p in range(6):
                    row[6 * into[k] + p] += other[6 * k + p]


def null_vectors(shifted: Factor, equations: NormalEquations, Q: FloatArray) -> FloatArray:
    """Return null vectors of the scaled matrix other than the motions, orthonormal, (reduced, e).

    Args:
        shifted: factor of the matrix with SHIFT added and the motions held.
        equations: normal equations.
        Q: motions, scaled and orthonormal, (reduced, d).
    """
    scale = equations.scale[:, None]
    sought = min(FIRST_SOUGHT, len(Q))
    while True:
        V = np.random.default_rng(0).standard_normal((len(Q), sought))
        for _ in range(STEPS):
            V = shifted.solve(_across(V, Q) / scale) / scale
        V = _across(V, Q)
        values, vectors = eigh(V.T @ _times(equations, V))
        null = values < NULL
        if not null.all() or sought == len(Q):
            return np.asarray(V @ vectors[:, null])
        sought = min(2 * sought, len(Q))


def search_bytes(layout: Unknowns) -> float:
    """Return the memory of the first search for null vectors, and of the points that they move, bytes.

    Args:
        layout: order of the unknowns.
    """
    return BYTES * FIRST_SOUGHT * (3 * len(layout.point_free) + COPIES * layout.reduced)


def refined(vectors: FloatArray, held: Factor, equations: NormalEquations, Q: FloatArray) -> FloatArray:
    """Return null vectors after removing remnants of other eigenvectors.

    Args:
        vectors: null vectors, scaled and orthonormal, (reduced, e).
        held: factor of the matrix in which they and the motions are held.
        equations: normal equations.
        Q: motions, scaled and orthonormal, (reduced, d).
    """
    scale = equations.scale[:, None]
    return _across(vectors - held.solve(_times(equations, vectors) / scale) / scale, Q)


def _across(V: FloatArray, Q: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the part of V orthogonal to Q."""
    return np.asarray(np.linalg.qr(V - Q @ (Q.T @ V))[0])


def _times(equations: NormalEquations, V: FloatArray) -> FloatArray:
    """Return S V with the scaled, undamped matrix S, (reduced, e)."""
    scale = equations.scale[:, None]
    return scale * equations.times_schur(scale * V)
