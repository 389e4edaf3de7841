"""Given values against the free network: bars, control and projection centres, judged before they are used.

An adjustment shares a contradiction among all observations, and weak photographs bend until nothing shows.
The free network has the shape that the image points give by themselves, with its covariance. Given values
differ from it by v with covariance network + stated, but for the parameters A that only they determine: a
scale (bars), a similarity (points). In what A leaves of v every error of a given value is tested, and the
errors compared: some values are wrong, two names are exchanged, the standard deviations are too small.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6 (tests, external
reliability); Schwarz (1978), Ann. Stat. 6(2) (the cost of a parameter); Patterson and Thompson (1971),
Biometrika 58(3) (standard deviations from what A leaves).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from math import comb

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray, rotation_from_vector
from sfm.distributions import f_sf
from sfm.errors import GeometryError
from sfm.similarity import Similarity, fit_similarity, similarity_motions

LEVEL = 0.001  # probability with which a test of a survey rejects right given values; Baarda (1968)
MARGIN = 2 * np.log(1 / LEVEL)  # by which an explanation must beat others to be told apart from them
NONCENTRALITY = 4.13  # of an error that a test at LEVEL finds with 80 %; Baarda (1968)
RANK = 1e-9  # eigenvalue over the largest below which a direction does not exist
MAX_SETS = 2000  # sets of wrong values that are tried; with more, those that differ in one value
MAX_TRIPLES = 300  # similarities by three points that are tried for the start
MAX_WRONG = 10  # values that are sought among others; where more do not fit, it is no few wrong ones
MAX_EXCHANGED = 40  # points of which pairs may have exchanged names, those that fit worst
RELINEARISED = 3
MAX_FACTOR = 30.0  # on stated standard deviations: one that is larger is a mistake, not a misjudgement
FACTORS = np.geomspace(1.0, 1e6, 241)  # on standard deviations


@dataclass(frozen=True)
class GivenModel:
    """Differences between given values and the free network, and what they are known by."""

    v: FloatArray  # given minus predicted by the free network, (m,)
    network: FloatArray  # their covariance from the free network, (m, m)
    stated: FloatArray  # their covariance as stated, (m, m)
    A: FloatArray  # derivatives by what only the given values determine, (m, u)
    item: IntArray  # which given value each row is of, (m,)
    redundancy: int  # of the free network: how well its variance factor is known
    estimated: bool = False  # whether the standard deviations are unknown and come from the differences

    @cached_property
    def items(self) -> int:
        """How many values were given."""
        return int(self.item.max(initial=-1)) + 1

    @cached_property
    def _left(self) -> FloatArray:
        """Orthonormal base of what the parameters leave, (m, m - u)."""
        U, d, _ = np.linalg.svd(self.A)
        return U[:, int((d > RANK * d.max(initial=0.0)).sum()) :]

    @cached_property
    def precision(self) -> FloatArray:
        """Inverse covariance of what the parameters leave, back in the differences, (m, m)."""
        N = self._left
        if not N.shape[1]:
            return np.zeros((len(self.v), len(self.v)))
        S = N.T @ (self.network + self.stated) @ N
        return np.asarray(N @ np.linalg.inv((S + S.T) / 2) @ N.T)

    @cached_property
    def share(self) -> float:
        """Share of the network in the variance of the differences."""
        dof = self._left.shape[1]
        return float(np.einsum("ij,ij->", self.precision, self.network) / dof) if dof else 0.0

    @cached_property
    def _left_by(self) -> FloatArray:
        return np.asarray(self.precision @ self.v)

    def rows(self, some: tuple[int, ...]) -> IntArray:
        """Return the rows of some given values."""
        return np.flatnonzero(np.isin(self.item, some))

    def misfit(self, without: tuple[int, ...] = ()) -> tuple[float, int]:
        """Return chi-square of the differences and its degrees of freedom, some values left out."""
        T, dof = float(self.v @ self._left_by), self._left.shape[1]
        if without:
            fewer, rank = self.decrease(without)
            T, dof = T - fewer, dof - rank
        return max(T, 0.0), dof

    def decrease(self, some: tuple[int, ...]) -> tuple[float, int]:
        """Return by how much chi-square falls without some values, and the degrees of freedom these had."""
        rows = self.rows(some)
        return _form(self.precision[np.ix_(rows, rows)], self._left_by[rows])

    def probability(self, without: tuple[int, ...] = ()) -> float:
        """Return the probability of differences so large by chance: of all, of one value, of one coordinate.

        The three tests share the level, as the single values and coordinates do.
        """
        T, dof = self.misfit(without)
        if dof <= 0:
            return 1.0
        together = 1.0 if self.estimated else self._sf(T, dof)
        rows = np.flatnonzero(~np.isin(self.item, without))
        M, u = self.precision, self._left_by
        if without:
            out = self.rows(without)
            gain = M[np.ix_(rows, out)] @ np.linalg.pinv(M[np.ix_(out, out)], rcond=RANK, hermitian=True)
            M, u = M[np.ix_(rows, rows)] - gain @ M[np.ix_(out, rows)], u[rows] - gain @ u[out]
        single, tested = 1.0, 0
        for one in np.unique(self.item[rows]):
            own = np.flatnonzero(self.item[rows] == one)
            fewer, rank = _form(M[np.ix_(own, own)], u[own])
            if rank:
                tested += 1
                single = min(single, self._sf_of_one(fewer, rank, T, dof))
        if self.estimated:
            return min(1.0, tested * single)
        of_one = np.diagonal(M)
        checked = of_one > RANK**0.5 * max(float(of_one.max(initial=0.0)), np.finfo(float).tiny)
        largest = float((u[checked] ** 2 / of_one[checked]).max(initial=0.0))
        return min(1.0, 3 * together, 3 * tested * single, 3 * int(checked.sum()) * self._sf(largest, 1))

    def _sf(self, T: float, dof: int) -> float:
        """Probability of a larger chi-square, its network part by a variance factor that is estimated.

        Source: Satterthwaite (1946), Biometrics 2(6).
        """
        freedom = self.redundancy / max(self.share, 1e-3) ** 2
        return float(f_sf(T / dof, dof, freedom))

    def _sf_of_one(self, fewer: float, rank: int, T: float, dof: int) -> float:
        if not self.estimated:
            return self._sf(fewer, rank)
        if dof - rank < 1:
            return 1.0
        rest = max(T - fewer, np.finfo(float).tiny) / (dof - rank)
        return float(f_sf(fewer / rank / rest, rank, dof - rank))

    def external(self, some: tuple[int, ...] = ()) -> FloatArray:
        """Return the external reliability of each given value, infinite where nothing checks it, (items,).

        It is the largest shift that a just detectable error of the value causes in what only the given values
        determine, in standard deviations of that.

        Args:
            some: values that are left out.
        """
        out = np.full(self.items, np.nan)
        kept = ~np.isin(self.item, some)
        part = replace(
            self,
            v=self.v[kept],
            network=self.network[np.ix_(kept, kept)],
            stated=self.stated[np.ix_(kept, kept)],
            A=self.A[kept],
            item=self.item[kept],
        )
        S, N = part.network + part.stated, part._left
        M, P = part.precision, np.linalg.pinv(S, rcond=RANK, hermitian=True)
        if self.estimated or not self.stated.any():  # only the geometry is known
            M, P = N @ N.T, np.eye(len(S))
        for one in np.unique(part.item):
            rows = part.rows((int(one),))
            own, W = M[np.ix_(rows, rows)], P[np.ix_(rows, rows)]
            L = np.linalg.cholesky(W + RANK * np.trace(W) * np.eye(len(rows)))
            checked = np.linalg.eigvalsh(np.linalg.solve(L, np.linalg.solve(L, own).T)).min()
            r = float(np.clip(checked, 0.0, 1.0))
            out[one] = NONCENTRALITY * np.sqrt((1 - r) / r) if r > RANK**0.5 else np.inf
        return out

    def factor(self) -> tuple[float, float]:
        """Return the factor on the stated standard deviations that fits best, and what it gains.

        The gain is in -2 ln likelihood of what the parameters leave; of values without standard deviations
        the factor is their standard deviation itself.
        """
        N = self._left
        S0, C0 = N.T @ self.network @ N, N.T @ self.stated @ N
        fixed = not self.stated.any()
        if fixed:
            C0 = np.eye(len(C0))
        try:
            L = np.linalg.cholesky((C0 + C0.T) / 2)
        except np.linalg.LinAlgError:  # some are fixed, some are not
            return 1.0, 0.0
        half = np.linalg.solve(L, np.linalg.solve(L, S0).T)
        d, U = np.linalg.eigh((half + half.T) / 2)
        z2, d = (U.T @ np.linalg.solve(L, N.T @ self.v)) ** 2, np.maximum(d, 0.0)
        start = d + (0.0 if fixed else 1.0)
        start = np.maximum(start, RANK * start.max())
        tried = FACTORS
        if fixed:
            tried = np.sqrt(max(float(z2.mean()), float(start.min()))) * np.geomspace(1e-3, 10.0, 241)
        cost = [float((np.log((d + f * f) / start) + z2 / (d + f * f) - z2 / start).sum()) for f in tried]
        best = int(np.argmin(cost))
        return float(tried[best]), -cost[best]


def _form(M: FloatArray, u: FloatArray) -> tuple[float, int]:
    """Return u' M^-1 u over the directions that M has, and how many these are."""
    d, U = np.linalg.eigh((M + M.T) / 2)
    on = d > RANK**0.5 * max(float(d.max(initial=0.0)), np.finfo(float).tiny)
    return float(((U.T @ u)[on] ** 2 / d[on]).sum()), int(on.sum())


