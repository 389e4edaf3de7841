"""Alternatives of moved points and bodies, and the patterns of photographs that they affect.

Points move between two photographs of the sequence. Sets of points with different vectors are built in the
order of their single gains. Sets that shift by one vector are found by two-means clustering. Bodies are
given.

A `Pattern` gives each photograph, or run of photographs, a factor on the columns of a family. `Part` computes
the gain of a pattern, and `score_alternative` the test.

Source: Baarda (1968), A testing procedure for use in geodetic networks; Foerstner and Wrobel (2016), sec.
4.6.4 (groups of parameters).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from sfm.adjustment.result import Adjustment
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.judgement.hypotheses.columns import Columns
from sfm.judgement.hypotheses.families import (
    BODY,
    MOVED,
    SHIFTED,
    Alternative,
    Family,
)
from sfm.judgement.hypotheses.score import (
    NONE,
    Gain,
    Reduced,
    Spread,
    gain_of,
    gains_of,
    least_share,
    log_f_sf,
    log_probability,
    points_by_cameras,
)
from sfm.likelihood import price_of
from sfm.network import sum_rows

MIN_GROUP = 2  # photographs on each side of a split
MAX_RUNS = 60  # photographs, or runs of photographs, with separate freedoms
ROUNDS = 20  # iterations of two-means clustering
STARTS = 8  # photographs or points from which a group is grown
MAX_PRODUCTS = 2e11  # multiplications for all splits, about ten seconds
MAX_SPLITS = 12  # positions in the sequence at which a movement is tested
MAX_MOVED = 60  # points that are tested together


def moved_points(reduced: Reduced) -> Iterator[Alternative]:
    """Yield the best alternative of each family of moved points, over all positions in the sequence.

    Args:
        reduced: normal equations of the adjustment.
    """
    m = reduced.photographs
    if m < 2 * MIN_GROUP:
        return
    splits = list(range(MIN_GROUP, m - MIN_GROUP + 1))
    products = 6 * len(reduced.L) * len(reduced.t) ** 2  # products of one split
    affordable = max(1, min(MAX_SPLITS, int(MAX_PRODUCTS / products)))
    splits = splits[:: -(-len(splits) // affordable)]
    best: dict[str, Alternative] = {}
    for k in splits:
        for one in _moved_at(reduced, (np.arange(m) >= k).astype(float), np.log(len(splits))):
            if one.family.name not in best or one.evidence > best[one.family.name].evidence:
                best[one.family.name] = one
    yield from best.values()


def _moved_at(reduced: Reduced, factor: FloatArray, search: float) -> Iterator[Alternative]:
    """Yield the sets of points that moved between the photographs with factor 0 and those with factor 1."""
    n, m, size = len(reduced.L), reduced.photographs, len(reduced.t)
    on = factor[reduced.image] > 0
    D = np.where(on[:, None, None], reduced.B, 0.0)
    V = sum_rows(reduced.point[on], np.swapaxes(D[on], 1, 2) @ D[on], n)
    C = reduced.L @ V  # L^-1 B'D, as B'D = V here
    before = np.bincount(reduced.point[~on], minlength=n)
    after = np.bincount(reduced.point[on], minlength=n)
    movable = np.flatnonzero((before >= MIN_GROUP) & (after >= MIN_GROUP))
    if not len(movable):
        return
    # A'D of each point, with the point itself eliminated
    by = np.swapaxes(reduced.B[on], 1, 2) @ reduced.A[on]
    K = points_by_cameras(by, reduced.point[on], reduced.image[on], n, m)
    K = K[movable] - np.swapaxes(C[movable], 1, 2) @ reduced.W[movable]
    g = sum_rows(reduced.point[on], np.einsum("kab,ka->kb", D[on], reduced.v[on]), n)
    g = g[movable] - np.einsum("nab,na->nb", C[movable], reduced.y[movable])
    g = g - K @ (reduced.Sinv @ reduced.t)
    blocks_of = V[movable] - np.swapaxes(C[movable], 1, 2) @ C[movable]
    KS = K @ reduced.Sinv
    blocks = blocks_of - np.einsum("nas,nbs->nab", KS, K)
    squares = np.einsum("nii->ni", V[movable])
    single, _ = gains_of(blocks, g, squares)
    order = np.argsort(-single)[: min(MAX_MOVED, len(movable) // 2 or 1)]
    flat = (K[order].reshape(-1, size), KS[order].reshape(-1, size))
    H = -flat[1] @ flat[0].T
    for place, k in enumerate(order):
        block = slice(3 * place, 3 * place + 3)
        H[block, block] += blocks_of[k]
    best: Alternative | None = None
    total = len(movable)
    ordered = np.sort(single)[::-1]
    for count in range(1, len(order) + 1):
        part = slice(0, 3 * count)
        gain = gain_of(H[part, part], g[order].ravel()[part], squares[order].ravel()[part])
        sets = _log_sets(total, count)
        others = ordered[count:]
        spread = Spread(float(others.mean()) / 3, 3 * len(others)) if len(others) else NONE
        pattern = Pattern("split", factor, search + sets)
        one = score_alternative(reduced, MOVED, pattern, gain, spread, points=movable[order[:count]])
        if best is None or one.evidence > best.evidence:
            best = one
        elif count > 2 * len(best.points) + 4:
            break
    if best is not None:
        yield best
    yield from _shifted(reduced, factor, search, (movable, blocks, g))


def moved_bodies(
    a: Adjustment, reduced: Reduced, columns: Columns, bodies: Sequence[IntArray]
) -> Iterator[Alternative]:
    """Yield the alternative that a body moved, for each body, at the best position in the sequence.

    One photograph determines the pose of a body. So a body may move right after the first photograph, or
    right before the last.

    Args:
        a: adjustment.
        reduced: its normal equations.
        columns: derivatives of its image points.
        bodies: object points of each body.
    """
    if reduced.photographs < 2 * MIN_GROUP:
        return
    run = runs_of(np.zeros(reduced.photographs, dtype=np.int64))
    m = int(run.max()) + 1
    splits = (np.arange(m) >= np.arange(1, m)[:, None]).astype(float)
    for points in bodies:
        field = BODY.field(a.estimate.points, points)[a.network.image_points.point]
        part = Part(*reduced.project_by_run(reduced.whiten(columns.point @ field), run))
        gains = [part.gain(factor) for factor in splits]
        best = max(range(len(gains)), key=lambda k: gains[k].value)
        pattern = Pattern("split", splits[best][run], np.log(m - 1))
        spread = part.spread(splits[best], gains[best])
        yield score_alternative(reduced, BODY, pattern, gains[best], spread, points=points)


def _log_sets(total: int, count: int) -> float:
    """Return ln of the number of sets of `count` points out of `total`."""
    return float(gammaln(total + 1) - gammaln(count + 1) - gammaln(total - count + 1))


def _shifted(
    reduced: Reduced,
    factor: FloatArray,
    search: float,
    parts: tuple[IntArray, FloatArray, FloatArray],
) -> Iterator[Alternative]:
    """Yield the set of points that moved by the same vector, like a part of the object that shifted.

    Two-means clustering starts from the points that moved most. `parts` are the points that can have moved,
    their normal equations (n, 3, 3) and right-hand sides (n, 3).
    """
    movable, blocks, g = parts
    total = len(movable)
    squares = np.einsum("nii->ni", blocks)
    single, _ = gains_of(blocks, g, squares)
    best: Alternative | None = None
    for first in np.argsort(-single)[:STARTS]:
        members = np.arange(total) == first
        for _ in range(ROUNDS):
            N = blocks[members].sum(axis=0)
            d = -np.linalg.lstsq(N, g[members].sum(axis=0), rcond=None)[0]
            again = np.einsum("a,nab,b->n", d, blocks, d) + 2 * g @ d < 0
            if (again == members).all() or not again.any():
                break
            members = again
        if 2 * members.sum() > total:
            members = ~members  # equivalent: the other points moved in the opposite direction
        count = int(members.sum())  # at most half of the points
        if count < MIN_GROUP:
            continue
        points = movable[members]
        on = (factor[reduced.image] > 0) & np.isin(reduced.point, points)
        D = np.where(on[:, None, None], reduced.B, 0.0)
        gain = gain_of(*reduced.project(D))
        sets = _log_sets(total, count)
        left = g + np.where(members[:, None], blocks @ gain.beta, 0.0)
        values, ranks = gains_of(blocks, left, squares)
        redundancy = int(ranks.sum()) - gain.rank
        spread = Spread(float(values.sum()) / redundancy, redundancy)
        pattern = Pattern("split", factor, search + sets)
        one = score_alternative(reduced, SHIFTED, pattern, gain, spread, points=points)
        if best is None or one.evidence > best.evidence:
            best = one
    if best is not None:
        yield best


@dataclass(frozen=True)
class Pattern:
    """Photographs in which a family is freed."""

    name: str
    factor: FloatArray  # factor of each photograph, (m,)
    search: float = 0.0  # ln of the number of patterns, or sets of points, from which it was chosen
    among: BoolArray | None = None  # photographs within which some differ, (m,); None: all
    parts: int = 1  # number of parts with separate parameters


def score_alternative(
    reduced: Reduced,
    family: Family,
    pattern: Pattern,
    gain: Gain,
    spread: Spread = NONE,
    *,
    points: IntArray | None = None,
    parameters: tuple[tuple[int, int], ...] = (),
) -> Alternative:
    """Return an alternative with its test.

    Args:
        reduced: normal equations of the adjustment.
        family: family that is freed.
        pattern: photographs in which it is freed.
        gain: gain of the family in this pattern.
        spread: spread of the parts that it does not concern.
        points: points that moved, if any.
        parameters: interior parameters freed, (camera, parameter).
    """
    r, parts, search = reduced.redundancy, pattern.parts, pattern.search
    on = pattern.factor[reduced.image] != 0 if parts == 1 else np.ones(len(reduced.image), dtype=bool)
    some = np.zeros(0, dtype=np.int64) if points is None else points
    if len(some):
        on &= np.isin(reduced.point, some)
    touched = int(on.sum()) // parts
    log_p = log_probability(gain.value, gain.rank, r)
    if spread.factor > 1:
        f = spread.ratio(gain.value, gain.rank, r)
        log_p = max(log_p, log_f_sf(f, gain.rank, spread.redundancy)) if gain.rank else 0.0
    price = price_of(gain.rank, touched, search)
    evidence = spread.evidence(gain.value, gain.rank, r) - price
    return Alternative(
        *(family, pattern.name, pattern.factor, gain, spread, log_p, price, search, evidence),
        points=some,
        parameters=parameters,
        among=pattern.among,
    )


def patterns_of(m: int) -> Iterator[tuple[str, FloatArray, float]]:
    """Yield the patterns of m photographs: name, factors of the photographs (p, m), ln of the number p."""
    if m == MIN_GROUP:
        yield "pair", np.eye(m)[1:], 0.0  # equivalent: the other photograph differs
    elif m > MIN_GROUP:
        yield "single", np.eye(m), np.log(m)
    if m < 2 * MIN_GROUP:
        return
    splits = np.array([np.arange(m) >= k for k in range(MIN_GROUP, m - MIN_GROUP + 1)], dtype=float)
    yield "split", splits, np.log(len(splits))
    yield "linear", np.linspace(-1, 1, m)[None], 0.0
    yield "alternating", (np.arange(m) % 2)[None].astype(float), 0.0


@dataclass(frozen=True)
class Part:
    """Normal equations of a family in each photograph."""

    H: FloatArray  # (m, f, m, f)
    g: FloatArray  # (m, f)
    squares: FloatArray  # (m, f)

    def gain(self, factor: FloatArray) -> Gain:
        """Return the gain if the photographs have the family with these factors, (m,)."""
        return gain_of(
            np.tensordot(np.tensordot(factor, self.H, (0, 0)), factor, (1, 0)),
            factor @ self.g,
            factor**2 @ self.squares,
            least_share(self.g.shape[1]),
        )

    def spread(self, factor: FloatArray, gain: Gain) -> Spread:
        """Return the spread of the photographs in the family beyond what a pattern explains.

        Args:
            factor: factors of the pattern, (m,).
            gain: gain of the pattern.
        """
        m = len(self.g)
        left = self.g + np.tensordot(self.H, factor, (2, 0)) @ gain.beta
        some = np.ones(m, dtype=bool) if np.count_nonzero(factor) > 1 else factor == 0
        values, ranks = gains_of(self.blocks[some], left[some], self.squares[some])
        redundancy = int(ranks.sum()) - gain.rank
        return NONE if redundancy < 1 else Spread(float(values.sum()) / redundancy, redundancy)

    @property
    def blocks(self) -> FloatArray:
        """Normal equations of each photograph alone, (m, f, f)."""
        return np.asarray(np.einsum("iaib->iab", self.H))

    def group(self) -> tuple[FloatArray, Gain]:
        """Return the group of photographs with the largest gain, by two-means, as factors 0 and 1."""
        m = len(self.g)
        single, _ = gains_of(self.blocks, self.g, self.squares)
        best, most = np.zeros(m), None
        for first in np.argsort(-single)[:STARTS]:
            factor = (np.arange(m) == first).astype(float)
            for _ in range(ROUNDS):
                beta = self.gain(factor).beta
                # v'Pv as a function of the factors s, with beta held: s'Qs + 2 l's, minimised one by one
                Q = np.tensordot(beta, self.H, (0, 1)) @ beta
                linear = self.g @ beta
                again = factor.copy()
                for i in range(m):
                    others = Q[i] @ again - Q[i, i] * again[i]
                    again[i] = float(Q[i, i] + 2 * (linear[i] + others) < 0)
                if (again == factor).all() or not again.any():
                    break
                factor = again
            gain = self.gain(factor)
            if most is None or gain.value > most.value:
                best, most = factor, gain
        assert most is not None
        return best, most


def runs_of(camera: IntArray) -> IntArray:
    """Return the run of each photograph, (m,): a run has successive photographs of one camera.

    With too many cameras to test, a run includes photographs of several cameras.

    Args:
        camera: camera of each photograph, (m,).
    """
    m = len(camera)
    if m <= MAX_RUNS:
        return np.arange(m)
    if too_many_cameras(camera):
        camera = np.zeros_like(camera)
    piece = np.empty(m, dtype=np.int64)
    piece[np.argsort(camera, kind="stable")] = np.arange(m) * MAX_RUNS // m
    _, run = np.unique([camera, piece], axis=1, return_inverse=True)
    middle = np.bincount(run, weights=np.arange(m)) / np.bincount(run)
    return np.asarray(np.argsort(np.argsort(middle, kind="stable"))[run])


def too_many_cameras(camera: IntArray) -> bool:
    """Return whether there are too many cameras to test, given the camera of each photograph, (m,)."""
    return int(camera.max()) >= MAX_RUNS
