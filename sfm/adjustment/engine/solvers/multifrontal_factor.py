"""Factor of a reduced normal matrix in fronts: solutions, and elements of its inverse.

With A = L L', the elements of Z = A^-1 follow front by front, from the last to the first:

    Z_RJ = -Z_RR G,   Z_JJ = L_JJ^-T L_JJ^-1 - G' Z_RJ,   G = L_RJ L_JJ^-1

J are the pivots of a front and R its other unknowns; Z_RR is already known from the parent.

Source: Takahashi, Fagan and Chin (1973), Formation of a sparse bus impedance matrix; Erisman and Tinney
(1975), Comm. ACM 18(3); Liu (1992), SIAM Review 34(1); Foerstner and Wrobel (2016), sec. 15.2.5.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dtrtri

from sfm.adjustment.engine.collinearity import Observations
from sfm.adjustment.engine.normals import Equations
from sfm.adjustment.engine.solvers.fronts import Front, Fronts
from sfm.adjustment.engine.solvers.protocol import Inverse
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.runtime.compiling import kernel
from sfm.runtime.small_algebra import add_product

# Object points multiplied by the inverse of interior and kept unknowns at a time: so many values,
# 32 kB, and so few points that the inverse is not read again for each.
MOST_VALUES, FEWEST_POINTS = 2**12, 16


class EliminatedFront(NamedTuple):
    """Part of the factor from eliminating the photographs of a front."""

    L: FloatArray  # rows of the pivots, lower triangle, (j, j)
    K: FloatArray  # rows of the other unknowns of the front, (r, j)
    weakest: float  # smallest pivot


@dataclass(frozen=True)
class MultifrontalFactor:
    """Factor of a reduced normal matrix with its null space held."""

    layout: Unknowns
    fronts: Fronts
    scale: FloatArray  # 1/sqrt of the unreduced diagonal, (reduced,)
    eliminated: list[EliminatedFront]  # L of A + added = L L', front by front
    C: FloatArray  # (6 m, i + 3 s)
    further: FloatArray  # null vectors that the datum does not explain, scaled, orthonormal, (reduced, e)
    X: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # A^-1 C, (6 m, i + 3 s)
    corner: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # upper factor of D - C' A^-1 C
    weak: bool = False  # whether a pivot is near 0

    def with_border(self, X: FloatArray, corner: FloatArray, *, weak: bool) -> MultifrontalFactor:
        """Return the factor completed for the unknowns other than exterior orientation.

        Args:
            X: A^-1 C, (6 m, i + 3 s).
            corner: upper factor of D - C' A^-1 C.
            weak: whether a pivot is near 0.
        """
        return replace(self, X=X, corner=corner, weak=weak)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return a solution of S x = right for right-hand sides (reduced,) or (reduced, r)."""
        first = len(self.C)
        columns = right if right.ndim == 2 else right[:, None]
        s = self.scale[:, None]
        r = s * columns
        x = np.empty_like(r)
        x[:first] = self.solve_exterior(r[:first])
        if len(self.corner):
            x[first:] = cho_solve((self.corner, False), r[first:] - self.C.T @ x[:first])
            x[:first] -= self.X @ x[first:]
        return np.asarray((s * x).reshape(right.shape))

    def with_further(self, further: FloatArray) -> MultifrontalFactor:
        """Return the factor with the null vectors that it holds beside the motions.

        Args:
            further: scaled and orthonormal, (reduced, e).
        """
        return replace(self, further=further)

    def solve_exterior(self, right: FloatArray) -> FloatArray:
        """Return A^-1 right, scaled, (6 m, r)."""
        x = np.array(right, order="C")
        eliminate_right(self.fronts, self.eliminated, x)
        substitute_back(self.fronts, self.eliminated, x)
        return x

    def inverse(self, equations: Equations, *, cross: bool) -> Inverse:
        """Return the elements of the inverse; arguments as in `Factor.inverse`.

        With Z = A^-1 within the fronts, X = A^-1 C and Q = (D - C' A^-1 C)^-1, the inverse is
        S^-1 = (Z + X Q X'   -X Q; -Q X'   Q).
        """
        first, border = len(self.C), len(self.corner)
        scales = self.scale * self.layout.reduced_free()
        s, sb = scales[:first], scales[first:]
        X = self.X * s[:, None] / self.scale[first:]
        Q = cho_solve((self.corner, False), np.eye(border)) if border else np.zeros((0, 0))
        Q = np.ascontiguousarray(Q * sb[:, None] * sb)  # the kernel expects this layout
        matrices = inverse_fronts(self.fronts, self.eliminated)
        return inverse_of(matrices, self.fronts, equations, s, BorderInverse(X, Q), cross=cross)


