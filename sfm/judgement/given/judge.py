"""Tests of control, scale bars and projection centres against the image points, before they are used.

If the other values identify a contradicting value, it is left out and reported. If they do not, no value that
may be wrong is used. The rest takes part in the adjustment.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6 (tests).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sized
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.covariance import determines_cameras
from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.statistics import non_centrality
from sfm.judgement.given.free_network import FreeNetwork, confirmed, thinned
from sfm.judgement.given.groups import (
    GivenSettings,
    Group,
    Task,
    are_in_space,
    contradiction_of,
    in_free,
    remarks_on_unchecked,
)
from sfm.judgement.given.mistakes import explanations
from sfm.judgement.given.mounts import judge_mount_scales, judge_mounts
from sfm.judgement.given.points import GivenPoints, judge_points, parameters_of
from sfm.judgement.given.scales import judge_scales
from sfm.judgement.given.tables import Table, as_judged, judge_tables
from sfm.judgement.given.values import GivenModel
from sfm.judgement.survey_result import GivenTest
from sfm.model.conventions import BoolArray
from sfm.model.network import ExteriorObservations, Network, ObjectPoints, ScaleBars
from sfm.model.observations.kind import CoordinateKind
from sfm.model.observations.point_pairs import Distances
from sfm.model.observations.pose import MountObservations
from sfm.model.remarks.remark import Remark, remark
from sfm.model.similarity import Similarity


@dataclass(frozen=True)
class JudgedGiven:
    """Given values that may take part in the adjustment, and remarks on the rest."""

    network: Network
    datum: Datum
    remarks: tuple[Remark, ...] = ()
    tests: tuple[GivenTest, ...] = ()
    placing: Similarity | None = None
    """transformation from the free network to the object frame; None if nothing gives it"""
    checks_handedness: bool = False  # whether a mirrored network does not fit
    mounts: MountObservations | None = None  # mounts that may take part
    others_contradict: bool = False  # whether survey observations or mounts contradict others


def judge_given(
    network: Network,
    free: FreeNetwork | None,
    settings: GivenSettings,
    *,
    mounts: MountObservations | None = None,
    place: Callable[[Network], Similarity] | None = None,
) -> JudgedGiven:
    """Return the given values that may take part in an adjustment, and remarks on the others.

    Mounts are compared with the photographs, then control, bars and projection centres with the image points,
    then all other observations, and the lengths of mounts, with everything that was found right.

    Args:
        network: has all given values, except for the mounts.
        free: adjustment of its image points alone, or of some of them, in a free datum; None without one.
        settings: datum, unit, and how the values are judged.
        mounts: mounts of the cameras of rigs.
        place: gives the object frame from the frame of the free network, by all given values of a network.
    """
    of_mounts: tuple[Remark, ...] = ()
    if free is not None and mounts is not None and len(mounts):
        mounts, of_mounts = judge_mounts(mounts, free, settings.level)
    with_mounts = mounts is not None and len(mounts) > 0
    task = None if free is None else _task(network, free, settings)
    if not (len(network.scale_bars) or len(network.control) or len(network.exterior)):
        given = JudgedGiven(network, settings.datum)
    elif task is None or not len(task.reference.C) or not determines_cameras(task.reference.marginal):
        kinds = (("bars", network.scale_bars), ("control", network.control))
        of = [name for name, values in kinds if len(values)]
        remarks = (remark("given_not_judged", of=of),) if of else ()
        connects = settings.datum.kind == "control" and are_in_space(network.control.complete.xyz)
        given = JudgedGiven(network, settings.datum, remarks, checks_handedness=connects)
    else:
        checks = settings.checks_scale or with_mounts
        given = _judged(replace(task, settings=replace(settings, checks_scale=checks)))
    given = replace(given, remarks=(*of_mounts, *given.remarks), mounts=mounts)
    if not (network.further or with_mounts):
        return given
    if task is None or place is None or (given.datum.kind == "control" and not given.tests):
        unjudged = remark("given_not_judged", of=("observations",))
        return replace(given, remarks=(*given.remarks, unjudged))
    return _with_others(task, given, place)


def _task(network: Network, of_image_points: FreeNetwork, settings: GivenSettings) -> Task | None:
    """Return what is judged, with the free network; None if this does not determine the given points."""
    free = of_image_points.adjustment.network
    of_point, of_image = (
        np.array([number.get(name, -1) for name in names], dtype=np.int64)
        for names, number in (
            (network.points, {name: j for j, name in enumerate(free.points)}),
            (network.images, {name: i for i, name in enumerate(free.images)}),
        )
    )
    seen = network.exterior if settings.datum.kind == "control" else ExteriorObservations()
    kinds = [
        in_free(kind.select(thinned(len(kind))), of_point, of_image)[1]
        for kind in (network.control, seen, network.scale_bars)
    ]
    reference = of_image_points.reference_of(kinds)
    if reference is None:
        return None
    return Task(network, of_image_points, reference, of_point, of_image, settings)


def _with_others(task: Task, given: JudgedGiven, place: Callable[[Network], Similarity]) -> JudgedGiven:
    """Return the judged values with the survey observations and mounts that do not contradict others."""
    settings, network, mounts = task.settings, given.network, given.mounts
    in_control = given.datum.kind == "control"
    further = map(task.in_free, network.further)
    tables = [Table(kind, k, parts) for k, (parts, kind) in enumerate(further) if len(kind)]
    right = network if in_control else network.with_given(ObjectPoints(), ExteriorObservations())
    part = task.free.adjustment.network.with_given(
        task.in_free(right.control)[1],
        task.in_free(right.exterior)[1],
        task.in_free(right.scale_bars)[1],
        further=tuple(table.kind for table in tables),
    )
    kinds = [*confirmed(part), *part.further]
    reference = task.free.reference_of(kinds if mounts is None else [*kinds, mounts])
    if reference is None:
        return given
    settled = given.placing if in_control else None  # further observations do not change it
    place = place if settled is None else lambda _: settled
    wrong = judge_tables(tables, part, reference, place, settings.level)
    there, bars = task.in_free(network.scale_bars)
    if (
        not in_control
        and bars.is_one_scale
        and len({contradiction.kind for contradiction in wrong if contradiction.whole}) > 1
    ):
        # several kinds contradict the one scale that the bars have: which of them is wrong is open
        distances = Distances(bars.start, bars.end, bars.values, bars.sigma[:, None])
        table = Table(distances, len(network.further), there)
        part = part.with_given(ScaleBars())
        wrong = judge_tables([*tables, table], part, reference, place, settings.level)
        kept = [row for left in as_judged([table], wrong) for row in left.parts.tolist()]
        out = np.setdiff1d(there, kept)
        in_use = np.isin(np.arange(len(network.scale_bars)), out, invert=True)
        network = network.with_given(network.scale_bars.select(in_use))
        part = part.with_given(task.in_free(network.scale_bars)[1])
    part = part.with_given(further=tuple(table.kind for table in as_judged(tables, wrong)))
    of_mounts: tuple[Remark, ...] = ()
    if mounts is not None and len(mounts):
        mounts, of_mounts = judge_mount_scales(mounts, part, reference, place, settings.level)
    estimate = task.free.adjustment.estimate
    kinds = [*network.further, given.network.scale_bars]
    names = [kind.parts(network, estimate) for kind in kinds]
    every = [Table(kind, k, np.arange(len(names[k]))) for k, kind in enumerate(network.further)]
    observations = tuple(table.kind for table in as_judged(every, wrong))
    remarks = tuple(contradiction.remark(names) for contradiction in wrong) + of_mounts
    return replace(
        given,
        network=network.with_given(further=observations),
        remarks=given.remarks + remarks,
        mounts=mounts,
        others_contradict=bool(remarks),
    )


def _judged(task: Task) -> JudgedGiven:
    """Judge the given points, then the scales of bars and points."""
    network, datum = task.network, task.settings.datum
    seen = network.exterior if task.in_control else ExteriorObservations()
    tables: dict[str, CoordinateKind] = {"control": network.control, "centres": seen.of_positions}
    of_kinds = [_group(task, of, kind) for of, kind in tables.items()]
    groups = [group for group in of_kinds if group is not None]
    scales = judge_scales(task, [group for group in groups if group.dependable])
    used = [group for group in groups if not group.placed.mirrored and group.of not in scales.left_out]
    contradiction = contradiction_of(task, used)
    if contradiction is not None:
        used = []
    network = network.with_given(scales.bars)
    for group in groups:
        given = network.control if group.of == "control" else network.exterior
        judged = group.as_judged(given, rescale=task.settings.rescale, used=group in used)
        network = network.with_given(judged)
    if len(used) < len(groups) and not (len(network.control) or len(network.exterior)):
        datum = Datum("free")
    remarks = tuple(said for group in groups for said in _remarks_on(task, group)) + scales.remarks
    if contradiction is not None:
        remarks = (*remarks, contradiction)
    return JudgedGiven(
        network,
        datum,
        remarks,
        tuple(_with_count(group.test, tables[group.of]) for group in groups)
        + tuple(_with_count(test, task.network.scale_bars) for test in scales.tests),
        next((group.placed.placing for group in used), None),
        any(group.checks_handedness for group in groups),
    )


def _with_count(test: GivenTest, given: Sized) -> GivenTest:
    """Return a test with the number of given values that are judged, where these are only some."""
    judged = len(thinned(len(given)))
    return test if judged == len(given) else replace(test, judged=judged, given=len(given))


def _group(task: Task, of: str, kind: CoordinateKind) -> Group | None:
    """Judge the given points of a kind against the free network; None without any."""
    rows = thinned(len(kind))
    kind = kind.select(rows)
    names = kind.names(task.network, task.reference.marginal.adjustment.estimate)
    there, kind = task.in_free(kind)
    known: BoolArray = np.asarray(np.isfinite(kind.coordinates).any(axis=1))
    if not known.any():
        return None
    points, there = GivenPoints(kind.select(known), task.reference), there[known]
    in_datum = task.in_control
    fixed = not points.stated.any()
    start = Similarity(1.0, np.eye(3), np.zeros(3)) if in_datum else None
    placed = judge_points(points, task.level, start=start, estimated=fixed and not in_datum)
    if placed is None:
        return None
    group = Group(of, rows[there], tuple(names[k] for k in there.tolist()), placed)
    if fixed and in_datum and not (task.of_plate or placed.judgement.fits):
        group = _scattering(group, points, start, task)
    judgement = group.judgement
    if judgement.factor == 1.0:
        return group
    stated = np.broadcast_to(np.eye(3), points.stated.shape) if fixed else points.stated
    fitting = judge_points(points.with_stated(judgement.factor**2 * stated), task.level, start=start)
    return group if fitting is None else replace(group, placed=replace(fitting, judgement=judgement))


def _scattering(group: Group, points: GivenPoints, start: Similarity | None, task: Task) -> Group:
    """Judge fixed coordinates as values of unknown precision, if their scatter explains the misfit.

    No coordinate is exact. Single points are then wrong only if they exceed the scatter of the others, which
    does not depend on how many decimals the coordinates are written with.
    """
    placed = judge_points(points, task.level, start=start, estimated=True)
    if placed is None or placed.mirrored or placed.judgement.doubtful or not placed.judgement.explained:
        return group
    kept = ~np.isin(placed.model.item, placed.judgement.wrong)
    sigma = placed.model.part(kept).factor()[0]
    points = points.with_stated(np.broadcast_to(sigma**2 * np.eye(3), points.stated.shape))
    again = judge_points(points, task.level, start=start)
    if again is None or again.judgement.doubtful or again.judgement.wrong != placed.judgement.wrong:
        return group
    tested = group.judgement  # the test of the coordinates as they were given
    judgement = replace(
        again.judgement,
        factor=1.0,
        statistic=tested.statistic,
        dof=tested.dof,
        probability=tested.probability,
    )
    return replace(group, placed=replace(again, judgement=judgement), scatter=sigma)


def _remarks_on(task: Task, group: Group) -> Iterator[Remark]:
    """Yield the remarks on given points that do not fit, and on those that nothing checks."""
    judgement, of = group.judgement, group.of
    exchanged = [group.names[k] for k in group.placed.exchangeable] or None
    if group.placed.mirrored:
        yield remark(
            "given_mirrored",
            of=of,
            chi2=group.placed.unmirrored,
            mirrored=group.placed.model.kept(judgement.wrong).chi2,
            given=[group.names[k] for k in judgement.wrong] or None,
            exchanged=exchanged,
        )
        return
    if group.placed.renamed:
        yield remark("given_renamed", of=of, given=[group.names[k] for k in group.placed.renamed])
    if judgement.wrong:
        yield _left_out(task, group)
    if judgement.doubtful:
        yield _doubtful(task, group)
    if group.scatter:
        sigma, shift = (group.scatter, task.settings.unit), shift_of_fixed(group.placed.model, group.scatter)
        if task.settings.rescale:
            share = (100 * group.scatter / group.placed.model.extent, "%")
            yield remark("given_scatter", of=of, sigma=sigma, share=share, shift=shift)
        else:
            yield remark("given_not_exact", of=of, sigma=sigma, shift=shift)
    if task.in_control:
        yield from remarks_on_unchecked(of, group.names, group.placed.model, judgement.wrong, task.level)
    if judgement.factor == 1.0 or group.scatter or group.placed.model.estimated:
        return
    covariance = (task.network.control if of == "control" else task.network.exterior).covariance
    of_points = covariance[group.rows, :3, :3]
    if not of_points[np.isfinite(of_points)].any():
        shift = shift_of_fixed(group.placed.model, judgement.factor)
        yield remark("given_not_exact", of=of, sigma=(judgement.factor, task.settings.unit), shift=shift)
    else:
        used_factor = judgement.factor if task.settings.rescale else None
        yield remark("given_sigmas", of=of, factor=judgement.factor, used=used_factor)


def _left_out(task: Task, group: Group) -> Remark:
    """Return the remark on points that were left out, with the mistake whose correction makes them fit."""
    placed, model, out = group.placed, group.placed.model, group.judgement.wrong

    def fit(mended: list[CoordinateKind]) -> bool:
        points = replace(placed.points, kind=mended[0])
        return points.model(placed.placing, estimated=model.estimated).fits(task.level)

    kind = placed.points.kind
    mistakes = explanations([kind], fit, [kind.mistakes_at(np.array(out))])
    others = (model.kept(tuple(j for j in out if j != k)).difference(k) for k in out)
    d, covariance = max(others, key=lambda difference: float(np.linalg.norm(difference[0])))
    distance = float(np.linalg.norm(d))
    return remark(
        "given_left_out",
        of=group.of,
        given=[group.names[k] for k in out],
        distance=(distance, task.settings.unit),
        sigmas=distance**2 / float(np.sqrt(d @ covariance @ d)),
        mistake=next(iter(mistakes), None),
    )


def _doubtful(task: Task, group: Group) -> Remark:
    judgement, model, strain = group.judgement, group.placed.model, group.placed.strain
    if strain is not None:
        return remark(
            "given_strained",
            of=group.of,
            axis=strain.axis,
            elongation=(100 * strain.elongation, "%"),
            chi2=judgement.statistic,
            fitting=strain.chi2,
        )
    shift = np.inf
    if judgement.one_wrong:
        # the largest effect of one of them on the parameters, in their standard deviations
        reach = model.external()
        known = np.where(np.isfinite(reach), reach, 0.0)
        effect = np.sqrt(model.kept().decreases()[0]) * known / non_centrality()
        shift = float(np.where(np.isfinite(reach), effect, np.inf)[list(judgement.doubtful)].max())
        # they take part with standard deviations from their differences, if these may be replaced
        if task.settings.rescale and group.placed.points.stated.any() and model.at_worst.fits(task.level):
            shift /= model.factor()[0]
    return remark(
        "given_contradicted",
        of=group.of,
        given=[group.names[k] for k in judgement.doubtful],
        exchanged=[group.names[k] for k in group.placed.exchangeable] or None,
        chi2=judgement.statistic,
        dof=judgement.dof,
        shift=shift if np.isfinite(shift) else None,
    )


def shift_of_fixed(model: GivenModel, sigma: float) -> float:
    """Return the shift of coordinates by errors of points that are held fixed, in standard deviations.

    It is the standard deviation of the shift by the datum over that of the coordinate, at the given point
    where this ratio is largest. Sigma is the standard deviation of the errors.
    """
    fixed = replace(model, stated=np.zeros_like(model.stated), estimated=False)
    datum = model.A @ parameters_of(fixed, np.ones(len(model.v), dtype=bool))
    variance = np.diagonal(datum @ model.network @ datum.T) + np.diagonal(model.network)
    return float(sigma * np.sqrt(((datum**2).sum(axis=1) / variance).max()))
