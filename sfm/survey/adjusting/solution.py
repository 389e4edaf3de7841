"""The solution of a survey: matching and adjusting in turn, then the final adjustment in its datum."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.hypotheses.alternatives import explain_rejections
from sfm.adjustment.hypotheses.hypotheses import judge_alternatives
from sfm.adjustment.hypotheses.moved import bump_remarks
from sfm.adjustment.quality.correlations import estimate_error_correlation, with_neighbours
from sfm.adjustment.quality.given_values import GivenTest
from sfm.adjustment.quality.other_solutions import OtherSolution, other_solutions
from sfm.adjustment.quality.variance_components import least_factor
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.camera import base_name
from sfm.distortion.models import MODELS, Role
from sfm.errors import GeometryError
from sfm.network import Estimate, ExteriorObservations, Network, ScaleBars
from sfm.observations.pose import MountObservations
from sfm.orientation.incremental.starting_pair import pair_solutions
from sfm.reduced_network import MIN_IMAGE_POINTS, merge_estimate, reduce_network
from sfm.remarks.remark import Remark, remark
from sfm.result import ControlCheck, LeftOutPoint
from sfm.runtime.progress import report_step
from sfm.solution import NO_SCALE
from sfm.survey.adjusting.settling import (
    StableAdjustment,
    Task,
    adjust_finally,
    on_points,
    settle,
    settle_by_photograph,
)
from sfm.survey.adjusting.solution_remarks import (
    contradicted,
    handedness_unchecked,
    left_out_points,
    not_calibrated,
    remarks_on_solution,
    unused_image_points,
    windows_elsewhere,
)
from sfm.survey.correspondences import Correspondences
from sfm.survey.free_parameters import choose_free_parameters
from sfm.survey.hypotheses.given import JudgedGiven, judge_given, judge_mount_scales, judge_mounts
from sfm.survey.inputs.calibration import is_plate_control, plate_control, plate_family
from sfm.survey.inputs.cameras import split_cameras
from sfm.survey.inputs.measurements import Naming
from sfm.survey.inputs.settings import CameraSettings
from sfm.survey.inputs.start import given_values, with_given_mounts
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.tie_points import MIN_TIE_POINTS
from sfm.survey.observation_tables import find_gross, without_observations
from sfm.survey.placing import (
    MIN_CONTROL,
    hold_fixed,
    is_scaled,
    loosen_far,
    place_on_control,
    place_on_exterior,
    place_on_frame,
    place_on_observations,
    scale_to_bars,
)
from sfm.survey.rigs import hold_mounts, split_blocks
from sfm.targets.codes.plates import points_of_plates

OF_CAMERAS = ("other_camera", "two_cameras", "camera_varies", "camera_drift")
# Ratio of principal distances up to which photographs may differ by focusing, from far to about 15 c. Such a
# difference is reported. Free in each photograph it costs more than it cures where one of them determines it
# badly: halves of a video whose c differs by 2 % then differ by 4 % of the distance, before by 0.04 %.
MAX_FOCUS_CHANGE = 1.03
PAIR_TOLERANCE = 10.0  # standard deviations within which pairs of accepted image points fit an orientation
GIVEN_IMAGE_POINTS = 3  # of one whose given orientation decides which of the four solutions is meant


@dataclass(frozen=True)
class SolvedSurvey:
    """The final adjustment, and what happened on the way to it."""

    adjustment: Adjustment
    control_check: ControlCheck | None  # None without control or where the datum is control
    dropped_images: tuple[tuple[str, Remark], ...]  # photographs that lost their points, with the reason
    remarks: tuple[Remark, ...]
    left_out: tuple[LeftOutPoint, ...]  # measured points that are not in it
    unused_image_points: int  # of points and photographs that are not in it
    given_tests: tuple[GivenTest, ...]  # of control, bars and observed orientation against the image points
    others: tuple[OtherSolution, ...]  # that the image points allow as well


def solve_survey(survey: Survey, matched: Correspondences) -> SolvedSurvey:
    """Adjust the network in the datum of the survey, with rejection of outliers and full covariance.

    Points that keep too few rays and photographs that keep too few points leave the network, and the rest
    is adjusted again. A free network is placed on the scale bars and the control, where there are some,
    without changing its shape. Where the survey leaves to the photographs what is free, and texture shows
    that they were zoomed, c is adjusted per photograph.

    Args:
        survey: gives the datum, the a priori sigma and observed exterior orientation.
        matched: all image points, and approximate values of all that is to be adjusted.

    Raises:
        GeometryError: too little is left to adjust, or control is asked for and not seen.
    """
    found = _solution(survey, matched)
    varying = _varying(survey, found)
    if varying:
        report_step("adjusting c of each photograph")
        with suppress(GeometryError):
            zoomed = _solution(survey, matched, varying)
            a, focal = (
                zoomed.adjustment,
                [c for _, c, _ in _c_per_photograph(varying, zoomed.adjustment.estimate)],
            )
            differs = any(max(c) > MAX_FOCUS_CHANGE * min(c) for c in focal)  # more than by focusing
            if a.converged and not a.undetermined and differs:
                return zoomed
    return found


def _varying(survey: Survey, found: SolvedSurvey) -> frozenset[str]:
    """Return the cameras of which texture shows that c differs among their photographs."""
    differs = any(one.kind in OF_CAMERAS and "change" in one.numbers for one in found.remarks)
    if survey.tie_points is None or survey.rigs or not differs:
        return frozenset()
    return frozenset(one.name for one in survey.cameras if not one.states_free)


def _solution(
    survey: Survey, matched: Correspondences, varying: frozenset[str] = frozenset()
) -> SolvedSurvey:
    """Return the solution of a survey, with c of each photograph of some cameras."""
    start = _prepared(survey, matched, varying)
    free = _free_network(start)
    mounts, of_mounts = _judged_mounts(start, free)
    plates = _plates(survey, matched.naming, matched.network)
    task, given = _judged(start, free, plates, checks_scale=bool(len(mounts)))
    settled, gross = _settled(start, free, task, given, mounts)
    report_step("adjusting all observations")
    found, better = _best(start, settled)
    final, settled, whole = found.adjustment, found.settled, matched.network
    if survey.tie_points is not None:
        report_step("estimating the errors that neighbours have in common")
        final = with_neighbours(final)
    left_out = left_out_points(
        whole,
        final.network.points,
        reasons=matched.point_failures,
        accepted_rays=settled.rays,
        needed=matched.min_rays,
    )
    known = set(np.array(whole.points, dtype=object)[start.estimate.determined])
    # natural texture has points in plenty, of which only those that were lost on the way are worth a line
    listed = left_out if survey.tie_points is None else tuple(one for one in left_out if one.point in known)
    unit = survey.unit if final.has_scale else NO_SCALE
    report_step("testing the assumptions")
    plates = _plates(survey, matched.naming, final.network)
    judged = judge_alternatives(final, unit=unit, bodies=plates)
    return SolvedSurvey(
        final,
        found.check,
        _dropped(start, settled),
        (
            *start.remarks,
            *(() if settled.per_photograph is None else settled.per_photograph.remarks),
            *of_mounts,
            *given.remarks,
            *gross,
            *better,
            *settled.held,
            *(
                remark("c_per_photograph", camera=name, least=(min(c), unit), most=(max(c), unit))
                for name, c, unit in _c_per_photograph(varying, final.estimate)
            ),
            *remarks_on_solution(start.task.survey, listed, len(whole.points), final),
            *not_calibrated(survey, final.estimate),
            *handedness_unchecked(survey, checked=given.checks_handedness),
            *windows_elsewhere(survey, judged.causes),
            *judged.unchecked,
            *bump_remarks(final, unit),
            *windows_elsewhere(survey, explain_rejections(final, unit=unit, bodies=plates)),
            *contradicted(found.c_held, judged.causes),
        ),
        left_out,
        unused_image_points(whole, settled.images, np.isin(whole.points, final.network.points)),
        given.tests,
        found.others,
    )


def _plates(survey: Survey, naming: Naming | None, network: Network) -> tuple[tuple[str, ...], ...]:
    """Return the names of the points of each plate; none without plates."""
    if naming is None:
        return ()
    plates = points_of_plates(survey.family, naming.codes(network))
    return tuple(tuple(network.points[j] for j in one) for one in plates)


@dataclass(frozen=True)
class _Prepared:
    """The network before its adjustment, with its cameras and what is known of its datum."""

    task: Task  # with all that was given, which is not judged yet
    estimate: Estimate
    frame: Estimate | None  # given coordinates, which carry a free datum; None without
    remarks: tuple[Remark, ...]  # on observed exterior orientation, and which parameters were freed


@dataclass(frozen=True)
class _Final:
    """A last adjustment and what it was settled from."""

    settled: StableAdjustment
    adjustment: Adjustment  # with the iterations of all adjustments on the way
    check: ControlCheck | None
    c_held: tuple[str, ...]  # cameras whose c was to be free and had to be held
    others: tuple[OtherSolution, ...]


def _prepared(survey: Survey, matched: Correspondences, varying: frozenset[str]) -> _Prepared:
    """Bring network and approximate values into the frame and cameras that the survey asks for.

    Args:
        survey: asks for them.
        matched: network and approximate values.
        varying: names of the cameras of which every photograph has c by itself, where it is adjusted.
    """
    network, estimate = matched.network, matched.estimate
    tables = tuple(one for one in network.observations if not isinstance(one, MountObservations))
    network = replace(network, observations=tables)  # mounts take part as far as photographs confirm them
    datum = survey.datum.kind
    unused: tuple[Remark, ...] = ()
    if survey.exterior is not None and datum == "control":
        estimate = place_on_exterior(network, estimate)
    elif survey.exterior is not None:
        unused = (remark("exterior_unused", datum=datum),)
    report_step("choosing the free parameters of the cameras")
    if datum == "control" and len(network.control) == len(network.exterior) == 0:
        raise GeometryError("datum 'control', but no control point was measured")
    if datum == "minimal" and matched.given:  # it holds the given coordinates fixed
        given = given_values(survey, network)
        held = np.where(given.determined[:, None], given.points, estimate.points)
        estimate = replace(estimate, points=np.where(estimate.determined[:, None], held, np.nan))
    frame = given_values(survey, network) if matched.given else None
    chosen = choose_free_parameters(
        survey, replace(network, scale_bars=ScaleBars(), observations=()), estimate, datum=datum
    )
    cameras = tuple(_with_c_per_photograph(one) if one.name in varying else one for one in chosen.cameras)
    survey, estimate = replace(survey, cameras=cameras), chosen.estimate
    network, estimate = split_cameras(survey.cameras, network, estimate, survey.start_cameras)
    network, estimate = split_blocks(survey, network, estimate)
    fewest = MIN_IMAGE_POINTS if survey.tie_points is None else MIN_TIE_POINTS
    least = np.where(given_values(survey, network).oriented, GIVEN_IMAGE_POINTS, fewest)
    if network.moment is not None:  # the other photographs of a moment determine its pose
        shared = np.bincount(network.moment, weights=estimate.oriented)[network.moment] > 1
        least = np.where(shared, 1, least)
    return _Prepared(
        Task(survey, network, matched.min_rays, least, matched.suspected),
        estimate,
        frame,
        (*unused, *chosen.remarks),
    )


def _with_c_per_photograph(settings: CameraSettings) -> CameraSettings:
    """Return the settings with c per photograph, if it is adjusted."""
    focal = tuple(one.name for one in MODELS[settings.model].parameters if one.role is Role.FOCAL)
    if not set(focal) <= set(settings.free):
        return settings
    return settings.model_copy(update={"per_photograph": focal})


def _free_network(start: _Prepared) -> StableAdjustment | None:
    """Adjust the image points alone: nothing that was given bends their network, or costs one of them.

    Returns:
        The network; None for a plate that looks alike turned, whose points have no identity without it, and
        for image points that control may connect and calibrate, as they do not by themselves.

    Raises:
        GeometryError: they do not make a network by themselves, and there is no control.
    """
    task, estimate = start.task, start.estimate
    if _has_no_identity(task.survey):
        return None
    report_step("adjusting the image points alone")
    network = replace(task.network, scale_bars=ScaleBars(), exterior=ExteriorObservations(), observations=())
    try:
        return settle_by_photograph(replace(task.in_free_datum, network=network), estimate)
    except GeometryError:
        if task.datum.kind != "control":
            raise
        return None


def _has_no_identity(survey: Survey) -> bool:
    """Return whether points are on a plate that looks alike turned: they are no points without it."""
    plate = plate_family(survey.targets)
    return plate is not None and plate.is_ambiguous


def _judged_mounts(
    start: _Prepared, free: StableAdjustment | None
) -> tuple[MountObservations, tuple[Remark, ...]]:
    """Return the given mounts that the image points confirm, and remarks on the others."""
    mounts = start.task.survey.given_mounts
    if free is None or free.held or not len(mounts):
        return mounts, ()
    report_step("testing the given mounts")
    return judge_mounts(mounts, free.adjustment)


def _judged(
    start: _Prepared,
    free: StableAdjustment | None,
    plates: tuple[tuple[str, ...], ...],
    *,
    checks_scale: bool,
) -> tuple[Task, JudgedGiven]:
    """Return the task with what was given, as on plates, as far as the image points confirm it."""
    task = start.task
    network = task.network
    if free is not None:  # with per-photograph cameras, if there are
        network = replace(
            free.task.network,
            control=network.control,
            scale_bars=network.scale_bars,
            exterior=network.exterior,
            observations=network.observations,
        )
    if _has_no_identity(task.survey):
        return task, JudgedGiven(network, task.datum)
    report_step("testing the given values")
    # a camera that had to be held, at whatever value it started from, gives the network a wrong shape
    adjustment = None if free is None or free.held else free.adjustment
    given_any = len(network.control) or len(network.scale_bars) or len(network.exterior)
    if adjustment is not None and task.survey.tie_points is not None and given_any:
        adjustment = replace(adjustment, error_correlation=estimate_error_correlation(adjustment))
    plate = plate_control(task.survey.targets)
    given = judge_given(
        network,
        adjustment,
        task.datum,
        unit=task.survey.unit,
        rescale=task.survey.adjust.weights == "components",
        plates=plates if is_plate_control(task.survey.control, plate) else (),
        checks_scale=checks_scale,
    )
    needed = task.needed.copy()
    if given.datum.kind == "control":
        needed[given.network.control.complete.point] = 1
    else:
        task = task.in_free_datum
    return replace(task, network=given.network, needed=needed), given


def _settled(
    start: _Prepared,
    free: StableAdjustment | None,
    task: Task,
    given: JudgedGiven,
    mounts: MountObservations,
) -> tuple[StableAdjustment, tuple[Remark, ...]]:
    """Adjust the image points and what was given together.

    Args:
        start: network and approximate values.
        free: the image points adjusted alone.
        task: with what was given, as far as the image points confirm it.
        given: judged.
        mounts: given ones that the image points confirm.

    Returns:
        The adjustment, and remarks on observations of tables and mounts that were left out.
    """
    if free is not None and task.survey.adjust.weights == "components":
        alone = free.adjustment
        if alone.redundancy > 0:  # else there is only what was stated
            factor = float(np.clip(alone.sigma0, least_factor(alone.stated_px), 1.0))
            task = replace(task, factor=factor)
    if not given.tests and task.datum.kind == "control":
        free = None  # what they give alone is no start either, nor are the cameras that it gave photographs
        task = replace(task, network=replace(task.network, camera=start.task.network.camera))
    estimate = start.estimate
    if free is not None:
        estimate = _completed(estimate, free.whole, task, given)
    estimate = scale_to_bars(task.network, estimate, task.datum)
    gross: tuple[Remark, ...] = ()
    if task.network.observations and free is not None:
        task, gross = _without_gross(task, free, estimate)
        if gross and task.datum.kind != "control":
            estimate = place_on_observations(task.network, estimate)
    if task.datum.kind == "control":
        estimate = hold_fixed(task.network, estimate)
    if len(mounts):
        task, estimate, of_mounts = _with_mounts(task, estimate, free, mounts)
        gross += of_mounts
    if free is None:
        return settle_by_photograph(task, estimate), gross
    if task.datum.kind != "control" and not is_scaled(task.network, estimate):
        return _with_given(replace(free, task=task)), gross
    settled = settle(task, estimate, free.accepted).after(free)
    return replace(settled, held=settled.held or free.held), gross


def _with_mounts(
    task: Task, estimate: Estimate, free: StableAdjustment | None, mounts: MountObservations
) -> tuple[Task, Estimate, tuple[Remark, ...]]:
    """Return the task and start values with given mounts, if their scale agrees with that of all else."""
    kinds = (("bars", task.network.scale_bars), ("control", task.network.control))
    others = [name for name, some in kinds if len(some) and (name == "bars" or task.datum.kind == name)]
    others += [one.name for one in task.network.observations]
    said: tuple[Remark, ...] = ()
    if free is not None and not free.held:
        without = free.adjustment
        if others:
            with suppress(GeometryError):  # nothing else gives a scale that these others need
                without = settle(task, estimate, free.accepted).adjustment
        mounts, said = judge_mount_scales(mounts, without, others)
    scaled = task.datum.kind == "control" or len(task.network.scale_bars) > 0
    estimate = hold_mounts(estimate, mounts, scaled=scaled)
    network = with_given_mounts(mounts, task.network)
    if task.network.observations and task.datum.kind != "control":
        estimate = place_on_observations(task.network, estimate)
    return replace(task, network=network), estimate, said


def _best(start: _Prepared, settled: StableAdjustment) -> tuple[_Final, tuple[Remark, ...]]:
    """Return the last adjustment, and a remark where it starts from a solution of smaller v'Pv."""
    found = _final(start, settled)
    if not found.others or not found.others[0].converges:
        return found, ()
    other = found.others[0]
    estimate = merge_estimate(other.estimate, settled.images, settled.points)
    again = _final(start, settle(settled.task, estimate).after(settled), before=found.adjustment)
    if not again.adjustment.converged:  # what seemed better is no solution
        return found, ()
    return again, (_better_taken(found.adjustment, other),)


