"""Alternatives of moved points, bodies and rig cameras, and the patterns of photographs that they affect.

Points move between two photographs of the sequence. Sets of points with different vectors are built in the
order of their single gains. Sets that shift by one vector are found by two-means clustering. Bodies are
given.

`find_bumps` tests whether the cameras of a rig kept their mounts, by a separate pose of each photograph. E
are the derivatives of its image points by a separate pose, v the whitened residuals, and R = I - A Q A'. The
shift is estimated as (E'R E)^-1 E'v, and v'E (E'R E)^-1 E'v / sigma0^2 is chi-square with six degrees of
freedom. The photographs of all rigs are tested together. The largest shift comes first, and each further one
is tested jointly with those found before.

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

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.engine.collinearity import residuals
from sfm.adjustment.engine.correlated import linearise
from sfm.adjustment.hypotheses.columns import Columns
from sfm.adjustment.hypotheses.families import (
    BODY,
    MOVED,
    SHIFTED,
    Alternative,
    Family,
)
from sfm.adjustment.hypotheses.score import (
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
from sfm.adjustment.quality.statistics import level_of_single
from sfm.adjustment.result import Adjustment
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.distributions import chi2_sf
from sfm.kernels.threads import own_threads
from sfm.likelihood import price_of
from sfm.network import sum_rows
from sfm.remarks.remark import Remark, remark

MIN_GROUP = 2  # photographs on each side of a split
MAX_RUNS = 60  # photographs, or runs of photographs, with separate freedoms
ROUNDS = 20  # iterations of two-means clustering
STARTS = 8  # photographs or points from which a group is grown
FALSE_ALARM = 0.01  # probability that a bump is reported for a rig without one
MIN_REDUNDANCY = 1e-9  # redundancy of a separate pose below which nothing checks it
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
class Bump:
    """A photograph whose camera was displaced on the rig."""

    photograph: str
    camera: str
    shift: float  # shift of the projection centre, object unit
    turn: float  # rotation, rad
    sigmas: float  # square root of chi-square
    probability: float  # probability of such a shift by chance, in one test


def find_bumps(a: Adjustment) -> tuple[Bump, ...]:
    """Return the photographs whose cameras were displaced on a rig, largest shift first.

    With two photographs at a moment, nothing shows which camera was displaced; the one that is not the
    reference camera is named.

    Args:
        a: adjustment with rigs and independent errors.
    """
    moment, mounts = a.network.moment, a.estimate.mounts
    if moment is None or mounts is None or a.error_correlation is not None:
        return ()
    together = np.bincount(moment)[moment]
    mounted = np.isin(np.arange(len(mounts.rig)), np.flatnonzero(mounts.position.any(axis=1)))
    tested = np.flatnonzero((together > 1) & (mounted[a.network.camera] | (together > 2)))
    if not len(tested):
        return ()
    with own_threads():
        s, G = _scores(a, tested)
    critical = level_of_single(FALSE_ALARM, len(tested))
    found: list[Bump] = []
    taken: list[int] = []
    while len(taken) < len(tested):
        best, chi2, step = -1, 0.0, np.zeros(6)
        for k in range(len(tested)):
            if k in taken or _same_moment(moment, tested, k, taken):
                continue
            value, d = _gain(s, G, k, taken)
            if value > chi2:
                best, chi2, step = k, value, d
        probability = float(chi2_sf(chi2 / a.sigma0**2, 6))
        if best < 0 or probability >= critical:
            break
        i = int(tested[best])
        found.append(
            Bump(
                a.network.images[i],
                a.estimate.cameras[a.network.camera[i]].name,
                float(np.linalg.norm(step[:3])),
                float(np.linalg.norm(step[3:])),
                float(np.sqrt(chi2) / a.sigma0),
                probability,
            )
        )
        taken.append(best)
    return tuple(found)


def bump_remarks(a: Adjustment, unit: str) -> tuple[Remark, ...]:
    """Return the remark on cameras that were displaced on a rig; empty if there are none.

    Args:
        a: adjustment.
        unit: unit of its coordinates.
    """
    found = find_bumps(a)
    if not found:
        return ()
    cameras = {one.camera for one in found}
    theirs = [k for k, camera in enumerate(a.estimate.cameras) if camera.name in cameras]
    most = 2 * len(found) >= int(np.isin(a.network.camera, theirs).sum())
    return (
        remark(
            "rig_contradicted" if most else "rig_bumped",
            photographs=[one.photograph for one in found],
            cameras=list(dict.fromkeys(one.camera for one in found)),
            distance=(max(one.shift for one in found), unit),
            angle=(float(np.degrees(max(one.turn for one in found))), "deg"),
            shift=max(one.sigmas for one in found),
        ),
    )


def _same_moment(moment: IntArray, tested: IntArray, k: int, taken: list[int]) -> bool:
    """Return whether all other photographs of the same moment already have a separate pose."""
    taken_with = sum(int(moment[tested[t]] == moment[tested[k]]) for t in taken)
    return taken_with + 2 > int((moment == moment[tested[k]]).sum())


def _scores(a: Adjustment, tested: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return E'v (t, 6) and E'R E (t, 6, t, 6) of the tested photographs."""
    m = marginal_of(a, cross=False)
    o, weight = m.layout.observations, np.ascontiguousarray(a.weights[m.layout.order])
    linear = linearise(m.optimum, m.layout, weight)
    v = np.einsum("kab,kb->ka", linear.whitening, residuals(o, m.optimum.state)).ravel()
    v = np.where(np.repeat(weight > 0, 2), np.nan_to_num(v), 0.0)
    E = np.zeros((len(v), len(tested), 6))
    for t, i in enumerate(tested):
        rows = (2 * np.flatnonzero(o.image == i)[:, None] + np.arange(2)).ravel()
        columns = 6 * o.pose_of[i] + np.arange(6)
        E[rows, t] = linear.A[rows][:, columns].toarray()
    flat = E.reshape(len(v), -1)
    G = flat.T @ linear.residuals(flat)
    return (flat.T @ v).reshape(-1, 6), G.reshape(len(tested), 6, len(tested), 6)


def _gain(s: FloatArray, G: FloatArray, k: int, taken: list[int]) -> tuple[float, FloatArray]:
    """Return chi-square and shift (6,) of a separate pose of a photograph, jointly with those taken."""
    t, M = s[k], G[k][:, k]
    if taken:
        across = G[k][:, taken].reshape(6, -1)
        others = G[taken][:, :, taken].reshape(6 * len(taken), -1)
        solved = np.linalg.lstsq(others, np.column_stack([across.T, s[taken].ravel()]), rcond=None)[0]
        M, t = M - across @ solved[:, :6], t - across @ solved[:, 6]
    scale = np.sqrt(np.maximum(np.diagonal(G[k][:, k]), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(M / np.outer(scale, scale))
    on = values > MIN_REDUNDANCY
    part = vectors[:, on].T @ (t / scale)
    return float((part**2 / values[on]).sum()), -(vectors[:, on] @ (part / values[on])) / scale


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