@dataclass(frozen=True)
class Judgement:
    """What is wrong of given values, if anything is."""

    statistic: float  # chi-square of all differences
    dof: int  # its degrees of freedom
    probability: float  # of differences so large by chance
    wrong: tuple[int, ...] = ()  # given values without which the others fit
    exchanged: tuple[int, int] | None = None  # two of them whose names are exchanged
    factor: float = 1.0  # on all standard deviations, with which all fit; of fixed values their sigma
    doubtful: tuple[int, ...] = ()  # given values of which nothing shows which are wrong

    @property
    def fits(self) -> bool:
        """Whether nothing is wrong."""
        return not (self.wrong or self.exchanged or self.doubtful or self.factor != 1.0)


@dataclass(frozen=True)
class GivenTest:
    """Test of one kind of given values against the free network."""

    what: str  # scale, control points or projection centres
    statistic: float  # chi-square
    dof: int
    probability: float  # of differences so large by chance


def judge_values(model: GivenModel, level: float, exchange: FloatArray | None = None) -> Judgement:
    """Return what is wrong of given values.

    Args:
        model: their differences from the free network.
        level: probability with which right values are said to be wrong.
        exchange: given coordinates by rows, for the hypothesis of exchanged names, (m,); None without.
    """
    T, dof = model.misfit()
    p = model.probability()
    found = Judgement(T, dof, p)
    if dof < 1 or p >= level:
        return found
    cost = np.log(max(len(model.v), 2))
    removed = _wrong_values(model, level, cost)
    swapped = None if exchange is None else _exchanged(model, exchange, level)
    factor, gain = model.factor()
    # one wrong value of so few would look like standard deviations that are too small
    told_apart = all(model.misfit((one,))[1] > 0 for one in range(model.items))
    if model.estimated or not told_apart or (model.stated.any() and factor > MAX_FACTOR):
        gain = 0.0
    scores = {
        "wrong": np.inf if removed is None else removed[1],
        "exchanged": np.inf if swapped is None else swapped[1],
        "factor": np.inf if gain <= 0 else cost - gain,
    }
    best = min(scores, key=lambda one: scores[one])
    if scores[best] >= 0 or not np.isfinite(scores[best]):
        return replace(found, doubtful=_suspects(model, level))
    if best == "exchanged" and swapped is not None:
        return replace(found, exchanged=swapped[0])
    if best == "factor":
        return replace(found, factor=factor)
    assert removed is not None
    wrong, _, rivals = removed
    if rivals:
        return replace(found, doubtful=tuple(sorted({*wrong, *rivals})))
    return replace(found, wrong=wrong)


