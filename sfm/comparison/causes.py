"""Causes of the differences between the coordinates of the same points in two results: tests of alternatives.

An alternative is a row. It states what may differ between the two results: the scale, the handedness, the
names of the points, a strain, or a bending of the whole object. Under each row the differences are computed
again and tested for congruency. A row explains the differences if the majority of the points then agrees. It
wins if its likelihood

    L = ln p(d) - moved ln(extent / sigma)^3 - ln C(n, moved) - q/2 ln(3 n) - S

exceeds that of the assumption that only single points changed by ln(rows / alpha). Here p is Student's
density of the stable points, q the number of parameters of the row, and S the logarithm of the number of
choices searched inside it. Simple rows come first, and a later row must exceed them by the same margin: a
bending of the second degree also imitates a strain, and a strain imitates a scale and a mirror. If no row
explains the differences, a permutation test decides whether the points are related at all.

`find_pattern` aligns two sets of points by their geometry alone, whatever their names. It compares triangles
of neighbouring points by their sides, or by the ratios of the sides if the scale is unknown. Each pair of
triangles of the same shape proposes a similarity. The similarity that brings most points of one set onto
points of the other wins.

Source: Caspary (2000), Concepts of network and deformation analysis, secs. 7 and 8; Schwarz (1978),
Estimating the dimension of a model, for q/2 ln n; Jackson (1995), PROTEST: a Procrustean randomization test,
Ecoscience 2, 297-303, for the permutation test; Groth (1986), A pattern-matching algorithm for
two-dimensional coordinate
lists, Astronomical Journal 91, 1244-1248, with triangles in space; Fischler, Bolles (1981), Random sample
consensus.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from sfm.comparison.congruency import MIN_STABLE, MOTIONS, STABLE_FRACTION, bending, motions, strain
from sfm.comparison.pairing import ROUNDING, PointPairs, fit_affinity, fit_robustly, nearest_places
from sfm.comparison.stable_points import (
    candidates_of,
    critical_value,
    find_stable_points,
    robust_weights,
    tests_in_datum,
)
from sfm.model.conventions import SWELLING, BoolArray, FloatArray, IntArray, UnitFactor, find_unit
from sfm.model.distributions import LEVEL
from sfm.model.errors import GeometryError
from sfm.model.similarity import MAX_COLLINEAR_RATIO, Similarity, extended_axes, fit_similarity, mean_distance

NEIGHBOURS = 6  # of each point, which form triangles with it
TRIANGLES = 100  # of the first set that are tried
SIMILAR_TRIANGLES = 5  # triangles of the second set that are tried for each triangle of the first
ROUNDS = 5  # of pairing and fitting after a proposal
ENOUGH_FRACTION = 0.9  # of the points; if so many match, the search ends
PERMUTATIONS = 999  # of the names; the level of the permutation test is then 0.001
MIN_PERMUTED = 7  # points; fewer have no more than PERMUTATIONS permutations
MIRROR = np.diag([1.0, 1.0, -1.0])


@dataclass(frozen=True)
class Row:
    """Properties of the second result that may differ."""

    scale: bool = False
    mirror: bool = False
    names: bool = False
    strain: bool = False
    bending: bool = False


NOTHING = Row()
ROWS = (  # the simple ones first
    Row(scale=True),
    Row(mirror=True),
    Row(scale=True, mirror=True),
    Row(strain=True),
    Row(bending=True),
    Row(names=True),
    Row(scale=True, names=True),
    Row(mirror=True, names=True),
    Row(scale=True, mirror=True, names=True),
)


@dataclass(frozen=True)
class Stretch:
    """Ratio of lengths, second over first result, along a principal axis of a strain."""

    axis: FloatArray  # in the frame of the first, (3,)
    lengths: float
    sigma: float


@dataclass(frozen=True)
class Cause:
    """Explanation of the differences of two results."""

    row: Row
    other_object: bool = False  # no explanation: the points are unrelated
    lengths: float = 1.0  # ratio of lengths, second over first result, if the scale differs
    lengths_sigma: float = 0.0
    unit: UnitFactor | None = None  # the two units, if the second result has another length unit
    rest: bool = False  # whether lengths also differ beyond the unit, if the scale differs
    stretches: tuple[Stretch, ...] = ()  # significant stretches, the largest first, if there is a strain
    renamed: tuple[tuple[str, str], ...] = ()  # (name in the first result, name in the second)
    moved: tuple[str, ...] = ()  # points that still differ
    gain: float = math.inf  # log-likelihood ratio against the assumption that single points moved


@dataclass(frozen=True)
class _Fit:
    """Differences under a row."""

    row: Row
    pairs: PointPairs
    a_from_b: Similarity
    L: float
    agreed: bool  # whether a majority of the points agrees
    stable: BoolArray
    lengths: tuple[float, float]  # ratio of lengths b over a, and its standard deviation
    unit: UnitFactor | None  # of the ratio of lengths
    stretches: tuple[Stretch, ...]
    other: IntArray | None  # point of b for each point of a, -1 for none; None with the given names


def find_cause(
    pairs: PointPairs,
    *,
    reference: BoolArray | None = None,
    changed: bool = True,
    deforms: bool = False,
) -> Cause | None:
    """Return the cause of the differences of two results; None if single points moved, or without a cause.

    Args:
        pairs: the same points of both results.
        reference: points that may carry the datum, (n,); all if not given.
        changed: whether a test of all points shows a significant difference. If not, only the scale is
            tested, since a test of one parameter is sharper.
        deforms: whether the object may change its shape between the results. A strain or a bending then
            explains the differences only where no majority of the points stayed as it was.
    """
    if len(pairs.a) < MIN_STABLE:
        return None
    reference = np.ones(len(pairs.a), dtype=bool) if reference is None else reference
    rows = [row for row in ROWS if not (row.scale and pairs.scale is None)]
    parts = ((pairs.a, pairs.Q_a), (pairs.b, pairs.Q_b))
    variances = [float(np.median(np.diagonal(Q))) / mean_distance(xyz) ** 2 for xyz, Q in parts]
    relative_sigma = math.sqrt(sum(variances) + ROUNDING**2)  # of a coordinate, over the extent of the object
    cost = -3 * math.log(min(1.0, relative_sigma))
    try:
        nothing = _fitted(pairs, NOTHING, reference, cost)
    except GeometryError:
        return None
    limit = math.log(len(rows) / LEVEL)
    best = nothing
    for row in _tested_rows(rows, changed=changed, agreed=nothing.agreed):
        if row.names and best.agreed and best.stable.sum() == reference.sum():
            continue  # all points agree with their given names
        with suppress(GeometryError):
            fit = _fit(pairs, row, nothing, reference, cost)
            if fit is not None and fit.agreed and best.L + limit < fit.L:
                best = fit
    if deforms and nothing.agreed and (best.row.strain or best.row.bending):
        return None  # the points that moved tell more; a scale would only hide some of them
    if best is not nothing:
        return _cause(best, pairs, best.L - nothing.L)
    if changed and not nothing.agreed and is_unrelated(pairs.a, pairs.b):
        return Cause(NOTHING, other_object=True)
    return None


def _tested_rows(rows: list[Row], *, changed: bool, agreed: bool) -> list[Row]:
    """Return the rows that may explain the differences; `agreed`: a majority agrees without any cause."""
    if not changed:
        return [row for row in rows if row == Row(scale=True)]
    return [row for row in rows if not row.mirror] if agreed else rows


def is_unrelated(a: FloatArray, b: FloatArray) -> bool:
    """Return whether a similarity fits the points by their names no better than with the names shuffled.

    Args:
        a: coordinates of the points, (n, 3).
        b: coordinates of the same points in another frame, (n, 3).

    Source: Jackson (1995), PROTEST: a Procrustean randomization test.
    """
    if len(a) < MIN_PERMUTED:
        return False
    s, t = (x - x.mean(axis=0) for x in (b, a))
    fit = float(np.linalg.svd(t.T @ s, compute_uv=False).sum())
    rng = np.random.default_rng(len(a))
    shuffled = (t.T @ s[rng.permutation(len(s))] for _ in range(PERMUTATIONS))
    return any(float(np.linalg.svd(M, compute_uv=False).sum()) >= fit for M in shuffled)


def _fit(pairs: PointPairs, row: Row, nothing: _Fit, reference: BoolArray, cost: float) -> _Fit | None:
    """Return the differences under a row; None if its names cannot be assigned."""
    if not row.names:
        return _fitted(pairs, row, reference, cost)
    plain = replace(row, names=False)
    given = nothing if plain == NOTHING else _fitted(pairs, plain, reference, cost)
    if given.agreed:  # most names are correct, and the others are exchanged among themselves
        a_from_b: Similarity | None = given.a_from_b
    else:
        a_from_b = find_pattern(
            pairs.a, pairs.b, scale=None if row.scale else pairs.scale, mirrored=row.mirror
        )
    if a_from_b is None:
        return None
    # the point of b for each point of a: by its name if that fits, else by its position
    named = given.stable if given.agreed else np.zeros(len(pairs.a), dtype=bool)
    rows, every = np.flatnonzero(named), np.ones(len(named), dtype=bool)
    nearest = nearest_places(
        (pairs.a, every), (a_from_b.apply(pairs.b), every), np.stack([rows, rows], axis=1)
    )
    other = np.asarray(np.where(named, np.arange(len(named)), -1))
    other[nearest[:, 0]] = nearest[:, 1]
    kept = other >= 0
    if kept.sum() < max(MIN_STABLE, STABLE_FRACTION * len(pairs.a)):
        return None
    return _fitted(pairs.chosen(np.flatnonzero(kept), other[kept]), row, reference[kept], cost, other)


def _fitted(
    pairs: PointPairs, row: Row, reference: BoolArray, cost: float, other: IntArray | None = None
) -> _Fit:
    """Compute and test the differences under a row."""
    n = len(pairs.a)
    deforms = row.strain or row.bending
    estimated = row.scale or deforms or pairs.scale is None
    T = _transform(pairs, row, reference, None if estimated else pairs.scale)
    d, Q = pairs.differences(T)
    similarity = motions(pairs.a)
    G = similarity[:, : MOTIONS["similarity" if estimated else "rigid"]]
    if deforms:
        # an orthogonal basis of the span, with entries of about the same size
        columns = np.hstack([G, (bending if row.bending else strain)(pairs.a)])
        left, singular, _ = np.linalg.svd(columns, full_matrices=False)
        G = np.asarray(left[:, singular > 1e-6 * singular[0]] * math.sqrt(3 * n))
    parameters = G.shape[1] - MOTIONS["similarity" if pairs.scale is None else "rigid"]
    lost = 0 if other is None else len(other) - n
    searched = 0.0
    if other is not None:
        exchanged = int(((other >= 0) & (other != np.arange(len(other)))).sum())
        searched = exchanged * math.log(len(other))
    penalty = lost * cost + parameters / 2 * math.log(3 * n) + searched
    none_stable = np.zeros(n, dtype=bool)
    failed = _Fit(row, pairs, T, -(n * cost + penalty), False, none_stable, (1.0, 0.0), None, (), other)
    least = max(MIN_STABLE, math.ceil(STABLE_FRACTION * reference.sum()))
    if 2 * G.shape[1] > 3 * n or G.shape[1] >= 3 * least:  # too many parameters for so few points
        return failed
    single = critical_value(LEVEL / max(1, int(reference.sum())), 3, pairs.redundancy)
    weight = robust_weights(d, G, reference)
    fits = reference & (tests_in_datum(d, Q, G, weight) <= single)
    if fits.sum() < least:
        return failed
    among = candidates_of(d, Q, G, reference)
    search = find_stable_points(
        among, least=least, start=fits, redundancy=pairs.redundancy, alpha=LEVEL, alpha_single=LEVEL
    )
    if not search.agreed:
        return failed
    last = search.steps[-1]
    r = pairs.redundancy
    ln_p = -last.omega / 2 if r is None else -(r + last.freedom) / 2 * math.log1p(last.omega / r)
    candidates = int(reference.sum())
    moved = candidates - int(search.stable.sum())
    penalty += moved * cost + math.log(math.comb(candidates, moved))
    lengths = _lengths(pairs, T, d, Q, similarity, search.stable) if row.scale else (1.0, 0.0)
    unit = None
    if pairs.scale is not None:
        size, sigma = lengths if row.scale else (pairs.scale / T.scale, 0.0)
        beside = max(SWELLING, math.sqrt(critical_value(LEVEL, 1, r)) * sigma / size)
        unit = find_unit(size, beside)  # the remaining difference is reported
    factor = unit.factor if unit else 1.0
    stretches = _stretches(pairs, T, d, Q, similarity, search.stable, factor) if row.strain else ()
    return _Fit(row, pairs, T, ln_p - penalty, True, search.stable, lengths, unit, stretches, other)


def _transform(pairs: PointPairs, row: Row, reference: BoolArray, scale: float | None) -> Similarity:
    """Return the transformation from b to a under a row that most points of the reference agree on."""
    source = pairs.b @ MIRROR if row.mirror else pairs.b
    T = fit_robustly(source[reference], pairs.a[reference], scale=scale)
    if row.mirror:
        T = replace(T, rotation=T.rotation @ MIRROR)
    if row.strain or row.bending:  # also for large deformations
        T = fit_affinity(T, pairs.a, pairs.b, reference)
    return T


def _lengths(
    pairs: PointPairs, T: Similarity, d: FloatArray, Q: FloatArray, similarity: FloatArray, stable: BoolArray
) -> tuple[float, float]:
    """Return the ratio of lengths b over a from the stable points, and its standard deviation."""
    assert pairs.scale is not None
    among = candidates_of(d, Q, similarity[:, : MOTIONS["rigid"]], stable)
    g = similarity[np.repeat(stable, 3), 6]
    weight = float(g @ among.P @ g)
    size = mean_distance(pairs.a)  # the column of the scale is divided by it
    left = float(g @ among.P @ among.d) / weight / size
    lengths = pairs.scale / T.scale * (1 + left)
    return lengths, lengths / math.sqrt(weight) / size


def _stretches(
    pairs: PointPairs,
    T: Similarity,
    d: FloatArray,
    Q: FloatArray,
    similarity: FloatArray,
    stable: BoolArray,
    unit: float,
) -> tuple[Stretch, ...]:
    """Return the largest principal stretch and other significant ones, from the stable points.

    Lengths of the second result are divided by the unit factor `unit`. If not both results have a scale, the
    stretches are relative to the median one.
    """
    among = candidates_of(
        d, Q, similarity[:, : MOTIONS["similarity" if pairs.scale is None else "rigid"]], stable
    )
    axes, along = extended_axes(pairs.a)
    i, j = np.triu_indices(len(axes))
    tensors = np.zeros((len(i), 3, 3))
    for k, (u, v) in enumerate(zip(axes[i], axes[j], strict=True)):
        tensors[k] = np.outer(u, v) + np.outer(v, u)
    S = np.einsum("kxy,ny->nxk", tensors, along[stable] @ axes).reshape(-1, len(i))
    N = S.T @ among.P @ S
    if pairs.scale is None:  # only the trace is undetermined
        N += np.trace(N) * np.outer(i == j, i == j)
    covariance = np.linalg.inv(N)
    left = np.tensordot(covariance @ (S.T @ (among.P @ among.d)), tensors, 1)
    F = (pairs.scale or 1.0) / unit * np.linalg.solve(T.scale * T.rotation, np.eye(3) + left)
    squares, directions = np.linalg.eigh(F.T @ F)
    lengths = np.sqrt(squares)
    gradient = np.einsum("xa,kxy,ya->ak", directions, tensors, directions)
    sigma = lengths * np.sqrt(np.einsum("ak,kl,al->a", gradient, covariance, gradient))
    if pairs.scale is None:
        sigma, lengths = sigma / np.median(lengths), lengths / np.median(lengths)
    limit = math.sqrt(critical_value(LEVEL / 3, 1, pairs.redundancy))
    order = np.argsort(-np.abs(lengths - 1))
    return tuple(
        Stretch(directions[:, k], float(lengths[k]), float(sigma[k]))
        for k in order
        if k == order[0] or abs(lengths[k] - 1) > limit * sigma[k]
    )


def _cause(fit: _Fit, pairs: PointPairs, gain: float) -> Cause:
    """Return the cause that a fitted row stands for."""
    row, (lengths, sigma), unit = fit.row, fit.lengths, fit.unit
    limit = math.sqrt(critical_value(LEVEL, 1, pairs.redundancy))
    rest = row.scale and (unit is None or abs(lengths - unit.factor) > limit * sigma)
    renamed: tuple[tuple[str, str], ...] = ()
    if fit.other is not None:
        renamed = tuple(
            (pairs.names[k], pairs.names[j]) for k, j in enumerate(fit.other.tolist()) if j not in (-1, k)
        )
    moved = tuple(name for name, stays in zip(fit.pairs.names, fit.stable, strict=True) if not stays)
    return Cause(
        row,
        lengths=lengths,
        lengths_sigma=sigma,
        unit=unit,
        rest=rest,
        stretches=fit.stretches,
        renamed=renamed,
        moved=moved,
        gain=gain,
    )


def find_pattern(
    a: FloatArray, b: FloatArray, *, scale: float | None = None, mirrored: bool = False
) -> Similarity | None:
    """Return the similarity that brings most points of b onto points of a; None if it brings fewer than four.

    Args:
        a: points, (n, 3).
        b: points in another frame, (m, 3).
        scale: scale of a over b; estimated if not given.
        mirrored: whether the similarity has a reflection.
    """
    if min(len(a), len(b)) < 4:
        return None
    source = b @ MIRROR if mirrored else b
    ours, sides = _triangles(a)
    theirs, their_sides = _triangles(source if scale is None else scale * source)
    if scale is None:
        sides, their_sides = (np.log(s[:, :2] / s[:, 2:]) for s in (sides, their_sides))
    else:
        sides, their_sides = np.log(sides), np.log(their_sides)
    order = np.random.default_rng(len(a)).permutation(len(ours))[:TRIANGLES]
    near = (
        cKDTree(their_sides)
        .query(sides[order], k=min(SIMILAR_TRIANGLES, len(theirs)))[1]
        .reshape(len(order), -1)
    )
    best, most = None, 3
    for k, candidates in zip(order, near, strict=True):
        for j in candidates:
            try:
                refined, count = _refined(
                    a, source, fit_similarity(source[theirs[j]], a[ours[k]], scale=scale), scale
                )
            except GeometryError:
                continue
            if count > most:
                best, most = refined, count
        if most >= ENOUGH_FRACTION * min(len(a), len(b)):
            break
    if best is None:
        return None
    return replace(best, rotation=best.rotation @ MIRROR) if mirrored else best


def _refined(
    a: FloatArray, b: FloatArray, proposed: Similarity, scale: float | None
) -> tuple[Similarity, int]:
    """Return the similarity fitted to all points that it brings onto others, and their number."""
    none = np.empty((0, 2), dtype=np.int64)
    every_a, every_b = np.ones(len(a), dtype=bool), np.ones(len(b), dtype=bool)
    similarity, count = proposed, 0
    for _ in range(ROUNDS):
        pairs = nearest_places((a, every_a), (similarity.apply(b), every_b), none)
        if len(pairs) <= max(3, count):
            break
        count = len(pairs)
        similarity = fit_similarity(b[pairs[:, 1]], a[pairs[:, 0]], scale=scale)
    return similarity, count


def _triangles(xyz: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return triangles of neighbours, (t, 3), and their sides in rising order, (t, 3).

    Each vertex is opposite to the side in the same column.
    """
    near = cKDTree(xyz).query(xyz, k=min(NEIGHBOURS + 1, len(xyz)))[1]
    corners = np.concatenate([near[:, [0, i, j]] for i, j in combinations(range(1, near.shape[1]), 2)])
    p = xyz[corners]
    sides = np.linalg.norm(p[:, [1, 2, 0]] - p[:, [2, 0, 1]], axis=2)
    order = np.argsort(sides, axis=1)
    sides = np.take_along_axis(sides, order, axis=1)
    corners = np.take_along_axis(corners, order, axis=1)
    proper = sides[:, 0] + sides[:, 1] > (1 + MAX_COLLINEAR_RATIO) * sides[:, 2]
    return corners[proper], sides[proper]
