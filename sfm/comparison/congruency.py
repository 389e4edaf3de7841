"""Congruency of two sets of coordinates of the same points: which of them moved, tested in one datum.

The differences d of two independent solutions are projected with the S-transformation of the points F that
are taken as stable,

    S = I - G (G_F' G_F)^-1 G_F',  d_S = S d,  Q_S = S (Q_a + Q_b) S',

G being the translations, small rotations and, where the scale is not defined by both, the scale of the whole.
Whatever the datum of either solution fixes or leaves undefined drops out. Under no change
Omega = d' Q_S^+ d over F follows chi-square with 3 n_F - u degrees of freedom, Omega / (3 n_F - u) Fisher's F
where the variances are estimated. The point whose removal from F lowers Omega most is taken to have moved,
until the rest agrees.

Source: Caspary (2000), Concepts of network and deformation analysis, secs. 7 and 8; Pelzer (1971), Zur
Analyse geodaetischer Deformationsmessungen; Baarda (1973), S-transformations and criterion matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sfm.comparison.stable_points import (
    StablePoints,
    Step,
    candidates_of,
    critical_value,
    find_stable_points,
    in_datum,
    robust_weights,
    single_tests,
    tests_in_datum,
)
from sfm.conventions import BoolArray, FloatArray
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.similarity import extended_axes, mean_distance, similarity_motions

MOTIONS = {"none": 0, "rigid": 6, "similarity": 7}  # parameters of what is no change
MIN_STABLE = 4  # points that a datum needs to be checked by at least one more than it takes
STABLE_FRACTION = 0.5  # of the points that must agree for the others to be called moved
RANK = 1e-6  # of the largest singular value below which the points of reference are on a line


@dataclass(frozen=True)
class Congruency:
    """Differences of the points in the datum of those that did not move, and how these were found."""

    reference: BoolArray  # points that may carry the datum, (n,)
    search: StablePoints  # from all points of reference
    robust: StablePoints | None  # from those that a robust alignment leaves; None where all agree, or too few
    stable: BoolArray  # points that carry the datum, (n,); all of reference where no majority of them agrees
    agreed: bool  # whether the stable points agree; else no majority does
    difference: FloatArray  # d_S, (n, 3)
    covariance: FloatArray  # Q_S of all coordinates together, (3 n, 3 n)
    motions: FloatArray  # G: what is no change, (3 n, u)
    statistic: FloatArray  # T of each point, its drop of Omega (stable) or its separate test, over 3, (n,)
    level: FloatArray  # alpha of the test of each point, (n,)
    critical: FloatArray  # of T, (n,)
    weights: FloatArray  # P_kk of each stable point, from which its drop is, 0 of the others, (n, 3, 3)

    @property
    def moved(self) -> BoolArray:
        """Points that do not agree with the stable ones, (n,); none where it is not known which."""
        return np.asarray(self.agreed & ~self.stable & (self.critical < self.statistic))

    @property
    def first_test(self) -> Step:
        """The test of all points of reference together."""
        return self.search.steps[0]


def congruency(
    difference: FloatArray,
    covariance: FloatArray,
    xyz: FloatArray,
    *,
    motion: str = "rigid",
    redundancy: int | None = None,
    reference: BoolArray | None = None,
    alpha: float = 0.05,
) -> Congruency:
    """Test whether points have moved, and find those that have.

    Half of alpha is spent on the test of all points together and half on the largest of the single points.
    Points that moved are removed one by one, once from all of reference and once from those that a robust
    alignment leaves; the larger set that agrees is taken.

    Args:
        difference: second minus first coordinates after any alignment, (n, 3).
        covariance: Q_a + Q_b of all coordinates together, (3 n, 3 n).
        xyz: coordinates, (n, 3).
        motion: what of the whole is no change: rigid (translation and rotation), similarity (the scale too,
            where not both have one), or none (both in the datum of control).
        redundancy: of both adjustments together; None if the variances are known.
        reference: points that may carry the datum, (n,); all if not given.
        alpha: probability of calling something a change that is none.

    Raises:
        GeometryError: too few points, points on a line, or a covariance that is singular beyond the datum.

    Source: Caspary (2000), Concepts of network and deformation analysis, secs. 7 and 8; Niemeier (2008),
    Ausgleichungsrechnung, secs. 12.2 to 12.4.
    """
    n = len(xyz)
    reference = np.ones(n, dtype=bool) if reference is None else reference
    first = int(reference.sum())
    if first < MIN_STABLE:
        raise GeometryError(
            f"congruency: {counted(first, 'point')} of reference, expected {MIN_STABLE} or more"
        )
    G = motions(xyz)[:, : MOTIONS[motion]]
    sizes = np.linalg.svd(G[np.repeat(reference, 3)], compute_uv=False)
    if (sizes < RANK * np.linalg.svd(G, compute_uv=False).max(initial=0.0)).any():
        raise GeometryError(
            "congruency: the points of reference lie on a line, which fixes no rotation about it"
        )
    least = max(MIN_STABLE, math.ceil(STABLE_FRACTION * first))

    among = candidates_of(difference, covariance, G, reference)

    def search(start: BoolArray) -> StablePoints:
        return find_stable_points(
            among, least=least, start=start, redundancy=redundancy, alpha=alpha / 2, alpha_single=alpha / 2
        )

    level = np.where(reference, alpha / 2 / first, alpha / 2 / max(1, n - first))
    value = {one: critical_value(one, 3, redundancy) for one in set(level.tolist())}
    critical = np.array([value[one] for one in level.tolist()])
    whole = best = search(reference)
    robust = None
    if len(whole.steps) > 1:
        weight = robust_weights(difference, G, reference)
        fits = reference & ~(critical < tests_in_datum(difference, covariance, G, weight))
        if fits.sum() >= least:
            robust = search(fits)
            more = not whole.agreed or robust.stable.sum() > whole.stable.sum()
            best = robust if robust.agreed and more else whole
    stable, drops = (best.stable, best.drops) if best.agreed else (reference, whole.drops_of_all)
    d, Q = in_datum(difference, covariance, G, stable.astype(float))
    return Congruency(
        reference=reference,
        search=whole,
        robust=robust,
        stable=stable,
        agreed=best.agreed,
        difference=d,
        covariance=Q,
        motions=G,
        statistic=np.where(stable, drops, single_tests(d, Q)),
        level=level,
        critical=critical,
        weights=best.weights if best.agreed else whole.weights_of_all,
    )


def motions(xyz: FloatArray) -> FloatArray:
    """Return G: how coordinates change with translations, small rotations and the scale, (3 n, 7)."""
    G = similarity_motions(xyz, centre=xyz.mean(axis=0), size=mean_distance(xyz))
    return G.reshape(3 * len(xyz), 7)


def bending(xyz: FloatArray) -> FloatArray:
    """Return how coordinates change with a bending of the whole, of the second degree, (3 n, k).

    Effects of a wrong camera model on all points together: a dome, a saddle, an affinity; the
    polynomials are of the axes along which the object extends.

    Args:
        xyz: coordinates, (n, 3).

    Source: James and Robson (2014), Mitigating systematic error in topographic models derived from UAV and
    ground-based image networks (dome by errors of the radial distortion).
    """
    _, along = extended_axes(xyz)
    along = along / mean_distance(xyz)
    i, j = np.triu_indices(along.shape[1])
    return _in_every_direction(np.hstack([along, along[:, i] * along[:, j]]))


def strain(xyz: FloatArray) -> FloatArray:
    """Return how coordinates change with a homogeneous deformation and rotations, (3 n, k).

    Args:
        xyz: coordinates, (n, 3).
    """
    return _in_every_direction(extended_axes(xyz)[1] / mean_distance(xyz))


def _in_every_direction(terms: FloatArray) -> FloatArray:
    """Return how coordinates change with each of the terms (n, k), (3 n, 3 k)."""
    shapes: FloatArray = np.einsum("nk,xy->nxky", terms, np.eye(3))
    return shapes.reshape(3 * len(terms), -1)