def _final(start: _Prepared, settled: StableAdjustment, *, before: Adjustment | None = None) -> _Final:
    """Return the last adjustment of a settled network, and the other solutions that its image points allow.

    Args:
        start: network, frame and approximate values.
        settled: adjusted so that nothing leaves it any more.
        before: solution that was left for this one.
    """
    final, check = _placed(start, settled)
    final = replace(
        final, iterations=settled.iterations + final.iterations, start_sigma0=settled.start_sigma0
    )
    # c that had to be held was not estimated: what its other values give is another solution
    asked = {one.name for one in start.estimate.cameras if one.free[0]}
    c_held = tuple(one.name for one in final.estimate.cameras if one.name in asked and not one.free[0])
    report_step("looking for other solutions")
    starts = _of_pair(final)
    if before is not None and len(before.network.points) == len(final.network.points):
        starts = (*starts, before.estimate)
    return _Final(settled, final, check, c_held, other_solutions(final, starts=starts, had_to_be_held=c_held))


def _without_gross(
    task: Task, settled: StableAdjustment, estimate: Estimate
) -> tuple[Task, tuple[Remark, ...]]:
    """Return the task without observations of tables that contradict all others, by the settled network."""

    def adjusted(part: Network) -> Adjustment:
        free = task.datum.kind != "control"
        placed = place_on_observations(part, start) if free else start  # wrong observations turn it
        datum = on_points(task, part, placed)
        loose = loosen_far(part, placed)
        return adjust(loose, placed, datum=datum, reject="none", image_sigma_factor=task.factor)

    part, start = reduce_network(task.network, estimate, settled.images, settled.points, settled.accepted)
    gross = find_gross(part, adjusted)
    wrong, whole = {one.kind: one.names for one in gross}, {one.kind for one in gross if one.whole}
    remarks = tuple(
        remark("kind_wrong", of=one.kind, mistake=one.mistake)
        if one.whole
        else remark("observations_wrong", observations=one.names, mistake=one.mistake)
        for one in gross
    )
    return replace(task, network=without_observations(task.network, estimate, wrong, whole)), remarks


