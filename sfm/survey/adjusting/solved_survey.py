"""The solution of a survey: its adjustment in the datum, with the given values that image points confirm.

The image points are adjusted alone first. This free network judges control, scale bars, mounts and other
given values. Then all observations are adjusted together, from the best of several solutions. Finally the
assumptions are tested.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.correlations import estimate_error_correlation, with_neighbours
from sfm.adjustment.quality.other_solutions import OtherSolution, other_solutions
from sfm.adjustment.quality.variance_components import least_factor
from sfm.adjustment.result import Adjustment
from sfm.judgement.given.free_network import FreeNetwork
from sfm.judgement.given.groups import GivenSettings
from sfm.judgement.given.judge import JudgedGiven, judge_given
from sfm.judgement.hypotheses.bumps import bump_remarks
from sfm.judgement.hypotheses.hypotheses import judge_alternatives
from sfm.judgement.hypotheses.rejections import explain_rejections
from sfm.judgement.model_choice import Choice, choose
from sfm.judgement.survey_result import ControlCheck, GivenTest, LeftOutPoint
from sfm.model.conventions import BoolArray, IntArray
from sfm.model.distortion.models import MODELS, Role
from sfm.model.distributions import normal_ppf
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.likelihood import areas_of_photographs, log_likelihood
from sfm.model.network import ExteriorObservations, Network, ScaleBars
from sfm.model.observations.pose import MountObservations
from sfm.model.reduced_network import merge_estimate, reduce_network
from sfm.model.remarks.remark import Remark, remark
from sfm.model.similarity import Similarity, fit_similarity
from sfm.model.solution import NO_SCALE
from sfm.orientation.incremental.starting_pair import pair_solutions
from sfm.runtime.progress import report_step
from sfm.survey.adjusting.settling import (
    StableAdjustment,
    Task,
    accepted_image_points,
    adjust_finally,
    on_points,
    settle,
    settle_by_photograph,
)
from sfm.survey.adjusting.solution_remarks import (
    handedness_unchecked,
    left_out_points,
    posed_by_rigs,
    remarks_on_held_c,
    remarks_on_solution,
    remarks_on_uncalibrated,
    unused_image_points,
    windows_elsewhere,
)
from sfm.survey.free_parameters import choose_free_parameters
from sfm.survey.inputs.calibration import is_plate_control, plate_control, plate_family
from sfm.survey.inputs.cameras import split_cameras
from sfm.survey.inputs.start import given_values, with_given_mounts
from sfm.survey.inputs.survey import Survey
from sfm.survey.placing import (
    MIN_CONTROL,
    hold_fixed,
    is_scaled,
    place_on_control,
    place_on_exterior,
    place_on_frame,
    place_on_observations,
    scale_sigma,
    scale_to_bars,
)
from sfm.survey.rigs import hold_mounts, split_blocks
from sfm.survey.sources.source import Correspondences
from sfm.targets.codes.plates import points_of_plates

GIVEN_IMAGE_POINTS = 3  # of a photograph with given orientation, which selects one of the four solutions


@dataclass(frozen=True)
class SurveyModel:
    """What is adjusted."""

    survey: Survey
    matched: Correspondences
    varying: frozenset[str] = frozenset()  # names of the cameras with c per photograph, if c is adjusted
    left_out: tuple[tuple[str, Remark], ...] = ()  # photographs left out of the matched ones, with the reason
    # moments that the survey states, (m,); photographs with others in the network are free of their rig; None
    # if none is free
    stated_moment: IntArray | None = None
    moved: tuple[Remark, ...] = ()  # on points of which the image points of one state are left out
    unused: int = 0  # image points of the other states, which the matched ones lack


@dataclass(frozen=True)
class SolvedSurvey:
    """The final adjustment of a survey, with its tests and everything that was left out."""

    model: SurveyModel
    adjustment: Adjustment
    accepted: BoolArray  # image points of the matched network that the adjustment accepted, (k,)
    control_check: ControlCheck | None  # None without control, or if the datum is control
    dropped_images: tuple[tuple[str, Remark], ...]  # photographs that lost their points, with the reason
    remarks: tuple[Remark, ...]
    left_out: tuple[LeftOutPoint, ...]  # measured points that are not in the adjustment
    unused_image_points: int  # of points and photographs that are not in the adjustment
    given_tests: tuple[GivenTest, ...]  # of control, bars and observed orientation against the image points
    others: tuple[OtherSolution, ...]  # other solutions that the image points allow


def solve_model(model: SurveyModel) -> SolvedSurvey:
    """Return the solution of a model of a survey.

    Raises:
        GeometryError: too little is left to adjust, or the datum is control but no control is seen.
    """
    survey, matched = model.survey, model.matched
    start = _prepare(survey, matched, model.varying)
    free = _free_network(start)
    of_plates = points_of_plates(survey.family, matched.naming.codes(matched.network))
    plates = tuple(tuple(matched.network.points[j] for j in rows) for rows in of_plates)
    task, given = _with_confirmed_values(start, free, plates)
    settled = _settle_with_given(start, free, task, given)
    report_step("adjusting all observations")
    finished = _finish_from_best_start(start, settled)
    final, settled, network = finished.adjustment, finished.settled, matched.network
    if network.has_common_errors:
        report_step("estimating the errors that neighbours have in common")
        final = with_neighbours(final)
    left_out = left_out_points(
        network,
        final.network.points,
        reasons=matched.point_failures,
        accepted_rays=settled.rays,
        needed=matched.min_rays,
    )
    # Natural texture has very many points; only those that had approximate values are worth a line.
    known = set(np.array(network.points, dtype=object)[start.estimate.determined | network.named])
    listed = tuple(point for point in left_out if point.point in known)
    unit = survey.unit if final.has_scale else NO_SCALE
    stated = None if model.stated_moment is None else model.stated_moment[settled.images]
    of_photographs = () if settled.per_photograph is None else settled.per_photograph.remarks
    report_step("testing the assumptions")
    judged = judge_alternatives(final, unit=unit)
    return SolvedSurvey(
        model,
        final,
        accepted_image_points(network, final, settled.images, settled.points),
        finished.check,
        (*model.left_out, *_dropped_photographs(start, settled)),
        (
            *start.remarks,
            *of_photographs,
            *given.remarks,
            *finished.remarks,
            *settled.held,
            *remarks_on_solution(start.task.survey, listed, network, final),
            *posed_by_rigs(final, start.of_its_own[settled.images]),
            *remarks_on_uncalibrated(survey, final.estimate),
            *handedness_unchecked(network, checked=given.checks_handedness),
            *windows_elsewhere(network, (*judged.causes, *explain_rejections(final, unit=unit))),
            *model.moved,
            *judged.unchecked,
            *bump_remarks(final, unit, stated),
            *remarks_on_held_c(finished.c_held, judged.causes),
        ),
        left_out,
        model.unused
        + unused_image_points(network, settled.images, np.isin(network.points, final.network.points)),
        given.tests,
        finished.others,
    )


@dataclass(frozen=True)
class _Prepared:
    """The network before its adjustment, with its cameras and datum."""

    task: Task  # with all given values, which are not judged yet
    estimate: Estimate
    of_its_own: IntArray  # image points that each photograph would need without its rig, (m,)
    frame: Estimate | None  # given coordinates that carry a free datum; None without any
    remarks: tuple[Remark, ...]  # on observed exterior orientation and on freed parameters
    accepted: BoolArray | None = None  # image points without gross errors so far, (k,); None if not known


def log_likelihood_of_all(
    a: Adjustment, network: Network, estimate: Estimate, accepted: BoolArray, freed: int = 0
) -> float:
    """Return ln of the likelihood of all image points of a survey; those outside the adjustment are misfits.

    Args:
        a: adjustment of a part of the network.
        network: the whole network.
        estimate: has the cameras of its photographs.
        accepted: image points of the whole network that the adjustment accepted, (k,).
        freed: number of unknowns that adjustments it is compared with lack.
    """
    areas = areas_of_photographs(network, estimate.cameras)
    squares = a.sigma0_px**2 * a.redundancy
    redundancy = a.redundancy + freed
    return log_likelihood(squares, accepted, areas, redundancy=redundancy, share=network.share)


@dataclass(frozen=True)
class _Final:
    """A final adjustment, and the repeated adjustment before it."""

    settled: StableAdjustment
    adjustment: Adjustment  # with the iterations of all adjustments before it
    check: ControlCheck | None
    c_held: tuple[str, ...]  # cameras whose c should be free but had to be held
    others: tuple[OtherSolution, ...]
    remarks: tuple[Remark, ...] = ()  # on its start values

    @property
    def log_likelihood(self) -> float:
        """Ln of the likelihood of all image points, of which those outside the adjustment are misfits."""
        a, settled = self.adjustment, self.settled
        network = settled.task.network
        accepted = accepted_image_points(network, a, settled.images, settled.points)
        return log_likelihood_of_all(a, network, settled.whole, accepted)


def _prepare(survey: Survey, matched: Correspondences, varying: frozenset[str]) -> _Prepared:
    """Bring network and approximate values into the frame and cameras of the survey.

    varying: names of the cameras with c per photograph, if c is adjusted.
    """
    network, estimate = matched.network, matched.estimate
    tables = tuple(kind for kind in network.further if not isinstance(kind, MountObservations))
    network = network.with_given(further=tables)  # mounts only take part if photographs confirm them
    datum = survey.datum.kind
    unused: tuple[Remark, ...] = ()
    if survey.exterior is not None and datum == "control":
        estimate = place_on_exterior(network, estimate)
    elif survey.exterior is not None:
        unused = (remark("exterior_unused", datum=datum),)
    report_step("choosing the free parameters of the cameras")
    if datum == "control" and len(network.control) == len(network.exterior) == 0:
        raise GeometryError("datum 'control', but no control point was measured")
    if datum == "minimal" and matched.given:  # this datum holds the given coordinates fixed
        given = given_values(survey, network)
        held = np.where(given.determined[:, None], given.points, estimate.points)
        estimate = replace(estimate, points=np.where(estimate.determined[:, None], held, np.nan))
    frame = given_values(survey, network) if matched.given else None
    chosen = choose_free_parameters(
        survey, network.with_given(ScaleBars(), further=()), estimate, datum=datum
    )
    cameras = []
    for settings in chosen.cameras:
        focal = MODELS[settings.model].names_of(Role.FOCAL)
        varies = settings.name in varying and set(focal) <= set(settings.free)  # c per photograph
        cameras.append(settings.model_copy(update={"per_photograph": focal}) if varies else settings)
    survey, estimate = replace(survey, cameras=tuple(cameras)), chosen.estimate
    network, estimate = split_cameras(survey.cameras, network, estimate, survey.start_cameras)
    network, estimate = split_blocks(survey, network, estimate)
    # how many image points each photograph needs: those of a source that gives it enough
    needed = np.full(len(network.images), max(source.fewest for source in network.sources))
    for k, source in enumerate(network.sources):
        count = np.bincount(network.image_points.image[network.source == k], minlength=len(needed))
        needed = np.where(count >= source.fewest, np.minimum(needed, source.fewest), needed)
    least = np.where(given_values(survey, network).oriented, GIVEN_IMAGE_POINTS, needed)
    of_its_own = least
    if network.moment is not None:  # the other photographs of a moment determine its pose
        shared = np.bincount(network.moment, weights=estimate.oriented)[network.moment] > 1
        least = np.where(shared, 1, least)
    return _Prepared(
        Task(survey, network, matched.min_rays, least, matched.suspected),
        estimate,
        of_its_own,
        frame,
        (*unused, *chosen.remarks),
        chosen.accepted if survey.reject == "tau" else None,
    )


def _free_network(start: _Prepared) -> StableAdjustment | None:
    """Adjust the image points alone, so that no given value bends their network or causes a rejection.

    Returns:
        The adjustment. None for a plate that looks alike when turned, since its points have no identity
        without the plate. None also if the image points by themselves form no network, but control may
        connect and calibrate it.

    Raises:
        GeometryError: the image points by themselves form no network, and there is no control.
    """
    task, estimate = start.task, start.estimate
    if _has_no_identity(task.survey):
        return None
    report_step("adjusting the image points alone")
    network = task.network.with_given(ExteriorObservations(), ScaleBars(), further=())
    try:
        return settle_by_photograph(replace(task.in_free_datum, network=network), estimate, start.accepted)
    except GeometryError:
        if task.datum.kind != "control":
            raise
        return None


def _has_no_identity(survey: Survey) -> bool:
    """Return whether the points are on a plate that looks alike when turned: it alone identifies them."""
    plate = plate_family(survey.targets)
    return plate is not None and plate.is_ambiguous


def _with_confirmed_values(
    start: _Prepared, free: StableAdjustment | None, plates: tuple[tuple[str, ...], ...]
) -> tuple[Task, JudgedGiven]:
    """Return the task with the given values that the image points confirm, and their judgement."""
    task, survey, network = start.task, start.task.survey, start.task.network
    if free is not None:  # with its per-photograph cameras, if any
        network = free.task.network.with_given(
            network.control, network.exterior, network.scale_bars, further=network.further
        )
    mounts = survey.given_mounts
    if start.estimate.mounts is not None:  # of a camera that no moment pairs with others, nothing is used
        mounts = mounts.select(np.array(start.estimate.mounts.rig)[mounts.camera] != "")
    if _has_no_identity(survey):
        unjudged = len(network.further) > 0 or len(mounts) > 0
        remarks = (remark("given_not_judged", of=("observations",)),) if unjudged else ()
        return task, JudgedGiven(network, task.datum, remarks, mounts=mounts)
    report_step("testing the given values")
    is_plate = is_plate_control(survey.control, plate_control(survey.targets))
    others = start.task.network.with_given(ScaleBars())
    settings = GivenSettings(
        task.datum,
        survey.unit,
        rescale=survey.adjust.weights == "components",
        plates=tuple(map(frozenset, plates)) if is_plate else (),
        checks_scale=bool(np.isfinite(scale_sigma(others, start.estimate))),
        false_alarm=survey.adjust.false_alarm,
    )
    reference: FreeNetwork | None = None
    if free is not None and not free.held:  # c held at its start value gives the network a wrong shape
        adjusted = free.adjustment
        tables = start.task.network
        given_any = len(tables.control) or len(tables.scale_bars) or len(tables.exterior)
        if tables.has_common_errors and (given_any or tables.further):
            adjusted = replace(adjusted, error_correlation=estimate_error_correlation(adjusted))
        reference = FreeNetwork(adjusted)
    place = None if free is None else partial(_placing, start, free)
    given = judge_given(network, reference, settings, mounts=mounts, place=place)
    needed = task.needed.copy()
    if given.datum.kind == "control":
        needed[given.network.control.complete.point] = 1
    else:
        task = task.in_free_datum
    return replace(task, network=given.network, needed=needed), given


def _placing(start: _Prepared, free: StableAdjustment, part: Network) -> Similarity:
    """Return the object frame from the frame of the free network, by the given values of this network."""
    network, datum = start.task.network, Datum("free")
    before = start.estimate if start.task.datum.kind == "control" else free.whole
    before = scale_to_bars(network, before, start.task.datum)
    placed = reduce_network(network, before, free.images, free.points, free.accepted)[1]
    placed = place_on_observations(part, scale_to_bars(part, placed, datum))
    places = [np.concatenate([estimate.points, estimate.position]) for estimate in (free.estimate, placed)]
    return fit_similarity(places[0], places[1])


def _settle_with_given(
    start: _Prepared, free: StableAdjustment | None, task: Task, given: JudgedGiven
) -> StableAdjustment:
    """Adjust the image points together with the given values that they confirm."""
    if free is not None and task.survey.adjust.weights == "components":
        alone = free.adjustment
        if alone.redundancy > 0:  # without redundancy there is only the stated sigma
            factor = float(np.clip(alone.sigma0, least_factor(alone.stated_px), 1.0))
            task = replace(task, factor=factor)
    if not given.tests and task.datum.kind == "control":
        # neither the free network is a start, nor are its per-photograph cameras
        free = None
        task = replace(task, network=replace(task.network, camera=start.task.network.camera))
    estimate = start.estimate
    if free is not None:
        estimate = _free_network_in_frame(estimate, free.whole, task, given)
    estimate = scale_to_bars(task.network, estimate, task.datum)
    if given.others_contradict and task.datum.kind != "control":
        estimate = place_on_observations(task.network, estimate)
    if task.datum.kind == "control":
        estimate = hold_fixed(task.network, estimate)
    if given.mounts is not None and len(given.mounts):
        scaled = task.datum.kind == "control" or len(task.network.scale_bars) > 0
        estimate = hold_mounts(estimate, given.mounts, scaled=scaled)
        if task.network.further and task.datum.kind != "control":
            estimate = place_on_observations(task.network, estimate)
        task = replace(task, network=with_given_mounts(given.mounts, task.network))
    if free is None:
        return settle_by_photograph(task, estimate)
    if task.datum.kind != "control" and not is_scaled(task.network, estimate):
        # nothing else is adjusted with the image points, but the network states it
        every = np.ones(len(task.network.image_points), dtype=bool)
        part, _ = reduce_network(task.network, free.whole, free.images, free.points, every)
        return replace(free, task=task, adjustment=replace(free.adjustment, network=part))
    settled = settle(task, estimate, free.accepted).after(free)
    return replace(settled, held=settled.held or free.held)


def _finish_from_best_start(start: _Prepared, settled: StableAdjustment) -> _Final:
    """Return the final adjustment, from another solution if that is likelier."""

    def settle_again(before: _Final) -> _Final:
        last = before.settled  # without the points that the final adjustment lost
        estimate = merge_estimate(before.others[0].estimate, last.images, last.points)
        again = settle(last.task, estimate).after(last)
        return _finish(start, again, before=before.adjustment)

    return choose(_finish(start, settled), (BETTER_START,), settle_again)


def _report_start(before: _Final, again: _Final) -> _Final:
    """Return the final adjustment with the remark on its start, a solution of smaller v'Pv."""
    other, cameras = before.others[0], before.adjustment.estimate.cameras
    first = next(camera for camera in cameras if camera.name == other.camera)
    said = remark(
        "better_solution_taken",
        camera=other.camera,
        first=(first.parameters[0], other.unit),
        better=(other.c, other.unit),
        vPv=other.vPv,
    )
    return replace(again, remarks=(said,))


