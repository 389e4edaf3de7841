"""Scale bars, control and observed projection centres, judged by the image points before they are used.

What contradicts is left out where the others identify it, and named; where they do not, nothing that it
touches is believed. The rest takes part in the adjustment.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from sfm.remarks.kind import significant
from sfm.remarks.remark import Remark, remark
from sfm.similarity import Similarity

UNIT_FACTORS = (10.0, 12.0, 25.4, 100.0, 304.8, 1000.0)  # between mm, cm, m, inch and foot
SAME_UNIT = 0.02  # relative difference up to which a factor is that of a unit; 10 and 12 are 0.2 apart
WEAK = 5.0  # standard deviations by which an error that no test finds may shift the result; it is wrong then
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
    return _Judge(network, places, datum, unit, rescale).judged()


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


@dataclass
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
    def out(self) -> tuple[int, ...]:
        """Those that were left out."""
        return self.placed.judgement.wrong

    @property
    def dependable(self) -> bool:
        """Whether a scale may rest on them."""
        return not (self.placed.mirrored or self.placed.judgement.doubtful)


class _Judge:
    """The given values of one network."""

    def __init__(self, network: Network, places: _Places, datum: Datum, unit: str, rescale: bool) -> None:
        self.network, self.places, self.datum, self.unit = network, places, datum, unit
        self.rescale = rescale
        self.remarks: list[Remark] = []
        self.tests: list[GivenTest] = []
        tests = (len(network.scale_bars) > 0, len(network.control) > 0, len(network.exterior) > 0)
        self.level = LEVEL / max(sum(tests), 1)

    def judged(self) -> JudgedGiven:
        """Judge points, then the scales of bars and points."""
        control, centres = self._control(), self._centres()
        self._scales(control, centres)
        placing = next(
            (one.placed.placing for one in (control, centres) if one and not one.placed.mirrored), None
        )
        return JudgedGiven(self.network, self.datum, tuple(self.remarks), tuple(self.tests), placing)

    def _control(self) -> _Group | None:
        """Judge control, and leave out or change what does not fit."""
        control = self.network.control
        names = [self.network.points[j] for j in control.point]
        group = self._group("control", names, self.places.of_point, control.xyz, control.covariance)
        if group is None:
            return None
        placed = group.placed
        if placed.mirrored:
            mirrored = placed.judgement.statistic
            self.remarks.append(remark("control_mirrored", chi2=placed.unmirrored, mirrored=mirrored))
            self.network = replace(self.network, control=ObjectPoints())
            if self.datum.kind == "control" and not len(self.network.exterior):
                self.datum = Datum("free")
            return group
        order, keep, covariance = self._as_judged(group, control.covariance)
        self.network = replace(
            self.network,
            control=ObjectPoints(control.point[keep], control.xyz[order][keep], covariance[keep]),
        )
        return group

    def _centres(self) -> _Group | None:
        """Judge observed projection centres, and leave out or change what does not fit."""
        seen = self.network.exterior
        names = [self.network.images[i] for i in seen.image]
        group = self._group("centres", names, self.places.of_image, seen.position, seen.covariance[:, :3, :3])
        if group is None or group.placed.mirrored:
            return None
        order, keep, of_centres = self._as_judged(group, seen.covariance[:, :3, :3])
        covariance = seen.covariance[order]
        covariance[:, :3, :3] = of_centres
        self.network = replace(
            self.network,
            exterior=ExteriorObservations(
                seen.image[keep], seen.position[order][keep], seen.angles[order][keep], covariance[keep]
            ),
        )
        return group

    def _group(
        self, of: str, names: Sequence[str], place_of: dict[str, int], xyz: FloatArray, covariance: FloatArray
    ) -> _Group | None:
        """Judge points of a kind against the free network, and remark what does not fit."""
        given = np.where(np.isfinite(np.einsum("nii->ni", covariance)), xyz, np.nan)
        placed_there = np.array([name in place_of for name in names], dtype=bool)
        rows = np.flatnonzero(placed_there & np.isfinite(given).any(axis=1))
        if not len(rows):
            return None
        index, coordinates = self.places.at([place_of[names[k]] for k in rows.tolist()])
        points = GivenPoints(
            given[rows],
            np.where(np.isfinite(covariance[rows]), covariance[rows], 0.0),
            self.places.xyz[index],
            self.places.joint[np.ix_(coordinates, coordinates)],
            self.places.redundancy,
        )
        in_datum = self.datum.kind == "control"
        fixed = not points.stated.any()
        start = Similarity(1.0, np.eye(3), np.zeros(3)) if in_datum else None
        placed = judge_points(points, self.level, start=start, estimated=fixed and not in_datum)
        if placed is None:
            return None
        group = _Group(of, rows, tuple(names[k] for k in rows.tolist()), points, index, placed)
        if fixed and in_datum and self.rescale and not placed.judgement.fits:
            group = self._rounded(group, start)
        found = group.placed.judgement
        self.tests.append(GivenTest(of, found.statistic, found.dof, found.probability))
        if found.factor != 1.0:
            stated = np.broadcast_to(np.eye(3), points.stated.shape) if fixed else points.stated
            points = replace(points, stated=found.factor**2 * stated)
            fitting = judge_points(points, self.level, start=start)
            placed = group.placed if fitting is None else replace(fitting, judgement=found)
            group = replace(group, points=points, placed=placed)
        if not group.placed.mirrored:
            self._remark_group(group)
        return group

    def _rounded(self, group: _Group, start: Similarity | None) -> _Group:
        """Judge fixed coordinates again, as precise as their decimals, where these explain the misfit."""
        points = group.points.rounded()
        placed = judge_points(points, self.level, start=start) if points.stated.any() else None
        if placed is None or placed.judgement.factor != 1.0 or placed.judgement.doubtful:
            return group
        return replace(group, points=points, placed=placed, rounded=True)

    def _remark_group(self, group: _Group) -> None:
        """Remark what does not fit of points, and what nothing checks."""
        found = group.placed.judgement
        if found.exchanged:
            names = [group.names[k] for k in found.exchanged]
            self.remarks.append(remark("given_exchanged", of=group.of, given=names))
        if found.wrong:
            self._left_out(group)
        if found.doubtful:
            self._doubtful(group)
        if group.rounded:
            sigma = float(np.sqrt(group.points.stated.max()))
            step, used = (sigma * np.sqrt(12), self.unit), (sigma, self.unit)
            self.remarks.append(remark("given_rounded", of=group.of, step=step, sigma=used))
        if self.datum.kind == "control":
            self._unchecked(group.of, group.names, group.placed.model, found.wrong)

    def _as_judged(self, group: _Group, covariance: FloatArray) -> tuple[IntArray, BoolArray, FloatArray]:
        """Return whose coordinates each given point has, which take part, and their covariance, (n, 3, 3)."""
        order, keep = np.arange(len(covariance)), np.ones(len(covariance), dtype=bool)
        found = group.placed.judgement
        if found.exchanged:
            pair = group.rows[list(found.exchanged)]
            order[pair] = pair[::-1]
        keep[group.rows[list(found.wrong)]] = False
        changed = covariance[order]
        changed[group.rows] = self._confirmed(group, changed[group.rows])
        return order, keep, changed

    def _left_out(self, group: _Group) -> None:
        model, out = group.placed.model, group.out
        sizes = [np.linalg.norm(model.v[model.item == k]) for k in out]
        sigmas = np.sqrt(model.kept().decreases()[0][list(out)].max())
        self.remarks.append(
            remark(
                "given_left_out",
                of=group.of,
                given=[group.names[k] for k in out],
                distance=(float(max(sizes)), self.unit),
                sigmas=float(sigmas),
            )
        )

    def _doubtful(self, group: _Group) -> None:
        found = group.placed.judgement
        # they take part with the standard deviations that their differences show
        shift = float(_shifts(group.placed.model)[list(found.doubtful)].max())
        if group.points.stated.any():
            shift /= group.placed.model.factor()[0]
        self.remarks.append(
            remark(
                "given_contradicted",
                of=group.of,
                given=[group.names[k] for k in found.doubtful],
                chi2=found.statistic,
                dof=found.dof,
                shift=shift if np.isfinite(shift) else None,
            )
        )

    def _unchecked(
        self, of: str, names: Sequence[str], model: GivenModel, without: tuple[int, ...] = ()
    ) -> None:
        """Remark given values of which nothing, or hardly anything, would find an error."""
        reach = model.external(without)
        nothing = [names[k] for k in np.flatnonzero(reach > UNCHECKED).tolist()]
        if nothing:
            self.remarks.append(remark("given_unchecked", given=nothing, of=of))
        for k in np.flatnonzero((reach > WEAK) & (reach <= UNCHECKED)).tolist():
            weak = remark("given_weakly_checked", given=names[k], of=of, sigmas=float(reach[k]))
            self.remarks.append(weak)

    def _confirmed(self, group: _Group, covariance: FloatArray) -> FloatArray:
        """Return the covariance of given points with which they fit, and remark if it is another one."""
        found, model = group.placed.judgement, group.placed.model
        known = np.isfinite(covariance)
        if group.rounded:
            return np.where(known, group.points.stated, covariance)
        if not (found.doubtful or found.factor != 1.0) or model.estimated:
            return covariance
        fixed = not np.where(known, covariance, 0.0).any()
        factor = model.factor()[0] if found.doubtful else found.factor
        if not found.doubtful and fixed:
            self.remarks.append(remark("given_not_exact", of=group.of, sigma=(factor, self.unit)))
        elif not found.doubtful:
            used = factor if self.rescale else None
            self.remarks.append(remark("given_sigmas", of=group.of, factor=factor, used=used))
        if fixed or not self.rescale:
            return covariance
        return np.where(known, factor**2 * covariance, covariance)

    def _scales(self, control: _Group | None, centres: _Group | None) -> None:
        """Judge the scales of bars, control and projection centres against one another."""
        bars, count = self.network.scale_bars, len(self.places.xyz)
        scales: list[GivenScale] = []
        names: list[str] = []
        lengths: list[_Length] = []
        for one in _lengths(bars):
            b = one.bars[0]
            ends = tuple(self.network.points[j] for j in (bars.start[b], bars.end[b]))
            at = [self.places.of_point.get(name, -1) for name in ends]
            if min(at) >= 0 and at[0] != at[1]:
                scales.append(scale_of_length(one.length, one.sigma, self.places.xyz, at[0], at[1]))
                given = f" ({significant(one.length)} {self.unit})" if one.contradicted else ""
                names.append(f"{ends[0]} - {ends[1]}{given}")
                lengths.append(one)
        for group in (control, centres):
            found = None if group is None else self._scale_of(group, count)
            if group is not None and found is not None:
                scales.append(found)
                names.append(group.of)
        if not scales:
            return
        model = scale_model(tuple(scales), self.places.joint, self.places.redundancy)
        judgement = judge_values(model, self.level)
        self.tests.append(GivenTest("scale", judgement.statistic, judgement.dof, judgement.probability))
        if len(scales) == 1:
            self.remarks.append(remark("scale_unchecked", given=names[0]))
        elif judgement.fits:
            self._unchecked("lengths", names, model)
        elif judgement.factor != 1.0:
            self._imprecise_bars(judgement.factor)
        else:
            self._contradicting_scales(model, judgement, names, lengths)

    def _scale_of(self, group: _Group, count: int) -> GivenScale | None:
        """Return the scale by given points; by their distance where there are two."""
        if not group.dependable:
            return None
        points, complete = group.points, group.points.complete
        if len(complete) == 2 and points.known.sum() == 6:
            apart = points.given[complete[1]] - points.given[complete[0]]
            length = float(np.linalg.norm(apart))
            if not length > 0:
                return None
            e = apart / length
            sigma = np.sqrt(e @ (points.stated[complete[0]] + points.stated[complete[1]]) @ e)
            at = group.places[complete]
            found = scale_of_length(length, float(sigma), self.places.xyz, int(at[0]), int(at[1]))
        elif len(complete) < 3 or group.placed.model.kept(group.out).dof < 0:
            return None
        else:
            found = scale_of_points(points, group.placed, group.out, group.places, count)
        if self.datum.kind != "control" and not points.stated.any():
            return replace(found, variance=found.variance + PRINT_SIGMA**2)
        return found

    def _imprecise_bars(self, factor: float) -> None:
        """Replace the standard deviations of bars that are too small."""
        used = factor if self.rescale else None
        self.remarks.append(remark("given_sigmas", of="bars", factor=factor, used=used))
        bars = self.network.scale_bars
        self.network = replace(self.network, scale_bars=replace(bars, sigma=(used or 1.0) * bars.sigma))

    def _contradicting_scales(
        self, model: GivenModel, judgement: Judgement, names: list[str], lengths: list[_Length]
    ) -> None:
        """Leave out bars that the others identify as wrong, or all where nothing shows which are wrong."""
        bars, wrong = self.network.scale_bars, judgement.wrong
        identified = bool(wrong) and max(wrong) < len(lengths)
        out = [b for one in ([lengths[k] for k in wrong] if identified else lengths) for b in one.bars]
        if identified:
            kept = [k for k in range(len(names)) if k not in wrong]
            others = _mean_scale(model, kept)
            for k in wrong:
                off, sigmas = float(model.v[k]) - others, float(np.sqrt(model.kept().decreases()[0][k]))
                self.remarks.append(
                    remark(
                        "bar_left_out",
                        bar=names[k],
                        off=(100 * float(np.expm1(off)), "%"),
                        sigmas=sigmas,
                        unit_factor=_unit_factor(off),
                    )
                )
        else:
            which = judgement.doubtful or tuple(range(len(names)))
            if wrong:  # the control, by many bars that may share their unit
                which = tuple(range(len(names)))
            off = float(np.ptp(model.v[list(which)]))
            self.remarks.append(
                remark(
                    "scale_contradicted",
                    given=[names[k] for k in which],
                    off=(100 * float(np.expm1(off)), "%"),
                    sigmas=float(np.sqrt(judgement.statistic)),
                    unit_factor=_unit_factor(off),
                )
            )
        keep: BoolArray = np.ones(len(bars), dtype=bool)
        keep[out] = False
        self.network = replace(
            self.network,
            scale_bars=ScaleBars(bars.start[keep], bars.end[keep], bars.length[keep], bars.sigma[keep]),
        )


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
