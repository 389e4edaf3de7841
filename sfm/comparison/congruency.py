"""Congruency test of two sets of coordinates of the same points, which finds the points that moved.

The differences d of two independent solutions are projected with the S-transformation of the points F that
are assumed to be stable,

    S = I - G (G_F' G_F)^-1 G_F',  d_S = S d,  Q_S = S (Q_a + Q_b) S',

where G has the translations, the small rotations and, unless both solutions have a scale, the scale of the
whole. The result does not depend on what the datum of either solution fixes or leaves undefined. Without any
change, Omega = d' Q_S^+ d over F follows chi-square with 3 n_F - u degrees of freedom. If the variances are
estimated, Omega / (3 n_F - u) follows Fisher's F. The point whose removal from F lowers Omega most is
considered as moved and removed, until the rest agrees.

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
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.display import counted
from sfm.model.distributions import FALSE_ALARM
from sfm.model.errors import GeometryError
from sfm.model.similarity import extended_axes, mean_distance, similarity_motions

MOTIONS = {"none": 0, "rigid": 6, "similarity": 7}  # number of parameters of motions that are not a change
MIN_STABLE = 4  # points of a datum: three define it, and one more checks it
STABLE_FRACTION = 0.5  # of the points must agree before others are reported as moved
RANK = 1e-6  # of the largest singular value; below it the reference points are on a line


@dataclass(frozen=True)
class Congruency:
    """Differences of the points in the datum of the stable points, and the search for these."""

    reference: BoolArray  # points that may carry the datum, (n,)
    search: StablePoints  # search from all reference points
    robust: StablePoints | None  # search from points that fit a robust alignment; None if all or too few fit
    stable: BoolArray  # points that carry the datum, (n,); all reference points if no majority agrees
    agreed: bool  # whether the stable points agree; else no majority does
    difference: FloatArray  # d_S, (n, 3)
    covariance: FloatArray  # Q_S of all coordinates, (3 n, 3 n)
    motions: FloatArray  # G: motions that are not a change, (3 n, u)
    statistic: FloatArray  # T of each point: its drop of Omega if stable, else its single test, over 3, (n,)
    level: FloatArray  # alpha of the test of each point, (n,)
    critical: FloatArray  # critical value of T, (n,)
    weights: FloatArray  # P_kk of each stable point, which gives its drop, 0 for others, (n, 3, 3)

    @property
    def moved(self) -> BoolArray:
        """Points that do not agree with the stable ones, (n,); none if no majority agrees."""
        return np.asarray(self.agreed & ~self.stable & (self.critical < self.statistic))

    @property
    def first_test(self) -> Step:
        """The global test of all reference points."""
        return self.search.steps[0]


def congruency(
    difference: FloatArray,
    covariance: FloatArray,
    xyz: FloatArray,
    *,
    motion: str = "rigid",
    redundancy: int | None = None,
    reference: BoolArray | None = None,
    alpha: float = FALSE_ALARM,
) -> Congruency:
    """Test whether points have moved, and find these points.

    Half of alpha is spent on the global test of all points, and half on the largest test of single points.
    Points that moved are removed one by one. One search starts from all reference points, and another from
    the points that fit a robust alignment. The larger set that agrees is the result.

    Args:
        difference: second minus first coordinates after any alignment, (n, 3).
        covariance: Q_a + Q_b of all coordinates, (3 n, 3 n).
        xyz: coordinates, (n, 3).
        motion: motion of the whole that is not a change: rigid (translation and rotation), similarity (also
            scale, unless both have one), or none (both in the datum of control).
        redundancy: redundancy of both adjustments together; None if the variances are known.
        reference: points that may carry the datum, (n,); all if not given.
        alpha: probability of reporting a change if there is none.

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
            "congruency: the points of reference lie on a line, which does not fix the rotation about it"
        )
    least = max(MIN_STABLE, math.ceil(STABLE_FRACTION * first))

    among = candidates_of(difference, covariance, G, reference)

    def search(start: BoolArray) -> StablePoints:
        return find_stable_points(
            among, least=least, start=start, redundancy=redundancy, alpha=alpha / 2, alpha_single=alpha / 2
        )

    level = np.where(reference, alpha / 2 / first, alpha / 2 / max(1, n - first))
    value = {tail: critical_value(tail, 3, redundancy) for tail in set(level.tolist())}
    critical = np.array([value[tail] for tail in level.tolist()])
    from_all = best = search(reference)
    robust = None
    if len(from_all.steps) > 1:
        weight = robust_weights(difference, G, reference)
        fits = reference & ~(critical < tests_in_datum(difference, covariance, G, weight))
        if fits.sum() >= least:
            robust = search(fits)
            more = not from_all.agreed or robust.stable.sum() > from_all.stable.sum()
            best = robust if robust.agreed and more else from_all
    stable, drops = (best.stable, best.drops) if best.agreed else (reference, from_all.drops_of_all)
    d, Q = in_datum(difference, covariance, G, stable.astype(float))
    return Congruency(
        reference=reference,
        search=from_all,
        robust=robust,
        stable=stable,
        agreed=best.agreed,
        difference=d,
        covariance=Q,
        motions=G,
        statistic=np.where(stable, drops, single_tests(d, Q)),
        level=level,
        critical=critical,
        weights=best.weights if best.agreed else from_all.weights_of_all,
    )


def motions(xyz: FloatArray) -> FloatArray:
    """Return G: the changes of coordinates by translations, small rotations and the scale, (3 n, 7)."""
    G = similarity_motions(xyz, centre=xyz.mean(axis=0), size=mean_distance(xyz))
    return G.reshape(3 * len(xyz), 7)


def bending(xyz: FloatArray) -> FloatArray:
    """Return the changes of coordinates by a bending of the whole of second degree, (3 n, k).

    A wrong camera model has such effects on all points: a dome, a saddle, an affinity. The polynomials are in
    the axes along which the object extends.

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
    """Return the changes of coordinates by a homogeneous deformation and rotations, (3 n, k).

    Args:
        xyz: coordinates, (n, 3).
    """
    return _in_every_direction(extended_axes(xyz)[1] / mean_distance(xyz))


def _in_every_direction(terms: FloatArray) -> FloatArray:
    """Return the changes of coordinates by each term, (n, k), in each direction, (3 n, 3 k)."""
    shapes: FloatArray = np.einsum("nk,xy->nxky", terms, np.eye(3))
    return shapes.reshape(3 * len(terms), -1)
