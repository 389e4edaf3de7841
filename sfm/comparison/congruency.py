"""Congruency of two sets of coordinates of the same points: which of them moved, tested in one datum.

The differences d of two independent solutions are projected with the S-transformation of the points F that
are taken as stable,

    S = I - G (G_F' G_F)^-1 G_F',  d_S = S d,  Q_S = S (Q_a + Q_b) S',

G being the translations, small rotations and, where the scale is not defined by both, the scale of the whole.
What the datum of either solution holds or leaves undefined drops out. Under no change Omega = d' Q_S^+ d over
F follows chi-square with 3 n_F - u degrees of freedom, Omega / (3 n_F - u) Fisher's F where the variances are
estimated. The point whose removal from F lowers Omega most is taken to have moved, until the rest agrees.

Source: Caspary (2000), Concepts of network and deformation analysis, secs. 7 and 8; Pelzer (1971), Zur
Analyse geodaetischer Deformationsmessungen; Baarda (1973), S-transformations and criterion matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sfm.comparison.stable_points import (
    critical_value,
    find_stable_points,
    in_datum,
    point_blocks,
    single_tests,
)
from sfm.conventions import BoolArray, FloatArray
from sfm.errors import GeometryError
from sfm.similarity import mean_distance, similarity_motions

MOTIONS = {"none": 0, "rigid": 6, "similarity": 7}  # parameters of what is no change
MIN_STABLE = 4  # points that a datum needs to be checked by at least one more than it takes
STABLE_FRACTION = 0.5  # of the points that must agree for the others to be called moved
THIN = 0.05  # extent over the longest one below which an object has no depth to bend along
SAME_COLUMN = 1e-6  # singular value over the largest one below which a way to deform is no way of its own


@dataclass(frozen=True)
class Congruency:
    """Differences of the points in the datum of those that did not move."""

    difference: FloatArray  # d_S, (n, 3)
    covariance: FloatArray  # blocks of Q_S, (n, 3, 3)
    stable: BoolArray  # points that carry the datum, (n,); all that may where no majority of them agrees
    moved: BoolArray  # points that do not agree with the stable ones, (n,); none where nobody knows which
    statistic: FloatArray  # T of each point, its drop of Omega (stable) or its own test, over 3, (n,)
    critical: float  # of the largest T
    global_statistic: float  # Omega over its degrees of freedom, of all points before any was removed
    global_critical: float
    agreed: bool  # whether the stable points agree; else no majority of them does
    smooth: float  # fraction of Omega of all points that a bending of the whole takes away, see `bending`


def congruency(
    difference: FloatArray,
    covariance: FloatArray,
    xyz: FloatArray,
    *,
    motion: str = "rigid",
    redundancy: int | None = None,
    datum: BoolArray | None = None,
    alpha: float = 0.05,
) -> Congruency:
    """Test whether points have moved, and find those that have.

    Half of alpha is spent on the test of all points together and half on the largest of the single points.

    Args:
        difference: second minus first coordinates after any alignment, (n, 3).
        covariance: Q_a + Q_b of all coordinates together, (3 n, 3 n).
        xyz: coordinates, (n, 3).
        motion: what of the whole is no change: rigid (translation and rotation), similarity (the scale too,
            where not both have one of their own), or none (both in the datum of control).
        redundancy: of both adjustments together; None if the variances are known.
        datum: points that may carry the datum, (n,); all if not given.
        alpha: probability of calling something a change that is none.

    Raises:
        GeometryError: too few points, or a covariance that is singular beyond the datum.
    """
    n = len(xyz)
    candidates = np.ones(n, dtype=bool) if datum is None else datum.copy()
    first = int(candidates.sum())
    if first < MIN_STABLE:
        raise GeometryError(f"congruency: {first} points, expected {MIN_STABLE} or more")
    G = motions(xyz)[:, : MOTIONS[motion]]
    found = find_stable_points(
        difference,
        covariance,
        G,
        candidates=candidates,
        least=max(MIN_STABLE, math.ceil(STABLE_FRACTION * first)),
        redundancy=redundancy,
        alpha=alpha / 2,
        alpha_single=alpha / 2,
    )
    start = found.steps[0]
    smooth = 0.0
    if start.statistic > start.critical:
        smooth = smooth_fraction(difference, covariance, G, bending(xyz), candidates)
    stable, drops = (found.stable, found.drops) if found.agreed else (candidates, found.drops_of_all)
    d, Q = in_datum(difference, covariance, G, stable.astype(float))
    T = np.where(stable, drops, single_tests(d, Q))
    moved = candidates & ~stable
    if found.agreed and datum is not None:  # points that carry no datum are judged in it
        moved |= ~datum & (critical_value(alpha / 2 / max(1, n - first), 3, redundancy) < T)
    return Congruency(
        difference=d,
        covariance=point_blocks(Q, 3),
        stable=stable,
        moved=moved,
        statistic=T,
        critical=critical_value(alpha / 2 / first, 3, redundancy),
        global_statistic=start.statistic,
        global_critical=start.critical,
        agreed=found.agreed,
        smooth=smooth,
    )


def motions(xyz: FloatArray) -> FloatArray:
    """Return G: how coordinates change with translations, small rotations and the scale, (3 n, 7)."""
    G = similarity_motions(xyz, centre=xyz.mean(axis=0), size=mean_distance(xyz))
    return G.reshape(3 * len(xyz), 7)


def bending(xyz: FloatArray) -> FloatArray:
    """Return how coordinates change with a bending of the whole, of the second degree, (3 n, k).

    What a camera that is described wrongly does to all points together: a dome, a saddle, an affinity; the
    polynomials are of the axes along which the object extends.

    Args:
        xyz: coordinates, (n, 3).

    Source: James and Robson (2014), Mitigating systematic error in topographic models derived from UAV and
    ground-based image networks (dome by errors of the radial distortion).
    """
    _, extent, axes = np.linalg.svd(xyz - xyz.mean(axis=0), full_matrices=False)
    along = ((xyz - xyz.mean(axis=0)) @ axes.T / mean_distance(xyz))[:, extent > THIN * extent[0]]
    i, j = np.triu_indices(along.shape[1])
    terms = np.hstack([along, along[:, i] * along[:, j]])
    shapes: FloatArray = np.einsum("nk,xy->nxky", terms, np.eye(3))
    return shapes.reshape(3 * len(xyz), -1)


def smooth_fraction(
    difference: FloatArray, covariance: FloatArray, G: FloatArray, shapes: FloatArray, points: BoolArray
) -> float:
    """Return which fraction of Omega goes where the shapes may be fitted to the differences; 0 if too few."""
    rows = np.repeat(points, 3)
    basis = np.linalg.qr(G[rows])[0]
    B = shapes[rows] - basis @ (basis.T @ shapes[rows])
    left, size, _ = np.linalg.svd(B, full_matrices=False)
    B = left[:, size > SAME_COLUMN * size[0]]
    if 2 * (B.shape[1] + basis.shape[1]) > len(B):
        return 0.0
    d = difference.ravel()[rows] - basis @ (basis.T @ difference.ravel()[rows])
    Q = covariance[np.ix_(rows, rows)]
    Q = Q - basis @ (basis.T @ Q)
    Q = Q - (Q @ basis) @ basis.T
    factor = cho_factor(Q + float(np.trace(Q)) / len(Q) * basis @ basis.T, lower=True)
    w, W = cho_solve(factor, d), cho_solve(factor, B)  # d and B have no part along the basis
    b = B.T @ w
    return float(b @ np.linalg.solve(B.T @ W, b) / (d @ w))
