"""Dense solver: factors the full reduced normal matrix, scaled, with the open motions of the datum held.

With scaled S and an orthonormal basis Q of its null space, S + QQ' is positive definite. Its solution has
Q'dx = 0, which is an inner constraint and not damping. Directions that neither the observations nor the datum
determine are found as further null vectors and held in the same way. Everything else is still estimated, and
the null vectors are reported.

If most photographs see most points, Y Y' is summed as a product of full rows Y' of the object points.
Otherwise it is summed pair by pair of rays (`fronts.Pairs`). The elements of S^-1 for marginal covariances
are computed in the same way.

Source: Foerstner and Wrobel (2016), sec. 4.5, 15.2 and 15.2.5; Luhmann et al. (2020), sec. 4.4.3; Golub and
Van Loan (2013), sec. 1.3 (products by blocks).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.linalg.blas import dsyrk, ssyrk
from scipy.linalg.lapack import dlauum, dpotrf, dpotrs, dtrtri, spotrf, spotrs

from sfm.adjustment.datum import Motions
from sfm.adjustment.engine.accumulate import Blocks
from sfm.adjustment.engine.collinearity import Observations
from sfm.adjustment.engine.normals import Equations, times_reduced
from sfm.adjustment.engine.solvers import protocol
from sfm.adjustment.engine.solvers.fronts import BYTES, Pairs, subtract_squares, times_inverse
from sfm.adjustment.engine.solvers.protocol import Inverse
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.model.conventions import FloatArray
from sfm.model.display import counted
from sfm.runtime.compiling import compiled, kernel
from sfm.runtime.threads import at_once

CHUNK = 1_000_000  # smallest number of elements of Y' multiplied at a time
LEAST = 500  # smallest number of rows of Y' multiplied at a time; fewer would slow down a product
ROWS = 2  # rows per unknown if products are summed; with fewer, summing would take longer than multiplying
HALVED = 200**2  # number of matrix elements from which the halves are formed separately
TRIANGLE_PARTS = 4  # groups of columns of a triangular matrix; they take 5/8 of the work of a full one

NULL = 1e-12  # eigenvalue of the scaled matrix (diagonal at most 1) taken as 0; rounding leaves 1e-15
WEAK_PIVOT = 1e-11  # squared pivot below which the eigenvalues are computed
WEAK_SINGLE = 1e-5  # the same in single precision, where rounding leaves 1e-6
SINGLE_FROM = 100  # number of reduced unknowns from which the product in single precision saves time


@dataclass(frozen=True)
class DenseSolver:
    """Solver with a full reduced normal matrix."""

    layout: Unknowns
    pairs: Pairs | None = None  # positions of the rays to sum pair by pair; None for a product of full rows

    @property
    def has_coarse(self) -> bool:
        """Whether an intermediate step takes less time in single precision."""
        return self.pairs is None and self.layout.reduced >= SINGLE_FROM

    @property
    def bytes(self) -> float:
        """Peak memory of the factor and its inverse, bytes."""
        width = self.layout.reduced
        matrix, points = width**2, len(self.layout.point_free)
        if self.pairs is not None:  # factor, its inverse, their product, and rows Y'Q
            return BYTES * (3 * matrix + 18 * len(self.layout.order))
        rows = rows_at_a_time(points, width, summed=True) * width
        half = rows_at_a_time(points // 2, width) * width
        # S, a product and rows; or factor, its inverse, their product, and rows and products of both halves
        return BYTES * max(2 * matrix + rows, 3 * matrix + 4 * half)

    def factor(
        self, equations: Equations, motions: Motions, *, damped: bool = False, coarse: bool = False
    ) -> DenseFactor | None:
        """Return the factored reduced normal equations; arguments as in `Solver.factor`.

        Raises:
            GeometryError: the matrix would not fit in memory.
        """
        protocol.refuse_what_does_not_fit(
            self.bytes, f"{counted(self.layout.reduced, 'unknown')} that are all connected"
        )
        scale = equations.parts.scale
        S = schur_complement(equations, self.layout, self.pairs, single=coarse)
        Q = motions.orthonormal(scale)
        if motions.defect:
            S = (ssyrk if coarse else dsyrk)(1.0, Q, beta=1.0, c=S, overwrite_c=1)
        further = np.zeros((len(S), 0))
        if coarse:
            cholesky, info = spotrf(S, clean=0, overwrite_a=1)
            weak = info != 0 or float(np.diagonal(cholesky).min()) ** 2 < WEAK_SINGLE
            return None if weak else DenseFactor(self.layout, self.pairs, scale, cholesky, further)
        cholesky, info = dpotrf(S)
        weak = info != 0 or float(np.diagonal(cholesky).min()) ** 2 < WEAK_PIVOT
        if weak and not damped:
            del cholesky  # its memory is needed
            values, vectors = eigh(S, lower=False)
            further = np.asfortranarray(vectors[:, values < NULL])
            if further.shape[1]:
                S = dsyrk(1.0, further, beta=1.0, c=S, overwrite_c=1)
            cholesky, info = dpotrf(S, overwrite_a=1)
        return None if info != 0 else DenseFactor(self.layout, self.pairs, scale, cholesky, further)


@dataclass(frozen=True)
class DenseFactor:
    """Cholesky factor of the scaled reduced normal matrix with its null space filled."""

    layout: Unknowns
    pairs: Pairs | None  # positions of the rays if summed pair by pair
    scale: FloatArray  # 1/sqrt of the unreduced diagonal, (reduced,)
    cholesky: FloatArray  # upper factor of scaled S + QQ', (reduced, reduced)
    further: FloatArray  # null vectors that the datum does not explain, scaled, orthonormal, (reduced, e)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return S^+ right for one or several right-hand sides, (reduced,) or (reduced, r)."""
        s = self.scale if right.ndim == 1 else self.scale[:, None]
        solved = dpotrs if self.cholesky.dtype == np.float64 else spotrs
        x, _ = solved(self.cholesky, s * right)
        return np.asarray(s * x)

    def inverse_root(self) -> FloatArray:
        """Return the upper triangular W with S^+ = W W', in the units of the unknowns, (reduced, reduced)."""
        W, _ = dtrtri(self.cholesky)
        W *= self.scale[:, None]
        return np.asarray(W)

    def inverse(self, equations: Equations, *, cross: bool) -> Inverse:
        """Return the elements of the inverse; arguments as in `Factor.inverse`."""
        b, layout = equations.blocks, self.layout
        m, n = len(b.U), len(b.y)
        W = self.inverse_root()
        free = layout.reduced_free()
        if not free.all():
            W *= free[:, None]
        Q, _ = dlauum(W)
        _mirror(Q)
        first = 6 * m
        wanted = cross or self.pairs is not None
        core = np.empty((n, 3, 3))
        YQ = np.empty((len(b.Y) if wanted else 0, 3, 6))
        YQ_border = np.empty((n if wanted else 0, 3, layout.reduced - first))
        if self.pairs is not None:
            times_inverse(self.pairs, layout.observations, b.Y, Q.T, b.Y_interior, YQ)
            times_reduced(layout.observations, b, np.ascontiguousarray(Q[:, first:]), YQ_border)
            _core(layout.observations, YQ, b.Y, YQ_border, b.Y_interior, core)
        else:
            half = n // 2 if layout.reduced**2 >= HALVED else n

            def products(begin: int, end: int) -> None:
                for start, rows in rows_of(b, layout, np.ones(layout.reduced), np.float64, begin, end):
                    photographs = slice(start, start + len(rows) // 3)
                    if cross:
                        rowsQ = rows @ Q
                        pick_columns(layout.observations, rowsQ, start, YQ, YQ_border)
                        multiply_rows(rowsQ, rows, core[photographs])
                    else:
                        white = times_triangle(rows, W)
                        multiply_rows(white, white, core[photographs])

            at_once(lambda: products(0, half), lambda: products(half, n))
        if not cross:
            YQ, YQ_border = YQ[:0], YQ_border[:0]
        block = np.arange(first).reshape(m, 6)
        return Inverse(
            Q[block[:, :, None], block[:, None, :]], Q[:first, first:], Q[first:, first:], core, YQ, YQ_border
        )


def schur_complement(
    equations: Equations, layout: Unknowns, pairs: Pairs | None = None, *, single: bool = False
) -> FloatArray:
    """Return the scaled S = U - Y Y', upper triangle, column-major, (reduced, reduced).

    Args:
        equations: normal equations with object points eliminated.
        layout: order of the unknowns.
        pairs: positions of the rays to sum Y Y' pair by pair; None for a product of full rows.
        single: whether to compute in single precision.
    """
    b, parts = equations.blocks, equations.parts
    dtype = np.float32 if single else np.float64
    S = np.zeros((layout.reduced, layout.reduced), dtype=dtype)  # lower triangle, row-major, until the end
    if pairs is None:
        product = np.empty_like(S)
        for _, rows in rows_of(b, layout, parts.scale, dtype, summed=True):
            subtract_square(rows, product, S)
    else:
        subtract_squares(pairs, layout.observations, b.Y, b.Y_interior, S)
        S *= parts.scale
        S *= parts.scale[:, None]
    if parts.coupled is not None:
        first = parts.coupled.shape[0]
        of_poses = np.tril(parts.coupled.toarray()) * parts.scale[:first] * parts.scale[:first, None]
        S[:first, :first] += of_poses.astype(dtype)
    _add_blocks(b.U, parts.border, parts.corner, parts.scale, 1 + equations.damping, S.T)
    return S.T


@compiled
def _add_blocks(
    U: FloatArray, border: FloatArray, corner: FloatArray, scale: FloatArray, stretch: float, S: FloatArray
) -> None:
    """Add the scaled blocks to the upper triangle of S."""
    first = 6 * len(U)
    for i in range(len(U)):
        for q in range(6):
            for p in range(q + 1):
                value = U[i, p, q] * scale[6 * i + p] * scale[6 * i + q]
                S[6 * i + p, 6 * i + q] += value * stretch if p == q else value
    for q in range(border.shape[1]):
        for p in range(first):
            S[p, first + q] += border[p, q] * scale[p] * scale[first + q]
        for p in range(q + 1):
            value = corner[p, q] * scale[first + p] * scale[first + q]
            S[first + p, first + q] += value * stretch if p == q else value


@compiled
def _mirror(matrix: FloatArray) -> None:
    """Copy the upper triangle to the lower triangle."""
    for row in range(len(matrix)):
        for column in range(row):
            matrix[row, column] = matrix[column, row]


@kernel
def _core(
    observations: Observations,
    YQ: FloatArray,
    Y: FloatArray,
    YQ_border: FloatArray,
    Y_interior: FloatArray,
    core: FloatArray,
) -> None:
    """Fill Y'Q Y of each object point."""
    for j in range(len(core)):
        for p in range(3):
            for q in range(3):
                total = 0.0
                for c in range(Y_interior.shape[2]):
                    total += YQ_border[j, p, c] * Y_interior[j, q, c]
                core[j, p, q] = total
        for o in range(observations.start[j], observations.start[j + 1]):
            for p in range(3):
                for q in range(3):
                    for r in range(6):
                        core[j, p, q] += YQ[o, p, r] * Y[o, q, r]


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
    """Yield scaled rows Y', some object points at a time: the first point, and rows (3 points, reduced).

    Each set of rows overwrites the previous one.

    Args:
        blocks: filled blocks.
        layout: order of the unknowns.
        scale: scale of each reduced unknown, (reduced,).
        dtype: type of the numbers.
        begin: first object point.
        end: object point after the last; all if not given.
        summed: whether products of the rows are summed, for which more rows at a time are faster.
    """
    end, width = len(blocks.y) if end is None else end, layout.reduced
    space: FloatArray = np.empty((rows_at_a_time(end - begin, width, summed=summed), width), dtype=dtype)
    points = len(space) // 3
    for first in range(begin, end, points):
        rows = space[: 3 * min(points, end - first)]
        _fill(layout.observations, blocks.Y, blocks.Y_interior, scale, first, rows)
        yield first, rows


def rows_at_a_time(points: int, width: int, *, summed: bool = False) -> int:
    """Return the number of rows Y' that are formed at a time.

    Args:
        points: number of object points.
        width: length of a row.
        summed: whether products of the rows are summed.
    """
    least = ROWS * width if summed else LEAST
    return 3 * max(min(points, max(least, CHUNK // width) // 3 + 1), 1)


def subtract_square(rows: FloatArray, product: FloatArray, S: FloatArray) -> None:
    """Subtract rows' rows from the lower triangle of S.

    One thread forms the triangles of both halves, another the square between them, which takes as many
    operations. Numpy's product lets other threads run.

    Args:
        rows: some rows Y' of object points, (3 points, reduced).
        product: work space for the product, (reduced, reduced).
        S: matrix to subtract from, row-major, (reduced, reduced).
    """
    half = S.shape[0] // 2
    left, right = rows[:, :half], rows[:, half:]

    def subtract(a: FloatArray, b: FloatArray, row: int, column: int) -> None:
        block = slice(row, row + a.shape[1]), slice(column, column + b.shape[1])
        np.matmul(a.T, b, out=product[block])
        S[block] -= product[block]

    def triangles() -> None:
        subtract(left, left, 0, 0)
        subtract(right, right, half, half)

    if S.size < HALVED:
        subtract(rows, rows, 0, 0)
    else:
        at_once(triangles, lambda: subtract(right, left, half, 0))


def times_triangle(rows: FloatArray, W: FloatArray) -> FloatArray:
    """Return rows W, computed some columns at a time to skip most of the zeros of W.

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
    """Fill `core` with the products of the three left and the three right rows of each object point.

    Args:
        left: three rows of each point, (3 points, reduced).
        right: three rows of each point, (3 points, reduced).
        core: receives the products, (points, 3, 3).
    """
    shape = (-1, 3, left.shape[1])
    np.matmul(left.reshape(shape), np.swapaxes(right.reshape(shape), 1, 2), out=core)


@compiled
def pick_columns(
    observations: Observations, products: FloatArray, start: int, YQ: FloatArray, YQ_border: FloatArray
) -> None:
    """Copy from each point's rows the columns of the photographs that see the point, and the border columns.

    Args:
        observations: image points.
        products: rows Y'Q of some object points, (3 points, reduced).
        start: first of these points.
        YQ: receives the columns of poses, (k, 3, 6).
        YQ_border: receives the columns of the border, (n, 3, i + 3 s).
    """
    first = 6 * observations.poses
    for h in range(len(products) // 3):
        j = start + h
        for p in range(3):
            for o in range(observations.start[j], observations.start[j + 1]):
                for q in range(6):
                    YQ[o, p, q] = products[3 * h + p, 6 * observations.pose[o] + q]
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
    start = 6 * observations.poses
    for h in range(len(rows) // 3):
        j = first + h
        rows[3 * h : 3 * h + 3] = 0.0
        for o in range(observations.start[j], observations.start[j + 1]):
            c = 6 * observations.pose[o]
            for p in range(3):
                for q in range(6):
                    rows[3 * h + p, c + q] += Y[o, p, q] * scale[c + q]
        for p in range(3):
            for q in range(Y_interior.shape[2]):
                rows[3 * h + p, start + q] = Y_interior[j, p, q] * scale[start + q]
