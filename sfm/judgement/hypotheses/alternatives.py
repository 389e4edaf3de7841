"""Alternative hypotheses, each with its gain: one row of `alternatives_of` for each family.

A family is a set of columns, and a pattern gives each photograph, or run of photographs, a factor on them.
Points move between two photographs of the sequence: each by itself, in the order of their single gains, or
together, where they fit the motion of one of them. The level of the test is divided among all alternatives.
It is also lowered by the search inside one: the number of patterns, or of sets of points, from which it was
chosen.

Source: the score test of `sfm.judgement.hypotheses.score`; Holm (1979), Scand. J. Statist. 6, for the level;
Baarda (1968), A testing procedure for use in geodetic networks; Foerstner and Wrobel (2016), Photogrammetric
Computer Vision, sec. 4.6.4 (groups of parameters) and 4.6.5 (alternative hypotheses).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from sfm.adjustment.result import Adjustment
from sfm.judgement.hypotheses.columns import interior_columns, rigid_motions
from sfm.judgement.hypotheses.families import (
    BODY,
    FORMAT,
    GIVEN,
    HELD,
    MOVED,
    OF_EACH,
    OF_PHOTOGRAPHS,
    STRAIN,
    Alternative,
    CameraFamily,
    InteriorFamily,
    ObjectFamily,
)
from sfm.judgement.hypotheses.score import (
    NONE,
    Gain,
    Reduced,
    Spread,
    add_to_points,
    determined_inverse,
    gain_of,
    gains_of,
    least_share,
    log_probability,
)
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distortion.models import Role
from sfm.model.distributions import chi2_isf
from sfm.model.likelihood import price_of

MIN_GROUP = 2  # photographs on each side of a split
MAX_RUNS = 60  # photographs, or runs of photographs, with separate freedoms
MAX_PRODUCTS = 2e11  # multiplications for all splits, about ten seconds
MAX_SPLITS = 12  # positions in the sequence at which a movement is tested
MAX_MOVED = 60  # points with different vectors that are tested together
ROUNDS = 20  # iterations of a set and its parameters
STARTS = 8  # points or photographs from which a set is grown
MIN_OF_BODY = 3  # points that determine the six motions of a body


def alternatives_of(reduced: Reduced) -> tuple[Alternative, ...]:
    """Return all alternatives, best evidence first.

    With control, only changes of the camera and of the object, and strained control, are tested.
    """
    a, alternatives = reduced.adjustment, list(_by_photographs(reduced))
    in_all = Alternative(STRAIN if a.datum == "control" else FORMAT, "all", np.ones(reduced.photographs))
    alternatives += _in_all(reduced, in_all, in_all.whitened(reduced))
    if a.datum != "control":
        alternatives += [*interiors(reduced, HELD), *interiors(reduced, GIVEN), *moved_points(reduced)]
    needed = np.log(1 / a.levels.family)

    def tested(alternative: Alternative) -> Alternative:
        priced = alternative.priced(reduced)
        if a.error_correlation is None or not priced.evidence_beside_spread > needed:
            return priced  # not significant in any case
        return replace(priced, design_effect=reduced.design_effect(alternative.whitened(reduced)))

    return tuple(sorted(map(tested, alternatives), key=lambda alternative: -alternative.evidence))


def count_alternatives(a: Adjustment) -> int:
    """Return the number of alternatives tested for an adjustment, including some that have no gain.

    They are held and given parameters, families of photographs with their patterns, the format and moved
    points.
    """
    owners = [owner for family in (HELD, GIVEN) for owner in interior_parameters(a, family)]
    held = sum(len(owner) + (len(owner) > 1) for owner in owners)
    if len(a.network.images) < MIN_GROUP:
        return held + 1
    camera = cameras_of_photographs(a)
    run, patterns = runs_of(camera), 0
    for family in OF_PHOTOGRAPHS:
        for among in photographs_among(family, camera):
            patterns += len(list(patterns_of(family, len(np.unique(run[among])))))
    return held + patterns + len(OF_EACH) + len((FORMAT, MOVED, BODY))


def is_significant(alternative: Alternative, rows: int, level: float) -> bool:
    """Return whether chance would produce such a gain in a smaller share of all surveys than the level.

    The level is that of naming any alternative if none is true, `Levels.family`. All rows share it.
    """
    return bool(alternative.log_p < np.log(level / rows) - alternative.search)


def needed_gain(rank: int, touched: int, search: float, rows: int, level: float) -> float:
    """Return the smallest gain for which an alternative is named, with a known variance factor.

    Args:
        rank: number of parameters of the alternative.
        touched: number of image points that they move.
        search: ln of the number of patterns from which it was chosen.
        rows: number of alternatives tested together.
        level: probability of naming any alternative if none is true, `Levels.family`.
    """
    single = np.exp(np.log(level / rows) - search)
    return float(max(chi2_isf(single, rank), 2 * (price_of(rank, touched, search) + np.log(1 / level))))


def interior_parameters(a: Adjustment, family: InteriorFamily) -> list[list[tuple[tuple[int, int], ...]]]:
    """Return the held or given parameters of each camera or group of cameras, as (camera, parameter)."""
    network = a.network
    given = network.interior
    owners: dict[str, dict[str, list[tuple[int, int]]]] = {}
    for index, camera in enumerate(a.estimate.cameras):
        if not (network.camera == index).any():
            continue
        listed = ~camera.free
        if family.of_given:
            weighted = given.parameter[(given.camera == index) & (given.sigma > 0)]
            listed = camera.free & np.isin(np.arange(len(camera.free)), weighted)
        # the denominator of a fraction describes the same effect as its numerator
        for s in np.flatnonzero(listed & ~camera.plays(Role.DENOMINATOR)).tolist():
            owner = owners.setdefault(camera.owner_of(s), {})
            owner.setdefault(camera.names[s], []).append((index, s))
    return [[tuple(places) for places in owner.values()] for owner in owners.values()]


def interiors(reduced: Reduced, family: InteriorFamily) -> Iterator[Alternative]:
    """Yield an alternative for each held or given interior parameter, and one for all of a camera."""
    everywhere = np.ones(reduced.photographs)
    for sets in interior_parameters(reduced.adjustment, family):
        of_camera = tuple(pair for places in sets for pair in places)
        D = reduced.whiten(interior_columns(reduced.adjustment, of_camera)[0])
        every = gain_of(*reduced.project(D))
        tested = [(places, [k]) for k, places in enumerate(sets)]
        if len(sets) > 1:
            tested.append((of_camera, list(range(len(sets)))))
        for parameters, columns in tested:
            alternative = Alternative(family, "all", everywhere, parameters=parameters)
            yield from _in_all(reduced, alternative, D[:, :, columns], D @ every.beta)


def _in_all(
    reduced: Reduced, alternative: Alternative, D: FloatArray, further: FloatArray | None = None
) -> Iterator[Alternative]:
    """Yield an alternative of whitened columns (k, 2, q) that all photographs share, if it has a gain.

    Photographs differ by what remains after its step, or after a `further` step (k, 2) if that leaves less.

    Source: White (1982), Econometrica 50, for a score test with dependent observations.
    """
    H, g, squares = reduced.project(D)
    gain = gain_of(H, g, squares, least_share(len(H)))
    if gain.rank:
        step, variance = D @ gain.beta, float(gain.beta @ H @ gain.beta)
        m, spreads = reduced.photographs, list[Spread]()
        for after in (step, further):
            if after is not None and m > 1:  # scores of photographs along the step over their variance
                scores = reduced.scores(step, after)
                spreads.append(Spread(float(scores @ scores) / variance * m / (m - 1), m - 1, among=False))
        least = min(spreads, key=lambda spread: spread.factor, default=NONE)
        yield replace(alternative, gain=gain, spread=least)


def _by_photographs(reduced: Reduced) -> Iterator[Alternative]:
    """Yield the alternatives of cameras, strain and bending in some of the photographs.

    If there are more than MAX_RUNS photographs, neighbours in the sequence are combined. A camera changes in
    some of its photographs, an object in some of all photographs.
    """
    camera = cameras_of_photographs(reduced.adjustment)
    run = runs_of(camera)
    every_run = Part(*reduced.project_by_run(reduced.whiten(reduced.columns.freedoms), run))
    if len(every_run.g) >= 2 * MIN_GROUP and not too_many_cameras(camera):
        yield from _of_each(reduced, every_run, run, reduced.adjustment.levels.family)
    for family in OF_PHOTOGRAPHS:
        for among in photographs_among(family, camera):
            runs = np.unique(run[among])
            part = every_run.of(runs, np.array(family.places))
            for pattern, factors in patterns_of(family, len(runs)):
                if pattern == "group":
                    factors = part.groups()
                if not len(factors):
                    continue
                gains = [part.gain(factor) for factor in factors]
                best = max(range(len(gains)), key=lambda k: gains[k].value)
                gain, spread = gains[best], part.spread(factors[best], gains[best])
                every = np.zeros(len(every_run.g))
                every[runs] = factors[best]
                factor = every[run]
                if pattern == "single":
                    left = _variance_of(reduced, factor > 0, gain)
                    spread = replace(spread, factor=max(spread.factor, left))
                count = 2.0 ** (len(runs) - 1) if pattern == "group" else len(factors)
                search = float(np.log(count))
                yield Alternative(family, pattern, factor, gain, spread, search, among=among)


def _variance_of(reduced: Reduced, chosen: BoolArray, gain: Gain) -> float:
    """Return the variance that remains in some photographs, (m,), relative to that of all photographs."""
    rows = chosen[reduced.image]
    v = reduced.v[rows]
    expected = 2 * float(reduced.share[rows].sum()) * reduced.redundancy / reduced.count
    return float(max((v**2).sum() - gain.value, 0.0) / max(expected - gain.rank, 1.0))


def _of_each(reduced: Reduced, part: Part, run: IntArray, level: float) -> Iterator[Alternative]:
    """Yield the alternatives of a per-photograph camera.

    Such a camera must exceed, by an F test, the effect of all other freedoms of the photographs once it is
    included. Errors common to the image points of a photograph need not come from the camera.
    """
    m, f = part.g.shape
    for family in OF_EACH:
        places = np.array(family.places)
        rest = np.setdiff1d(np.arange(f), places)
        q, p = m * len(places), m * len(rest)
        H = part.H[:, places][:, :, :, places].reshape(q, q)
        squares = part.squares[:, places].ravel()
        gain = gain_of(H, part.g[:, places].ravel(), squares)
        if not log_probability(gain.value, gain.rank, reduced.redundancy) < np.log(level):
            continue
        cross = part.H[:, rest][:, :, :, places].reshape(p, q)
        others = gain_of(
            part.H[:, rest][:, :, :, rest].reshape(p, p) - cross @ determined_inverse(H, squares) @ cross.T,
            part.g[:, rest].ravel() + cross @ gain.beta,
            part.squares[:, rest].ravel(),
        )
        spread = Spread(others.value / others.rank, others.rank, among=False) if others.rank else NONE
        yield Alternative(family, "each", run.astype(float), gain, spread)


def cameras_of_photographs(a: Adjustment) -> IntArray:
    """Return the camera number of each photograph, (m,); cameras that share parameters count as one."""
    names = [camera.shared_name for camera in a.estimate.cameras]
    _, number = np.unique([names[k] for k in a.network.camera], return_inverse=True)
    return np.asarray(number)


def photographs_among(family: CameraFamily | ObjectFamily, camera: IntArray) -> list[BoolArray]:
    """Return the sets of photographs within which some may differ: those of each camera, or all, (m,) each.

    More than MAX_RUNS cameras, see `cameras_of_photographs`, are too many to test.
    """
    if not family.of_camera:
        return [np.ones(len(camera), dtype=bool)]
    return [] if too_many_cameras(camera) else [camera == k for k in range(int(camera.max()) + 1)]


def patterns_of(family: CameraFamily | ObjectFamily, m: int) -> Iterator[tuple[str, FloatArray]]:
    """Yield the patterns of m photographs: name, and factors of the photographs, (p, m).

    If only one photograph shows another shape of the object, the fault lies with the photograph.
    """
    if m > MIN_GROUP and family.of_camera:
        yield "single", np.eye(m)
    if m >= 2 * MIN_GROUP:
        yield "split", (np.arange(m) >= np.arange(MIN_GROUP, m - MIN_GROUP + 1)[:, None]).astype(float)
        yield "linear", np.linspace(-1, 1, m)[None]
        yield "alternating", (np.arange(m) % 2)[None].astype(float)
    if m > 2 * MIN_GROUP and family.of_camera:
        yield "group", np.zeros((0, m))  # grown, see `Part.groups`


@dataclass(frozen=True)
class Part:
    """Normal equations of a family in each photograph."""

    H: FloatArray  # (m, f, m, f)
    g: FloatArray  # (m, f)
    squares: FloatArray  # (m, f)

    def of(self, runs: IntArray, places: IntArray) -> Part:
        """Return the normal equations of some freedoms in some of the photographs."""
        H = self.H[np.ix_(runs, places, runs, places)]
        return Part(H, self.g[np.ix_(runs, places)], self.squares[np.ix_(runs, places)])

    def gain(self, factor: FloatArray) -> Gain:
        """Return the gain if the photographs have the family with these factors, (m,)."""
        return gain_of(
            np.tensordot(np.tensordot(factor, self.H, (0, 0)), factor, (1, 0)),
            factor @ self.g,
            factor**2 @ self.squares,
            least_share(self.g.shape[1]),
        )

    def groups(self) -> FloatArray:
        """Return groups of photographs in no order, grown by two-means, as factors 0 and 1, (p, m)."""
        m = len(self.g)
        single, _, _ = gains_of(np.einsum("iaib->iab", self.H), self.g, self.squares)
        groups = []
        for first in np.argsort(-single)[:STARTS]:
            factor = (np.arange(m) == first).astype(float)
            for _ in range(ROUNDS):
                beta = self.gain(factor).beta
                # v'Pv as a function of the factors s, with beta held: s'Qs + 2 l's, minimised one by one
                Q, linear, again = np.tensordot(beta, self.H, (0, 1)) @ beta, self.g @ beta, factor.copy()
                for i in range(m):
                    others = Q[i] @ again - Q[i, i] * again[i]
                    again[i] = float(Q[i, i] + 2 * (linear[i] + others) < 0)
                if (again == factor).all() or not again.any():
                    break
                factor = again
            if MIN_GROUP <= factor.sum() <= m - MIN_GROUP:
                groups.append(factor)
        return np.array(groups).reshape(-1, m)

    def spread(self, factor: FloatArray, gain: Gain) -> Spread:
        """Return the spread of the photographs in the family beyond what a pattern explains by its gain."""
        m = len(self.g)
        left = self.g + np.tensordot(self.H, factor, (2, 0)) @ gain.beta
        others = np.ones(m, dtype=bool) if np.count_nonzero(factor) > 1 else factor == 0
        blocks = np.einsum("iaib->iab", self.H)[others]
        values, ranks, _ = gains_of(blocks, left[others], self.squares[others])
        redundancy = int(ranks.sum()) - gain.rank
        return NONE if redundancy < 1 else Spread(float(values.sum()) / redundancy, redundancy)


def runs_of(camera: IntArray) -> IntArray:
    """Return the run of each photograph, (m,): a run has successive photographs of one camera.

    With too many cameras to test, a run includes photographs of several cameras.
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