def _wrong_values(
    model: GivenModel, level: float, cost: float
) -> tuple[tuple[int, ...], float, tuple[int, ...]] | None:
    """Return the fewest values without which the others fit, their score, and others that do as well.

    The others must be more, and must confirm one another.
    """
    T = model.misfit()[0]
    out: tuple[int, ...] = ()
    while 2 * (len(out) + 1) < model.items and len(out) < MAX_WRONG:
        tried = [(*out, one) for one in range(model.items) if one not in out]
        fall = [model.decrease(some) for some in tried]
        out = tried[int(np.argmax([fewer - cost * rank for fewer, rank in fall]))]
        if model.misfit(out)[1] < 1:
            return None
        if model.probability(out) >= level:
            break
    else:
        return None
    out = tuple(sorted(out))
    rivals: list[tuple[float, tuple[int, ...]]] = [
        (model.misfit(some)[0], some) for some in _sets_like(out, model.items) if model.misfit(some)[1] > 0
    ]
    best, out = min([(model.misfit(out)[0], out), *rivals])
    like = {one for misfit, some in rivals if misfit < best + MARGIN for one in some} - set(out)
    rank = model.decrease(out)[1]
    score = best - T + cost * rank + 2 * np.log(comb(model.items, len(out)))
    return out, float(score), tuple(sorted(like))


