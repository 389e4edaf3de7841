"""Tests of the scales given by bars, control and projection centres against one another.

Every scale bar, and every group of given points, gives the ratio of an object length to its length in the
free network. The logarithms of these scales are tested with their joint covariance.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix, vstack

from sfm.conventions import FloatArray, find_unit
from sfm.distributions import LEVEL, chi2_isf, chi2_sf
from sfm.judgement.given.free_network import Reference, thinned
from sfm.judgement.given.groups import Group, Task, plate_name, remarks_on_unchecked
from sfm.judgement.given.points import UNCHANGED, GivenPoints, PlacedPoints, parameters_of
from sfm.judgement.given.values import UNSTATED_FRACTION, GivenModel, Judgement, judge_values
from sfm.network import ScaleBars
from sfm.remarks.kind import significant
from sfm.remarks.remark import Remark, remark
from sfm.result import GivenTest

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

    Args:
        task: values to judge.
        groups: dependable groups of given points.
    """
    lengths = _lengths_of(task)
    found = [(group, scale_of_points(group.points, group.placed)) for group in groups]
    of_groups = [(group, scale) for group, scale in found if scale is not None]
    if not task.in_control:  # coordinates without a standard deviation may be those of a print
        of_groups = [
            (group, scale if group.points.stated.any() else scale.looser(UNSTATED_FRACTION))
            for group, scale in of_groups
        ]
    names = list(lengths.sources)
    names += [
        plate_name(0) if task.of_plate and group.of == "control" else group.of for group, _ in of_groups
    ]
    if not names:
        return JudgedScales(task.network.scale_bars)
    scales = Scales.joined(
        [lengths.scales.mean(lengths.sources.values()), *(scale for _, scale in of_groups)]
    )
    model = scales.model(task.reference)
    judgement = judge_values(model, task.level)
    tests: tuple[GivenTest, ...] = (
        GivenTest("scale", judgement.statistic, judgement.dof, judgement.probability),
    )
    out: tuple[int, ...] = ()
    remarks: tuple[Remark, ...] = ()
    factor = 1.0
    if len(names) == 1:
        tests = lengths.tests or tests
        alone = not (task.of_plate or task.settings.checks_scale)
        remarks = (remark("scale_unchecked", given=names[0]),) if alone else ()
    elif judgement.fits:
        remarks = tuple(remarks_on_unchecked("lengths", names, model))
    elif judgement.factor != 1.0:
        factor = judgement.factor if task.settings.rescale else 1.0
        used = factor if task.settings.rescale else None
        remarks = (remark("given_sigmas", of="bars", factor=judgement.factor, used=used),)
    else:
        out, remarks = _contradicting_scales(task, model, judgement, names, len(lengths.sources))
    count = len(lengths.sources)
    left_out = frozenset(of_groups[k - count][0].of for k in out if k >= count)
    bars = lengths.without([names[k] for k in out if k < count])
    bars = replace(bars, sigma=factor * bars.sigma)
    return JudgedScales(bars, (*lengths.remarks, *remarks), tests, left_out)


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

    def mean(self, sets: Collection[Sequence[int]]) -> Scales:
        """Return the mean of each of several sets of scales from independent lengths."""
        M = np.zeros((len(sets), len(self.log)))
        for row, members in zip(M, sets, strict=True):
            row[list(members)] = 1 / len(members)
        return Scales(M @ self.log, csr_matrix(M) @ self.J, M**2 @ self.variance)

    def model(self, reference: Reference) -> GivenModel:
        """Return the differences of scales as a model of given values.

        The sigma of the logarithm of a length is the sigma of the length over a logarithmic mean: the mean of
        the length and of the length that the median scale predicts. A difference of any size is then the same
        number of standard deviations in lengths and in logarithms.

        Args:
            reference: the free network.

        Source: Stolarsky (1975), Generalizations of the logarithmic mean, Math. Mag. 48(2), 87-92.
        """
        off, k = self.log - np.median(self.log), len(self.log)
        # x / (1 - e^-x) of a difference x in logarithms
        by_mean = np.where(off == 0, 1.0, off) / np.where(off == 0, 1.0, -np.expm1(-off))
        network = np.asarray(self.J @ (self.J @ reference.C).T)
        stated = np.diag(by_mean**2 * self.variance)
        redundancy = reference.marginal.adjustment.redundancy
        return GivenModel(self.log, network, stated, np.ones((k, 1)), np.arange(k), redundancy)


