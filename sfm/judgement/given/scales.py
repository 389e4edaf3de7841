"""Tests of the scales given by bars, control and projection centres against one another.

Every scale bar, and every group of given points, gives the ratio of an object length to its length in the
free network. The logarithms of these scales are tested with their joint covariance.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sfm.conventions import FloatArray, IntArray, find_unit
from sfm.distributions import LEVEL, chi2_isf, chi2_sf
from sfm.judgement.given.groups import Group, Task, plate_name, remarks_on_unchecked
from sfm.judgement.given.points import (
    GivenPoints,
    PlacedPoints,
    centre_and_size,
    parameters_of,
)
from sfm.judgement.given.values import (
    UNSTATED_FRACTION,
    GivenModel,
    Judgement,
    judge_values,
)
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
    places, lengths = task.places, _sources(task)
    names, of = list(lengths.of), list[str]()
    scales = [mean_scale([scale for _, scale in some]) for some in lengths.of.values()]
    for group in groups:
        given_scale = _scale_of(task, group)
        if given_scale is not None:
            scales.append(given_scale)
            of.append(group.of)
            names.append(plate_name(0) if task.of_plate and group.of == "control" else group.of)
    if not scales:
        return JudgedScales(task.network.scale_bars)
    model = scale_model(tuple(scales), places.joint, places.redundancy)
    judgement = judge_values(model, task.level)
    test = GivenTest("scale", judgement.statistic, judgement.dof, judgement.probability)
    bars = lengths.without(())
    if len(scales) == 1:
        alone = () if task.of_plate or task.checks_scale else (remark("scale_unchecked", given=names[0]),)
        return JudgedScales(bars, (*lengths.remarks, *alone), (lengths.test or test,))
    if judgement.fits:
        unchecked = remarks_on_unchecked("lengths", names, model)
        return JudgedScales(bars, (*lengths.remarks, *unchecked), (test,))
    if judgement.factor != 1.0:
        used = judgement.factor if task.rescale else None
        said = remark("given_sigmas", of="bars", factor=judgement.factor, used=used)
        bars = replace(bars, sigma=(used or 1.0) * bars.sigma)
        return JudgedScales(bars, (*lengths.remarks, said), (test,))
    on_points = task.datum.kind == "control"
    plates = {plate_name(k) for k in range(len(task.plates))}.intersection(names)
    sources = list(lengths.of)
    out, remarks = _contradicting_scales(
        model, judgement, names, len(sources), on_points=on_points, plates=plates
    )
    left_out = frozenset(of[k - len(sources)] for k in out if k >= len(sources))
    bars = lengths.without([sources[k] for k in out if k < len(sources)])
    return JudgedScales(bars, (*lengths.remarks, *remarks), (test,), left_out)


@dataclass(frozen=True)
class _Lengths:
    """Given lengths by the source of their scale: a bar, a plate, or a table of distances."""

    of: dict[str, list[tuple[_Length, GivenScale]]]
    bars: ScaleBars  # with standard deviations that fit
    wrong: tuple[int, ...] = ()  # bars of tables that contradict the others of their table
    remarks: tuple[Remark, ...] = ()  # on rows of tables
    test: GivenTest | None = None  # of the rows of a table

    def without(self, sources: Collection[str]) -> ScaleBars:
        """Return the bars of all other sources."""
        of_sources = {b for name in sources for length, _ in self.of[name] for b in length.bars}
        return self.bars.select(~np.isin(np.arange(len(self.bars)), [*self.wrong, *of_sources]))


def _sources(task: Task) -> _Lengths:
    """Return the given lengths by source.

    The rows of a table share the errors of a tape or an instrument. Rows that contradict most of their table
    are left out. If nothing shows which rows of a table are wrong, each of them is a source.
    """
    found = _Lengths({}, task.network.scale_bars)
    tables: dict[str, dict[str, list[tuple[_Length, GivenScale]]]] = {}
    for name, table, length, scale in _scales_of_lengths(task, found.bars):
        of = tables.setdefault(table, {}) if table else found.of
        of.setdefault(name, []).append((length, scale))
    for table, rows in tables.items():
        found = _with_table(task, found, table, rows)
    return found


def _with_table(
    task: Task, lengths: _Lengths, table: str, rows: dict[str, list[tuple[_Length, GivenScale]]]
) -> _Lengths:
    """Return the lengths with the rows of a table, judged against one another."""
    scales = tuple(mean_scale([scale for _, scale in row]) for row in rows.values())
    model = scale_model(scales, task.places.joint, task.places.redundancy)
    judgement, names = judge_values(model, task.level), list(rows)
    alike = [k for k in range(len(names)) if k not in judgement.wrong]
    for k in alike:
        name = names[k] if judgement.doubtful or len(alike) == 1 else table
        lengths.of.setdefault(name, []).extend(rows[names[k]])
    if judgement.doubtful:
        return lengths
    remarks = [_left_out(model, judgement.wrong, names, k, len(names), ()) for k in judgement.wrong]
    bars = lengths.bars
    if judgement.factor != 1.0:
        used = judgement.factor if task.rescale else None
        remarks.append(remark("given_sigmas", of=table, factor=judgement.factor, used=used))
        of_table = [b for row in rows.values() for length, _ in row for b in length.bars]
        factor = np.where(np.isin(np.arange(len(bars)), of_table), used or 1.0, 1.0)
        bars = replace(bars, sigma=factor * bars.sigma)
    remarks += remarks_on_unchecked("lengths", names, model, judgement.wrong)
    wrong = tuple(b for k in judgement.wrong for length, _ in rows[names[k]] for b in length.bars)
    test = GivenTest("scale", judgement.statistic, judgement.dof, judgement.probability)
    return replace(
        lengths,
        bars=bars,
        wrong=(*lengths.wrong, *wrong),
        remarks=(*lengths.remarks, *remarks),
        test=test,
    )


def _scales_of_lengths(task: Task, bars: ScaleBars) -> Iterator[tuple[str, str, _Length, GivenScale]]:
    """Yield the name, the table, or "" without one, the length and the scale of each given length."""
    places = task.places
    several = len(np.unique(bars.table[bars.table > 0])) > 1
    for length in _lengths(bars):
        b = length.bars[0]
        ends = tuple(task.network.points[j] for j in (bars.start[b], bars.end[b]))
        at = [places.of_point.get(name, -1) for name in ends]
        if min(at) < 0 or at[0] == at[1]:
            continue
        scale = scale_of_length(length.length, length.sigma, places.xyz, at[0], at[1])
        given = f" ({significant(length.length)} {task.unit})" if length.contradicted else ""
        number = int(bars.table[b]) if len(bars.table) else 0
        table = f"{TABLE} {number}" if several else TABLE
        table = table if number else ""
        yield task.plate_at(ends) or f"{ends[0]} - {ends[1]}{given}", table, length, scale


def _scale_of(task: Task, group: Group) -> GivenScale | None:
    """Return the scale from given points; from their distance if there are two."""
    points, complete, places = group.points, group.points.complete, task.places
    if len(complete) == 2 and points.known.sum() == 6:
        apart = points.given[complete[1]] - points.given[complete[0]]
        length = float(np.linalg.norm(apart))
        if not length > 0:
            return None
        e = apart / length
        sigma = np.sqrt(e @ (points.stated[complete[0]] + points.stated[complete[1]]) @ e)
        at = group.places[complete]
        found = scale_of_length(length, float(sigma), places.xyz, int(at[0]), int(at[1]))
    elif len(complete) < 3 or group.placed.model.kept(group.out).dof < 0:
        return None
    else:
        found = scale_of_points(points, group.placed, group.out, group.places, len(places.xyz))
    if task.datum.kind != "control" and not points.stated.any():
        return replace(found, sigma=float(np.hypot(found.sigma, UNSTATED_FRACTION * found.scale)))
    return found


def _contradicting_scales(
    model: GivenModel,
    judgement: Judgement,
    names: list[str],
    bars: int,
    *,
    on_points: bool,
    plates: Collection[str] = (),
) -> tuple[tuple[int, ...], tuple[Remark, ...]]:
    """Return the scales that the others identify as wrong, or all doubtful ones if they do not, with remarks.

    names: bars and plates, of which the first `bars` are lengths, then kinds of given points.
    on_points: whether given points carry the datum; bars, which may share a wrong unit, do not replace them.
    plates: the names that are plates.
    """
    wrong, every = judgement.wrong, range(model.items)
    if wrong and not (on_points and max(wrong) >= bars and {*every[bars:]} <= {*wrong}):
        return wrong, tuple(_left_out(model, wrong, names, k, bars, plates) for k in wrong)
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
    model: GivenModel, wrong: tuple[int, ...], names: list[str], k: int, bars: int, plates: Collection[str]
) -> Remark:
    """Return the remark that a bar, a plate or given points were left out because of their scale."""
    off, sigma = _difference(model, wrong, k)
    what = "plate" if names[k] in plates else "given"
    return remark("scale_left_out", **{what: names[k]}, **numbers_of_scale(off, sigma))


def _difference(model: GivenModel, wrong: tuple[int, ...], k: int) -> tuple[float, float]:
    """Return the logarithm of a wrong scale over the scale of the correct ones, and its sigma."""
    (off,), ((variance,),) = model.kept(tuple(j for j in wrong if j != k)).difference(k)
    return float(off), float(np.sqrt(variance))


@dataclass(frozen=True)
class _Length:
    """A length between two points, given once or several times."""

    bars: tuple[int, ...]
    length: float  # weighted mean
    sigma: float  # of the best bar: giving a length twice does not improve it
    contradicted: bool  # whether a different length is given between the same points


def _lengths(bars: ScaleBars) -> list[_Length]:
    """Return the lengths of scale bars; agreeing lengths between the same points are merged."""
    same: dict[tuple[frozenset[int], int], list[list[int]]] = {}
    for b in np.argsort(bars.length, kind="stable").tolist():
        ends = frozenset((int(bars.start[b]), int(bars.end[b])))
        alike = same.setdefault((ends, int(bars.table[b]) if len(bars.table) else 0), [])
        if alike and _agree(bars, alike[-1][0], b):
            alike[-1].append(b)
        else:
            alike.append([b])
    found = [
        _Length(
            tuple(some),
            float(np.average(bars.length[some], weights=1 / bars.sigma[some] ** 2)),
            float(bars.sigma[some].min()),
            len(alike) > 1,
        )
        for alike in same.values()
        for some in alike
    ]
    return sorted(found, key=lambda one: min(one.bars))


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


@dataclass(frozen=True)
class GivenScale:
    """Object units per unit of the free network, from one bar or from all given points of a kind."""

    scale: float
    rows: FloatArray  # derivatives of its logarithm by the points of the free network, (3 n,)
    sigma: float  # of the scale, from the stated standard deviations


def scale_of_length(length: float, sigma: float, free: FloatArray, start: int, end: int) -> GivenScale:
    """Return the scale from a length between two points of the free network.

    Args:
        length: given length, object unit.
        sigma: standard deviation of the length, object unit.
        free: points of the free network, (n, 3).
        start: index of the first point.
        end: index of the second point.
    """
    apart = free[end] - free[start]
    found = float(np.linalg.norm(apart))
    rows = np.zeros(free.shape)
    rows[end], rows[start] = -apart / found**2, apart / found**2
    return GivenScale(length / found, rows.ravel(), sigma / found)


def mean_scale(scales: Sequence[GivenScale]) -> GivenScale:
    """Return the geometric mean of scales from independent lengths."""
    scale = float(np.exp(np.mean([np.log(one.scale) for one in scales])))
    relative = np.array([one.sigma / one.scale for one in scales])
    rows = np.mean([one.rows for one in scales], axis=0)
    return GivenScale(scale, rows, scale * float(np.linalg.norm(relative)) / len(scales))


def scale_of_points(
    points: GivenPoints, placed: PlacedPoints, without: tuple[int, ...], at: IntArray, count: int
) -> GivenScale:
    """Return the scale from given points, without some of them.

    Args:
        points: given coordinates, and coordinates in the free network.
        placed: the judged points.
        without: indices of the points that are left out.
        at: index of each point in the free network, (k,).
        count: number of points of the free network, n.
    """
    model, placing = placed.model, placed.placing
    kept = ~np.isin(model.item, without)
    G = parameters_of(model, kept)[6] / centre_and_size(placing.apply(points.free))[1]
    axis = (np.flatnonzero(points.known.ravel()) % 3)[kept]
    rows = np.zeros((count, 3))
    np.subtract.at(rows, at[model.item[kept]], G[:, None] * placing.scale * placing.rotation[axis])
    variance = float(G @ model.stated[np.ix_(kept, kept)] @ G)
    return GivenScale(placing.scale, rows.ravel(), placing.scale * float(np.sqrt(variance)))


def scale_model(scales: tuple[GivenScale, ...], joint: FloatArray, redundancy: int) -> GivenModel:
    """Return the differences of scales as a model of given values.

    The sigma of the logarithm of a length is the sigma of the length over a logarithmic mean: the mean of the
    length and of the length that the median scale predicts. A difference of any size is then the same number
    of standard deviations in lengths and in logarithms.

    Args:
        scales: scales from bars and given points.
        joint: covariance of the points of the free network, (3 n, 3 n).
        redundancy: redundancy of the free network.

    Source: Stolarsky (1975), Generalizations of the logarithmic mean, Math. Mag. 48(2), 87-92.
    """
    H = np.stack([one.rows for one in scales])
    v = np.log([one.scale for one in scales])
    off = v - np.median(v)
    # (e^x - 1) / x of a difference x in logarithms
    mean = np.exp(v - off) * np.where(off == 0, 1.0, np.expm1(off) / np.where(off == 0, 1.0, off))
    return GivenModel(
        v,
        H @ joint @ H.T,
        np.diag((np.array([one.sigma for one in scales]) / mean) ** 2),
        np.ones((len(scales), 1)),
        np.arange(len(scales)),
        redundancy,
    )
