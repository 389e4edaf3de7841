"""Scales of bars, plates, tables of distances, points and mounts, tested against one another.

Each of them gives the logarithm of an object length over its length in the free network: of its differences
from this network, the one parameter that the image points leave open. The logarithms are tested with their
joint covariance. Rows of a table share the errors of a tape or an instrument, so they are one scale.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix, diags, vstack
from scipy.spatial.transform import Rotation

from sfm.judgement.given.free_network import Reference, thinned
from sfm.judgement.given.groups import Group, Task, plate_name, remarks_on_unchecked
from sfm.judgement.given.points import UNCHANGED, PlacedPoints, parameters_of
from sfm.judgement.given.values import (
    RANK,
    UNSTATED_FRACTION,
    GivenModel,
    Judgement,
    cost_of_parameter,
    judge_values,
)
from sfm.judgement.survey_result import GivenTest
from sfm.model.conventions import FloatArray, IntArray, find_unit
from sfm.model.distributions import chi2_isf
from sfm.model.network import ScaleBars
from sfm.model.observations.kind import Kind
from sfm.model.remarks.remark import Remark, remark
from sfm.model.remarks.row import significant
from sfm.model.similarity import Similarity

TABLE = "the table of distances"
MAX_PERCENT = 2.0  # a larger ratio of lengths is reported as a factor, a smaller one in per cent


@dataclass(frozen=True)
class JudgedScales:
    """The judged scale bars, and remarks on them and on the scale of given points."""

    bars: ScaleBars  # bars that take part
    remarks: tuple[Remark, ...] = ()
    tests: tuple[GivenTest, ...] = ()
    left_out: frozenset[str] = frozenset()  # kinds of given points that do not take part


def judge_scales(task: Task, groups: Sequence[Group]) -> JudgedScales:
    """Judge the scales of bars, tables and dependable groups of points against one another.

    Rows that contradict most of their table are left out. If nothing shows which rows of a table are wrong,
    each of them is a source.
    """
    bars, rescale = task.network.scale_bars, task.settings.rescale
    used, factor = np.ones(len(bars), dtype=bool), np.ones(len(bars))
    sources, remarks, tests = list[Source](), list[Remark](), list[GivenTest]()
    for name, rows in _lengths(task).items():
        shared = _with_one_scale(task, name, rows)
        sources += shared.sources
        remarks += shared.remarks
        tests += shared.tests
        used[list(shared.out)] = False
        factor[shared.bars] = shared.factor
    for group in groups:
        scale = scale_of_points(group.placed)
        if scale is None:
            continue
        if not (task.in_control or group.placed.points.stated.any()):
            # coordinates without a standard deviation may be those of a print
            scale = scale.looser(UNSTATED_FRACTION)
        is_plate = task.of_plate and group.of == "control"
        origin = plate_name(0) if is_plate else group.of
        sources.append(Source(origin, scale, points=group.of, is_plate=is_plate))
    if not sources:
        return JudgedScales(bars)
    compared = Comparison.of(task, sources)
    if len(sources) == 1:
        alone = not (task.of_plate or task.settings.checks_scale)
        unchecked = [remark("scale_unchecked", given=sources[0].name)] if alone else []
        return JudgedScales(
            replace(bars, sigma=factor * bars.sigma).select(used),
            (*remarks, *unchecked),
            tuple(tests) or (compared.test,),
        )
    if compared.is_open(on_points=task.in_control):
        out, contradiction = compared.contradiction()
        remarks.append(contradiction)
    else:
        out = compared.judgement.wrong
        factor *= compared.factor if rescale else 1.0
        remarks += compared.remarks("bars", rescale=rescale)
        remarks += compared.unchecked if compared.judgement.fits else ()
    for source in (sources[k] for k in out):
        used[list(source.bars)] = False
        if source.is_table:
            used &= bars.table != source.table
    left_out = frozenset(sources[k].points for k in out) - {""}
    taken = replace(bars, sigma=factor * bars.sigma).select(used)
    return JudgedScales(taken, tuple(remarks), (compared.test,), left_out)


class _Shared(NamedTuple):
    """Lengths of one table, plate or pair of points, judged against one another."""

    sources: list[Source]
    bars: IntArray  # all their bars, also those that were not judged
    out: Sequence[int] = ()  # bars that are left out
    factor: float = 1.0  # on their standard deviations
    remarks: Sequence[Remark] = ()
    tests: Sequence[GivenTest] = ()


def _with_one_scale(task: Task, name: str, rows: list[Source]) -> _Shared:
    """Return lengths of a table, plate or pair of points as one source, or each as one if that is open."""
    bars, rescale, table = task.network.scale_bars, task.settings.rescale, rows[0].table
    judged = np.array([b for row in rows for b in row.bars])
    every = np.flatnonzero(bars.table == table) if table else judged
    compared = Comparison.of(task, rows)
    if compared.judgement.doubtful and not compared.scatters and not rows[0].is_plate:
        return _Shared(compared.with_lengths(bars, task.settings.unit), every)
    unchecked = compared.unchecked if table else ()
    return _Shared(
        [compared.as_one(name)],
        every,
        [b for k in compared.judgement.wrong for b in rows[k].bars],
        compared.factor if rescale else 1.0,
        [*compared.remarks(name, rescale=rescale), *unchecked],
        [compared.test] if table else (),
    )


class Scales(NamedTuple):
    """Logarithms of the object length over the length in the free network."""

    log: FloatArray  # (k,)
    J: csr_matrix  # derivatives by the unknowns of the reference, (k, u)
    variance: FloatArray  # from the stated standard deviations, (k,)

    @classmethod
    def joined(cls, every: Sequence[Scales]) -> Scales:
        """Return all scales."""
        log, variance = (np.concatenate([scales[k] for scales in every]) for k in (0, 2))
        return cls(log, vstack([scales.J for scales in every]).tocsr(), variance)

    def looser(self, sigma: float) -> Scales:
        """Return the scales with a further relative standard deviation."""
        return self._replace(variance=self.variance + sigma**2)

    @property
    def mean(self) -> Scales:
        """Mean of scales from independent lengths."""
        k = len(self.log)
        J = csr_matrix(np.full((1, k), 1 / k)) @ self.J
        return Scales(self.log.mean(keepdims=True), J, self.variance.sum(keepdims=True) / k**2)

    def model(self, reference: Reference) -> GivenModel:
        """Return the differences of scales as a model of given values.

        The sigma of the logarithm of a length is the sigma of the length over a logarithmic mean: the mean of
        the length and of the length that the median scale predicts. A difference of any size is then the same
        number of standard deviations in lengths and in logarithms.

        Source: Stolarsky (1975), Generalizations of the logarithmic mean, Math. Mag. 48(2), 87-92.
        """
        off, k = self.log - np.median(self.log), len(self.log)
        # x / (1 - e^-x) of a difference x in logarithms
        by_mean = np.where(off == 0, 1.0, off) / np.where(off == 0, 1.0, -np.expm1(-off))
        network = np.asarray(self.J @ (self.J @ reference.C).T)
        stated = np.diag(by_mean**2 * self.variance)
        redundancy = reference.marginal.adjustment.redundancy
        return GivenModel(self.log, network, stated, np.ones((k, 1)), np.arange(k), redundancy)


def scales_of(
    reference: Reference, kinds: Sequence[Kind], placing: Similarity, by_values: csr_matrix | FloatArray
) -> Scales:
    """Return the scales that observations give, from their differences from the free network.

    `by_values` are the derivatives of the logarithms of scales by the given values, (k, m).
    """
    comparison, W = reference.compare(kinds, placing), csr_matrix(by_values)
    left = 1 - W @ comparison.v  # length in the free network, over the given one
    variance = np.asarray(W.multiply(W @ comparison.stated).sum(axis=1)).ravel()
    return Scales(
        np.log(placing.scale) - np.log(left), -csr_matrix(diags(1 / left) @ W @ comparison.J), variance
    )


def scales_of_lengths(bars: ScaleBars, reference: Reference) -> Scales:
    """Return the scale of each length between two points of the free network."""
    return scales_of(reference, [bars], UNCHANGED, diags(1 / bars.length))


def common_scale(
    reference: Reference,
    kinds: Sequence[Kind],
    placing: Similarity,
    *,
    without: tuple[int, ...] = (),
    estimated: bool = False,
) -> Scales | None:
    """Return the scale that observations, without some values, give together; None if they give none.

    `placing` is the object frame from the frame of the free network.
    """
    if not kinds:
        return None
    model, _ = reference.differences(kinds, placing)
    kept, by_values = ~np.isin(model.item, without), np.zeros((1, len(model.v)))
    by_values[0, kept] = parameters_of(replace(model, estimated=estimated), kept)[6]
    if by_values @ model.A[:, 6] < 1 - RANK**0.5:  # another parameter may be all of it
        return None
    return scales_of(reference, kinds, placing, by_values / reference.compare(kinds, placing).size)


def scale_of_points(placed: PlacedPoints) -> Scales | None:
    """Return the scale from judged points, from their distance if there are two; None if they give none."""
    points = placed.points
    complete, placing, out = points.complete, placed.placing, placed.judgement.wrong
    if len(complete) == 2 and np.isfinite(points.given).sum() == 6:
        points, out = points.select(complete), ()
        (apart,), (apart_free,) = np.diff(points.given, axis=0), np.diff(points.free, axis=0)
        if not apart.any():
            return None
        turn = Rotation.align_vectors(apart[None], apart_free[None])[0].as_matrix()
        scale = float(np.linalg.norm(apart) / np.linalg.norm(apart_free))
        placing = Similarity(scale, turn, np.zeros(3))  # a shift does not change the scale
    elif len(complete) < 3 or placed.model.kept(out).dof < 0:
        return None
    estimated = placed.model.estimated
    return common_scale(points.reference, [points.kind], placing, without=out, estimated=estimated)


class Source(NamedTuple):
    """Given values that have one scale: a bar, a plate, a table of distances, or given points."""

    name: str
    scales: Scales  # of its independent lengths
    bars: tuple[int, ...] = ()  # rows of its lengths among all bars
    table: int = 0  # number of the table of its lengths
    points: str = ""  # kind of given points
    is_plate: bool = False
    is_table: bool = False  # whether it is all rows of its table


class Comparison(NamedTuple):
    """Sources of scale, judged against one another."""

    sources: Sequence[Source]
    model: GivenModel
    judgement: Judgement
    level: float  # probability that right sources are reported as wrong

    @classmethod
    def of(cls, task: Task, sources: Sequence[Source]) -> Comparison:
        """Judge sources of scale."""
        model = Scales.joined([source.scales.mean for source in sources]).model(task.reference)
        return cls(sources, model, judge_values(model, task.level), task.level)

    @property
    def scatters(self) -> bool:
        """Whether all are rows of a table, and too small deviations explain more than errors of some rows.

        The rows of a table have one precision. If nothing shows which of them are wrong, it is their scatter.
        """
        if not (self.sources[0].table and self.judgement.doubtful and self.model.at_worst.fits(self.level)):
            return False
        score = cost_of_parameter(len(self.sources)) - self.model.factor()[1]
        return score <= min(self.judgement.score, 0.0)

    @property
    def factor(self) -> float:
        """Factor on all standard deviations with which the sources agree."""
        return self.model.factor()[0] if self.scatters else self.judgement.factor

    @property
    def test(self) -> GivenTest:
        """Test of all sources."""
        return GivenTest("scale", self.judgement.statistic, self.judgement.dof, self.judgement.probability)

    @property
    def names(self) -> list[str]:
        """Names of the sources."""
        return [source.name for source in self.sources]

    @property
    def unchecked(self) -> Iterator[Remark]:
        """Remarks on right sources whose errors hardly anything would reveal."""
        return remarks_on_unchecked("lengths", self.names, self.model, self.judgement.wrong, self.level)

    def as_one(self, table: str) -> Source:
        """Return the right ones as one source, with sigmas that fit; rows take the name of the table."""
        first, *others = (source for k, source in enumerate(self.sources) if k not in self.judgement.wrong)
        scales = Scales.joined([first.scales, *(source.scales for source in others)])
        variance = self.factor**2 * scales.variance
        if not (first.table or first.is_plate):  # of the same ends: giving a length twice does not improve it
            variance = np.full(len(variance), len(variance) * variance.min())
        scales = scales._replace(variance=variance)
        name, is_table = (table, True) if first.table and others else (first.name, False)
        bars = tuple(b for source in (first, *others) for b in source.bars)
        return first._replace(name=name, scales=scales, bars=bars, is_table=is_table)

    def with_lengths(self, bars: ScaleBars, unit: str) -> list[Source]:
        """Return the sources, with their lengths where several have one name."""
        lengths = [f" ({significant(float(bars.length[source.bars[0]]))} {unit})" for source in self.sources]
        return [
            source._replace(name=source.name + length) if self.names.count(source.name) > 1 else source
            for source, length in zip(self.sources, lengths, strict=True)
        ]

    def remarks(self, of: str, *, rescale: bool) -> Iterator[Remark]:
        """Yield remarks on wrong sources and on standard deviations, which `rescale` replaces."""
        wrong = self.judgement.wrong
        for k in wrong:
            what = "plate" if self.sources[k].is_plate else "given"
            by = numbers_of_scale(*self.difference(k), self.level)
            yield remark("scale_left_out", **{what: self.sources[k].name}, **by)
        if self.factor != 1.0:
            yield remark("given_sigmas", of=of, factor=self.factor, used=self.factor if rescale else None)

    def difference(self, k: int) -> tuple[float, float]:
        """Return the logarithm of a wrong scale over the scale of the right ones, and its sigma."""
        others = tuple(j for j in self.judgement.wrong if j != k)
        (off,), ((variance,),) = self.model.kept(others).difference(k)
        return float(off), float(np.sqrt(variance))

    def is_open(self, *, on_points: bool) -> bool:
        """Return whether the others do not identify the wrong ones.

        If points carry the datum, bars, which may share a wrong unit, do not replace them.
        """
        of_points = {k for k, source in enumerate(self.sources) if source.points}
        outvoted = on_points and len(of_points) > 0 and of_points <= {*self.judgement.wrong}
        return bool(self.judgement.doubtful) or outvoted

    def contradiction(self) -> tuple[tuple[int, ...], Remark]:
        """Return the sources that are not used because they contradict one another, and the remark on it."""
        wrong = self.judgement.wrong
        which = sorted(wrong or self.judgement.doubtful, key=lambda k: (not self.sources[k].points, k))
        lengths = [k for k, source in enumerate(self.sources) if not source.points]
        agreeing = None
        if wrong:
            off, sigma = self.difference(which[0])
            agreeing = len(set(lengths) - set(wrong))
        else:
            low, *_, high = sorted(which, key=lambda k: self.model.v[k])
            off, sigma = difference_of(self.model, high, low)
        by = numbers_of_scale(abs(off), sigma, self.level)
        out = (*lengths, *(k for k in which if self.sources[k].points))
        if not any(source.is_plate for source in self.sources):
            given = [self.sources[k].name for k in which]
            return out, remark("scale_contradicted", given=given, agreeing=agreeing, **by)
        by_name = (self.sources[k] for k in which)
        given = [
            source.name if source.is_plate or source.is_table else f"bar {source.name}" for source in by_name
        ]
        others = [name for k, name in enumerate(self.names) if k not in which] or None
        return out, remark("plate_sizes_contradict", given=given, others=others, **by)


def _lengths(task: Task) -> dict[str, list[Source]]:
    """Return the given lengths that have one scale: of each table, plate or pair of points."""
    bars = task.network.scale_bars
    judged = thinned(len(bars))
    rows, seen = task.in_free(bars.select(judged))
    apart = seen.start != seen.end
    rows, scales = judged[rows[apart]], scales_of_lengths(seen.select(apart), task.reference)
    several = len(np.unique(bars.table[bars.table > 0])) > 1
    sources: dict[str, list[Source]] = {}
    for k, b in enumerate(rows.tolist()):
        ends = tuple(task.network.points[j] for j in (bars.start[b], bars.end[b]))
        plate, table = task.plate_at(ends), int(bars.table[b]) if len(bars.table) else 0
        of_table = f"{TABLE} {table}" if several else TABLE
        name = plate or " - ".join(ends)
        source = Source(name, Scales(*(part[[k]] for part in scales)), (b,), table, is_plate=bool(plate))
        sources.setdefault(of_table if table else plate or " - ".join(sorted(ends)), []).append(source)
    return sources


def difference_of(model: GivenModel, a: int, b: int) -> tuple[float, float]:
    """Return the logarithm of one scale over another, and its sigma."""
    S = model.network + model.stated
    return float(model.v[a] - model.v[b]), float(np.sqrt(S[a, a] + S[b, b] - 2 * S[a, b]))


def numbers_of_scale(log: float, sigma: float, level: float) -> dict[str, Any]:
    """Return the numbers for a remark on the logarithm of a ratio of scales, with its standard deviation.

    They include both units if it is a unit factor; `level` is the probability that one is not recognised.
    """
    unit = find_unit(float(np.exp(abs(log))), float(np.sqrt(chi2_isf(level, 1))) * sigma)
    numbers: dict[str, Any] = {"sigmas": abs(log) / sigma}
    if abs(log) > np.log(MAX_PERCENT):
        numbers["times"] = float(np.exp(log))
    else:
        numbers["off"] = (100 * float(np.expm1(log)), "%")
    if unit is not None:
        finer, coarser = unit.units
        numbers |= {"unit_factor": unit.factor, "finer": finer, "coarser": coarser}
    return numbers