def scales_of_lengths(bars: ScaleBars, reference: Reference) -> Scales:
    """Return the scale of each length between two points of the free network."""
    if not len(bars):
        return Scales(np.zeros(0), csr_matrix((0, len(reference.C))), np.zeros(0))
    found = reference.compare([bars], UNCHANGED)
    length = bars.length - found.v  # in the free network
    J = csr_matrix(-found.J.multiply(1 / length[:, None]))
    return Scales(np.log(bars.length / length), J, (bars.sigma / bars.length) ** 2)


def scale_of_points(points: GivenPoints, placed: PlacedPoints) -> Scales | None:
    """Return the scale from given points, from their distance if there are two; None if they give none.

    Args:
        points: given points.
        placed: these points, judged.
    """
    complete, reference, out = points.complete, points.reference, placed.judgement.wrong
    if len(complete) == 2 and np.isfinite(points.given).sum() == 6:
        pair = points.select(complete)
        apart, apart_free = (X[1] - X[0] for X in (pair.given, pair.free))
        length, free = float(np.linalg.norm(apart)), float(np.linalg.norm(apart_free))
        if not length > 0:
            return None
        log, G = np.log(length / free), np.concatenate([-apart_free, apart_free]) / free**2
        J, e = reference.compare([pair.kind], UNCHANGED).J, apart / length
        variance = float(e @ pair.stated.sum(axis=0) @ e) / length**2
    elif len(complete) < 3 or placed.model.kept(out).dof < 0:
        return None
    else:
        found, kept = reference.compare([points.kind], placed.placing), ~np.isin(placed.model.item, out)
        G = np.zeros(len(kept))
        G[kept] = parameters_of(placed.model, kept)[6] / found.size
        log, J, variance = np.log(placed.placing.scale), found.J, float(G @ placed.model.stated @ G)
    return Scales(np.array([log]), csr_matrix(-csr_matrix(G) @ J), np.array([variance]))


@dataclass(frozen=True)
class _Lengths:
    """Given lengths, and the sources of their scale: a bar, a plate, or a table of distances."""

    scales: Scales
    bars: ScaleBars  # with standard deviations that fit
    members: tuple[tuple[int, ...], ...]  # bars of each length
    sources: dict[str, list[int]]  # lengths of each source
    tables: dict[str, int]  # number of each table
    wrong: tuple[int, ...] = ()  # lengths of tables that contradict the others of their table
    remarks: tuple[Remark, ...] = ()  # on rows of tables
    tests: tuple[GivenTest, ...] = ()  # of the rows of a table

    def without(self, sources: Collection[str]) -> ScaleBars:
        """Return the bars of all other sources; of a table that is left out, none remains."""
        lengths = [*self.wrong, *(length for source in sources for length in self.sources[source])]
        out = np.isin(np.arange(len(self.bars)), [b for length in lengths for b in self.members[length]])
        if len(self.bars.table):
            tables = [self.tables[source] for source in sources if source in self.tables]
            out |= np.isin(self.bars.table, tables)
        return self.bars.select(~out)


