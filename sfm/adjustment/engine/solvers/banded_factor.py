"""The factor of a banded reduced normal matrix with a border: solutions, and elements of its inverse.

Source: George and Liu (1981), Computer Solution of Large Sparse Positive Definite Systems, ch. 4; Foerstner
and Wrobel (2016), sec. 15.2.5; Golub and Plemmons (1980), Linear Algebra Appl. 34.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.lapack import dpbtrs

from sfm.adjustment.engine.accumulate import Blocks
from sfm.adjustment.engine.collinearity import Observations
from sfm.adjustment.engine.solvers.banded_inverse import band_inverse
from sfm.adjustment.engine.solvers.protocol import Inverse
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.conventions import FloatArray, IntArray
from sfm.kernels.options import compiled, kernel


@dataclass(frozen=True)
class BandFactor:
    """Factors of a banded reduced normal matrix with its null space held."""

    layout: Unknowns
    scale: FloatArray  # 1/sqrt of the unreduced diagonal, (reduced,)
    rows: IntArray  # exterior unknown at each place of the band, (6 m,)
    points: IntArray  # object points as the band meets them, (n,)
    C: FloatArray  # (6 m, i + 3 s)
    L: FloatArray  # A + holds = L L', stored as A
    X: FloatArray  # A^-1 C, (6 m, i + 3 s)
    corner: FloatArray  # upper Cholesky factor of D - C' A^-1 C, (i + 3 s, i + 3 s)
    further: FloatArray  # null vectors that the datum does not explain, scaled, orthonormal, (reduced, e)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return a solution of S x = right for one or several right sides, (reduced,) or (reduced, r)."""
        first = len(self.rows)
        columns = right if right.ndim == 2 else right[:, None]
        s = self.scale[:, None]
        r = s * columns
        z, _ = dpbtrs(self.L.T, r[self.rows], lower=1)
        xb = r[first:] - self.C.T @ z
        if len(xb):
            xb = cho_solve((self.corner, False), xb)
        x = np.empty_like(r)
        x[self.rows] = z - self.X @ xb
        x[first:] = xb
        return np.asarray((s * x).reshape(right.shape))

    def inverse(self, blocks: Blocks, *, cross: bool) -> Inverse:
        """Return the elements of the inverse; Args: as `Factor.inverse`.

        With Z = A^-1 within the band, X = A^-1 C and Q = (D - C' A^-1 C)^-1 they are those of
        S^-1 = (Z + X Q X'   -X Q; -Q X'   Q).
        """
        b, layout = blocks, self.layout
        m, n = len(b.U), len(b.y)
        first, border = 6 * m, len(self.corner)
        free = layout.reduced_free().astype(float)
        s, sb = (self.scale * free)[self.rows], (self.scale * free)[first:]
        Z = band_inverse(self.L)
        _scale_inverse(Z, s)
        X = self.X * s[:, None] / self.scale[first:]
        Q = cho_solve((self.corner, False), np.eye(border)) if border else np.zeros((0, 0))
        Q = Q * sb[:, None] * sb
        place = np.empty(m, dtype=np.int64)
        place[self.rows[::6] // 6] = np.arange(m)
        mixed = np.empty((first, border))
        XQ = X @ Q
        mixed[self.rows] = -XQ
        exterior = np.empty((m, 6, 6))
        core, YQ, YQ_border = np.zeros((n, 3, 3)), np.empty((len(b.Y), 3, 6)), np.empty((n, 3, border))
        _diagonal_blocks(Z, place, X, XQ, exterior)
        space = np.empty((3, border))
        _sum_pairs(
            layout.observations, place, self.points, b.Y, b.Y_interior, Z, X, Q, space, core, YQ, YQ_border
        )
        if not cross:
            YQ, YQ_border = YQ[:0], YQ_border[:0]
        return Inverse(exterior, mixed, Q, core, YQ, YQ_border)


@compiled
def _scale_inverse(band: FloatArray, scale: FloatArray) -> None:
    """Scale a band by rows and columns."""
    for column in range(len(band)):
        for below in range(min(band.shape[1], len(band) - column)):
            band[column, below] *= scale[column] * scale[column + below]


@compiled
def _diagonal_blocks(
    Z: FloatArray, place: IntArray, X: FloatArray, XQ: FloatArray, exterior: FloatArray
) -> None:
    """Fill Z + X Q X' of each photograph by itself."""
    for i in range(len(place)):
        c = 6 * place[i]
        for p in range(6):
            for q in range(6):
                total = Z[c + min(p, q), abs(p - q)]
                for s in range(X.shape[1]):
                    total += XQ[c + p, s] * X[c + q, s]
                exterior[i, p, q] = total


@kernel
def _sum_pairs(
    observations: Observations,
    place: IntArray,
    points: IntArray,
    Y: FloatArray,
    Y_interior: FloatArray,
    Z: FloatArray,
    X: FloatArray,
    Q: FloatArray,
    uQ: FloatArray,
    core: FloatArray,
    YQ: FloatArray,
    YQ_border: FloatArray,
) -> None:
    """Fill Y'S^-1 and Y'S^-1 Y of each object point; Y_interior of the interior unknowns."""
    inner = Y_interior.shape[2]
    for j in points:
        for p in range(3):  # u Q with u = Y'X - Y_interior
            for c in range(len(Q)):
                YQ_border[j, p, c] = -Y_interior[j, p, c] if c < inner else 0.0
        for t in range(observations.start[j], observations.start[j + 1]):
            column = 6 * place[observations.image[t]]
            for p in range(3):
                for q in range(6):
                    for c in range(len(Q)):
                        YQ_border[j, p, c] += Y[t, p, q] * X[column + q, c]
        for p in range(3):
            for c in range(len(Q)):
                total = 0.0
                for s in range(len(Q)):
                    total += YQ_border[j, p, s] * Q[s, c]
                uQ[p, c] = total
        for s in range(observations.start[j], observations.start[j + 1]):
            row = 6 * place[observations.image[s]]
            for p in range(3):
                for q in range(6):
                    total = 0.0
                    for c in range(len(Q)):
                        total += uQ[p, c] * X[row + q, c]
                    YQ[s, p, q] = total
            for t in range(observations.start[j], observations.start[j + 1]):
                column = 6 * place[observations.image[t]]
                for r in range(6):
                    t0, t1, t2 = Y[t, 0, r], Y[t, 1, r], Y[t, 2, r]
                    for q in range(6):
                        if row + q >= column + r:
                            z = Z[column + r, row + q - column - r]
                        else:
                            z = Z[row + q, column + r - row - q]
                        YQ[s, 0, q] += t0 * z
                        YQ[s, 1, q] += t1 * z
                        YQ[s, 2, q] += t2 * z
            for p in range(3):
                for q in range(3):
                    for r in range(6):
                        core[j, p, q] += YQ[s, p, r] * Y[s, q, r]
        for p in range(3):
            for c in range(len(Q)):
                YQ_border[j, p, c] = -uQ[p, c]
            for q in range(3):
                for c in range(inner):
                    core[j, p, q] -= uQ[p, c] * Y_interior[j, q, c]
