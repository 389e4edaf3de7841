"""The reduced normal matrix as a band with a border: photographs near one another, the rest beside them.

With the photographs in the order of `sfm.adjustment.engine.solvers.choice`

    S = (A C; C' D)     A banded: exterior orientation; D: interior unknowns and kept points

is factored as A = L L' and D - C' A^-1 C. The motions that the datum leaves open, and any further null
vectors, are held by adding 1 to one diagonal element for each, which leaves the band a band: with g free of
the null space these unknowns get dx = 0 and nothing else changes, a minimal constraint.

Source: George and Liu (1981), Computer Solution of Large Sparse Positive Definite Systems, ch. 4; Foerstner
and Wrobel (2016), sec. 15.2.4 and 4.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, eigh, qr
from scipy.linalg.lapack import dpbtrf, dpbtrs

from sfm.adjustment.engine.collinearity import Observations
from sfm.adjustment.engine.motions import Motions
from sfm.adjustment.engine.normals import Equations
from sfm.adjustment.engine.solvers.banded_factor import BandFactor
from sfm.adjustment.engine.solvers.dense import NULL, WEAK_PIVOT
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.conventions import FloatArray, IntArray
from sfm.kernels.blocks import subtract_pair
from sfm.kernels.options import compiled, inlined, kernel
from sfm.kernels.threads import at_once

SHIFT = 1e-10  # share of the diagonal added to look for null vectors; far above rounding, far below weak ones
INVERSE_STEPS = 12  # of inverse iteration; each brings null vectors forward by eigenvalue / SHIFT
FIRST_SOUGHT = 8  # null vectors looked for at first


class BandMatrix(NamedTuple):
    """Scaled reduced normal matrix, photographs in their order in the band."""

    A: FloatArray  # A[c, d] = S[c + d, c], (6 m, bandwidth + 1)
    C: FloatArray  # (6 m, i + 3 s)
    D: FloatArray  # (i + 3 s, i + 3 s)


@dataclass(frozen=True)
class BandSolver:
    """The reduced normal matrix as a band."""

    layout: Unknowns
    place: IntArray  # place of each photograph in the band, (m,)
    points: IntArray  # object points in the order of the first of their photographs, which keeps what is near
    # in the band near in time, (n,)
    width: int  # largest difference of the places of two photographs that share a point

    @property
    def has_coarse(self) -> bool:
        """Whether a step on the way takes less time in single precision: never."""
        return False

    def factor(
        self, equations: Equations, motions: Motions, *, damped: bool = False, coarse: bool = False
    ) -> BandFactor | None:
        """Return the factored reduced normal equations; Args: as `Solver.factor`."""
        scale = equations.parts.scale
        rows = (6 * np.argsort(self.place)[:, None] + np.arange(6)).ravel()
        Q = np.linalg.qr(motions.reduced / scale[:, None])[0] if motions.defect else motions.reduced
        holds = _largest(Q[: len(rows)])  # of exterior unknowns, else A would stay singular
        matrix = self._matrix(equations, rows)
        found = _factored(matrix, rows, holds)
        further = np.zeros((self.layout.reduced, 0))
        if not damped and (found is None or found.weak):
            matrix = self._matrix(equations, rows)  # factoring has taken its place
            further = self._null_vectors(matrix, rows, holds, Q)
            found = _factored(matrix, rows, np.concatenate([holds, _largest(further)]))
        if found is None:
            return None
        return self._factor_of(scale, rows, matrix, found, further)

    def _matrix(self, equations: Equations, rows: IntArray) -> BandMatrix:
        """Return the scaled matrix, photographs in the order of the band."""
        b, parts = equations.blocks, equations.parts
        first, border = len(rows), len(parts.corner)
        A = np.zeros((first, 6 * self.width + 6))
        C = parts.border[rows]
        inner = b.Y_interior.shape[2]
        interior = b.Y_interior.reshape(-1, inner)
        D = parts.corner.copy()
        D[:inner, :inner] -= interior.T @ interior
        flat = np.reshape(A, -1)
        stride = A.shape[1] - 1  # element (r, c) of the matrix at c stride + r

        def add(begin: int, end: int) -> None:
            _add_pairs(
                self.layout.observations,
                b.U,
                b.Y,
                b.Y_interior,
                self.place,
                self.points,
                begin,
                end,
                flat,
                stride,
                C,
            )

        half = len(b.U) // 2
        at_once(lambda: add(0, half), lambda: add(half, len(b.U)))
        s, sb = parts.scale[rows], parts.scale[first:]
        _scale_band(A, s, 1 + equations.damping)
        C *= s[:, None] * sb
        D *= sb[:, None] * sb
        D[np.arange(border), np.arange(border)] += equations.damping
        return BandMatrix(A, C, D)

    def _null_vectors(self, matrix: BandMatrix, rows: IntArray, holds: IntArray, Q: FloatArray) -> FloatArray:
        """Return null vectors that are none of the motions Q, orthonormal, by inverse iteration."""
        found = _factored(matrix._replace(A=matrix.A.copy()), rows, holds, SHIFT)
        if found is None:
            return np.zeros((len(Q), 0))
        factor = self._factor_of(np.ones(len(Q)), rows, matrix, found, Q)
        sought = FIRST_SOUGHT
        while True:
            V = np.random.default_rng(0).standard_normal((len(Q), sought))
            for _ in range(INVERSE_STEPS):
                V = factor.solve(np.linalg.qr(V - Q @ (Q.T @ V))[0])
            V = np.linalg.qr(V - Q @ (Q.T @ V))[0]
            values, vectors = eigh(V.T @ _times(matrix, rows, V))
            null = values < NULL
            if not null.all() or sought >= len(Q):
                return np.asarray(V @ vectors[:, null])
            sought *= 2

    def _factor_of(
        self, scale: FloatArray, rows: IntArray, matrix: BandMatrix, found: _Factored, further: FloatArray
    ) -> BandFactor:
        """Return the factor with all that belongs to it."""
        return BandFactor(
            self.layout, scale, rows, self.points, matrix.C, found.L, found.X, found.corner, further
        )


class _Factored(NamedTuple):
    """The factors that `BandFactor` explains."""

    L: FloatArray
    X: FloatArray
    corner: FloatArray
    weak: bool  # whether a pivot is near 0


def _factored(matrix: BandMatrix, rows: IntArray, holds: IntArray, shift: float = 0.0) -> _Factored | None:
    """Return the factors, in the place of the matrix's A; None if that fails."""
    first = len(rows)
    place = np.empty(first, dtype=np.int64)
    place[rows] = np.arange(first)
    A, D = matrix.A, matrix.D.copy()
    A[:, 0] += shift
    D[np.arange(len(D)), np.arange(len(D))] += shift
    A[place[holds[holds < first]], 0] += 1.0
    own = holds[holds >= first] - first
    D[own, own] += 1.0
    L, info = dpbtrf(A.T, lower=1, overwrite_ab=1)
    if info != 0:
        return None
    pivots = L[0]
    X, corner = matrix.C, D
    if len(D):
        X, _ = dpbtrs(L, matrix.C, lower=1)
        try:
            corner, _ = cho_factor(D - matrix.C.T @ X)
        except np.linalg.LinAlgError:
            return None
        pivots = np.concatenate([pivots, np.diagonal(corner)])
    return _Factored(L.T, np.asarray(X), corner, bool(pivots.min() ** 2 < WEAK_PIVOT))


