"""The reduced normal equations factored: scaled, with the open motions of the datum held, undamped.

With scaled S and an orthonormal basis Q of its null space, S + QQ' is positive definite and its
solution is the one with Q'dx = 0: an inner constraint, not damping. Directions that the observations
cannot determine although the datum does not explain them are found as further null vectors and held in
the same way, so that everything else is still estimated; they are reported.

Source: Foerstner and Wrobel (2016), sec. 4.5; Luhmann et al. (2020), sec. 4.4.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.linalg.blas import dsyrk
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from sfm.adjustment.datum import Motions
from sfm.adjustment.normals import Normals
from sfm.conventions import FloatArray

NULL = 1e-12  # eigenvalue of the scaled matrix (diagonal at most 1) taken as 0; rounding leaves 1e-15
WEAK_PIVOT = 1e-11  # squared pivot below which the eigenvalues are looked at


@dataclass(frozen=True)
class Factor:
    """Cholesky factor of the scaled reduced normal matrix with its null space filled."""

    scale: FloatArray  # 1/sqrt of the unreduced diagonal, (reduced,)
    cholesky: FloatArray  # upper factor of scale S scale + QQ', (reduced, reduced)
    motions: FloatArray  # Q, null vectors that the datum explains, scaled, orthonormal, (reduced, d)
    further: FloatArray  # null vectors that it does not, scaled, orthonormal, (reduced, e)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return S^+ right for one or several right sides, (reduced,) or (reduced, r)."""
        s = self.scale if right.ndim == 1 else self.scale[:, None]
        x, _ = dpotrs(self.cholesky, s * right)
        return np.asarray(s * x)

    def verified(self, normals: Normals) -> int:
        """Return how many of the null vectors that the datum explains the normal matrix maps to 0."""
        S = normals.S * self.scale[:, None] * self.scale
        SQ = np.triu(S) @ self.motions + np.triu(S, 1).T @ self.motions
        return int((np.linalg.norm(SQ, axis=0) < np.sqrt(NULL)).sum())

    def inverse(self) -> FloatArray:
        """Return the inverse with its null space filled, in the units of the unknowns, (reduced, reduced)."""
        Q, _ = dpotri(self.cholesky)
        Q = np.triu(Q) + np.triu(Q, 1).T
        return np.asarray(Q * self.scale[:, None] * self.scale)


def factor(normals: Normals, motions: Motions, *, damped: bool = False) -> Factor | None:
    """Return the factored reduced normal equations; None if a damped matrix is not positive definite.

    Args:
        normals: reduced normal equations, upper triangle.
        motions: null vectors that the datum explains.
        damped: whether the equations carry damping, so that no further null vectors are sought.
    """
    scale = 1 / np.sqrt(np.maximum(normals.diagonal, np.finfo(float).tiny))
    S = np.asfortranarray(normals.S * scale[:, None] * scale)
    Q = np.linalg.qr(motions.reduced / scale[:, None])[0] if motions.defect else motions.reduced
    if motions.defect:
        S = dsyrk(1.0, Q, beta=1.0, c=S, overwrite_c=1)
    further = np.zeros((len(S), 0))
    cholesky, info = dpotrf(S)
    weak = info != 0 or float(np.diagonal(cholesky).min()) ** 2 < WEAK_PIVOT
    if weak and damped:
        return None if info != 0 else Factor(scale, cholesky, Q, further)
    if weak:
        values, vectors = eigh(S, lower=False)
        further = np.asfortranarray(vectors[:, values < NULL])
        if further.shape[1]:
            S = dsyrk(1.0, further, beta=1.0, c=S, overwrite_c=1)
            cholesky, info = dpotrf(S)
        if info != 0:
            return None
    return Factor(scale, cholesky, Q, further)
