"""Alternatives of an object or a rig that moved, and the patterns of photographs they affect.

They moved at a place in the sequence of photographs. Points that move by different vectors are tried by
their single gains, those that shift by one vector by two means, and bodies as they are known.

Whether the cameras of a rig kept their places: a test of each photograph for a separate pose.

With the derivatives E of the image points of one photograph by a separate pose, the whitened residuals v
and R = I - A Q A', its shift is estimated as (E'R E)^-1 E'v, and v'E (E'R E)^-1 E'v / sigma0^2 is chi-square
of six. The photographs of a rig are tested together, the largest shift first, each beside those found before.

The patterns: photographs in which a family is freed, with its gain and the test of the alternative. A pattern
gives each photograph, or run of photographs, a factor on the columns of a family.

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
from sfm.remarks.remark import Remark, remark

MIN_GROUP = 2  # photographs on each side of a split
MAX_RUNS = 60  # photographs, or runs of them, that have freedoms by themselves
ROUNDS = 20  # of two means
STARTS = 8  # photographs from which a group is grown
FALSE_ALARM = 0.01  # probability that a rig without a bump is reported to have one
MIN_REDUNDANCY = 1e-9  # redundancy of a separate pose below which nothing checks it
MAX_PRODUCTS = 2e11  # numbers multiplied to try all of these places, some ten seconds
MAX_SPLITS = 12  # places in the sequence at which points are tried to have moved
MAX_MOVED = 60  # points that are tried together


def moved_points(reduced: Reduced) -> Iterator[Alternative]:
    """Return for each place in the sequence the set of points that moved there with the best evidence."""
    m = reduced.photographs
    if m < 2 * MIN_GROUP:
        return
    splits = list(range(MIN_GROUP, m - MIN_GROUP + 1))
    products = 6 * len(reduced.L) * len(reduced.t) ** 2  # of one place
    affordable = max(1, min(MAX_SPLITS, int(MAX_PRODUCTS / products)))
    splits = splits[:: -(-len(splits) // affordable)]
    best: dict[str, Alternative] = {}
    for k in splits:
        for one in _moved_at(reduced, (np.arange(m) >= k).astype(float), np.log(len(splits))):
            if one.family.name not in best or one.evidence > best[one.family.name].evidence:
                best[one.family.name] = one
    yield from best.values()


def _moved_at(reduced: Reduced, factor: FloatArray, search: float) -> Iterator[Alternative]:
    """Return the set of points that moved between the photographs of factor 0 and those of factor 1."""
    n, m, size = len(reduced.L), reduced.photographs, len(reduced.t)
    on = factor[reduced.image] > 0
    D = np.where(on[:, None, None], reduced.B, 0.0)
    V = np.zeros((n, 3, 3))
    np.add.at(V, reduced.point[on], np.swapaxes(D[on], 1, 2) @ D[on])
    C = reduced.L @ V  # L^-1 B'D, as B'D = V here
    before = np.bincount(reduced.point[~on], minlength=n)
    after = np.bincount(reduced.point[on], minlength=n)
    movable = np.flatnonzero((before >= MIN_GROUP) & (after >= MIN_GROUP))
    if not len(movable):
        return
    # A'D of each point, reduced by the point itself
    by = np.swapaxes(reduced.B[on], 1, 2) @ reduced.A[on]
    K = points_by_cameras(by, reduced.point[on], reduced.image[on], n, m)
    K = K[movable] - np.swapaxes(C[movable], 1, 2) @ reduced.W[movable]
    g = np.zeros((n, 3))
    np.add.at(g, reduced.point[on], np.einsum("kab,ka->kb", D[on], reduced.v[on]))
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
    """Return for each body that it moved, at the best place in the sequence.

    One photograph gives the place of a body, so that it may move behind the first and before the last.
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
    """Return ln of the number of sets of so many points."""
    return float(gammaln(total + 1) - gammaln(count + 1) - gammaln(total - count + 1))