def _largest(vectors: FloatArray) -> IntArray:
    """Return as many rows as there are vectors, in which these are as independent as can be."""
    if vectors.shape[1] == 0:
        return np.zeros(0, dtype=np.int64)
    _, _, pivots = qr(vectors.T, mode="economic", pivoting=True)
    return np.asarray(pivots[: vectors.shape[1]], dtype=np.int64)


def _times(matrix: BandMatrix, rows: IntArray, V: FloatArray) -> FloatArray:
    """Return S V, (reduced, e)."""
    first = len(rows)
    top = np.ascontiguousarray(V[rows])
    product = np.zeros_like(top)
    _band_times(matrix.A, top, product)
    out = np.empty_like(V)
    out[rows] = product + matrix.C @ V[first:]
    out[first:] = matrix.C.T @ top + matrix.D @ V[first:]
    return out


@kernel
def _add_pairs(
    observations: Observations,
    U: FloatArray,
    Y: FloatArray,
    Y_interior: FloatArray,
    place: IntArray,
    points: IntArray,
    begin: int,
    end: int,
    flat: FloatArray,
    stride: int,
    C: FloatArray,
) -> None:
    """Add U - Y Y' of photographs to the band and -Y Y_interior of interior unknowns to the border C.

    Takes the columns of the photographs in places begin to end, so that others can be taken at the same time.
    """
    for i in range(len(U)):
        c = 6 * place[i]
        if begin <= place[i] < end:
            for q in range(6):
                for p in range(q, 6):
                    flat[(c + q) * stride + c + p] += U[i, p, q]
    for j in points:
        for s in range(observations.start[j], observations.start[j + 1]):
            own = place[observations.image[s]]
            if begin <= own < end:
                _add_border(6 * own, Y, s, Y_interior, j, C)
                _add_triangle(flat, 6 * own, stride, Y, s, s)
            for t in range(observations.start[j], s):
                other = place[observations.image[t]]
                if begin <= min(own, other) < end:
                    if other < own:
                        subtract_pair(flat, 6 * other * stride + 6 * own, stride, Y, t, s)
                    elif other > own:
                        subtract_pair(flat, 6 * own * stride + 6 * other, stride, Y, s, t)
                    else:  # a point measured twice in a photograph
                        _add_triangle(flat, 6 * own, stride, Y, s, t)
                        _add_triangle(flat, 6 * own, stride, Y, t, s)


