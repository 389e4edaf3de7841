"""Scale bars, control and observed projection centres, judged by the image points before they are used.

What contradicts is left out where the others identify it, and named; where they do not, nothing that it
touches is believed. The rest takes part in the adjustment.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.covariance import determines_cameras, marginal_of
from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.given_points import (
    GivenPoints,
    GivenScale,
    PlacedPoints,
    judge_points,
    scale_model,
    scale_of_length,
    scale_of_points,
)
from sfm.adjustment.quality.given_values import (
    LEVEL,
    NONCENTRALITY,
    GivenModel,
    GivenTest,
    Judgement,
    judge_values,
)
from sfm.adjustment.result import Adjustment
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.distributions import chi2_sf
from sfm.errors import GeometryError
from sfm.network import ExteriorObservations, Network, ObjectPoints, ScaleBars
from sfm.remarks.kind import WRONG_SIGMAS, significant
from sfm.remarks.remark import Remark, remark
from sfm.similarity import Similarity

UNIT_FACTORS = (10.0, 12.0, 25.4, 100.0, 304.8, 1000.0)  # between mm, cm, m, inch and foot
SAME_UNIT = 0.02  # relative difference up to which a factor is that of a unit; 10 and 12 are 0.2 apart
CHECKABLE = 0.01  # redundancy number below which nothing checks a value; Foerstner (1987), CVGIP 40(3)
UNCHECKED = NONCENTRALITY * ((1 - CHECKABLE) / CHECKABLE) ** 0.5  # the same as external reliability, 41
PRINT_SIGMA = (
    0.002  # relative scale of coordinates without standard deviations: paper swells by 1 to 2 permille
)
MAX_PLACES = 1000  # given points whose joint covariance is formed, 72 MB; of more, so many are judged


@dataclass(frozen=True)
class JudgedGiven:
    """What may take part in the adjustment, and what was found of the rest."""

    network: Network
    datum: Datum
    remarks: tuple[Remark, ...] = ()
    tests: tuple[GivenTest, ...] = ()
    placing: Similarity | None = (
        None  # object frame from that of the free network; None where nothing says it
    )


@dataclass(frozen=True)
class _Places:
    """Points and projection centres of the free network with their joint covariance."""

    xyz: FloatArray  # (p, 3)
    joint: FloatArray  # (3 p, 3 p)
    redundancy: int
    of_point: dict[str, int]  # place of a point
    of_image: dict[str, int]  # place of a photograph

    def at(self, places: Sequence[int]) -> tuple[IntArray, IntArray]:
        """Return indices of places, and of their coordinates."""
        index = np.asarray(places, dtype=np.int64)
        return index, (3 * index[:, None] + np.arange(3)).ravel()


def without_given(network: Network) -> Network:
    """Return the network of the image points alone."""
    return replace(network, control=ObjectPoints(), scale_bars=ScaleBars(), exterior=ExteriorObservations())


def judge_given(
    network: Network, free: Adjustment | None, datum: Datum, *, unit: str, rescale: bool = True
) -> JudgedGiven:
    """Return which given values may take part in an adjustment, and remarks on the others.

    Args:
        network: with all that was given.
        free: adjustment of its image points alone, or of a part of them, in a free datum; None if none.
        datum: that was asked for.
        unit: object unit.
        rescale: whether standard deviations that are too small may be replaced; fixed values stay fixed.
    """
    if not (len(network.scale_bars) or len(network.control) or len(network.exterior)):
        return JudgedGiven(network, datum)
    places = None if free is None or free.redundancy < 1 else _places(network, free, datum)
    if places is None:
        kinds = (("bars", network.scale_bars), ("control", network.control))
        of = [name for name, some in kinds if len(some)]
        remarks = (remark("given_not_judged", of=of),) if of else ()
        return JudgedGiven(network, datum, remarks)
    return _judged(_Task(network, places, datum, unit, rescale))


def _places(network: Network, free: Adjustment, datum: Datum) -> _Places | None:
    """Return where the given points are in the free network; None where that does not determine them."""
    if not free.converged or free.undetermined or free.defect != free.expected_defect:
        return None
    bars, control = network.scale_bars, network.control
    number = {name: j for j, name in enumerate(free.network.points)}
    photograph = {name: i for i, name in enumerate(free.network.images)}
    ends = [network.points[j] for j in np.unique(np.concatenate([bars.start, bars.end]))]
    some = [network.points[j] for j in control.point]
    step = max(1, -(-len(some) // MAX_PLACES))
    names = [name for name in dict.fromkeys([*ends, *some[::step]]) if name in number]
    seen = network.exterior if datum.kind == "control" else ExteriorObservations()
    step = max(1, -(-len(seen) // MAX_PLACES))
    images = [name for name in (network.images[i] for i in seen.image[::step]) if name in photograph]
    if not names and not images:
        return None
    points = np.array([number[name] for name in names], dtype=np.int64)
    stations = np.array([photograph[name] for name in images], dtype=np.int64)
    try:
        marginal = marginal_of(free)
        joint = marginal.joint((6 * stations[:, None] + np.arange(3)).ravel(), points)
    except (GeometryError, np.linalg.LinAlgError):
        return None
    if not np.isfinite(joint).all() or not determines_cameras(marginal):
        return None
    return _Places(
        np.concatenate([free.estimate.position[stations], free.estimate.points[points]]),
        (joint + joint.T) / 2,
        free.redundancy,
        {name: len(images) + k for k, name in enumerate(names)},
        {name: k for k, name in enumerate(images)},
    )


@dataclass(frozen=True)
class _Task:
    """What is judged, and how."""

    network: Network  # with all that was given
    places: _Places
    datum: Datum  # that was asked for
    unit: str
    rescale: bool

    @property
    def level(self) -> float:
        """Probability with which one kind of right given values is said to be wrong."""
        kinds = (self.network.scale_bars, self.network.control, self.network.exterior)
        return LEVEL / max(sum(len(one) > 0 for one in kinds), 1)


@dataclass(frozen=True)
class _Group:
    """Given points of a kind, judged."""

    of: str  # control or centres
    rows: IntArray  # of the kind in the network, (n,)
    names: tuple[str, ...]
    points: GivenPoints
    places: IntArray  # (n,)
    placed: PlacedPoints
    rounded: bool = False  # whether the standard deviations are those of the rounding

    @property
    def found(self) -> Judgement:
        """What is wrong of them."""
        return self.placed.judgement

    @property
    def out(self) -> tuple[int, ...]:
        """Those that were left out."""
        return self.found.wrong

    @property
    def dependable(self) -> bool:
        """Whether a scale may rest on them."""
        return not (self.placed.mirrored or self.found.doubtful)

    @property
    def test(self) -> GivenTest:
        """Test of all of them."""
        return GivenTest(self.of, self.found.statistic, self.found.dof, self.found.probability)

    def as_judged(self, covariance: FloatArray, *, rescale: bool) -> tuple[IntArray, BoolArray, FloatArray]:
        """Return whose coordinates each given point has, which take part, and their covariance, (n, 3, 3)."""
        order, keep = np.arange(len(covariance)), np.ones(len(covariance), dtype=bool)
        if self.found.exchanged:
            pair = self.rows[list(self.found.exchanged)]
            order[pair] = pair[::-1]
        keep[self.rows[list(self.out)]] = False
        changed = covariance[order]
        changed[self.rows] = self._confirmed(changed[self.rows], rescale)
        return order, keep, changed

    def _confirmed(self, covariance: FloatArray, rescale: bool) -> FloatArray:
        """Return the covariance of the points with which they fit."""
        known = np.isfinite(covariance)
        if self.rounded:
            return np.where(known, self.points.stated, covariance)
        fixed = not np.where(known, covariance, 0.0).any()
        changes = bool(self.found.doubtful) or self.found.factor != 1.0
        if fixed or not rescale or not changes or self.placed.model.estimated:
            return covariance
        factor = self.placed.model.factor()[0] if self.found.doubtful else self.found.factor
        return np.where(known, factor**2 * covariance, covariance)


@dataclass(frozen=True)
class _Scales:
    """Scale bars as judged, and what was found of them and of the scale of given points."""

    bars: ScaleBars  # that take part
    remarks: tuple[Remark, ...] = ()
    tests: tuple[GivenTest, ...] = ()


def _judged(task: _Task) -> JudgedGiven:
    """Judge points, then the scales of bars and points."""
    network, datum = task.network, task.datum
    control, centres = _control_of(task), _centres_of(task)
    groups = [one for one in (control, centres) if one is not None]
    scales = _judged_scales(task, [one for one in groups if one.dependable])
    network = replace(network, scale_bars=scales.bars)
    if control is not None:
        network = replace(network, control=_judged_control(task, control))
        if control.placed.mirrored and datum.kind == "control" and not len(network.exterior):
            datum = Datum("free")
    if centres is not None and not centres.placed.mirrored:
        network = replace(network, exterior=_judged_centres(task, centres))
    return JudgedGiven(
        network,
        datum,
        tuple(found for one in groups for found in _remarks_on(task, one)) + scales.remarks,
        tuple(one.test for one in groups) + scales.tests,
        next((one.placed.placing for one in groups if not one.placed.mirrored), None),
    )


def _control_of(task: _Task) -> _Group | None:
    control = task.network.control
    names = [task.network.points[j] for j in control.point]
    return _group(task, "control", names, task.places.of_point, control.xyz, control.covariance)


def _centres_of(task: _Task) -> _Group | None:
    seen = task.network.exterior
    names = [task.network.images[i] for i in seen.image]
    return _group(task, "centres", names, task.places.of_image, seen.position, seen.covariance[:, :3, :3])


def _judged_control(task: _Task, group: _Group) -> ObjectPoints:
    """Return control without what does not fit, or changed."""
    control = task.network.control
    if group.placed.mirrored:
        return ObjectPoints()
    order, keep, covariance = group.as_judged(control.covariance, rescale=task.rescale)
    return ObjectPoints(control.point[keep], control.xyz[order][keep], covariance[keep])


def _judged_centres(task: _Task, group: _Group) -> ExteriorObservations:
    """Return observed orientation without projection centres that do not fit, or changed."""
    seen = task.network.exterior
    order, keep, of_centres = group.as_judged(seen.covariance[:, :3, :3], rescale=task.rescale)
    covariance = seen.covariance[order]
    covariance[:, :3, :3] = of_centres
    return ExteriorObservations(
        seen.image[keep], seen.position[order][keep], seen.angles[order][keep], covariance[keep]
    )


def _group(
    task: _Task,
    of: str,
    names: Sequence[str],
    place_of: dict[str, int],
    xyz: FloatArray,
    covariance: FloatArray,
) -> _Group | None:
    """Judge points of a kind against the free network; None without such."""
    given = np.where(np.isfinite(np.einsum("nii->ni", covariance)), xyz, np.nan)
    placed_there = np.array([name in place_of for name in names], dtype=bool)
    rows = np.flatnonzero(placed_there & np.isfinite(given).any(axis=1))
    if not len(rows):
        return None
    index, coordinates = task.places.at([place_of[names[k]] for k in rows.tolist()])
    points = GivenPoints(
        given[rows],
        np.where(np.isfinite(covariance[rows]), covariance[rows], 0.0),
        task.places.xyz[index],
        task.places.joint[np.ix_(coordinates, coordinates)],
        task.places.redundancy,
    )
    in_datum = task.datum.kind == "control"
    fixed = not points.stated.any()
    start = Similarity(1.0, np.eye(3), np.zeros(3)) if in_datum else None
    placed = judge_points(points, task.level, start=start, estimated=fixed and not in_datum)
    if placed is None:
        return None
    group = _Group(of, rows, tuple(names[k] for k in rows.tolist()), points, index, placed)
    if fixed and in_datum and task.rescale and not placed.judgement.fits:
        group = _rounded(group, start, task.level)
    found = group.found
    if found.factor == 1.0:
        return group
    stated = np.broadcast_to(np.eye(3), points.stated.shape) if fixed else points.stated
    points = replace(points, stated=found.factor**2 * stated)
    fitting = judge_points(points, task.level, start=start)
    placed = group.placed if fitting is None else replace(fitting, judgement=found)
    return replace(group, points=points, placed=placed)


def _rounded(group: _Group, start: Similarity | None, level: float) -> _Group:
    """Judge fixed coordinates again, as precise as their decimals, where these explain the misfit."""
    points = group.points.rounded()
    placed = judge_points(points, level, start=start) if points.stated.any() else None
    if placed is None or placed.judgement.factor != 1.0 or placed.judgement.doubtful:
        return group
    return replace(group, points=points, placed=placed, rounded=True)


def _remarks_on(task: _Task, group: _Group) -> Iterator[Remark]:
    """Yield what does not fit of points, and what nothing checks."""
    found, of = group.found, group.of
    if group.placed.mirrored:
        if of == "control":
            yield remark("control_mirrored", chi2=group.placed.unmirrored, mirrored=found.statistic)
        return
    if found.exchanged:
        yield remark("given_exchanged", of=of, given=[group.names[k] for k in found.exchanged])
    if found.wrong:
        yield _left_out(group, task.unit)
    if found.doubtful:
        yield _doubtful(group)
    if group.rounded:
        sigma = float(np.sqrt(group.points.stated.max()))
        step, used = (sigma * np.sqrt(12), task.unit), (sigma, task.unit)
        yield remark("given_rounded", of=of, step=step, sigma=used)
    if task.datum.kind == "control":
        yield from _unchecked(of, group.names, group.placed.model, found.wrong)
    if found.factor == 1.0 or group.rounded or group.placed.model.estimated:
        return
    covariance = (task.network.control if of == "control" else task.network.exterior).covariance
    of_points = covariance[group.rows, :3, :3]
    if not of_points[np.isfinite(of_points)].any():
        yield remark("given_not_exact", of=of, sigma=(found.factor, task.unit))
    else:
        used_factor = found.factor if task.rescale else None
        yield remark("given_sigmas", of=of, factor=found.factor, used=used_factor)


def _left_out(group: _Group, unit: str) -> Remark:
    model, out = group.placed.model, group.out
    sizes = [np.linalg.norm(model.v[model.item == k]) for k in out]
    sigmas = np.sqrt(model.kept().decreases()[0][list(out)].max())
    return remark(
        "given_left_out",
        of=group.of,
        given=[group.names[k] for k in out],
        distance=(float(max(sizes)), unit),
        sigmas=float(sigmas),
    )


def _doubtful(group: _Group) -> Remark:
    found = group.found
    # they take part with the standard deviations that their differences show
    shift = float(_shifts(group.placed.model)[list(found.doubtful)].max())
    if group.points.stated.any():
        shift /= group.placed.model.factor()[0]
    return remark(
        "given_contradicted",
        of=group.of,
        given=[group.names[k] for k in found.doubtful],
        chi2=found.statistic,
        dof=found.dof,
        shift=shift if np.isfinite(shift) else None,
    )


def _unchecked(
    of: str, names: Sequence[str], model: GivenModel, without: tuple[int, ...] = ()
) -> Iterator[Remark]:
    """Yield remarks on given values of which nothing, or hardly anything, would find an error."""
    reach = model.external(without)
    nothing = [names[k] for k in np.flatnonzero(reach > UNCHECKED).tolist()]
    if nothing:
        yield remark("given_unchecked", given=nothing, of=of)
    for k in np.flatnonzero((reach > WRONG_SIGMAS) & (reach <= UNCHECKED)).tolist():
        yield remark("given_weakly_checked", given=names[k], of=of, sigmas=float(reach[k]))


def _judged_scales(task: _Task, groups: Sequence[_Group]) -> _Scales:
    """Judge the scales of bars and of dependable points against one another."""
    bars, places = task.network.scale_bars, task.places
    scales: list[GivenScale] = []
    names: list[str] = []
    lengths: list[_Length] = []
    for one in _lengths(bars):
        b = one.bars[0]
        ends = tuple(task.network.points[j] for j in (bars.start[b], bars.end[b]))
        at = [places.of_point.get(name, -1) for name in ends]
        if min(at) >= 0 and at[0] != at[1]:
            scales.append(scale_of_length(one.length, one.sigma, places.xyz, at[0], at[1]))
            given = f" ({significant(one.length)} {task.unit})" if one.contradicted else ""
            names.append(f"{ends[0]} - {ends[1]}{given}")
            lengths.append(one)
    for group in groups:
        found = _scale_of(task, group)
        if found is not None:
            scales.append(found)
            names.append(group.of)
    if not scales:
        return _Scales(bars)
    model = scale_model(tuple(scales), places.joint, places.redundancy)
    judgement = judge_values(model, task.level)
    tests = (GivenTest("scale", judgement.statistic, judgement.dof, judgement.probability),)
    if len(scales) == 1:
        return _Scales(bars, (remark("scale_unchecked", given=names[0]),), tests)
    if judgement.fits:
        return _Scales(bars, tuple(_unchecked("lengths", names, model)), tests)
    if judgement.factor != 1.0:
        used = judgement.factor if task.rescale else None
        said = remark("given_sigmas", of="bars", factor=judgement.factor, used=used)
        return _Scales(replace(bars, sigma=(used or 1.0) * bars.sigma), (said,), tests)
    out, remarks = _contradicting_scales(model, judgement, names, lengths)
    keep: BoolArray = np.ones(len(bars), dtype=bool)
    keep[out] = False
    kept = ScaleBars(bars.start[keep], bars.end[keep], bars.length[keep], bars.sigma[keep])
    return _Scales(kept, remarks, tests)


def _scale_of(task: _Task, group: _Group) -> GivenScale | None:
    """Return the scale by given points; by their distance where there are two."""
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
        return replace(found, variance=found.variance + PRINT_SIGMA**2)
    return found


def _contradicting_scales(
    model: GivenModel, judgement: Judgement, names: list[str], lengths: list[_Length]
) -> tuple[list[int], tuple[Remark, ...]]:
    """Return bars that the others identify as wrong, or all where nothing shows which are, and remarks."""
    wrong = judgement.wrong
    if wrong and max(wrong) < len(lengths):
        others = _mean_scale(model, [k for k in range(len(names)) if k not in wrong])
        sigmas = np.sqrt(model.kept().decreases()[0])
        off_of = {k: float(model.v[k]) - others for k in wrong}
        return [b for k in wrong for b in lengths[k].bars], tuple(
            remark(
                "bar_left_out",
                bar=names[k],
                off=(100 * float(np.expm1(off)), "%"),
                sigmas=float(sigmas[k]),
                unit_factor=_unit_factor(off),
            )
            for k, off in off_of.items()
        )
    # the control may be wrong by many bars that share their unit
    which = range(len(names)) if wrong or not judgement.doubtful else judgement.doubtful
    off = float(np.ptp(model.v[list(which)]))
    said = remark(
        "scale_contradicted",
        given=[names[k] for k in which],
        off=(100 * float(np.expm1(off)), "%"),
        sigmas=float(np.sqrt(judgement.statistic)),
        unit_factor=_unit_factor(off),
    )
    return [b for one in lengths for b in one.bars], (said,)


@dataclass(frozen=True)
class _Length:
    """A length between two points, given once or several times alike."""

    bars: tuple[int, ...]
    length: float  # mean by weights
    sigma: float  # of the best: to give it twice makes it no better
    contradicted: bool  # whether another length is given between the same points


def _lengths(bars: ScaleBars) -> list[_Length]:
    """Return the lengths that scale bars give, those between the same points once where they agree."""
    same: dict[frozenset[int], list[list[int]]] = {}
    for b in np.argsort(bars.length, kind="stable").tolist():
        alike = same.setdefault(frozenset((int(bars.start[b]), int(bars.end[b]))), [])
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


def _mean_scale(model: GivenModel, kept: list[int]) -> float:
    """Return the mean logarithm of scales by their stated standard deviations."""
    variance = np.diagonal(model.network + model.stated)[kept]
    weight = 1 / np.maximum(variance, np.finfo(float).tiny)
    return float(weight @ model.v[kept] / weight.sum())


def _unit_factor(log: float) -> float | None:
    """Return the factor between two units that a difference of scale is; None if it is none."""
    factor = float(np.exp(abs(log)))
    return next((one for one in UNIT_FACTORS if abs(factor / one - 1) < SAME_UNIT), None)


def _shifts(model: GivenModel) -> FloatArray:
    """Return the largest shift of what given values determine without each, in its standard deviations."""
    reach = model.external()
    found = np.sqrt(model.kept().decreases()[0]) * np.where(np.isfinite(reach), reach, 0.0) / NONCENTRALITY
    return np.where(np.isfinite(reach), found, np.inf)