def _completed(before: Estimate, found: Estimate, task: Task, given: JudgedGiven) -> Estimate:
    """Return the free network in the frame of what was given, with what it had to leave out where it was."""
    if given.placing is not None and task.datum.kind == "control":
        found = given.placing.apply_estimate(found)
    elif task.datum.kind == "control":
        return replace(before, cameras=found.cameras)  # with per-photograph cameras, if there are
    lost = task.needed == 1  # control that one photograph sees is determined by its coordinates
    points = np.where((lost & ~found.determined)[:, None], before.points, found.points)
    return replace(found, points=points)


def _with_given(settled: StableAdjustment) -> StableAdjustment:
    """Return an adjustment with the network of its task, which has what was given beside the image points."""
    network = settled.task.network
    every = np.ones(len(network.image_points), dtype=bool)
    part, _ = reduce_network(network, settled.whole, settled.images, settled.points, every)
    return replace(settled, adjustment=replace(settled.adjustment, network=part))


def _of_pair(final: Adjustment) -> tuple[Estimate, ...]:
    """Return the solutions that the image points of two photographs allow; control decides by itself."""
    if len(final.network.images) > 2 or final.datum == "control":
        return ()
    accepted = replace(final.network, image_points=final.network.image_points.select(~final.rejected))
    return pair_solutions(
        accepted, final.estimate, tolerance_px=PAIR_TOLERANCE * max(final.sigma0, 1.0) * final.sigma_px
    )


