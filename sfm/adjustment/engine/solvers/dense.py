"""The reduced normal matrix in full and factored: scaled, with the open motions of the datum held, undamped.

With scaled S and an orthonormal basis Q of its null space, S + QQ' is positive definite and its
solution is the one with Q'dx = 0: an inner constraint, not damping. Directions that the observations
cannot determine although the datum does not explain them are found as further null vectors and held in
the same way, so that everything else is still estimated; they are reported.

Source: Foerstner and Wrobel (2016), sec. 4.5; Luhmann et al. (2020), sec. 4.4.3.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.linalg import eigh
from scipy.linalg.blas import dsyrk, ssyrk
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtri, spotrf, spotrs

from sfm.adjustment.engine.motions import Motions
from sfm.adjustment.engine.normals import Blocks, Equations
from sfm.adjustment.engine.solvers.pairs import Pairs, subtract_squares
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.conventions import FloatArray
from sfm.errors import GeometryError
from sfm.kernels.threads import at_once

NULL = 1e-12  # eigenvalue of the scaled matrix (diagonal at most 1) taken as 0; rounding leaves 1e-15
WEAK_PIVOT = 1e-11  # squared pivot below which the eigenvalues are looked at
WEAK_SINGLE = 1e-5  # the same in single precision, whose rounding leaves 1e-6
CHUNK = 1_000_000  # numbers of rows Y' that are multiplied at a time, at least
ROWS = 2  # and rows for each unknown: adding up the products would take longer than forming them otherwise
HALVED = 200**2  # elements of the matrix from which its halves are formed by themselves
LARGEST_BYTES = 6e9  # of the full matrix; larger ones would swap


@dataclass(frozen=True)
class Factor:
    """Cholesky factor of the scaled reduced normal matrix with its null space filled."""

    scale: FloatArray  # 1/sqrt of the unreduced diagonal, (reduced,)
    cholesky: FloatArray  # upper factor of S + QQ' scaled, (reduced, reduced)
    further: FloatArray  # null vectors that the datum does not explain, scaled, orthonormal, (reduced, e)
    pairs: Pairs | None  # where it was summed pair by pair

    def solve(self, right: FloatArray) -> FloatArray:
        """Return S^+ right for one or several right sides, (reduced,) or (reduced, r)."""
        s = self.scale if right.ndim == 1 else self.scale[:, None]
        solved = dpotrs if self.cholesky.dtype == np.float64 else spotrs
        x, _ = solved(self.cholesky, s * right)
        return np.asarray(s * x)

    def inverse_root(self) -> FloatArray:
        """Return W with S^+ = W W', upper triangle, in the units of the unknowns, (reduced, reduced)."""
        W, _ = dtrtri(self.cholesky)
        W *= self.scale[:, None]
        return np.asarray(W)


def factor(
    equations: Equations,
    layout: Unknowns,
    motions: Motions,
    pairs: Pairs | None = None,
    *,
    damped: bool = False,
    single: bool = False,
) -> Factor | None:
    """Return the factored reduced normal equations; None if they are not positive definite.

    Args:
        equations: normal equations with object points eliminated.
        layout: order of the unknowns.
        motions: null vectors that the datum explains.
        pairs: places of the rays where the matrix is summed pair by pair, None: as a product of full rows.
        damped: whether the equations carry damping, so that no further null vectors are sought.
        single: whether all this may be in single precision, for a step on the way; None if that is too weak.

    Raises:
        GeometryError: the matrix would not fit in memory.
    """
    scale = equations.parts.scale
    S = schur_complement(equations, layout, pairs, single=single)
    Q = np.linalg.qr(motions.reduced / scale[:, None])[0] if motions.defect else motions.reduced
    if motions.defect:
        S = (ssyrk if single else dsyrk)(1.0, Q, beta=1.0, c=S, overwrite_c=1)
    further = np.zeros((len(S), 0))
    if single:
        cholesky, info = spotrf(S, clean=0, overwrite_a=1)
        weak = info != 0 or float(np.diagonal(cholesky).min()) ** 2 < WEAK_SINGLE
        return None if weak else Factor(scale, cholesky, further, pairs)
    cholesky, info = dpotrf(S)
    weak = info != 0 or float(np.diagonal(cholesky).min()) ** 2 < WEAK_PIVOT
    if weak and damped:
        return None if info != 0 else Factor(scale, cholesky, further, pairs)
    if weak:
        values, vectors = eigh(S, lower=False)
        further = np.asfortranarray(vectors[:, values < NULL])
        if further.shape[1]:
            filled = dsyrk(1.0, further, beta=1.0, c=S)
            cholesky, info = dpotrf(filled)
        if info != 0:
            return None
    return Factor(scale, cholesky, further, pairs)


def rows_of(
    blocks: Blocks,
    layout: Unknowns,
    scale: FloatArray,
    dtype: type,
    begin: int = 0,
    end: int | None = None,
) -> Iterator[tuple[int, FloatArray]]:
    """Yield rows Y' times scale, some object points at a time: the first point, and (3 points, reduced).

    The next rows take the place of the last ones. Begins and ends with object points begin and end, if given.
    """
    end, width = len(blocks.y) if end is None else end, layout.reduced
    points = max(min(end - begin, max(ROWS * width, CHUNK // width) // 3 + 1), 1)
    space: FloatArray = np.empty((3 * points, width), dtype=dtype)
    for first in range(begin, end, points):
        rows = space[: 3 * min(points, end - first)]
        _fill(layout.observations, blocks.Y, blocks.Z, scale, first, rows)
        yield first, rows


def schur_complement(
    equations: Equations, layout: Unknowns, pairs: Pairs | None = None, *, single: bool = False
) -> FloatArray:
    """Return S = U - Y Y' scaled, upper triangle, column-major."""
    size = 8.0 * layout.reduced**2
    if size > LARGEST_BYTES:
        raise GeometryError(
            f"adjustment: {layout.reduced} unknowns that are all connected need {size / 1e9:.0f} GB in one "
            f"dense system, at most {LARGEST_BYTES / 1e9:.0f} GB are taken"
        )
    b, parts = equations.blocks, equations.parts
    dtype = np.float32 if single else np.float64
    S = np.zeros((layout.reduced, layout.reduced), dtype=dtype)  # lower triangle, row-major, until the end
    if pairs is None:
        product = np.empty_like(S)
        for _, rows in rows_of(b, layout, parts.scale, dtype):
            _subtract_square(rows, product, S)
    else:
        subtract_squares(pairs, layout.observations, b.Y, b.Z, S)
        S *= parts.scale
        S *= parts.scale[:, None]
    _add_blocks(b.U, parts.border, parts.corner, parts.scale, 1 + equations.damping, S.T)
    return S.T


def _subtract_square(rows: FloatArray, product: FloatArray, S: FloatArray) -> None:
    """Take rows' rows off the lower triangle of S: both triangles of its halves in one thread, the square
    between them, which is as many operations, in another. numpy's product lets other threads run."""
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


@njit(cache=True, error_model="numpy", nogil=True)
def _fill(observations, Y, Z, scale, first, rows):  # type: ignore[no-untyped-def]
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
            for q in range(Z.shape[2]):
                rows[3 * h + p, start + q] = Z[j, p, q] * scale[start + q]


@njit(cache=True, error_model="numpy")
def _add_blocks(U, border, corner, scale, stretch, S):  # type: ignore[no-untyped-def]
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