def _sets_like(out: tuple[int, ...], items: int) -> Iterator[tuple[int, ...]]:
    """Return other sets of as many values: all, or those that differ in one where these are too many."""
    if comb(items, len(out)) <= MAX_SETS:
        yield from (some for some in combinations(range(items), len(out)) if some != out)
        return
    for one in out:
        for other in range(items):
            if other not in out:
                yield tuple(sorted({*out, other} - {one}))


def _suspects(model: GivenModel, level: float) -> tuple[int, ...]:
    """Return the values any of which may be wrong: those without which the others fit, else all."""
    alone = [
        one
        for one in range(model.items)
        if model.misfit((one,))[1] > 0 and model.probability((one,)) >= level
    ]
    return tuple(alone) if len(alone) > 1 else tuple(range(model.items))


def _exchanged(model: GivenModel, given: FloatArray, level: float) -> tuple[tuple[int, int], float] | None:
    """Return the two values with whose names exchanged all fit, and their score; None without such."""
    fall = [model.decrease((one,))[0] for one in range(model.items)]
    suspects = [one for one in np.argsort(fall)[::-1].tolist() if (model.item == one).sum() == 3]
    T = model.misfit()[0]
    found: list[tuple[float, tuple[int, int]]] = []
    for i, j in combinations(sorted(suspects[:MAX_EXCHANGED]), 2):
        rows, others = model.rows((i,)), model.rows((j,))
        v = model.v.copy()
        v[rows] += given[others] - given[rows]
        v[others] += given[rows] - given[others]
        found.append((float(v @ model.precision @ v), (i, j)))
    found.sort()
    if not found or (len(found) > 1 and found[1][0] < found[0][0] + MARGIN):
        return None
    misfit, pair = found[0]
    rows, others = model.rows((pair[0],)), model.rows((pair[1],))
    v = model.v.copy()
    v[rows] += given[others] - given[rows]
    v[others] += given[rows] - given[others]
    if replace(model, v=v).probability() < level:
        return None
    return pair, float(misfit - T + 2 * np.log(len(found)))