@inlined
def _add_border(row: int, Y: FloatArray, s: int, Y_interior: FloatArray, j: int, C: FloatArray) -> None:
    for q in range(6):
        s0, s1, s2 = Y[s, 0, q], Y[s, 1, q], Y[s, 2, q]
        for c in range(Y_interior.shape[2]):
            C[row + q, c] -= s0 * Y_interior[j, 0, c] + s1 * Y_interior[j, 1, c] + s2 * Y_interior[j, 2, c]


@inlined
def _add_triangle(flat: FloatArray, column: int, stride: int, Y: FloatArray, s: int, t: int) -> None:
    for q in range(6):
        for p in range(q, 6):
            product = Y[s, 0, q] * Y[t, 0, p] + Y[s, 1, q] * Y[t, 1, p] + Y[s, 2, q] * Y[t, 2, p]
            flat[(column + q) * stride + column + p] -= product


@compiled
def _scale_band(band: FloatArray, scale: FloatArray, stretch: float) -> None:
    """Scale a band by rows and columns; its diagonal was 1 before anything was taken off."""
    for column in range(len(band)):
        for below in range(min(band.shape[1], len(band) - column)):
            band[column, below] *= scale[column] * scale[column + below]
        band[column, 0] += stretch - 1.0


@compiled
def _band_times(band: FloatArray, vectors: FloatArray, out: FloatArray) -> None:
    """Add the product of a symmetric band and vectors (6 m, e) to out."""
    for column in range(len(band)):
        for below in range(min(band.shape[1], len(band) - column)):
            for e in range(vectors.shape[1]):
                out[column + below, e] += band[column, below] * vectors[column, e]
                if below > 0:
                    out[column, e] += band[column, below] * vectors[column + below, e]
