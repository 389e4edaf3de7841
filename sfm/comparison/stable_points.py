"""Stable points of a network between two epochs: moved points are removed one by one until the rest agrees.

The differences d of m coordinates of n points have the covariance Q. Motions of the whole in the columns of G
(translations, rotations, the scale) are not a change. The point whose removal from the datum lowers Omega =
d' Q^+ d most is removed first. With W = (Q + c G G')^-1, where c does not affect the test,

    P = W - W G (G' W G)^-1 G' W,  w = P d,  Omega = d' w,  drop of point k: w_k' P_kk^-1 w_k,

and the removal of a point, which gives it a separate displacement, is P - P_k P_kk^-1 P_k'. This is
equivalent to a new S-transformation to the remaining points, but only costs a product.

Source: Caspary (2000), Concepts of network and deformation analysis, sec. 8.2; Niemeier (2008),
Ausgleichungsrechnung, sec. 12.3; Chen (1983), Analysis of deformation surveys, for the robust start.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.linalg.lapack import dpotri

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.distributions import FALSE_ALARM, chi2_isf, f_isf
from sfm.model.errors import GeometryError

ROBUST_ROUNDS = 100  # of weighting, which converges long before
SINGULAR = 1e-12  # share of a covariance before a transformation, below which rounding is left of it
MIN_WEIGHTED = 1e-6  # of the median difference; smaller differences get no larger weight


@dataclass(frozen=True)
class Step:
    """A global test of the remaining points, and the point that is removed after it."""

    points: int  # number of remaining points
    omega: float  # d' Q^+ d
    freedom: int  # degrees of freedom
    statistic: float  # Omega over its degrees of freedom
    critical: float
    removed: int | None  # index of the removed point, or None


@dataclass(frozen=True)
class StablePoints:
    """The points that agree, and the steps of the search."""

    stable: BoolArray  # (n,)
    agreed: bool  # whether they pass the test; else no majority does
    steps: tuple[Step, ...]
    drops: FloatArray  # T of each stable point, NaN for others, (n,)
    weights: FloatArray  # P_kk of each stable point, 0 for others, (n, m, m)
    drops_of_all: FloatArray  # T of each candidate before the first removal, NaN for others, (n,)
    weights_of_all: FloatArray  # P_kk of each candidate before the first removal, 0 for others, (n, m, m)


@dataclass(frozen=True)
class Candidates:
    """Points that may be stable, and the start of every search among them."""

    chosen: IntArray  # indices of the candidates, (k,)
    difference: FloatArray  # differences of all points, (n, m)
    d: FloatArray  # differences of the candidates without motions of the whole, (k m,)
    P: FloatArray  # weights of d, (k m, k m)
    motions: int  # number of columns of G


def candidates_of(
    difference: FloatArray, covariance: FloatArray, G: FloatArray, candidates: BoolArray
) -> Candidates:
    """Return the points that may be stable with their joint weights P.

    Args:
        difference: second minus first coordinates, (n, m).
        covariance: joint covariance of the differences, (n m, n m).
        G: motions that are not a change, as columns, (n m, u).
        candidates: points that may be stable, (n,).

    Raises:
        GeometryError: the covariance is singular beyond G.
    """
    chosen = np.flatnonzero(candidates)
    rows = _rows(chosen, difference.shape[1])
    basis = np.linalg.qr(G[rows])[0]
    d = difference[chosen].ravel()
    d = d - basis @ (basis.T @ d)
    return Candidates(chosen, difference, d, _weights(covariance[np.ix_(rows, rows)], basis), G.shape[1])


@checked_arguments()
def find_stable_points(
    among: Candidates,
    *,
    least: int,
    start: BoolArray | None = None,
    redundancy: int | None = None,
    alpha: float = FALSE_ALARM,
    alpha_single: float | None = None,
) -> StablePoints:
    """Remove points until the rest passes the global test of congruency.

    Args:
        among: the candidates.
        least: number of points that must remain.
        start: points that the search starts from, (n,); all candidates if not given.
        redundancy: redundancy of the variance in the covariance; None if the variance is known.
        alpha: level of the global test.
        alpha_single: level of the test of the largest drop; not tested if None.

    Raises:
        GeometryError: the search starts from fewer than `least` points.

    Source: Caspary (2000), Concepts of network and deformation analysis, sec. 8.2.
    """
    n, m = among.difference.shape
    chosen, d, u = among.chosen, among.d, among.motions
    left = np.ones(len(chosen), dtype=bool) if start is None else start[chosen]
    begun = int(left.sum())
    if begun < least:
        raise GeometryError(f"congruency: {counted(begun, 'point')}, expected {least} or more")
    P = among.P.copy()
    w = P @ d
    if begun < len(chosen):
        _remove(P, w, _rows(np.flatnonzero(~left), m))
    single = None if alpha_single is None else critical_value(alpha_single / begun, m, redundancy)
    steps: list[Step] = []
    of_all = np.full(n, np.nan)
    of_all[chosen] = _drops(P, w, left, m)
    weights_of_all = np.zeros((n, m, m))
    weights_of_all[chosen[left]] = point_blocks(P, m)[left]
    while True:
        omega, freedom = float(d @ w), m * int(left.sum()) - u
        drops = _drops(P, w, left, m)
        critical = critical_value(alpha, freedom, redundancy)
        k = int(np.nanargmax(drops))
        agreed = omega / freedom <= critical and (single is None or drops[k] <= single)
        ended = agreed or left.sum() - 1 < least
        removed = None if ended else int(chosen[k])
        tested = (int(left.sum()), omega, freedom, omega / freedom, critical)
        steps.append(Step(*tested, removed))
        if ended:
            break
        _remove(P, w, slice(m * k, m * k + m))
        left[k] = False
    stable, T = np.zeros(n, dtype=bool), np.full(n, np.nan)
    stable[chosen[left]] = True
    T[chosen] = drops
    weights = np.zeros((n, m, m))
    weights[chosen[left]] = point_blocks(P, m)[left]
    return StablePoints(stable, bool(agreed), tuple(steps), T, weights, of_all, weights_of_all)


def _rows(points: IntArray, m: int) -> IntArray:
    """Return the rows of the m coordinates of points, (k m,)."""
    return np.asarray((m * points[:, None] + np.arange(m)).ravel())


def _remove(P: FloatArray, w: FloatArray, rows: IntArray | slice) -> None:
    """Give points separate displacements in place: their rows of P and of w = P d become 0."""
    by_rows = np.linalg.solve(P[rows][:, rows], P[rows])
    w -= by_rows.T @ w[rows]
    P -= P[:, rows] @ by_rows


def in_datum(
    difference: FloatArray, covariance: FloatArray, G: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return differences and covariance after the S-transformation to a datum.

    Args:
        difference: second minus first coordinates, (n, m).
        covariance: joint covariance of the differences, (n m, n m).
        G: motions that are not a change, (n m, u).
        weight: weight of each point in the datum, (n,); 1 or 0 for a set of points.

    Returns:
        d_S (n, m) and Q_S (n m, n m).

    Source: Baarda (1973), S-transformations and criterion matrices.
    """
    H, d = _motion_in_datum(difference, G, weight)
    A = covariance @ H.T
    Q = covariance - G @ A.T
    Q -= A @ G.T
    Q += G @ ((H @ A) @ G.T)
    return d, Q


