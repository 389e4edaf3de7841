"""Null vectors of a reduced normal matrix that is never put together, by subspace iteration.

The matrix with a small shift of its diagonal is factored; solving with it again and again brings forward the
directions that the observations leave open, of which Rayleigh and Ritz's method then takes those with
eigenvalue 0. They carry the rounding of a factor that is all but singular; one step with the factor in
which they are held takes them to the rounding of the matrix itself, as its eigenvalue decomposition would.

Source: Golub and Van Loan (2013), Matrix Computations, sec. 8.2.4 and 8.1; Wilkinson (1965), The Algebraic
Eigenvalue Problem, ch. 9 (inverse iteration).
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh

from sfm.adjustment.engine.normals import Equations, times_schur
from sfm.adjustment.engine.solvers.dense import NULL
from sfm.adjustment.engine.solvers.protocol import Factor
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.conventions import FloatArray

SHIFT = 1e-10  # share of the diagonal added to look for null vectors; far above rounding, far below weak ones
STEPS = 12  # of the iteration; each brings null vectors forward by eigenvalue / SHIFT
FIRST_SOUGHT = 8  # null vectors looked for at first; as often twice as many as all of them are null


def null_vectors(shifted: Factor, equations: Equations, layout: Unknowns, Q: FloatArray) -> FloatArray:
    """Return null vectors of the scaled matrix that are none of the motions, orthonormal, (reduced, e).

    Args:
        shifted: its factor with SHIFT added and the motions held.
        equations: normal equations.
        layout: order of the unknowns.
        Q: the motions, scaled, orthonormal, (reduced, d).
    """
    scale = equations.parts.scale[:, None]
    sought = min(FIRST_SOUGHT, len(Q))
    while True:
        V = np.random.default_rng(0).standard_normal((len(Q), sought))
        for _ in range(STEPS):
            V = shifted.solve(_across(V, Q) / scale) / scale
        V = _across(V, Q)
        values, vectors = eigh(V.T @ _times(equations, layout, V))
        null = values < NULL
        if not null.all() or sought == len(Q):
            return np.asarray(V @ vectors[:, null])
        sought = min(2 * sought, len(Q))


def refined(
    vectors: FloatArray, held: Factor, equations: Equations, layout: Unknowns, Q: FloatArray
) -> FloatArray:
    """Return null vectors without what is left of others in them.

    Args:
        vectors: scaled, orthonormal, (reduced, e).
        held: factor of the matrix in which they and the motions are held.
        equations: normal equations.
        layout: order of the unknowns.
        Q: the motions, scaled, orthonormal, (reduced, d).
    """
    scale = equations.parts.scale[:, None]
    return _across(vectors - held.solve(_times(equations, layout, vectors) / scale) / scale, Q)


def _across(V: FloatArray, Q: FloatArray) -> FloatArray:
    """Return an orthonormal basis of what is left of V without Q."""
    return np.asarray(np.linalg.qr(V - Q @ (Q.T @ V))[0])


def _times(equations: Equations, layout: Unknowns, V: FloatArray) -> FloatArray:
    """Return S V of the scaled, undamped matrix, (reduced, e)."""
    scale = equations.parts.scale[:, None]
    return scale * times_schur(equations, layout, scale * V)