def _lengths_of(task: Task) -> _Lengths:
    """Return the given lengths by source.

    The rows of a table share the errors of a tape or an instrument. Rows that contradict most of their table
    are left out. If nothing shows which rows of a table are wrong, each of them is a source.
    """
    bars = task.network.scale_bars
    judged = thinned(len(bars))
    rows, seen = task.in_free(bars.select(judged))
    apart = seen.start != seen.end
    rows, seen = judged[rows[apart]], seen.select(apart)
    merged, members, contradicted = merge_lengths(seen)
    several = len(np.unique(bars.table[bars.table > 0])) > 1
    lengths = _Lengths(
        scales_of_lengths(merged, task.reference),
        bars,
        tuple(tuple(rows[list(group)].tolist()) for group in members),
        {},
        {},
    )
    tables: dict[str, dict[str, list[int]]] = {}
    for k, of_length in enumerate(lengths.members):
        b = of_length[0]
        ends = tuple(task.network.points[j] for j in (bars.start[b], bars.end[b]))
        given = f" ({significant(float(merged.length[k]))} {task.settings.unit})" if contradicted[k] else ""
        name = task.plate_at(ends) or f"{ends[0]} - {ends[1]}{given}"
        number = int(bars.table[b]) if len(bars.table) else 0
        table = (f"{TABLE} {number}" if several else TABLE) if number else ""
        of = tables.setdefault(table, {}) if table else lengths.sources
        of.setdefault(name, []).append(k)
        if table:
            lengths.tables[table] = number
    for table, of_table in tables.items():
        lengths = _with_table(task, lengths, table, of_table)
    return lengths


def _with_table(task: Task, lengths: _Lengths, table: str, rows: dict[str, list[int]]) -> _Lengths:
    """Return the lengths with the rows of a table, judged against one another."""
    model = lengths.scales.mean(rows.values()).model(task.reference)
    judgement, names = judge_values(model, task.level), list(rows)
    alike = [name for k, name in enumerate(names) if k not in judgement.wrong]
    for name in alike:
        source = name if judgement.doubtful or len(alike) == 1 else table
        lengths.sources.setdefault(source, []).extend(rows[name])
    if judgement.doubtful:
        return lengths
    remarks = [_left_out(model, judgement.wrong, names, k) for k in judgement.wrong]
    scales, bars = lengths.scales, lengths.bars
    if judgement.factor != 1.0:
        used = judgement.factor if task.settings.rescale else None
        remarks.append(remark("given_sigmas", of=table, factor=judgement.factor, used=used))
        every = [length for row in rows.values() for length in row]
        variance = scales.variance.copy()
        variance[every] *= judgement.factor**2
        factor = np.where(bars.table == lengths.tables[table], used or 1.0, 1.0)
        scales, bars = scales._replace(variance=variance), replace(bars, sigma=factor * bars.sigma)
    remarks += remarks_on_unchecked("lengths", names, model, judgement.wrong)
    test = GivenTest("scale", judgement.statistic, judgement.dof, judgement.probability)
    return replace(
        lengths,
        scales=scales,
        bars=bars,
        wrong=(*lengths.wrong, *(length for k in judgement.wrong for length in rows[names[k]])),
        remarks=(*lengths.remarks, *remarks),
        tests=(test,),
    )


def merge_lengths(bars: ScaleBars) -> tuple[ScaleBars, tuple[tuple[int, ...], ...], tuple[bool, ...]]:
    """Merge agreeing lengths of a table between the same points: giving one twice does not improve it.

    Args:
        bars: scale bars.

    Returns:
        The weighted means with the sigma of the best bar, the bars of each, and whether a different length
        is given between the same points.
    """
    same: dict[tuple[frozenset[int], int], list[list[int]]] = {}
    for b in np.argsort(bars.length, kind="stable").tolist():
        ends = frozenset((int(bars.start[b]), int(bars.end[b])))
        alike = same.setdefault((ends, int(bars.table[b]) if len(bars.table) else 0), [])
        if alike and _agree(bars, alike[-1][0], b):
            alike[-1].append(b)
        else:
            alike.append([b])
    found = sorted(
        ((members, len(alike) > 1) for alike in same.values() for members in alike),
        key=lambda one: min(one[0]),
    )
    members = tuple(tuple(group) for group, _ in found)
    merged = replace(
        bars.select(np.array([group[0] for group in members], dtype=np.int64)),
        length=np.array([np.average(bars.length[[*b]], weights=1 / bars.sigma[[*b]] ** 2) for b in members]),
        sigma=np.array([bars.sigma[[*b]].min() for b in members]),
    )
    return merged, members, tuple(contradicted for _, contradicted in found)


