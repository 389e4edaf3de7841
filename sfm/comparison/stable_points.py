"""The points of a network that did not move between two epochs: removed one by one until the rest agrees.

The differences d of m coordinates of n points have the covariance Q; whatever lies in the columns of G
(translations, rotations, the scale) is no change. Points that moved are removed from the datum in the order
in which they lower Omega = d' Q^+ d. With W = (Q + c G G')^-1, which is the same test for every c,

    P = W - W G (G' W G)^-1 G' W,  w = P d,  Omega = d' w,  drop of point k: w_k' P_kk^-1 w_k,

and the removal of a point, which gives it a separate displacement, is P - P_k P_kk^-1 P_k'. This
repeats the S-transformation to the points that are left after every removal, at the cost of a product.

Source: Caspary (2000), Concepts of network and deformation analysis, sec. 8.2; Niemeier (2008),
Ausgleichungsrechnung, sec. 12.3; Chen (1983), Analysis of deformation surveys, for the robust start.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.linalg.lapack import dpotri

from sfm.arguments import checked_arguments
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.display import counted
from sfm.distributions import chi2_isf, f_isf
from sfm.errors import GeometryError

ROBUST_ROUNDS = 100  # of weighting; it has come to its end long before
MIN_WEIGHTED = 1e-6  # of the median difference: what lies nearer has no more weight


@dataclass(frozen=True)
class Step:
    """The test of all points that are left, and the one that is removed after it."""

    points: int  # that are left
    omega: float  # d' Q^+ d
    freedom: int  # degrees of freedom
    statistic: float  # Omega over its degrees of freedom
    critical: float
    removed: int | None  # index of the point, None where none is


@dataclass(frozen=True)
class StablePoints:
    """Which points agree, and how they were found."""

    stable: BoolArray  # (n,)
    agreed: bool  # whether they pass the test; else no majority does
    steps: tuple[Step, ...]
    drops: FloatArray  # T of each stable point, NaN of the others, (n,)
    weights: FloatArray  # P_kk of each stable point, 0 of the others, (n, m, m)
    drops_of_all: FloatArray  # T of each candidate before any was removed, NaN of the others, (n,)
    weights_of_all: FloatArray  # P_kk of each candidate before any was removed, 0 of the others, (n, m, m)


@dataclass(frozen=True)
class Candidates:
    """Points that may be stable, with what every search among them starts from."""

    chosen: IntArray  # their indices, (k,)
    difference: FloatArray  # of all points, (n, m)
    d: FloatArray  # of the candidates without any motion of the whole, (k m,)
    P: FloatArray  # weights of d, (k m, k m)
    motions: int  # what is no change: columns of G


def candidates_of(
    difference: FloatArray, covariance: FloatArray, G: FloatArray, candidates: BoolArray
) -> Candidates:
    """Return the points that may be stable with their joint weights P.

    Args:
        difference: second minus first coordinates, (n, m).
        covariance: of all of them together, (n m, n m).
        G: what is no change, a column each, (n m, u).
        candidates: points that may be stable, (n,).

    Raises:
        GeometryError: a covariance that is singular beyond G.
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
    alpha: float = 0.05,
    alpha_single: float | None = None,
) -> StablePoints:
    """Remove points until the rest passes the global test of congruency.

    Args:
        among: the candidates.
        least: points that must be left.
        start: those of the points that the search starts with, (n,); else all candidates.
        redundancy: of the variance in the covariance; None if it is known.
        alpha: level of the global test.
        alpha_single: level of the largest drop of all points, which is tested, too, unless None.

    Raises:
        GeometryError: fewer points than `least` to start with.

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
    """Give points separate displacements: their rows of P and of w = P d become 0."""
    by_rows = np.linalg.solve(P[rows][:, rows], P[rows])
    w -= by_rows.T @ w[rows]
    P -= P[:, rows] @ by_rows


def in_datum(
    difference: FloatArray, covariance: FloatArray, G: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return differences and covariance after the S-transformation to a datum.

    Args:
        difference: (n, m).
        covariance: (n m, n m).
        G: what is no change, (n m, u).
        weight: of each point in the datum, 1 or 0 for a set of points, (n,).

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
    """Return T of each point by itself after the S-transformation to a datum, see `in_datum`, (n,).

    Only the covariance of each point by itself is formed.

    Args:
        difference: (n, m).
        covariance: (n m, n m).
        G: what is no change, (n m, u).
        weight: of each point in the datum, (n,).
    """
    n, m = difference.shape
    H, d = _motion_in_datum(difference, G, weight)
    A = covariance @ H.T
    of_point, by_coordinates = G.reshape(n, m, -1), A.reshape(n, m, -1)
    mixed = np.einsum("niu,nju->nij", of_point, by_coordinates)
    spread = np.einsum("niu,uv,njv->nij", of_point, H @ A, of_point)
    return _tests_of_blocks(d, point_blocks(covariance, m) - mixed - np.swapaxes(mixed, 1, 2) + spread)


def _motion_in_datum(
    difference: FloatArray, G: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return H, the motion t = H d of the weighted points (u, n m), and d without it, (n, m)."""
    m = difference.shape[1]
    EG = np.repeat(weight, m)[:, None] * G
    H = np.asarray(np.linalg.solve(G.T @ EG, EG.T), dtype=float)
    return H, difference - (G @ (H @ difference.ravel())).reshape(-1, m)