def _shifted(
    reduced: Reduced,
    factor: FloatArray,
    search: float,
    parts: tuple[IntArray, FloatArray, FloatArray],
) -> Iterator[Alternative]:
    """Return the set of points that moved by one and the same vector, as a part of the object that shifted.

    By two means over the points, from those that moved most; parts are the points that can have moved, their
    normal equations (n, 3, 3) and right sides (n, 3).
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
            members = ~members  # that the others moved the other way is the same statement
        count = int(members.sum())  # not more than half
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
    """A photograph whose camera has left its place on the rig."""

    photograph: str
    camera: str
    shift: float  # of the projection centre, object unit
    turn: float  # rad
    sigmas: float  # root of chi-square
    probability: float  # of so large a shift by chance, in one test


def find_bumps(a: Adjustment) -> tuple[Bump, ...]:
    """Return the photographs whose cameras have left their places on a rig, the largest shift first.

    Of a moment with two photographs nothing shows which of them; the one that is not of the reference camera
    is named.

    Args:
        a: an adjustment with rigs, of independent errors.
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
    """Return the remark on cameras that have left their places on a rig; none without.

    Args:
        a: an adjustment.
        unit: of its coordinates.
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
    """Whether all but one photograph of the moment of a photograph have a separate pose already."""
    taken_with = sum(int(moment[tested[t]] == moment[tested[k]]) for t in taken)
    return taken_with + 2 > int((moment == moment[tested[k]]).sum())


def _scores(a: Adjustment, tested: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return E'v (t, 6) and E'R E (t, 6, t, 6) of the photographs that are tested."""
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
    """Return chi-square of a separate pose of a photograph beside those of others, and the shift, (6,)."""
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
    factor: FloatArray  # of each photograph, (m,)
    search: float = 0.0  # ln of the number of patterns, or of sets of points, from which it was taken
    among: BoolArray | None = None  # photographs of which some differ, (m,); None: all
    parts: int = 1  # each of which has parameters by itself


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
    """Return an alternative with its test."""
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


def price_of(rank: int, touched: int, search: float) -> float:
    """Return what parameters must gain in ln likelihood, by the number of image points that they move.

    Source: Kass and Raftery (1995), J. Am. Stat. Assoc. 90, on the n of the Bayesian information criterion.
    """
    return float(rank / 2 * np.log(2 * max(touched, 2)) + search)


def patterns_of(m: int) -> Iterator[tuple[str, FloatArray, float]]:
    """Return the patterns: name, factors of the photographs (p, m), ln of the number p."""
    if m == MIN_GROUP:
        yield "pair", np.eye(m)[1:], 0.0  # that the other one differs is the same statement
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
        """Return the gain where the photographs have the family with these factors."""
        return gain_of(
            np.tensordot(np.tensordot(factor, self.H, (0, 0)), factor, (1, 0)),
            factor @ self.g,
            factor**2 @ self.squares,
            least_share(self.g.shape[1]),
        )

    def spread(self, factor: FloatArray, gain: Gain) -> Spread:
        """Return how much the photographs differ in the family beyond what a pattern explains."""
        m = len(self.g)
        left = self.g + np.tensordot(self.H, factor, (2, 0)) @ gain.beta
        some = np.ones(m, dtype=bool) if np.count_nonzero(factor) > 1 else factor == 0
        values, ranks = gains_of(self.blocks[some], left[some], self.squares[some])
        redundancy = int(ranks.sum()) - gain.rank
        return NONE if redundancy < 1 else Spread(float(values.sum()) / redundancy, redundancy)

    @property
    def blocks(self) -> FloatArray:
        """Normal equations of each photograph by itself, (m, f, f)."""
        return np.asarray(np.einsum("iaib->iab", self.H))

    def group(self) -> tuple[FloatArray, Gain]:
        """Return the photographs that together have the largest gain, as factors 0 and 1, by two means."""
        m = len(self.g)
        single, _ = gains_of(self.blocks, self.g, self.squares)
        best, most = np.zeros(m), None
        for first in np.argsort(-single)[:STARTS]:
            factor = (np.arange(m) == first).astype(float)
            for _ in range(ROUNDS):
                beta = self.gain(factor).beta
                # v'Pv as a function of the factors: s'Qs + 2 l's with beta held, one photograph after another
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
    """Return the run of each photograph, (m,): those of one camera that follow one another.

    Of more cameras than are tested a run has several.
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
    """Return whether there are more cameras, by `cameras_of_photographs`, than are tested."""
    return int(camera.max()) >= MAX_RUNS