def _contradicting_scales(
    task: Task, model: GivenModel, judgement: Judgement, names: list[str], bars: int
) -> tuple[tuple[int, ...], tuple[Remark, ...]]:
    """Return the scales that the others identify as wrong, or all doubtful ones if they do not, with remarks.

    names: bars and plates, of which the first `bars` are lengths, then kinds of given points.
    If given points carry the datum, bars, which may share a wrong unit, do not replace them.
    """
    on_points = task.in_control
    plates = {plate_name(k) for k in range(len(task.settings.plates))}.intersection(names)
    wrong, every = judgement.wrong, range(model.items)
    if wrong and not (on_points and max(wrong) >= bars and {*every[bars:]} <= {*wrong}):
        return wrong, tuple(_left_out(model, wrong, names, k, plates) for k in wrong)
    which = sorted(wrong or judgement.doubtful or every, key=lambda k: (k < bars, k))
    if wrong:
        off, sigma = _difference(model, wrong, which[0])
        agreeing = bars - sum(k < bars for k in wrong)
    else:
        v, S = model.v[which], (model.network + model.stated)[np.ix_(which, which)]
        low, high = int(v.argmin()), int(v.argmax())
        off = float(v[high] - v[low])
        sigma = float(np.sqrt(S[low, low] + S[high, high] - 2 * S[low, high]))
        agreeing = None
    by = numbers_of_scale(abs(off), sigma)
    if plates:
        given = [
            one if one in plates or one.startswith(TABLE) else f"bar {one}"
            for one in (names[k] for k in which)
        ]
        others = [names[k] for k in every if k not in which] or None
        said = remark("plate_sizes_contradict", given=given, others=others, **by)
    else:
        said = remark("scale_contradicted", given=[names[k] for k in which], agreeing=agreeing, **by)
    return (*every[:bars], *(k for k in which if k >= bars)), (said,)


def _left_out(
    model: GivenModel, wrong: tuple[int, ...], names: list[str], k: int, plates: Collection[str] = ()
) -> Remark:
    """Return the remark that a bar, a plate or given points were left out because of their scale."""
    off, sigma = _difference(model, wrong, k)
    what = "plate" if names[k] in plates else "given"
    return remark("scale_left_out", **{what: names[k]}, **numbers_of_scale(off, sigma))


def _difference(model: GivenModel, wrong: tuple[int, ...], k: int) -> tuple[float, float]:
    """Return the logarithm of a wrong scale over the scale of the correct ones, and its sigma."""
    (off,), ((variance,),) = model.kept(tuple(j for j in wrong if j != k)).difference(k)
    return float(off), float(np.sqrt(variance))


def _agree(bars: ScaleBars, a: int, b: int) -> bool:
    """Return whether two lengths differ by no more than their standard deviations allow."""
    variance = float(bars.sigma[a] ** 2 + bars.sigma[b] ** 2)
    return bool(chi2_sf((bars.length[b] - bars.length[a]) ** 2 / variance, 1) >= LEVEL)


def numbers_of_scale(log: float, sigma: float) -> dict[str, Any]:
    """Return the numbers for a remark on a difference of scale, with the two units if it is a unit factor.

    Args:
        log: logarithm of the ratio of scales.
        sigma: standard deviation of the logarithm.
    """
    unit = find_unit(float(np.exp(abs(log))), float(np.sqrt(chi2_isf(LEVEL, 1))) * sigma)
    found: dict[str, Any] = {"sigmas": abs(log) / sigma}
    if abs(log) > np.log(MAX_PERCENT):
        found["times"] = float(np.exp(log))
    else:
        found["off"] = (100 * float(np.expm1(log)), "%")
    if unit is not None:
        finer, coarser = unit.units
        found |= {"unit_factor": unit.factor, "finer": finer, "coarser": coarser}
    return found