@dataclass(frozen=True)
class GivenPoints:
    """Points with given coordinates, and the same points of the free network."""

    given: FloatArray  # NaN where not known, (n, 3)
    stated: FloatArray  # covariance of the known ones, 0 where fixed, (n, 3, 3)
    free: FloatArray  # in the frame of the free network, (n, 3)
    joint: FloatArray  # covariance of the free ones, (3 n, 3 n)
    redundancy: int  # of the free network

    @property
    def known(self) -> FloatArray:
        """Which coordinates are known, (n, 3)."""
        return np.isfinite(self.given)

    @property
    def complete(self) -> IntArray:
        """Points of which all three coordinates are known."""
        return np.flatnonzero(self.known.all(axis=1))

    def select(self, some: IntArray) -> GivenPoints:
        """Return some of the points."""
        rows = (3 * np.asarray(some)[:, None] + np.arange(3)).ravel()
        return replace(
            self,
            given=self.given[some],
            stated=self.stated[some],
            free=self.free[some],
            joint=self.joint[np.ix_(rows, rows)],
        )

    def mirrored(self) -> GivenPoints:
        """Return them with the free network mirrored."""
        flip = np.tile([-1.0, 1.0, 1.0], len(self.free))
        return replace(
            self, free=self.free * (-1.0, 1.0, 1.0), joint=self.joint * flip[:, None] * flip[None, :]
        )

    def model(self, placing: Similarity, *, estimated: bool) -> GivenModel:
        """Return the differences from the free network as a similarity places it."""
        rows = np.flatnonzero(self.known.ravel())
        X = placing.apply(self.free)
        centre, size = _centre_and_size(X)
        A = similarity_motions(X, centre=centre, size=size).reshape(-1, 7)[rows]
        n = len(X)
        turned = np.einsum(
            "ab,ibjc,dc->iajd", placing.rotation, self.joint.reshape(n, 3, n, 3), placing.rotation
        )
        network = placing.scale**2 * turned.reshape(3 * n, 3 * n)[np.ix_(rows, rows)]
        stated = np.zeros((3 * n, 3 * n))
        for k in range(n):
            stated[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = self.stated[k]
        return GivenModel(
            (self.given - X).ravel()[rows],
            network,
            stated[np.ix_(rows, rows)],
            A,
            rows // 3,
            self.redundancy,
            estimated,
        )

    def moved(self, placing: Similarity, model: GivenModel, without: tuple[int, ...]) -> Similarity:
        """Return the similarity that fits the given values best, some left out, by generalised least squares.

        Source: Mikhail (1976), Observations and Least Squares, ch. 8.
        """
        kept = ~np.isin(model.item, without)
        dx = parameters_of(model, kept) @ model.v[kept]
        X = placing.apply(self.free)
        centre, size = _centre_and_size(X)
        R, scale = rotation_from_vector(dx[3:6] / size), float(np.exp(dx[6] / size))
        rotation = R @ placing.rotation
        shift = centre + dx[:3] + scale * R @ (placing.translation - centre)
        return Similarity(scale * placing.scale, rotation, shift)


def _centre_and_size(X: FloatArray) -> tuple[FloatArray, float]:
    """Return the centre of points and their farthest coordinate from it."""
    centre = X.mean(axis=0)
    return centre, max(float(np.abs(X - centre).max()), np.finfo(float).tiny)


def parameters_of(model: GivenModel, kept: BoolArray) -> FloatArray:
    """Return the parameters as a linear function of the kept differences, (u, m)."""
    S = (model.network + model.stated)[np.ix_(kept, kept)]
    A = model.A[kept]
    unit = max(float(np.trace(S)), np.finfo(float).tiny)
    if not (model.network.any() or model.stated.any()) or model.estimated:
        return np.asarray(np.linalg.pinv(A, rcond=RANK))
    # covariance along the parameters does not change them, and makes that of a free network regular
    P = np.linalg.inv(S + unit * A @ A.T + RANK**1.5 * unit * np.eye(len(S)))
    return np.asarray(np.linalg.pinv(A.T @ P @ A, rcond=RANK, hermitian=True) @ A.T @ P)


@dataclass(frozen=True)
class PlacedPoints:
    """Given points judged, and how they place the free network."""

    judgement: Judgement
    placing: Similarity  # given frame from that of the free network
    model: GivenModel  # at it
    unmirrored: float | None = None  # chi-square as given, where only the mirrored network fits

    @property
    def mirrored(self) -> bool:
        """Whether they fit the mirrored network and not the network."""
        return self.unmirrored is not None


def judge_points(
    points: GivenPoints, level: float, *, start: Similarity | None = None, estimated: bool = False
) -> PlacedPoints | None:
    """Return what is wrong of given points, and how the others place the free network.

    Args:
        points: given, and of the free network.
        level: probability with which right points are said to be wrong.
        start: approximate similarity, used with fewer than three complete points.
        estimated: whether their standard deviations are unknown.

    Returns:
        None where they do not place the network.
    """
    found = _placed(points, level, start, estimated)
    if found is None or found.judgement.fits or found.judgement.wrong or found.judgement.exchanged:
        return found
    other = _placed(points.mirrored(), level, None, estimated)
    if other is not None and (other.judgement.fits or other.judgement.wrong):
        out, as_given = other.judgement.wrong, found.judgement.statistic
        better = other.model.misfit(out)[0] + MARGIN < found.model.misfit(out)[0]
        if better and found.model.probability(out) < level:
            return replace(other, unmirrored=as_given)
    return found


def _placed(
    points: GivenPoints, level: float, start: Similarity | None, estimated: bool
) -> PlacedPoints | None:
    """Judge points at the similarity that most of them agree upon."""
    placing = _start(points, start)
    if placing is None:
        return None
    given = points.given.ravel()[np.flatnonzero(points.known.ravel())]
    judgement = None
    for _ in range(RELINEARISED):
        model = points.model(placing, estimated=estimated)
        judgement = judge_values(model, level, given)
        out = judgement.wrong or judgement.exchanged or ()
        placing = points.moved(placing, model, out)
        if not np.isfinite(placing.translation).all():
            return None
    assert judgement is not None
    model = points.model(placing, estimated=estimated)
    return PlacedPoints(judge_values(model, level, given), placing, model)


def _start(points: GivenPoints, start: Similarity | None) -> Similarity | None:
    """Return the similarity by three points of the smallest median distance, else by all, else as given.

    Source: Rousseeuw (1984), J. Am. Stat. Assoc. 79(388), least median of squares.
    """
    at = points.complete
    if len(at) < 3:
        return start
    X, given = points.free[at], points.given[at]
    try:
        best = fit_similarity(X, given)
    except GeometryError:
        return start
    if len(at) == 3:
        return best
    least = float(np.median(np.linalg.norm(best.apply(X) - given, axis=1)))
    every = comb(len(at), 3) <= MAX_TRIPLES
    rng = np.random.default_rng(len(at))
    triples = (
        combinations(range(len(at)), 3)
        if every
        else (rng.choice(len(at), 3, replace=False) for _ in range(MAX_TRIPLES))
    )
    for some in triples:
        own = list(some)
        try:
            one = fit_similarity(X[own], given[own])
        except GeometryError:
            continue
        median = float(np.median(np.linalg.norm(one.apply(X) - given, axis=1)))
        if median < least:
            best, least = one, median
    return best


@dataclass(frozen=True)
class GivenScale:
    """Object units per unit of the free network, by one bar or by all given points together."""

    log: float  # natural logarithm
    rows: FloatArray  # its derivative by the points of the free network, (3 n,)
    variance: float  # of the logarithm, by what was stated


def scale_of_length(length: float, sigma: float, free: FloatArray, start: int, end: int) -> GivenScale:
    """Return the scale by a length between two points of the free network, (n, 3)."""
    apart = free[end] - free[start]
    found = float(np.linalg.norm(apart))
    rows = np.zeros(free.shape)
    rows[end], rows[start] = -apart / found**2, apart / found**2
    return GivenScale(float(np.log(length / found)), rows.ravel(), (sigma / length) ** 2)


def scale_of_points(
    points: GivenPoints, placed: PlacedPoints, without: tuple[int, ...], at: IntArray, count: int
) -> GivenScale:
    """Return the scale by given points, some left out.

    Args:
        points: given, and of the free network.
        placed: the same, judged.
        without: those left out.
        at: which points of the free network they are, (k,).
        count: how many points the free network has, n.
    """
    model, placing = placed.model, placed.placing
    kept = ~np.isin(model.item, without)
    G = parameters_of(model, kept)[6] / _centre_and_size(placing.apply(points.free))[1]
    axis = (np.flatnonzero(points.known.ravel()) % 3)[kept]
    rows = np.zeros((count, 3))
    np.subtract.at(rows, at[model.item[kept]], G[:, None] * placing.scale * placing.rotation[axis])
    return GivenScale(
        float(np.log(placing.scale)), rows.ravel(), float(G @ model.stated[np.ix_(kept, kept)] @ G)
    )


def scale_model(scales: tuple[GivenScale, ...], joint: FloatArray, redundancy: int) -> GivenModel:
    """Return the differences of scales, with the covariance of the points of the free network, (3 n, 3 n)."""
    H = np.stack([one.rows for one in scales])
    return GivenModel(
        np.array([one.log for one in scales]),
        H @ joint @ H.T,
        np.diag([one.variance for one in scales]),
        np.ones((len(scales), 1)),
        np.arange(len(scales)),
        redundancy,
    )