BETTER_START = Choice[_Final, _Final](  # of a final adjustment that has another solution to start from
    lambda final: [final] if final.others and final.others[0].converges else [],
    lambda before, again: (  # the gain of ln likelihood of all image points; both have the same parameters
        again.log_likelihood - before.log_likelihood if again.adjustment.converged else -np.inf
    ),
    report=_report_start,
)


def _finish(start: _Prepared, settled: StableAdjustment, *, before: Adjustment | None = None) -> _Final:
    """Return the final adjustment of a settled network, and other solutions that its image points allow.

    before: the solution that this one replaces.
    """
    final, check = _place_settled(start, settled)
    lost = _lost_points(settled, final)
    if lost.any():
        whole = settled.whole
        without = replace(whole, points=np.where(lost[:, None], np.nan, whole.points))
        again = settle(settled.task, without, settled.accepted).after(settled)
        return _finish(start, replace(again, rays=np.where(lost, 1, again.rays)), before=before)
    final = replace(
        final, iterations=settled.iterations + final.iterations, start_sigma0=settled.start_sigma0
    )
    # c that had to be held was not estimated: other values of c give other solutions
    asked = {camera.name for camera in start.estimate.cameras if camera.free[0]}
    c_held = tuple(
        camera.name for camera in final.estimate.cameras if camera.name in asked and not camera.free[0]
    )
    report_step("looking for other solutions")
    starts: tuple[Estimate, ...] = ()
    if len(final.network.images) <= 2 and final.datum != "control":  # control decides between those of a pair
        accepted = replace(final.network, image_points=final.network.image_points.select(~final.rejected))
        critical = -float(normal_ppf(final.test_alpha / 2))
        tolerance_px = critical * max(final.sigma0, 1.0) * final.sigma_px
        starts = pair_solutions(accepted, final.estimate, tolerance_px=tolerance_px)
    if before is not None and len(before.network.points) == len(final.network.points):
        starts = (*starts, before.estimate)
    return _Final(settled, final, check, c_held, other_solutions(final, starts=starts, had_to_be_held=c_held))