@checked_arguments(difference="n m", G="q u", candidates="n")
def robust_weights(difference: FloatArray, G: FloatArray, candidates: BoolArray) -> FloatArray:
    """Return the weights of the datum in which the sum of the lengths of all differences is least (L1 norm).

    Iterated weights 1 / |d|; of m coordinates the length of a point's difference counts.

    Args:
        difference: (n, m).
        G: what is no change, (n m, u).
        candidates: points that take part, (n,).

    Raises:
        GeometryError: no candidates, or motions of other points.

    Source: Chen (1983), Analysis of deformation surveys (iterative weighted similarity transformation).
    """
    m = difference.shape[1]
    if len(G) != difference.size:
        raise GeometryError(
            f"robust_weights: G has {len(G)} rows, expected {difference.size}, a row a coordinate"
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
    """Return T = d' Q_dd^-1 d / m of each point by itself, (n,); NaN where Q_dd is singular."""
    return _tests_of_blocks(difference, point_blocks(covariance, difference.shape[1]))


def _tests_of_blocks(difference: FloatArray, blocks: FloatArray) -> FloatArray:
    n, m = difference.shape
    T = np.full(n, np.nan)
    size = np.einsum("nii->n", blocks)
    regular = np.linalg.eigvalsh(blocks)[:, 0] > 1e-12 * size
    d = difference[regular]
    T[regular] = np.einsum("ni,ni->n", d, np.linalg.solve(blocks[regular], d[..., None])[..., 0]) / m
    return T


def point_blocks(covariance: FloatArray, m: int) -> FloatArray:
    """Return the covariance of each point by itself, (n, m, m)."""
    n = len(covariance) // m
    k = np.arange(n)
    return np.ascontiguousarray(covariance.reshape(n, m, n, m)[k, :, k])


def critical_value(alpha: float, freedom: int, redundancy: int | None) -> float:
    """Return the value that a mean of `freedom` squares exceeds with probability alpha under no change.

    Args:
        alpha: error probability.
        freedom: degrees of freedom of the statistic.
        redundancy: of the variances; None if they are known.
    """
    if redundancy is None:
        return float(chi2_isf(alpha, freedom) / freedom)
    return float(f_isf(alpha, freedom, redundancy))


def _weights(Q: FloatArray, basis: FloatArray) -> FloatArray:
    """Return P of all candidates together; the basis of G is orthonormal."""
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
    """Return what Omega drops by without each of the points that are left, over m."""
    drops = np.full(len(left), np.nan)
    blocks, w = point_blocks(P, m)[left], w.reshape(-1, m)[left]
    drops[left] = np.einsum("ki,ki->k", w, np.linalg.solve(blocks, w[..., None])[..., 0]) / m
    return drops
