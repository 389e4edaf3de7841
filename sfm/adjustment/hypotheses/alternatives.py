"""The alternatives: what is freed (family) in which photographs (pattern), each with its gain.

A family is a set of columns; a pattern gives each photograph a factor on them. The level of the test is
shared out among all alternatives, and lowered by what was searched inside each of them: the number of
patterns, or of sets of points, from which the best one was taken.

Source: the score test of `sfm.adjustment.hypotheses.score`; Holm (1979), Scand. J. Statist. 6, for the level.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln

from sfm.adjustment.hypotheses.columns import Columns, shared_columns
from sfm.adjustment.hypotheses.families import (
    BODY,
    FORMAT,
    GIVEN,
    HELD,
    MOVED,
    OF_EACH,
    OF_PHOTOGRAPHS,
    SHIFTED,
    Alternative,
    CameraFamily,
    Family,
    InteriorFamily,
    ObjectFamily,
    format_columns,
)
from sfm.adjustment.hypotheses.score import (
    NONE,
    Gain,
    Reduced,
    Spread,
    determined_inverse,
    gain_of,
    gains_of,
    least_share,
    log_f_sf,
    log_likelihood_gain,
    log_probability,
    points_by_cameras,
)
from sfm.adjustment.result import Adjustment
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.distortion.models import Role
from sfm.distributions import chi2_isf

ALPHA = 0.01  # probability of naming any alternative where none holds
MIN_GROUP = 2  # photographs on each side of a split
MAX_RUNS = 60  # photographs, or runs of them, that have freedoms by themselves
MAX_PRODUCTS = 2e11  # numbers multiplied to try all of these places, some ten seconds
MAX_SPLITS = 12  # places in the sequence at which points are tried to have moved
MAX_MOVED = 60  # points that are tried together
ROUNDS = 20  # of two means
OF_ONE = ("single", "pair")  # patterns of one photograph
STARTS = 8  # photographs from which a group is grown


def alternatives_of(
    a: Adjustment, reduced: Reduced, columns: Columns, bodies: Sequence[IntArray] = ()
) -> tuple[Alternative, ...]:
    """Return all alternatives, the best evidence first.

    Args:
        a: adjustment of the image points alone; or with control, beside which only a change of the camera is
            looked for, and what a wrong shape of the control explains as well.
        reduced: its normal equations.
        columns: its derivatives.
        bodies: object points of each rigid body that may move against the others.
    """
    if a.datum == "control":
        found = [*_by_photographs(a, reduced, columns), *_shapes_of_control(reduced, columns)]
        return _by_evidence(a, reduced, columns, found)
    found = [
        *interiors(a, reduced, HELD),
        *interiors(a, reduced, GIVEN),
        *_format(a, reduced),
        *_by_photographs(a, reduced, columns),
        *_moved_points(reduced),
        *_moved_bodies(a, reduced, columns, bodies),
    ]
    return _by_evidence(a, reduced, columns, found)


def _by_evidence(
    a: Adjustment, reduced: Reduced, columns: Columns, found: Sequence[Alternative]
) -> tuple[Alternative, ...]:
    """Return alternatives, the best evidence first, gains divided by what correlated errors make of them."""

    def tested(one: Alternative) -> Alternative:
        grows = log_likelihood_gain(one.gain.value, reduced.redundancy) - one.price
        if reduced.correlation is None or not grows > np.log(1 / ALPHA):
            return one  # not named anyhow
        effect = reduced.design_effect(reduced.whiten(one.columns(a, columns)))
        return one.with_design_effect(effect, reduced.redundancy)

    return tuple(sorted(map(tested, found), key=lambda one: -one.evidence))


def count_alternatives(a: Adjustment, bodies: int = 0) -> int:
    """Return how many alternatives are tested of an adjustment, but for some without any gain.

    They are the held and given parameters, the families of photographs by their patterns, the format,
    points that moved, and so many bodies.
    """
    owners = [one for family in (HELD, GIVEN) for one in interior_parameters(a, family)]
    held = sum(len(one) + (len(one) > 1) for one in owners)
    if len(a.network.images) < MIN_GROUP:
        return held + 1
    camera = cameras_of_photographs(a)
    run, patterns = _runs(camera), 0
    for family in OF_PHOTOGRAPHS:
        for among in photographs_among(family, camera):
            m = len(np.unique(run[among]))
            names = [name for name, _, _ in _patterns(m) if family.of_camera or name not in OF_ONE]
            patterns += len(names) + (m > 2 * MIN_GROUP)
    return held + patterns + len(OF_EACH) + len((FORMAT, MOVED, SHIFTED)) + bodies


def is_significant(one: Alternative, rows: int) -> bool:
    """Return whether chance makes so large a gain in fewer than ALPHA of the surveys, all rows together."""
    return bool(one.log_p < np.log(ALPHA / rows) - one.search)


def needed_gain(rank: int, touched: int, search: float, rows: int) -> float:
    """Return the gain from which an alternative is named, of a known variance factor.

    Args:
        rank: parameters of the alternative.
        touched: image points that they move.
        search: ln of the number of patterns from which it was taken.
        rows: alternatives that are tested.
    """
    level = np.exp(np.log(ALPHA / rows) - search)
    return float(max(chi2_isf(level, rank), 2 * (price_of(rank, touched, search) + np.log(1 / ALPHA))))


def price_of(rank: int, touched: int, search: float) -> float:
    """Return what parameters must gain in ln likelihood, by the number of image points that they move.

    Source: Kass and Raftery (1995), J. Am. Stat. Assoc. 90, on the n of the Bayesian information criterion.
    """
    return float(rank / 2 * np.log(2 * max(touched, 2)) + search)


@dataclass(frozen=True)
class _Pattern:
    """Photographs in which a family is freed."""

    name: str
    factor: FloatArray  # of each photograph, (m,)
    search: float = 0.0  # ln of the number of patterns, or of sets of points, from which it was taken
    among: BoolArray | None = None  # photographs of which some differ, (m,); None: all
    parts: int = 1  # each of which has parameters by itself


def _made(
    reduced: Reduced,
    family: Family,
    pattern: _Pattern,
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


def interior_parameters(a: Adjustment, family: InteriorFamily) -> list[list[tuple[tuple[int, int], ...]]]:
    """Return for each camera, or group of cameras, its held or its given parameters: (camera, parameter)."""
    network = a.network
    given = network.interior
    owners: dict[str, dict[str, list[tuple[int, int]]]] = {}
    for index, camera in enumerate(a.estimate.cameras):
        if not (network.camera == index).any():
            continue
        some = ~camera.free
        if family.of_given:
            weighted = given.parameter[(given.camera == index) & (given.sigma > 0)]
            some = camera.free & np.isin(np.arange(len(camera.free)), weighted)
        # the denominator of a fraction says the same as its numerator
        for s in np.flatnonzero(some & ~camera.plays(Role.DENOMINATOR)).tolist():
            owner = owners.setdefault(camera.owner_of(s), {})
            owner.setdefault(camera.names[s], []).append((index, s))
    return [[tuple(one) for one in owner.values()] for owner in owners.values()]


def interiors(a: Adjustment, reduced: Reduced, family: InteriorFamily) -> Iterator[Alternative]:
    """Return an alternative for each held or given interior parameter, and one for all of a camera."""
    everywhere = _Pattern("all", np.ones(len(a.network.images)))
    for sets in interior_parameters(a, family):
        whole = tuple(pair for one in sets for pair in one)
        D = reduced.whiten(shared_columns(a, list(whole))[0])
        every = gain_of(*reduced.project(D))
        for parameters, columns in [
            *((one, [k]) for k, one in enumerate(sets)),
            *([(whole, list(range(len(sets))))] if len(sets) > 1 else []),
        ]:
            own = D[:, :, columns]
            H, g, squares = reduced.project(own)
            gain = gain_of(H, g, squares, least_share(len(H)))
            if gain.rank:
                # what the photographs say of it once it, or all of the camera, are free
                variance = float(gain.beta @ H @ gain.beta)
                spread = min(
                    (
                        _of_scores(reduced.scores(own @ gain.beta, step), variance)
                        for step in (own @ gain.beta, D @ every.beta)
                    ),
                    key=lambda one: one.factor,
                )
                yield _made(reduced, family, everywhere, gain, spread, parameters=parameters)


def _format(a: Adjustment, reduced: Reduced) -> Iterator[Alternative]:
    """Return the alternative of residuals that depend on the place in the photograph."""
    return _in_all(reduced, FORMAT, format_columns(a))


def _in_all(reduced: Reduced, family: Family, columns: FloatArray) -> Iterator[Alternative]:
    """Return the alternative of a family whose columns, px, (k, 2, q), are the same in all photographs."""
    D = reduced.whiten(columns)
    H, g, squares = reduced.project(D)
    gain = gain_of(H, g, squares)
    if gain.rank:
        step = D @ gain.beta
        spread = _of_scores(reduced.scores(step, step), float(gain.beta @ H @ gain.beta))
        yield _made(reduced, family, _Pattern("all", np.ones(reduced.photographs)), gain, spread)


def _of_scores(scores: FloatArray, variance: float) -> Spread:
    """Return the spread of what the photographs say of one direction, (m,), over its expected variance.

    Source: White (1982), Econometrica 50, for a score test with dependent observations.
    """
    m = len(scores)
    return Spread(float(scores @ scores) / variance * m / (m - 1), m - 1, among=False) if m > 1 else NONE


def _by_photographs(a: Adjustment, reduced: Reduced, columns: Columns) -> Iterator[Alternative]:
    """Return the alternatives of cameras, strain and bending in some of the photographs.

    Of more than MAX_RUNS photographs those next to one another in the sequence are taken together. A camera
    changes in some of its own photographs, an object in some of all.
    """
    camera = cameras_of_photographs(a)
    run = _runs(camera)
    m = int(run.max()) + 1
    H, g, squares = reduced.project_by_run(reduced.whiten(columns.freedoms), run)
    if m >= 2 * MIN_GROUP and not too_many_cameras(camera):
        yield from _each(reduced, H, g, squares, run)
    for family in OF_PHOTOGRAPHS:
        some = np.array(family.places)
        for among in photographs_among(family, camera):
            runs = np.unique(run[among])
            part = _Part(
                H[np.ix_(runs, some, runs, some)], g[np.ix_(runs, some)], squares[np.ix_(runs, some)]
            )
            for pattern, factors, search in _patterns(len(runs)):
                if pattern in OF_ONE and not family.of_camera:
                    continue  # an object that one photograph shows otherwise is that photograph's fault
                gains = [part.gain(factor) for factor in factors]
                best = max(range(len(gains)), key=lambda k: gains[k].value)
                spread = part.spread(factors[best], gains[best])
                factor = _of_photographs(factors[best], runs, run, m)
                if pattern in OF_ONE:
                    alone = among if pattern == "pair" else factor > 0
                    own = _variance_of(reduced, alone, gains[best])
                    spread = replace(spread, factor=max(spread.factor, own))
                yield _made(reduced, family, _Pattern(pattern, factor, search, among), gains[best], spread)
            if len(runs) > 2 * MIN_GROUP:
                members, gain = part.group()
                if MIN_GROUP <= members.sum() <= len(runs) - MIN_GROUP:
                    factor, search = _of_photographs(members, runs, run, m), (len(runs) - 1) * np.log(2)
                    grown = _Pattern("group", factor, search, among)
                    yield _made(reduced, family, grown, gain, part.spread(members, gain))


def _shapes_of_control(reduced: Reduced, columns: Columns) -> Iterator[Alternative]:
    """Return the alternatives of control that is strained or bent, as all photographs show it."""
    for family in OF_PHOTOGRAPHS:
        if not family.of_camera:
            yield from _in_all(reduced, family, columns.freedoms[:, :, list(family.places)])


def cameras_of_photographs(a: Adjustment) -> IntArray:
    """Return the number of the camera that took each photograph, (m,); parameters of its own leave it one."""
    names = [camera.shared_name for camera in a.estimate.cameras]
    _, number = np.unique([names[k] for k in a.network.camera], return_inverse=True)
    return np.asarray(number)


def photographs_among(family: CameraFamily | ObjectFamily, camera: IntArray) -> list[BoolArray]:
    """Return the photographs among which some may differ, (m,) each: of each camera, or all of the object.

    More than MAX_RUNS cameras are too many to test.

    Args:
        family: what differs.
        camera: `cameras_of_photographs`, (m,).
    """
    if not family.of_camera:
        return [np.ones(len(camera), dtype=bool)]
    return [] if too_many_cameras(camera) else [camera == k for k in range(int(camera.max()) + 1)]


def too_many_cameras(camera: IntArray) -> bool:
    """Return whether there are more cameras, by `cameras_of_photographs`, than are tested."""
    return int(camera.max()) >= MAX_RUNS


def _runs(camera: IntArray) -> IntArray:
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


def _of_photographs(factor: FloatArray, runs: IntArray, run: IntArray, count: int) -> FloatArray:
    """Return the factors of photographs, (m,), from those of some of the runs, 0 in the others."""
    every = np.zeros(count)
    every[runs] = factor
    return every[run]


def _each(
    reduced: Reduced, H: FloatArray, g: FloatArray, squares: FloatArray, run: IntArray
) -> Iterator[Alternative]:
    """Return the alternatives of a camera of its own for each photograph.

    It must exceed what all other freedoms of the photographs show once it is in, by an F test: errors that
    the image points of a photograph have in common need not be those of a camera.
    """
    m, f = g.shape
    for family in OF_EACH:
        some = np.array(family.places)
        rest = np.setdiff1d(np.arange(f), some)
        q, p = m * len(some), m * len(rest)
        own = H[:, some][:, :, :, some].reshape(q, q)
        gain = gain_of(own, g[:, some].ravel(), squares[:, some].ravel())
        if not log_probability(gain.value, gain.rank, reduced.redundancy) < np.log(ALPHA):
            continue
        cross = H[:, rest][:, :, :, some].reshape(p, q)
        inverse = determined_inverse(own, squares[:, some].ravel())
        others = gain_of(
            H[:, rest][:, :, :, rest].reshape(p, p) - cross @ inverse @ cross.T,
            g[:, rest].ravel() + cross @ gain.beta,
            squares[:, rest].ravel(),
        )
        spread = Spread(others.value / others.rank, others.rank, among=False) if others.rank else NONE
        yield _made(reduced, family, _Pattern("each", run.astype(float), parts=m), gain, spread)


def _variance_of(reduced: Reduced, some: BoolArray, gain: Gain) -> float:
    """Return the variance that an alternative leaves in some photographs, (m,), over that of all."""
    v = reduced.v[some[reduced.image]]
    expected = v.size * reduced.redundancy / reduced.count
    return float(max((v**2).sum() - gain.value, 0.0) / max(expected - gain.rank, 1.0))


def _patterns(m: int) -> Iterator[tuple[str, FloatArray, float]]:
    """Return the patterns: name, factors of the photographs (p, m), ln of the number p."""
    if m == MIN_GROUP:
        yield "pair", np.eye(m)[1:], 0.0  # that the other one differs says the same
    elif m > MIN_GROUP:
        yield "single", np.eye(m), np.log(m)
    if m < 2 * MIN_GROUP:
        return
    splits = np.array([np.arange(m) >= k for k in range(MIN_GROUP, m - MIN_GROUP + 1)], dtype=float)
    yield "split", splits, np.log(len(splits))
    yield "linear", np.linspace(-1, 1, m)[None], 0.0
    yield "alternating", (np.arange(m) % 2)[None].astype(float), 0.0


@dataclass(frozen=True)
class _Part:
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


def _moved_points(reduced: Reduced) -> Iterator[Alternative]:
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
    own = V[movable] - np.swapaxes(C[movable], 1, 2) @ C[movable]
    KS = K @ reduced.Sinv
    blocks = own - np.einsum("nas,nbs->nab", KS, K)
    squares = np.einsum("nii->ni", V[movable])
    single, _ = gains_of(blocks, g, squares)
    order = np.argsort(-single)[: min(MAX_MOVED, len(movable) // 2 or 1)]
    flat = (K[order].reshape(-1, size), KS[order].reshape(-1, size))
    H = -flat[1] @ flat[0].T
    for place, k in enumerate(order):
        block = slice(3 * place, 3 * place + 3)
        H[block, block] += own[k]
    best: Alternative | None = None
    total = len(movable)
    ordered = np.sort(single)[::-1]
    for count in range(1, len(order) + 1):
        part = slice(0, 3 * count)
        gain = gain_of(H[part, part], g[order].ravel()[part], squares[order].ravel()[part])
        sets = _log_sets(total, count)
        others = ordered[count:]
        spread = Spread(float(others.mean()) / 3, 3 * len(others)) if len(others) else NONE
        pattern = _Pattern("split", factor, search + sets)
        one = _made(reduced, MOVED, pattern, gain, spread, points=movable[order[:count]])
        if best is None or one.evidence > best.evidence:
            best = one
        elif count > 2 * len(best.points) + 4:
            break
    if best is not None:
        yield best
    yield from _shifted(reduced, factor, search, (movable, blocks, g))


def _moved_bodies(
    a: Adjustment, reduced: Reduced, columns: Columns, bodies: Sequence[IntArray]
) -> Iterator[Alternative]:
    """Return for each body that it moved, at the best place in the sequence.

    One photograph gives the place of a body, so that it may move behind the first and before the last.
    """
    if reduced.photographs < 2 * MIN_GROUP:
        return
    run = _runs(np.zeros(reduced.photographs, dtype=np.int64))
    m = int(run.max()) + 1
    splits = (np.arange(m) >= np.arange(1, m)[:, None]).astype(float)
    for points in bodies:
        field = BODY.field(a.estimate.points, points)[a.network.image_points.point]
        part = _Part(*reduced.project_by_run(reduced.whiten(columns.point @ field), run))
        gains = [part.gain(factor) for factor in splits]
        best = max(range(len(gains)), key=lambda k: gains[k].value)
        pattern = _Pattern("split", splits[best][run], np.log(m - 1))
        spread = part.spread(splits[best], gains[best])
        yield _made(reduced, BODY, pattern, gains[best], spread, points=points)


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
    own, _ = gains_of(blocks, g, squares)
    best: Alternative | None = None
    for first in np.argsort(-own)[:STARTS]:
        members = np.arange(total) == first
        for _ in range(ROUNDS):
            N = blocks[members].sum(axis=0)
            d = -np.linalg.lstsq(N, g[members].sum(axis=0), rcond=None)[0]
            again = np.einsum("a,nab,b->n", d, blocks, d) + 2 * g @ d < 0
            if (again == members).all() or not again.any():
                break
            members = again
        if 2 * members.sum() > total:
            members = ~members  # that the others moved the other way says the same
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
        pattern = _Pattern("split", factor, search + sets)
        one = _made(reduced, SHIFTED, pattern, gain, spread, points=points)
        if best is None or one.evidence > best.evidence:
            best = one
    if best is not None:
        yield best