class BorderInverse(NamedTuple):
    """What the elements of the inverse take from the unknowns other than exterior orientation."""

    X: FloatArray  # A^-1 C in the units of the unknowns, (6 m, i + 3 s)
    Q: FloatArray  # (D - C' A^-1 C)^-1, likewise, (i + 3 s, i + 3 s)


def eliminate_right(fronts: Fronts, eliminated: Sequence[EliminatedFront], x: FloatArray) -> None:
    """Eliminate right-hand sides front by front: x becomes L^-1 x, and what remains in later fronts.

    Args:
        fronts: the fronts.
        eliminated: the first of them, which are eliminated.
        x: right-hand sides, (6 m, r).
    """
    for front, (L, K, _) in zip(fronts.fronts, eliminated, strict=False):
        pivots, rest = np.split(front.rows, [6 * front.pivots])
        x[pivots] = dtrsm(1.0, L.T, x[pivots], trans_a=1)
        if len(rest):
            x[rest] -= K @ x[pivots]


def substitute_back(fronts: Fronts, eliminated: Sequence[EliminatedFront], x: FloatArray) -> None:
    """Substitute back front by front: eliminated right-hand sides become the solution.

    Args:
        fronts: the fronts.
        eliminated: the first of them, which are eliminated.
        x: eliminated right-hand sides, and the solution in later fronts, (6 m, r).
    """
    for front, (L, K, _) in reversed(list(zip(fronts.fronts, eliminated, strict=False))):
        pivots, rest = np.split(front.rows, [6 * front.pivots])
        y = x[pivots] - K.T @ x[rest] if len(rest) else x[pivots]
        x[pivots] = dtrsm(1.0, L.T, y)


