"""Elements of the inverse of a banded matrix within its band, without the rest of the inverse.

From A = L L' and Z = A^-1 follows, block column by block column from the last,

    Z_RJ = -Z_RR G,   Z_JJ = L_JJ^-T L_JJ^-1 - G' Z_RJ,   G = L_RJ L_JJ^-1

where R are the rows of the band below block J, so that Z_RR is known already.

Source: Takahashi, Fagan and Chin (1973), Formation of a sparse bus impedance matrix; Erisman and Tinney
(1975), Comm. ACM 18(3).
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dtrtri

from sfm.conventions import FloatArray
from sfm.kernels.options import compiled

BLOCK = 96  # columns at a time; large enough for matrix products, small against a band


def band_inverse(L: FloatArray) -> FloatArray:
    """Return the elements of (L L')^-1 within the band.

    Args:
        L: L[c, d] = element (c + d, c) of the factor, shape (n, bandwidth + 1).

    Returns:
        The same elements of the inverse, stored in the same way.
    """
    n, band = L.shape[0], L.shape[1] - 1
    Z = np.zeros(L.shape)
    below = np.zeros((0, 0))  # Z_RR
    for start in range((n - 1) // BLOCK * BLOCK, -1, -BLOCK):
        width, end = min(BLOCK, n - start), min(start + BLOCK + band, n)
        panel = np.zeros((end - start, width))
        _unpack(L, start, panel)
        inverse, _ = dtrtri(panel[:width], lower=1)
        inverse = np.tril(inverse)
        G = panel[width:] @ inverse
        below = below[: len(G), : len(G)]
        Z_RJ = -(below @ G)
        Z_JJ = inverse.T @ inverse - G.T @ Z_RJ
        column = np.vstack([Z_JJ, Z_RJ])
        _pack(column, start, Z)
        kept = min(len(column), band)
        window = np.empty((kept, kept))
        own = min(width, kept)
        window[:, :own] = column[:kept, :own]
        window[:own, own:] = column[own:kept, :own].T
        window[own:, own:] = below[: kept - own, : kept - own]
        below = window
    return Z


@compiled
def _unpack(band: FloatArray, start: int, panel: FloatArray) -> None:
    """Copy columns of a band, from start, into a dense panel whose first row is start."""
    for column in range(panel.shape[1]):
        for below in range(min(band.shape[1], len(panel) - column)):
            panel[column + below, column] = band[start + column, below]


@compiled
def _pack(panel: FloatArray, start: int, band: FloatArray) -> None:
    """Copy a dense panel whose first row is start into columns of a band."""
    for column in range(panel.shape[1]):
        for below in range(min(band.shape[1], len(panel) - column)):
            band[start + column, below] = panel[column + below, column]