def tests_in_datum(
    difference: FloatArray, covariance: FloatArray, G: FloatArray, weight: FloatArray
) -> FloatArray:
    """Return T of each single point after the S-transformation to a datum, see `in_datum`, (n,).

    Only the covariance of each single point is computed.

    Args:
        difference: second minus first coordinates, (n, m).
        covariance: joint covariance of the differences, (n m, n m).
        G: motions that are not a change, (n m, u).
        weight: weight of each point in the datum, (n,).
    """
    n, m = difference.shape
    H, d = _motion_in_datum(difference, G, weight)
    A = covariance @ H.T
    of_point, by_coordinates = G.reshape(n, m, -1), A.reshape(n, m, -1)
    mixed = np.einsum("niu,nju->nij", of_point, by_coordinates)
    spread = np.einsum("niu,uv,njv->nij", of_point, H @ A, of_point)
    before = point_blocks(covariance, m)
    return _tests_of_blocks(d, before - mixed - np.swapaxes(mixed, 1, 2) + spread, before)


def _motion_in_datum(
    difference: FloatArray, G: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return H of the motion t = H d of the weighted points, (u, n m), and d without this motion, (n, m)."""
    m = difference.shape[1]
    EG = np.repeat(weight, m)[:, None] * G
    H = np.asarray(np.linalg.solve(G.T @ EG, EG.T), dtype=float)
    return H, difference - (G @ (H @ difference.ravel())).reshape(-1, m)


@checked_arguments(difference="n m", G="q u", candidates="n")
def robust_weights(difference: FloatArray, G: FloatArray, candidates: BoolArray) -> FloatArray:
    """Return the weights of the datum with the smallest sum of lengths of all differences (L1 norm), (n,).

    The weights 1 / |d| are iterated, where |d| is the length of a point's difference of m coordinates.

    Args:
        difference: second minus first coordinates, (n, m).
        G: motions that are not a change, (n m, u).
        candidates: points that take part, (n,).

    Raises:
        GeometryError: no candidates, or G has another number of rows.

    Source: Chen (1983), Analysis of deformation surveys (iterative weighted similarity transformation).
    """
    m = difference.shape[1]
    if len(G) != difference.size:
        raise GeometryError(
            f"robust_weights: G has {len(G)} rows, expected {difference.size}, one for each coordinate"
        )
    if not candidates.any():
        raise GeometryError("robust_weights: no point takes part, expected some candidates")
    weight = candidates.astype(float)
    if not G.shape[1]:
        return weight
    for _ in range(ROBUST_ROUNDS):
        EG = np.repeat(weight, m)[:, None] * G
        t = np.linalg.solve(G.T @ EG, EG.T @ difference.ravel())
        length = np.linalg.norm(difference - (G @ t).reshape(-1, m), axis=1)
        middle = float(np.median(length[candidates]))
        if not middle > 0:
            break
        weight = np.where(candidates, 1 / np.maximum(length, MIN_WEIGHTED * middle), 0.0)
        weight /= weight.max()
    return weight


def single_tests(difference: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return T = d' Q_dd^-1 d / m of each single point, (n,); NaN where Q_dd is singular."""
    blocks = point_blocks(covariance, difference.shape[1])
    return _tests_of_blocks(difference, blocks, blocks)


def _tests_of_blocks(difference: FloatArray, blocks: FloatArray, before: FloatArray) -> FloatArray:
    """Return T of each point, (n,); NaN if only rounding is left of the covariance that it had before."""
    n, m = difference.shape
    T = np.full(n, np.nan)
    regular = np.linalg.eigvalsh(blocks)[:, 0] > SINGULAR * np.einsum("nii->n", before)
    d = difference[regular]
    T[regular] = np.einsum("ni,ni->n", d, np.linalg.solve(blocks[regular], d[..., None])[..., 0]) / m
    return T


def point_blocks(covariance: FloatArray, m: int) -> FloatArray:
    """Return the covariance of each single point, (n, m, m)."""
    n = len(covariance) // m
    k = np.arange(n)
    return np.ascontiguousarray(covariance.reshape(n, m, n, m)[k, :, k])


def critical_value(alpha: float, freedom: int, redundancy: int | None) -> float:
    """Return the value that a mean of `freedom` squares exceeds with probability alpha without any change.

    Args:
        alpha: error probability.
        freedom: degrees of freedom of the statistic.
        redundancy: redundancy of the variances; None if they are known.
    """
    if redundancy is None:
        return float(chi2_isf(alpha, freedom) / freedom)
    return float(f_isf(alpha, freedom, redundancy))


def _weights(Q: FloatArray, basis: FloatArray) -> FloatArray:
    """Return P of all candidates; `basis` is an orthonormal basis of G."""
    u = basis.shape[1]
    if u:
        Q = Q + float(np.trace(Q)) / len(Q) * (basis @ basis.T)
    try:
        factor, _ = cho_factor(Q, lower=True, overwrite_a=True)
    except LinAlgError as error:
        raise GeometryError(
            "congruency: the covariance of the points is singular beyond its datum"
        ) from error
    lower, _ = dpotri(factor, lower=1, overwrite_c=1)
    W: FloatArray = np.tril(lower)
    W += np.tril(lower, -1).T
    if not u:
        return W
    WG = W @ basis
    W -= WG @ cho_solve(cho_factor(basis.T @ WG, lower=True), WG.T)
    return W


def _drops(P: FloatArray, w: FloatArray, left: BoolArray, m: int) -> FloatArray:
    """Return the drop of Omega by the removal of each remaining point, over m, NaN for others."""
    drops = np.full(len(left), np.nan)
    blocks, w = point_blocks(P, m)[left], w.reshape(-1, m)[left]
    drops[left] = np.einsum("ki,ki->k", w, np.linalg.solve(blocks, w[..., None])[..., 0]) / m
    return drops