def moved_points(reduced: Reduced) -> Iterator[Alternative]:
    """Yield the best sets of points that moved, each by a vector or all as a body, at some photograph."""
    m = reduced.photographs
    splits = np.arange(MIN_GROUP, m - MIN_GROUP + 1)
    products = 6 * len(reduced.L) * len(reduced.t) ** 2  # products of one split
    affordable = max(1, min(MAX_SPLITS, int(MAX_PRODUCTS / products)))
    splits = splits[:: max(-(-len(splits) // affordable), 1)]
    best: dict[str, Alternative] = {}
    for k in splits:
        moves = _moves(reduced, (np.arange(m) >= k).astype(float))
        for moved in (*_each_by_itself(reduced, moves), *_as_one_body(reduced, moves)):
            tested = replace(moved, search=moved.search + float(np.log(len(splits)))).priced(reduced)
            if moved.family.name not in best or tested.evidence > best[moved.family.name].evidence:
                best[moved.family.name] = tested
    yield from best.values()


@dataclass(frozen=True)
class _Moves:
    """Normal equations of the n points that can have moved between two sets of photographs."""

    factor: FloatArray  # 1 in the photographs afterwards, (m,)
    points: IntArray  # their indices, (n,)
    alone: FloatArray  # normal equations of their motions, the point itself eliminated, (n, 3, 3)
    K: FloatArray  # their coupling with photographs and cameras, (n, 3, a)
    g: FloatArray  # right-hand sides, (n, 3)
    squares: FloatArray  # normal equations before the elimination, (n, 3, 3)
    blocks: FloatArray  # those of each point alone, with all unknowns eliminated, (n, 3, 3)

    @property
    def squares_of_columns(self) -> FloatArray:
        """Squares of the columns of each motion, (n, 3)."""
        return np.diagonal(self.squares, axis1=1, axis2=2)

    @cached_property
    def single(self) -> FloatArray:
        """Gain of the motion of each point alone, (n,)."""
        return gains_of(self.blocks, self.g, self.squares_of_columns)[0]

    def log_sets(self, count: int) -> float:
        """Return ln of the number of sets of so many points."""
        return float(
            gammaln(len(self.points) + 1) - gammaln(count + 1) - gammaln(len(self.points) - count + 1)
        )


def _moves(reduced: Reduced, factor: FloatArray) -> _Moves:
    """Return the normal equations of motions before the photographs with factor 1."""
    n, on = len(reduced.L), factor[reduced.image] > 0
    before, after = (np.bincount(reduced.point[rows], minlength=n) for rows in (~on, on))
    points = np.flatnonzero((before >= MIN_GROUP) & (after >= MIN_GROUP))
    # the columns of a motion are those of the point in the photographs afterwards
    V, g, K = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3, len(reduced.t)))
    B, A, v, image, point = reduced.B[on], reduced.A[on], reduced.v[on], reduced.image[on], reduced.point[on]
    add_to_points(B, A, v, image, point, reduced.photographs, V, g, K)
    V, g, K = V[points], g[points], K[points]
    Ct = np.swapaxes(reduced.L[points] @ V, 1, 2)
    K -= Ct @ reduced.W[points]
    g = g - np.einsum("nab,nb->na", Ct, reduced.y[points]) - K @ (reduced.Sinv @ reduced.t)
    alone = V - Ct @ np.swapaxes(Ct, 1, 2)
    return _Moves(factor, points, alone, K, g, V, alone - K @ reduced.Sinv @ np.swapaxes(K, 1, 2))


def _each_by_itself(reduced: Reduced, moves: _Moves) -> Iterator[Alternative]:
    """Yield the best set of points that moved by different vectors, in the order of their single gains."""
    squares, order = moves.squares_of_columns, np.argsort(-moves.single)
    tried = order[: min(MAX_MOVED, max(len(order) // 2, 1))]
    flat = moves.K[tried].reshape(-1, len(reduced.t))
    H = -flat @ reduced.Sinv @ flat.T
    for place, j in enumerate(tried):
        block = slice(3 * place, 3 * place + 3)
        H[block, block] += moves.alone[j]
    best: Alternative | None = None
    for count in range(1, len(tried) + 1):
        part, others = slice(0, 3 * count), moves.single[order[count:]]
        gain = gain_of(H[part, part], moves.g[tried].ravel()[part], squares[tried].ravel()[part])
        spread = Spread(float(others.mean()) / 3, 3 * len(others)) if len(others) else NONE
        search, points = moves.log_sets(count), moves.points[tried[:count]]
        moved = Alternative(MOVED, "split", moves.factor, gain, spread, search, points).priced(reduced)
        if best is None or moved.evidence > best.evidence:
            best = moved
        elif count > 2 * len(best.points) + 4:
            break
    if best is not None:
        yield best


def _as_one_body(reduced: Reduced, moves: _Moves) -> Iterator[Alternative]:
    """Yield sets of points that moved as a body: those that fit the motion of a point better than none.

    The motion is then that of the set, in turn with the set, until it stays the same.
    """
    first = np.argsort(-moves.single)[:STARTS]
    rounding = 3 * np.finfo(float).eps
    inverse = np.linalg.pinv(moves.blocks[first], rcond=rounding, hermitian=True)
    d = -(inverse @ moves.g[first][:, :, None])[:, :, 0]
    loss = np.einsum("si,nij,sj->sn", d, moves.blocks, d, optimize=True)
    starts = [_smaller(moved) for moved in loss + 2 * d @ moves.g.T < 0]
    bodies, earlier = _bodies_from(reduced, moves, starts), set[bytes]()
    for members in starts:
        own: list[bytes] = []
        key = members.tobytes()
        while len(own) < ROUNDS and key in bodies and key not in earlier and key not in own[-1:]:
            own.append(key)
            key = bodies[key].fitting.tobytes()
        earlier |= set(own)
        if not own or (len(own) < ROUNDS and key != own[-1]):
            continue  # it is none, or what follows is that of an earlier start
        body = bodies[own[-1]]
        values, ranks, _ = gains_of(moves.blocks, body.left, moves.squares_of_columns)
        redundancy = int(ranks.sum()) - body.gain.rank
        spread = Spread(float(values.sum()) / redundancy, redundancy)
        points = moves.points[body.members]
        search = moves.log_sets(len(points))
        yield Alternative(BODY, "split", moves.factor, body.gain, spread, search, points)


class _Body(NamedTuple):
    """A set of points that moved by the motion of a body that fits them best."""

    members: BoolArray  # (n,)
    gain: Gain
    left: FloatArray  # right-hand sides of all points with this motion, (n, 3)
    fitting: BoolArray  # the points that this motion fits better than none, (n,)


def _smaller(moved: BoolArray) -> BoolArray:
    """Return a set of points, or the others: if most moved, they moved in the opposite direction."""
    return ~moved if 2 * moved.sum() > len(moved) else moved


def _bodies_from(reduced: Reduced, moves: _Moves, starts: list[BoolArray]) -> dict[bytes, _Body]:
    """Return the bodies of some sets of points and of all sets that follow from them, each in turn."""
    bodies: dict[bytes, _Body] = {}
    reached = starts
    for _ in range(ROUNDS):
        sets = {members.tobytes(): members for members in reached if members.sum() >= MIN_OF_BODY}
        new = [key for key in sets if key not in bodies]
        if not new:
            break
        evaluated = _bodies_of(reduced, moves, np.array([sets[key] for key in new]))
        bodies |= zip(new, evaluated, strict=True)
        reached = [body.fitting for body in evaluated]
    return bodies


def _bodies_of(reduced: Reduced, moves: _Moves, sets: BoolArray) -> list[_Body]:
    """Return the body of each set of points, (s, n); one product serves all of them."""
    X, K = reduced.adjustment.estimate.points[moves.points], moves.K.reshape(-1, len(reduced.t))
    (s, n), some = sets.shape, np.flatnonzero(sets.any(axis=0))
    motions, alone = rigid_motions(X, sets), moves.alone[some]
    M = np.moveaxis(np.where(sets[:, some, None, None], motions[:, some], 0.0), 0, 2)
    flat, M = M.reshape(-1, 6 * s), M.reshape(len(some), 3, 6 * s)
    by_cameras = flat.T @ moves.K[some].reshape(len(flat), -1)
    with_cameras = by_cameras @ reduced.Sinv
    H = flat.T @ (alone @ M).reshape(len(flat), 6 * s) - with_cameras @ by_cameras.T
    H = np.einsum("iaib->iab", H.reshape(s, 6, s, 6))
    g = (flat.T @ moves.g[some].ravel()).reshape(s, 6)
    squares = (M * (moves.squares[some] @ M)).sum(axis=(0, 1)).reshape(s, 6)
    values, ranks, beta = gains_of(H, g, squares)
    move = np.moveaxis((motions.reshape(s, 3 * n, 6) @ beta[:, :, None]).reshape(s, n, 3), 0, 2)
    through = np.matmul(beta[:, None], with_cameras.reshape(s, 6, -1))[:, 0].T
    left = moves.g[:, :, None] - (K @ through).reshape(n, 3, s)
    left[some] += alone @ np.where(sets.T[some, None], move[some], 0.0)
    # of v'Pv, by a point that changes
    loss = (move * (moves.blocks @ move)).sum(axis=1)
    along = 2 * (left * move).sum(axis=1)
    moved = np.where(sets.T, loss > along, loss + along < 0).T
    return [
        _Body(members, Gain(float(values[b]), int(ranks[b]), beta[b]), left[:, :, b], _smaller(moved[b]))
        for b, members in enumerate(sets)
    ]