def inverse_of(
    matrices: Iterator[tuple[Front, FloatArray]],
    fronts: Fronts,
    equations: Equations,
    scale: FloatArray,
    by_border: BorderInverse,
    *,
    cross: bool,
) -> Inverse:
    """Return the elements of S^-1 of photographs, border and object points.

    Args:
        matrices: the fronts from the last to the first, with their elements of scaled A^-1.
        fronts: all fronts.
        equations: undamped normal equations.
        scale: scale of each exterior unknown, 0 for fixed unknowns, (6 m,).
        by_border: effect and inverse of the other unknowns.
        cross: whether to compute Y'S^-1; it is empty otherwise.
    """
    b, observations, (X, Q) = equations.blocks, equations.layout.observations, by_border
    border, XQ = len(Q), X @ Q
    n, most = len(b.y), int(np.diff(observations.start).max(initial=0))
    core, exterior = np.zeros((n, 3, 3)), np.empty((len(b.U), 6, 6))
    YQ = np.zeros((len(b.Y) if cross else most, 3, 6))
    YQ_border = np.zeros((n if cross else 1, 3, border))
    together = max(FEWEST_POINTS, MOST_VALUES // max(3 * border, 1))
    for front, Z in matrices:
        of_front = scale[front.rows]
        Z_own = Z * of_front
        Z_own *= of_front[:, None]
        for i, photograph in enumerate(front.photographs[: front.pivots]):
            at = slice(6 * i, 6 * i + 6)
            rows = slice(6 * photograph, 6 * photograph + 6)
            exterior[photograph] = Z_own[at, at] + XQ[rows] @ X[rows].T
        for begin in range(0, len(front.points), together):
            points = front.points[begin : begin + together]
            u = np.empty((len(points), 3, border))
            _by_border(observations, points, b.Y, b.Y_interior, X, u)
            uQ = (u.reshape(3 * len(points), border) @ Q).reshape(u.shape)
            _sum_pairs(
                observations, points, fronts.local, b.Y, b.Y_interior, Z_own.reshape(-1), len(Z_own), X, uQ,
                cross, core, YQ, YQ_border,
            )  # fmt: skip
    if not cross:
        YQ, YQ_border = YQ[:0], YQ_border[:0]
    return Inverse(exterior, -XQ, Q, core, YQ, YQ_border)


def inverse_fronts(
    fronts: Fronts, eliminated: Sequence[EliminatedFront], root: FloatArray | None = None
) -> Iterator[tuple[Front, FloatArray]]:
    """Yield the fronts from the last to the first, with their elements of scaled A^-1.

    Args:
        fronts: the fronts.
        eliminated: those that were eliminated, all or all but the last.
        root: elements of A^-1 of the last front if it was not eliminated, (6 r, 6 r).
    """
    tree = fronts.fronts
    waiting = np.bincount([front.parent + 1 for front in tree], minlength=len(tree) + 1)[1:]
    kept: dict[int, FloatArray] = {}
    if root is not None:
        kept[len(tree) - 1] = root
        yield tree[-1], root
    for g in range(len(eliminated) - 1, -1, -1):
        front, (L, K, _) = tree[g], eliminated[g]
        pivots, size = 6 * front.pivots, 6 * len(front.photographs)
        inverse = np.tril(dtrtri(L.T, lower=0)[0].T)
        Z = np.empty((size, size))
        Z[:pivots, :pivots] = inverse.T @ inverse
        if size > pivots:
            _pick(kept[front.parent], front.into, Z[pivots:, pivots:])
            G = K @ inverse
            Z[pivots:, :pivots] = -(Z[pivots:, pivots:] @ G)
            Z[:pivots, pivots:] = Z[pivots:, :pivots].T
            Z[:pivots, :pivots] -= G.T @ Z[pivots:, :pivots]
        if front.parent >= 0:
            waiting[front.parent] -= 1
            if waiting[front.parent] == 0:
                del kept[front.parent]
        if waiting[g]:
            kept[g] = Z
        yield front, Z


@kernel
def _pick(Z: FloatArray, into: IntArray, part: AnyArray) -> None:
    """Copy the elements of some photographs of a front to `part`."""
    for i in range(len(into)):
        for q in range(6):
            row, other = Z[6 * into[i] + q], part[6 * i + q]
            for k in range(len(into)):
                for p in range(6):
                    other[6 * k + p] = row[6 * into[k] + p]


@kernel
def _by_border(
    observations: Observations,
    points: IntArray,
    Y: FloatArray,
    Y_interior: FloatArray,
    X: FloatArray,
    u: FloatArray,
) -> None:
    """Fill u = Y'X - Y_interior of some object points, (p, 3, i + 3 s)."""
    inner = Y_interior.shape[2]
    for k in range(len(points)):
        j = points[k]
        for p in range(3):
            for c in range(u.shape[2]):
                u[k, p, c] = -Y_interior[j, p, c] if c < inner else 0.0
        for t in range(observations.start[j], observations.start[j + 1]):
            column = 6 * observations.pose[t]
            for p in range(3):
                for q in range(6):
                    for c in range(u.shape[2]):
                        u[k, p, c] += Y[t, p, q] * X[column + q, c]


@kernel
def _sum_pairs(
    observations: Observations,
    points: IntArray,
    local: AnyArray,
    Y: FloatArray,
    Y_interior: FloatArray,
    Z: FloatArray,
    size: int,
    X: FloatArray,
    uQ: FloatArray,
    cross: bool,
    core: FloatArray,
    YQ: FloatArray,
    YQ_border: FloatArray,
) -> None:
    """Fill Y'S^-1 and Y'S^-1 Y of object points of a front; Z of its photographs is row-major."""
    inner = Y_interior.shape[2]
    for k in range(len(points)):
        j = points[k]
        begin, end = observations.start[j], observations.start[j + 1]
        shift = 0 if cross else begin
        for s in range(begin, end):
            row = 6 * observations.pose[s]
            for p in range(3):
                for q in range(6):
                    total = 0.0
                    for c in range(uQ.shape[2]):
                        total += uQ[k, p, c] * X[row + q, c]
                    YQ[s - shift, p, q] = total
            for t in range(begin, end):
                add_product(YQ, s - shift, Y, t, Z, 6 * local[t] * size + 6 * local[s], size)
            for p in range(3):
                for q in range(3):
                    for r in range(6):
                        core[j, p, q] += YQ[s - shift, p, r] * Y[s, q, r]
        for p in range(3):
            for q in range(3):
                for c in range(inner):
                    core[j, p, q] -= uQ[k, p, c] * Y_interior[j, q, c]
            if cross:
                for c in range(uQ.shape[2]):
                    YQ_border[j, p, c] = -uQ[k, p, c]