def _placed(start: _Prepared, settled: StableAdjustment) -> tuple[Adjustment, ControlCheck | None]:
    """Return the final adjustment of a settled network, placed on control or on the frame of its datum."""
    task, last, check = settled.task, settled.estimate, None
    if task.datum.kind != "control" and len(settled.part.control.complete) >= MIN_CONTROL:
        last, check = place_on_control(settled.part, last)
    elif task.datum.kind == "free":
        carriers = on_points(task, settled.part, last).resolve(settled.part).points
        every = np.ones(len(start.task.network.image_points), dtype=bool)
        values = start.frame
        if values is None:
            values = scale_to_bars(task.network, start.estimate, task.datum)
        frame = reduce_network(start.task.network, values, settled.images, settled.points, every)[1]
        last = place_on_frame(settled.part, last, frame, carriers)
    return adjust_finally(task, settled.part, last, settled.rejected), check


def _dropped(start: _Prepared, settled: StableAdjustment) -> tuple[tuple[str, Remark], ...]:
    """Return the photographs that had an orientation and are not in the result, with the reason."""
    reasons = {} if settled.per_photograph is None else dict(settled.per_photograph.left_out)
    task = start.task
    return tuple(
        (name, reasons.get(name, remark("photograph_with_few_accepted", needed=int(fewest))))
        for name, was, is_in, fewest in zip(
            task.network.images, start.estimate.oriented, settled.images, task.least, strict=True
        )
        if was and not is_in
    )


def _better_taken(final: Adjustment, other: OtherSolution) -> Remark:
    """Return the remark that the network was adjusted anew from a solution of smaller v'Pv."""
    first = final.estimate.cameras[[one.name for one in final.estimate.cameras].index(other.camera)]
    return remark(
        "better_solution_taken",
        camera=other.camera,
        first=(first.parameters[0], other.unit),
        better=(other.c, other.unit),
        vPv=other.vPv,
    )


def _c_per_photograph(varying: frozenset[str], estimate: Estimate) -> Iterator[tuple[str, list[float], str]]:
    """Yield the name of each camera of which every photograph has c by itself, these c, and their unit."""
    for name in sorted(varying):
        cameras = [
            one for one in estimate.cameras if one.name != name and base_name(one.name, [name]) == name
        ]
        if cameras:
            yield name, [float(one.parameters[0]) for one in cameras], cameras[0].units[0]