def _lost_points(settled: StableAdjustment, final: Adjustment) -> BoolArray:
    """Return the settled points of which a final adjustment, with other weights, accepts one ray only, (n,).

    The ray does not determine them, unless they need no other, as control.
    """
    rays = np.bincount(final.network.image_points.point[~final.rejected], minlength=len(final.network.points))
    lost = settled.points.copy()
    lost[settled.points] = (rays == 1) & (settled.task.needed[settled.points] > 1)
    return lost


def _free_network_in_frame(before: Estimate, free: Estimate, task: Task, given: JudgedGiven) -> Estimate:
    """Return the free network in the frame of the given values; single-ray control keeps its start values."""
    if given.placing is not None and task.datum.kind == "control":
        free = given.placing.apply_estimate(free)
    elif task.datum.kind == "control":
        return replace(before, cameras=free.cameras)  # with per-photograph cameras, if any
    lost = task.needed == 1  # control seen by one photograph: its given coordinates determine it
    points = np.where((lost & ~free.determined)[:, None], before.points, free.points)
    return replace(free, points=points)


def _place_settled(start: _Prepared, settled: StableAdjustment) -> tuple[Adjustment, ControlCheck | None]:
    """Return the final adjustment of a settled network, placed on its control or the frame of its datum."""
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


def _dropped_photographs(start: _Prepared, settled: StableAdjustment) -> tuple[tuple[str, Remark], ...]:
    """Return the oriented photographs that are not in the result, with the reason."""
    reasons = {} if settled.per_photograph is None else dict(settled.per_photograph.left_out)
    task = start.task
    return tuple(
        (name, reasons.get(name, remark("photograph_with_few_fitting", needed=int(fewest))))
        for name, was, is_in, fewest in zip(
            task.network.images, start.estimate.oriented, settled.images, task.least, strict=True
        )
        if was and not is_in
    )
