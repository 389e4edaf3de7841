"""Given values: judges bars, control and projection centres against the free network before they are used.

An adjustment distributes a contradiction over all observations, and weak photographs deform until nothing
shows. The free network has the shape that the image points determine alone, with its covariance. Given values
differ from it by v, with the covariance network + stated. The parameters A, which only given values
determine, are removed from v: a scale for bars, a similarity for points. In the remainder every error of a
given value is tested, and explanations are compared. Either some values are wrong, or all standard deviations
are too small, by at most an order of magnitude. `points` adds explanations by names and handedness.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6 (tests, external
reliability); Schwarz (1978), Ann. Stat. 6(2) (the cost of a parameter); Patterson and Thompson (1971),
Biometrika 58(3) (standard deviations from what A leaves).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from math import comb, log

import numpy as np

from sfm.adjustment.quality.statistics import non_centrality
from sfm.model.conventions import SWELLING, BoolArray, FloatArray, IntArray
from sfm.model.distributions import LEVEL, MARGIN, MIN_LEAD, f_sf

# An order of magnitude: mm stated for cm, or the precision of the instrument alone. Differences that it does
# not explain are errors of the values. The best-fitting factor may be larger by chance.
MAX_FACTOR = 10.0
UNSTATED_FRACTION = SWELLING  # relative standard deviation of coordinates without a stated one
RANK = 1e-9  # ratio of an eigenvalue to the largest below which a direction does not exist
MIN_REDUNDANCY = RANK**0.5  # redundancy number below which nothing checks a direction
MAX_SETS = 2000  # sets of wrong values that are tried; beyond, only sets that differ in one value
FACTORS = np.geomspace(1.0, 1e6, 241)  # tried factors on standard deviations


@dataclass(frozen=True)
class Bias:
    """Additional parameters of the differences, and the test that they are 0."""

    parameters: FloatArray  # (q,)
    statistic: float  # chi-square that they explain
    dof: int
    probability: float  # chance probability of such values, all together or one; both tests share the level


@dataclass(frozen=True)
class Kept:
    """Differences of given values after some values are left out."""

    model: GivenModel
    precision: FloatArray  # inverse covariance after removing parameters and values left out, (m, m)
    u: FloatArray  # precision times v, (m,)
    chi2: float
    dof: int

    def without(self, item: int) -> Kept:
        """Leave out one more value, by updating the partitioned inverse.

        Source: Foerstner and Wrobel (2016), sec. 4.6.2.
        """
        rows = np.flatnonzero(self.model.item == item)
        s = self.model.size[rows]
        d, U = np.linalg.eigh(self.precision[rows[:, None], rows] * s[:, None] * s)
        on = d > MIN_REDUNDANCY
        half = s[:, None] * U[:, on] / np.sqrt(d[on])
        G, w = self.precision[:, rows] @ half, half.T @ self.u[rows]
        M, u = self.precision - G @ G.T, self.u - G @ w
        M[rows], M[:, rows], u[rows] = 0.0, 0.0, 0.0
        return Kept(self.model, M, u, max(self.chi2 - float(w @ w), 0.0), self.dof - int(on.sum()))

    def decreases(self) -> tuple[FloatArray, IntArray]:
        """Return the decrease of chi-square without each further value, and of its dof, (items,) each."""
        at, there = self.model.blocks
        s = np.where(there, self.model.size[at], 0.0)
        d, U = np.linalg.eigh(self.precision[at[:, :, None], at[:, None, :]] * s[:, :, None] * s[:, None, :])
        on = d > MIN_REDUNDANCY
        w2 = np.einsum("kab,ka->kb", U, self.u[at] * s) ** 2
        return np.where(on, w2 / np.where(on, d, 1.0), 0.0).sum(axis=1), on.sum(axis=1)

    def difference(self, item: int) -> tuple[FloatArray, FloatArray]:
        """Return the difference of a value from the prediction by the others, (k,), and its covariance."""
        rows = np.flatnonzero(self.model.item == item)
        covariance = np.linalg.pinv(self.precision[np.ix_(rows, rows)], rcond=RANK, hermitian=True)
        return covariance @ self.u[rows], np.asarray(covariance, dtype=np.float64)

    def bias(self, columns: FloatArray) -> Bias:
        """Return the estimate and score test of parameters in addition to those of the model.

        Args:
            columns: derivatives of the differences by these parameters, none of them all 0, (m, q). Columns
                that cannot be distinguished from the parameters of the model explain nothing.

        Source: Rao (1948), Math. Proc. Camb. Phil. Soc. 44(1) (score test).
        """
        # scaled by the standard deviation of each parameter if the differences were independent and nothing
        # else unknown
        scale = 1 / np.linalg.norm(columns / self.model.size[:, None], axis=0)
        g, H = scale * (columns.T @ self.u), scale[:, None] * (columns.T @ self.precision @ columns) * scale
        d, U = np.linalg.eigh((H + H.T) / 2)
        on, alone = d > MIN_REDUNDANCY, np.diagonal(H) > MIN_REDUNDANCY
        if not on.any():
            return Bias(np.zeros(len(g)), 0.0, 0, 1.0)
        w = U[:, on].T @ g
        fall, rank = float((w**2 / d[on]).sum()), int(on.sum())
        largest = float((g[alone] ** 2 / np.diagonal(H)[alone]).max())
        single = int(alone.sum()) * self._sf(largest, 1)
        probability = min(1.0, 2 * self._sf(fall, rank), 2 * single)
        return Bias(scale * (U[:, on] @ (w / d[on])), fall, rank, probability)

    def probability(self) -> float:
        """Return the probability of such differences by chance: of all, of one value, or of one coordinate.

        The three tests share the level, and so do the single values and coordinates.
        """
        if self.dof <= 0:
            return 1.0
        fall, rank = self.decreases()
        of_rank = list[float]()
        for r in np.unique(rank[rank > 0]).tolist():
            largest, rest = float(fall[rank == r].max()), self.dof - r
            if not self.model.estimated:
                of_rank.append(self._sf(largest, r))
            elif rest:  # the other values scatter at least as much as the network does
                variance = max((self.chi2 - largest) / rest, 1.0)
                of_rank.append(float(f_sf(largest / r / variance, r, rest)))
            else:
                of_rank.append(1.0)
        single = int((rank > 0).sum()) * min(of_rank) if of_rank else np.inf  # no value is checked alone
        if self.model.estimated:
            return min(1.0, single)
        of_one, u = np.diagonal(self.precision) * self.model.size**2, self.u * self.model.size
        on = of_one > MIN_REDUNDANCY
        largest = float((u[on] ** 2 / of_one[on]).max(initial=0.0))
        together = self._sf(self.chi2, self.dof)
        coordinate = int(on.sum()) * self._sf(largest, 1) if on.any() else np.inf
        return min(1.0, 3 * together, 3 * single, 3 * coordinate)

    def may_fit(self, level: float, fall: float, rank: int) -> bool:
        """Return whether the test of all differences together lets them fit after a decrease of chi-square.

        It is a part of `probability` that needs no further inverse. The rank is less than `dof`.
        """
        if self.model.estimated:
            return True
        together = 3 * self._sf(max(self.chi2 - fall, 0.0), self.dof - rank)
        return together >= level * (1 - RANK)  # up to rounding

    def _sf(self, chi2: float, dof: int) -> float:
        """Return the probability of a larger chi-square, whose network part has an estimated variance factor.

        Source: Satterthwaite (1946), Biometrics 2(6).
        """
        freedom = self.model.redundancy / max(self.model.share, 1e-3) ** 2
        return float(f_sf(chi2 / dof, dof, freedom))


@dataclass(frozen=True)
class GivenModel:
    """Differences between given values and the free network, with their covariance."""

    v: FloatArray  # given value minus prediction by the free network, (m,)
    network: FloatArray  # covariance of the prediction, (m, m)
    stated: FloatArray  # stated covariance of the given values, (m, m)
    A: FloatArray  # derivatives by the parameters that only the given values determine, (m, u)
    item: IntArray  # given value of each row, (m,)
    redundancy: int  # redundancy of the variance factor of the free network
    estimated: bool = False  # whether the standard deviations are unknown and follow from the differences
    extent: float = 0.0  # extent of the given values, for standard deviations that are not stated
    confirmed: int = 0  # further values that are right, and count among those who agree

    @cached_property
    def items(self) -> int:
        """Number of given values."""
        return int(self.item.max(initial=-1)) + 1

    @cached_property
    def _left(self) -> FloatArray:
        """Orthonormal basis of the space orthogonal to the parameters, (m, m - u)."""
        U, d, _ = np.linalg.svd(self.A)
        return U[:, int((d > RANK * d.max(initial=0.0)).sum()) :]

    @cached_property
    def precision(self) -> FloatArray:
        """Inverse covariance after removing the parameters, in the space of the differences, (m, m)."""
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
    def size(self) -> FloatArray:
        """Standard deviations of the differences, (m,)."""
        # rounding can make the variance of a point of an exact network negative
        return np.sqrt(np.maximum(np.diagonal(self.network + self.stated), np.finfo(float).tiny))

    @cached_property
    def blocks(self) -> tuple[IntArray, BoolArray]:
        """Rows of each value, and which of these entries exist, (items, most) each."""
        count = np.bincount(self.item, minlength=self.items)
        there = np.arange(count.max(initial=0)) < count[:, None]
        at = np.zeros(there.shape, dtype=np.int64)
        at[there] = np.argsort(self.item, kind="stable")
        return at, there

    @cached_property
    def all_kept(self) -> Kept:
        """The differences of all values."""
        u = self.precision @ self.v
        return Kept(self, self.precision, u, max(float(self.v @ u), 0.0), self._left.shape[1])

    def kept(self, without: tuple[int, ...] = ()) -> Kept:
        """Return the differences without some values."""
        out = self.all_kept
        for item in without:
            out = out.without(item)
        return out

    @cached_property
    def at_worst(self) -> GivenModel:
        """The model with the largest plausible standard deviations."""
        stated = self.stated
        if self.estimated or not stated.any():
            stated = (UNSTATED_FRACTION * self.extent) ** 2 * np.eye(len(self.v))
        return replace(self, stated=MAX_FACTOR**2 * stated, estimated=False)

    def fits(self, level: float, without: tuple[int, ...] = ()) -> bool:
        """Return whether values fit without some; unknown standard deviations must also be plausible."""
        at_worst = self.at_worst.kept(without) if self.estimated else None
        return _fits(self.kept(without), at_worst, level)

    def confirms_rest(self, out: tuple[int, ...]) -> bool:
        """Return whether the values without some confirm one another.

        Each value must be checked, and the degrees of freedom must suffice to check one in all its rows.
        Fewer values would fit in any case.
        """
        return self.kept(out).dof >= self.blocks[1].shape[1] and not np.isinf(self.external(out)).any()

    def part(self, kept: BoolArray) -> GivenModel:
        """Return the model of the differences selected by a mask, (m,)."""
        return replace(
            self,
            v=self.v[kept],
            network=self.network[np.ix_(kept, kept)],
            stated=self.stated[np.ix_(kept, kept)],
            A=self.A[kept],
            item=self.item[kept],
        )

    def beside(self, right: BoolArray) -> GivenModel:
        """Return the model of the other differences, predicted by the network and by the right ones, (m,).

        Source: Foerstner and Wrobel (2016), sec. 4.2.7 (sequential estimation).
        """
        if not right.any():
            return self
        c, t = np.flatnonzero(right), np.flatnonzero(~right)
        S, size = self.network + self.stated, float(np.trace(self.A[c] @ self.A[c].T))
        unit = float(np.trace(S[np.ix_(c, c)])) / len(c)
        # covariance along the parameters changes nothing, and makes the covariance of fixed values regular
        S = S + (unit * len(c) / size if size else 0.0) * self.A @ self.A.T
        W = np.linalg.inv(S[np.ix_(c, c)] + RANK**1.5 * unit * np.eye(len(c)))
        d, U = np.linalg.eigh(self.A[c].T @ W @ self.A[c])
        on = d > RANK * d.max(initial=0.0)  # parameters that the right values determine
        Q, G = U[:, on] / d[on] @ U[:, on].T, S[np.ix_(t, c)] @ W
        B = self.A[t] - G @ self.A[c]
        covariance = S[np.ix_(t, t)] - G @ S[np.ix_(c, t)] + B @ Q @ B.T
        stated = self.stated[np.ix_(t, t)]
        _, item = np.unique(self.item[t], return_inverse=True)
        return replace(
            self,
            v=self.v[t] - G @ self.v[c] - B @ Q @ self.A[c].T @ W @ self.v[c],
            network=(covariance + covariance.T) / 2 - stated,
            stated=stated,
            A=B @ U[:, ~on],
            item=item,
            confirmed=len(np.unique(self.item[c])),
        )

    def external(self, without: tuple[int, ...] = (), *, level: float = LEVEL) -> FloatArray:
        """Return the external reliability of each given value, infinite if nothing checks it, (items,).

        It is the largest shift that a just detectable error of the value causes in the parameters that only
        given values determine, in standard deviations of the parameters.
        """
        out, delta0 = np.full(self.items, np.nan), non_centrality(level)
        part = self.part(~np.isin(self.item, without))
        S, N = part.network + part.stated, part._left
        M, P = part.precision, np.linalg.pinv(S, rcond=RANK, hermitian=True)
        if self.estimated or not self.stated.any():  # only the geometry is known
            M, P = N @ N.T, np.eye(len(S))
        for item in np.unique(part.item):
            rows = np.flatnonzero(part.item == item)
            M_rows, W = M[np.ix_(rows, rows)], P[np.ix_(rows, rows)]
            L = np.linalg.cholesky(W + RANK * np.trace(W) * np.eye(len(rows)))
            checked = np.linalg.eigvalsh(np.linalg.solve(L, np.linalg.solve(L, M_rows).T)).min()
            r = float(np.clip(checked, 0.0, 1.0))
            out[item] = delta0 * np.sqrt((1 - r) / r) if r > MIN_REDUNDANCY else np.inf
        return out

    def factor(self) -> tuple[float, float]:
        """Return the best-fitting factor on the stated standard deviations, and its gain.

        The gain is in -2 ln likelihood of the differences after removing the parameters. For values without
        standard deviations, the factor is the standard deviation itself.
        """
        N = self._left
        S0, C0 = N.T @ self.network @ N, N.T @ self.stated @ N
        fixed = not self.stated.any()
        if fixed:
            C0 = np.eye(len(C0))
        try:
            L = np.linalg.cholesky((C0 + C0.T) / 2)
        except np.linalg.LinAlgError:  # only some are fixed
            return 1.0, 0.0
        half = np.linalg.solve(L, np.linalg.solve(L, S0).T)
        d, U = np.linalg.eigh((half + half.T) / 2)
        z2, d = (U.T @ np.linalg.solve(L, N.T @ self.v)) ** 2, np.maximum(d, 0.0)
        start = d + (0.0 if fixed else 1.0)
        start = np.maximum(start, RANK * start.max())
        tried = FACTORS
        if fixed:
            tried = np.sqrt(max(float(z2.mean()), float(start.min()))) * np.geomspace(1e-3, 10.0, 241)
        variance = d + tried[:, None] ** 2
        cost = (np.log(variance / start) + z2 / variance).sum(axis=1)
        best = int(np.argmin(cost))
        return float(tried[best]), float((z2 / start).sum() - cost[best])


def _fits(kept: Kept, at_worst: Kept | None, level: float) -> bool:
    """Return whether values fit, and, with standard deviations that are unknown, with the largest too."""
    fits = kept.probability() >= level
    return fits and (at_worst is None or at_worst.probability() >= level)


@dataclass(frozen=True)
class Judgement:
    """The errors found in given values, if any."""

    statistic: float  # chi-square of all differences
    dof: int  # its degrees of freedom
    probability: float  # of such differences by chance
    wrong: tuple[int, ...] = ()  # given values without which the others fit
    factor: float = 1.0  # factor on all standard deviations with which all fit; sigma itself of fixed values
    doubtful: tuple[int, ...] = ()  # given values of which an unknown subset is wrong
    one_wrong: bool = False  # whether exactly one of the doubtful values is wrong and all others are right
    score: float = 0.0  # change of -2 ln likelihood by the errors found, plus their cost

    @property
    def fits(self) -> bool:
        """Whether no error was found."""
        return not (self.wrong or self.doubtful or self.factor != 1.0)

    @property
    def explained(self) -> bool:
        """Whether errors of some values, or of all standard deviations, explain the differences."""
        return not self.doubtful or self.score < 0

    def contradicted(self, doubtful: tuple[int, ...]) -> Judgement:
        """Return the judgement that an unknown subset of some values is wrong."""
        return replace(self, wrong=(), factor=1.0, score=0.0, doubtful=doubtful, one_wrong=False)

    @property
    def misfit(self) -> float:
        """Chi-square after accounting for the errors found, plus their cost."""
        return self.statistic + self.score


def judge_values(model: GivenModel, level: float) -> Judgement:
    """Return the errors of given values; `level` is the probability that correct ones are called wrong."""
    every = model.kept()
    judgement = Judgement(every.chi2, every.dof, every.probability())
    if every.dof < 1 or model.fits(level):
        return judgement
    cost = cost_of_parameter(len(model.v))
    removed = _wrong_values(model, level, cost)
    factor, gain = (1.0, 0.0) if model.estimated else model.factor()
    if gain <= 0 or not model.at_worst.fits(level):
        gain = -np.inf
    of_wrong, of_factor = np.inf, cost - gain
    if removed is not None:  # errors of values without standard deviations count as scatter
        kept = model.kept(removed.values)
        of_wrong = _score(model, removed.values, kept, scatter=not model.stated.any())
    if min(of_wrong, of_factor) >= 0:
        suspects = _suspects(model, level)
        return replace(judgement, doubtful=suspects, one_wrong=_one_is_wrong(model, suspects))
    if removed is None or of_factor < of_wrong:
        sets = _sets(model, cost)
        # with few values, one wrong value would look like standard deviations that are too small, unless each
        # single error is too small for its test to find
        unseen = float(np.sqrt(every.decreases()[0].max())) < non_centrality(level)
        if sets and (unseen or of_factor + 2 * MIN_LEAD < min(wrong_values.score for wrong_values in sets)):
            return replace(judgement, factor=factor, score=of_factor)
        return replace(judgement, doubtful=tuple(range(model.items)), score=of_factor)
    judgement = replace(judgement, score=removed.score)
    if removed.rivals or not model.confirms_rest(removed.values):
        suspects = tuple(sorted({*removed.values, *removed.rivals}))
        one_wrong = len(removed.values) == 1 and _one_is_wrong(model, suspects)
        return replace(judgement, doubtful=suspects, one_wrong=one_wrong)
    return replace(judgement, wrong=removed.values)


def misfit_of(model: GivenModel, judgement: Judgement) -> float:
    """Return chi-square after accounting for the errors found, plus their cost.

    Unknown standard deviations take their largest plausible values. With wrong values, chi-square is computed
    from the other values directly, because a difference of two values of 1e29 would be rounding only.
    """
    if not judgement.wrong:
        return model.at_worst.kept().chi2 if model.estimated else judgement.misfit
    model = model.at_worst if model.estimated else model
    others = model.part(~np.isin(model.item, judgement.wrong)).kept().chi2
    return others + _cost_of(model, judgement.wrong, model.kept(judgement.wrong))


@dataclass(frozen=True)
class WrongValues:
    """A set of given values that may be wrong."""

    values: tuple[int, ...]
    score: float  # change of -2 ln likelihood without them, plus their cost
    rivals: tuple[int, ...] = ()  # other values that may be wrong instead of some of them


def _sets(model: GivenModel, cost: float) -> tuple[WrongValues, ...]:
    """Return the best set of wrong values of each size up to half, while the others check one another.

    The scores treat errors as scatter, to be comparable with a factor.
    """
    kept = model.kept()
    out: tuple[int, ...] = ()
    sets: list[WrongValues] = []
    for k in range(1, (model.items + 1) // 2 + 1):
        fall, rank = kept.decreases()
        gain = np.where(np.isin(np.arange(model.items), out), -np.inf, fall - cost * rank)
        more = int(np.argmax(gain))
        out, kept = tuple(sorted((*out, more))), kept.without(more)
        if comb(model.items, k) <= MAX_SETS:
            misfit = dict(_misfits_like(model, out))
            out = min(misfit, key=lambda values: misfit[values], default=out)
            kept = model.kept(out)
        if kept.dof < 1:
            break
        sets.append(WrongValues(out, _score(model, out, kept)))
    return tuple(sets)


def _score(model: GivenModel, out: tuple[int, ...], kept: Kept, *, scatter: bool = True) -> float:
    """Return the change of -2 ln likelihood without some values, plus the cost of their errors and choice."""
    return _cost_of(model, out, kept, scatter=scatter) - (model.kept().chi2 - kept.chi2)


def _cost_of(model: GivenModel, out: tuple[int, ...], kept: Kept, *, scatter: bool = True) -> float:
    """Return the cost of the errors of some values, without which the others are kept, and of their choice.

    The errors have one distribution, as with a factor, if they scatter; otherwise each is a parameter.
    """
    every, m = model.kept(), len(model.v)
    q = every.dof - kept.dof
    of_errors = cost_of_scatter(q, every.chi2 - kept.chi2, m) if scatter else q * cost_of_parameter(m)
    return of_errors + 2 * log(comb(model.items, len(out)))


def cost_of_parameter(m: int) -> float:
    """Return the cost of a parameter with m differences, in -2 ln likelihood.

    Source: Schwarz (1978), Ann. Stat. 6(2).
    """
    return log(max(m, 2))


def cost_of_scatter(q: int, chi2: float, m: int) -> float:
    """Return the cost of q of m differences that scatter more than stated, given their chi-square.

    Their standard deviation costs a parameter, and each difference costs 1 + ln(chi2 / q).
    """
    return cost_of_parameter(m) + q * (1 + log(max(chi2 / max(q, 1), 1.0)))


def _wrong_values(model: GivenModel, level: float, cost: float) -> WrongValues | None:
    """Return the smallest set of values without which the others fit; None if there is none.

    The others must outnumber the set. Rivals are other sets of the same size, and also the other values: if
    these are not more likely by the margin, either part may be wrong.
    """
    kept = model.kept()
    at_worst = model.at_worst.kept() if model.estimated else None
    out: tuple[int, ...] = ()
    while out == () or not _fits(kept, at_worst, level):
        if 2 * (len(out) + 1) >= model.items + model.confirmed:
            return None
        fall, rank = kept.decreases()
        gain = fall - cost * rank
        gain[list(out)] = -np.inf
        out = (*out, int(np.argmax(gain)))
        kept = kept.without(out[-1])
        at_worst = None if at_worst is None else at_worst.without(out[-1])
        if kept.dof < 1:
            return None
    misfit = dict(_misfits_like(model, out))
    out = min(misfit, key=lambda values: misfit[values])
    like = {value for values, chi2 in misfit.items() if chi2 < misfit[out] + MARGIN for value in values}
    # the others may be wrong and these right; errors with one cause do not scatter
    rest, others = model.kept(out), model.part(np.isin(model.item, out)).kept()
    if others.dof > 0 and others.chi2 - rest.chi2 < cost * (others.dof - rest.dof) + MARGIN:
        like = set(range(model.items))
    return WrongValues(out, _score(model, out, rest), tuple(sorted(like - set(out))))


def _misfits_like(model: GivenModel, out: tuple[int, ...]) -> Iterator[tuple[tuple[int, ...], float]]:
    """Yield sets of the same size, with chi-square without them, if degrees of freedom remain.

    These are all sets, or, if there are too many, those that differ in one value.
    """
    k, items = len(out), range(model.items)
    left_out: Iterator[tuple[tuple[int, ...], Kept]]
    if comb(len(items), k) <= MAX_SETS:
        left_out = ((others, model.kept(others)) for others in combinations(items, k - 1))
    else:
        left_out = _each_but_one(model.kept(), (), tuple(sorted(out)))
    for others, kept in left_out:
        fall, rank = kept.decreases()
        for item in items:
            if item not in others and rank[item] < kept.dof:
                yield tuple(sorted((*others, item))), kept.chi2 - float(fall[item])


def _each_but_one(
    kept: Kept, without: tuple[int, ...], values: tuple[int, ...]
) -> Iterator[tuple[tuple[int, ...], Kept]]:
    """Yield the differences without all but one of some values, for each of them, in n ln n updates."""
    if len(values) == 1:
        yield without, kept
        return
    half = len(values) // 2
    for stay, go in ((values[half:], values[:half]), (values[:half], values[half:])):
        rest = kept
        for value in go:
            rest = rest.without(value)
        yield from _each_but_one(rest, (*without, *go), stay)


def _suspects(model: GivenModel, level: float) -> tuple[int, ...]:
    """Return the values that may be wrong: those without which the others fit, otherwise all."""
    every = model.kept()
    fall, rank = every.decreases()
    alone = [
        item
        for item in range(model.items)
        if rank[item] < every.dof and every.may_fit(level, float(fall[item]), int(rank[item]))
        if model.fits(level, (item,))
    ]
    return tuple(alone) if len(alone) > 1 else tuple(range(model.items))


def _one_is_wrong(model: GivenModel, suspects: tuple[int, ...]) -> bool:
    """Return whether exactly one of the suspected values is wrong, which the other values must confirm."""
    return len(suspects) < model.items and all(model.confirms_rest((item,)) for item in suspects)
