"""The solution of a survey: matching and adjusting in turn, then the final adjustment in its datum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.observed_unknowns import observed
from sfm.adjustment.quality.against_free import FreeNetwork, free_network_of
from sfm.adjustment.quality.other_solutions import OtherSolution, other_solutions
from sfm.adjustment.quality.variance_components import IMAGE_POINTS, estimate_components
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.orientation.ray_angles import ray_angles
from sfm.reduced_network import reduce_network, supported
from sfm.result import ControlCheck, Eccentricity, Explanation, LeftOutPoint, TakenOut
from sfm.survey.datum_definition import (
    Contradiction,
    datum_warnings,
    find_contradiction,
    place_on_control,
    place_on_frame,
    refuse_other_units,
    scale_to_bars,
)
from sfm.survey.explanations import explain_residuals
from sfm.survey.exterior import add_exterior
from sfm.survey.free_parameters import choose_free_parameters
from sfm.survey.inputs.incomplete_cameras import unlike_squares
from sfm.survey.inputs.interior import split_cameras, without_idle_cameras
from sfm.survey.inputs.measurements import Naming
from sfm.survey.inputs.start import given_values
from sfm.survey.inputs.survey import Survey
from sfm.survey.left_out import datum_carriers, left_out_points, unused_image_points, words_of_left_out
from sfm.survey.observation_count import refuse_too_few_observations
from sfm.survey.own_camera import Treated, treat_lost
from sfm.survey.principal_distance import far_principal_distances
from sfm.survey.scale_check import check_scales

TOLERANCE_FACTOR = 6.0  # of the robust spread of the residuals
FALSE_ALARM = 0.05  # chance that a survey without any outlier loses an image coordinate; Pope (1976)
MIN_IMAGE_POINTS = 4  # of a photograph in the final adjustment: three determine it, the fourth checks
GIVEN_IMAGE_POINTS = 3  # of one whose given orientation tells which of the four solutions is meant
MIN_DATUM_POINTS = 3  # that fix position, attitude and scale
CARRYING_DEG = 2.0  # largest angle between two rays of a point below which it carries no free datum
MAX_NAMES = 10  # points named in one line


@dataclass(frozen=True)
class Correspondences:
    """The network of a survey with all its points, and approximate values."""

    network: Network
    estimate: Estimate  # NaN for points that have left it
    min_rays: IntArray  # photographs that each point needs, (n,)
    naming: Naming | None = None  # of targets; None without
    eccentricity: Eccentricity | None = None  # what was corrected; None where nothing was
    no_circles: tuple[str, ...] = ()  # uncoded points left out: their outlines are not images of one circle
    warnings: tuple[str, ...] = ()  # one line each
    point_failures: tuple[tuple[str, str], ...] = ()  # points without approximate values, with the reason
    given: bool = False  # whether the survey's own approximate values were what the orientation started from


@dataclass(frozen=True)
class Solution:
    """The final adjustment, and what happened on the way to it."""

    adjustment: Adjustment
    control_check: ControlCheck | None  # None without control or where the datum is control
    dropped_images: tuple[tuple[str, str], ...]  # photographs that lost their points, with the reason
    warnings: tuple[str, ...]  # one line each
    left_out: tuple[LeftOutPoint, ...]  # measured points that are not in it
    unused_image_points: int  # of points and photographs that are not in it
    taken_out: tuple[TakenOut, ...]  # control and scale bars that do not fit
    free_network: FreeNetwork | None  # of the image points alone; None where nothing else took part
    others: tuple[OtherSolution, ...]  # that the image points allow as well
    notes: tuple[str, ...]  # what was chosen where the survey says nothing, one line each
    explanations: tuple[Explanation, ...]  # of large residuals, tried on the finished network


def refine(network: Network, estimate: Estimate) -> Estimate:
    """Adjust a growing network for its approximate values only; see `orientation.sequence.orient`."""
    return adjust(network, estimate, datum=Datum("free"), reject="none", covariance=False).estimate


def solve_survey(survey: Survey, matched: Correspondences) -> Solution:
    """Adjust the network in the datum of the survey, with rejection of outliers and full covariance.

    Points that keep too few rays and photographs that keep too few points leave the network, and the rest
    is adjusted again. A free network is placed on the scale bars and the control, where there are some,
    without changing its shape.

    Args:
        survey: says the datum and the a priori sigma, and gives observed exterior orientation.
        matched: all image points, and approximate values of all that is to be adjusted.

    Raises:
        GeometryError: too little is left to adjust, or control is asked for and not seen.
    """
    placed = add_exterior(matched.network, matched.estimate, survey.exterior, survey.datum.kind)
    network, estimate = placed.network, placed.estimate
    datum = Datum(survey.datum.kind)
    if datum.kind == "control" and len(network.control) == len(network.exterior) == 0:
        raise GeometryError("datum 'control', but no control point was measured")
    refuse_other_units(survey, network, estimate)
    scales = check_scales(network, estimate, held=datum.kind == "control")
    network = scales.network
    needed = matched.min_rays.copy()
    if datum.kind == "control":
        needed[network.control.complete.point] = 1
    whole, known = placed.network, estimate.determined
    oriented = estimate.oriented
    if datum.kind == "minimal" and matched.given:  # what it holds are the given coordinates
        given = given_values(survey, network)
        held = np.where(given.determined[:, None], given.points, estimate.points)
        estimate = replace(estimate, points=np.where(estimate.determined[:, None], held, np.nan))
    estimate = scale_to_bars(network, estimate, datum)
    frame = given_values(survey, network) if matched.given else estimate
    chosen = choose_free_parameters(survey, network, estimate, datum=datum.kind)
    survey, estimate = replace(survey, cameras=chosen.cameras), chosen.estimate
    network, estimate = split_cameras(survey.cameras, network, estimate, survey.start_cameras)
    least = np.where(given_values(survey, network).oriented, GIVEN_IMAGE_POINTS, MIN_IMAGE_POINTS)
    task = _Task(survey, datum, network, needed, least, survey.reject)
    every = np.ones(len(network.image_points), dtype=bool)
    iterations = 0
    contradictions, taken_out = list(scales.lines), list(scales.taken_out)
    better: tuple[str, ...] = ()
    first: tuple[_Settled, Adjustment, ControlCheck | None, tuple[OtherSolution, ...]] | None = None
    settled = _settle(task, estimate)
    ready: _Settled | None = settled
    treated = _treated(task, settled, estimate, oriented)
    if treated is not None:
        iterations += settled.iterations
        task, estimate, ready = replace(task, network=treated.network), treated.estimate, None
    while True:
        settled = _settle(task, estimate) if ready is None else ready
        ready = None
        iterations += settled.iterations
        found = settled.contradiction
        if found is None:
            last, check = settled.estimate, None
            if datum.kind != "control" and len(settled.part.control.complete) >= 3:
                last, check = place_on_control(settled.part, last)
            elif datum.kind == "free":
                carriers = _on_points(survey, settled.part, last, datum).resolve(settled.part).points
                part_of_frame = reduce_network(network, frame, settled.images, settled.points, every)[1]
                last = place_on_frame(settled.part, last, part_of_frame, carriers)
            final = _final(task, settled.part, last)
            found = _contradiction(task, final)
        if found is None:
            others = other_solutions(final)
            if first is not None and not final.converged:  # what seemed better is none: as it was
                (settled, final, check, others), better = first, ()
                break
            if first is not None or not others or not others[0].converges:
                break
            first = settled, final, check, others
            better = (_words_of_better(final, others[0]),)
            estimate = merge_estimate(estimate, others[0].estimate, settled.images, settled.points)
            continue
        contradictions.append(found.line)
        taken_out += [] if found.taken_out is None else [found.taken_out]
        task = _resolved(task, found, settled.accepted)
    reasons = {} if treated is None else dict(treated.left_out)
    dropped = tuple(
        (name, reasons.get(name, f"fewer than {fewest} accepted image points of the network"))
        for name, was, is_in, fewest in zip(network.images, oriented, settled.images, least, strict=True)
        if was and not is_in
    )
    final = replace(final, iterations=iterations + final.iterations)
    left_out = left_out_points(
        whole,
        final.network.points,
        reasons=matched.point_failures,
        accepted_rays=settled.rays,
        needed=needed,
    )
    # natural texture has points in plenty, of which only those that were lost on the way are worth a line
    told = left_out if survey.tie_points is None else _among(left_out, whole, known)
    own = () if treated is None else treated.lines
    warnings = (*placed.warnings, *own, *contradictions, *better)
    warnings += _warnings(survey, told, len(whole.points), final)
    in_result = np.isin(whole.points, final.network.points)
    unused = unused_image_points(whole, settled.images, in_result)
    if len(whole.scale_bars) and not len(final.network.scale_bars) and datum.kind == "control":
        # every bar is against the control: nothing says which of the two is right
        taken_out = [replace(one, resolved=False) for one in taken_out]
    alone = free_network_of(final)
    return Solution(
        final,
        check,
        dropped,
        warnings,
        left_out,
        unused,
        tuple(taken_out),
        alone,
        others,
        chosen.notes,
        explain_residuals(final),
    )


def _words_of_better(final: Adjustment, other: OtherSolution) -> str:
    """Say that the network was adjusted anew from a solution of smaller v'Pv than that found first."""
    first = final.estimate.cameras[[one.name for one in final.estimate.cameras].index(other.camera)]
    return (
        f"two solutions: c of camera {other.camera} was {first.parameters[0]:.5g} {other.unit} at first; "
        f"from {other.c:.5g} {other.unit} v'Pv is {other.vPv:.3g} times as large, which was taken"
    )


def _among(left_out: tuple[LeftOutPoint, ...], whole: Network, known: BoolArray) -> tuple[LeftOutPoint, ...]:
    """Return those of the points that had approximate values."""
    names = {name for name, is_in in zip(whole.points, known, strict=True) if is_in}
    return tuple(one for one in left_out if one.point in names)


@dataclass(frozen=True)
class _Task:
    """What is adjusted and how; contradictions change it."""

    survey: Survey
    datum: Datum
    network: Network
    needed: IntArray  # rays that each point needs to stay, (n,)
    least: IntArray  # image points that each photograph needs to stay, (m,)
    reject: str  # how gross errors are treated


@dataclass(frozen=True)
class _Settled:
    """An adjustment after which no point or photograph leaves, or in which there is a contradiction."""

    part: Network  # what was adjusted
    estimate: Estimate  # of it
    images: BoolArray  # photographs in it, (m,)
    points: BoolArray  # points in it, (n,)
    accepted: BoolArray  # image points of the whole network, (k,)
    contradiction: Contradiction | None
    iterations: int  # of all adjustments on the way
    rays: IntArray  # accepted rays of each point, of those that left when they left, (n,)


def _settle(task: _Task, estimate: Estimate) -> _Settled:
    """Adjust until the points and photographs that are left stay, or control or a bar is contradicted."""
    network, iterations = task.network, 0
    accepted = np.ones(len(network.image_points), dtype=bool)
    rays = network.rays()
    images, points = determined(network, estimate, accepted, task.needed, task.least)
    while True:
        part, start = reduce_network(network, estimate, images, points, np.ones_like(accepted))
        refuse_too_few_observations(part, start, task.datum.kind)
        adjustment = _tested(task, part, start, covariance=False)
        iterations += adjustment.iterations
        found = _contradiction(task, adjustment)
        estimate = merge_estimate(estimate, adjustment.estimate, images, points)
        accepted = _accepted(network, adjustment, images, points)
        now = np.bincount(network.image_points.point[accepted], minlength=len(points))
        rays = np.where(points, now, rays)
        left_images, left_points = determined(network, estimate, accepted, task.needed, task.least)
        if found is not None or ((left_images == images).all() and (left_points == points).all()):
            return _Settled(part, adjustment.estimate, images, points, accepted, found, iterations, rays)
        images, points = left_images, left_points


def _treated(task: _Task, settled: _Settled, start: Estimate, oriented: BoolArray) -> Treated | None:
    """Return the network with cameras of their own for the photographs that fit with them, others left out.

    Args:
        task: what was adjusted; without tests nothing tells a photograph that does not fit.
        settled: the adjustment.
        start: approximate values, which what has left the adjustment starts from again.
        oriented: photographs that had an exterior orientation, (m,).
    """
    if task.reject == "none" or settled.contradiction is not None:
        return None
    adjusted = merge_estimate(start, settled.estimate, settled.images, settled.points)
    found = treat_lost(task.network, adjusted, settled.accepted, oriented=oriented)
    if found is None:
        return None
    one, again = found.estimate, ~found.estimate.oriented & ~found.without
    position = np.where(again[:, None], start.position, one.position)
    rotation = np.where(again[:, None, None], start.rotation, one.rotation)
    points = np.where(one.determined[:, None], one.points, start.points)
    return replace(found, estimate=replace(one, position=position, rotation=rotation, points=points))


def _resolved(task: _Task, found: Contradiction, accepted: BoolArray) -> _Task:
    """Return the task without what is to blame, or, where that cannot be told, without any more tests."""
    network = task.network
    if found.freed is not None:
        needed = task.needed.copy()
        needed[np.setdiff1d(network.control.point, found.freed.control.point)] = 2
        return replace(task, network=found.freed, needed=needed)
    # what the test holds against the other image points stands
    keep = accepted | found.protected[network.image_points.point]
    return replace(
        task, network=replace(network, image_points=network.image_points.select(keep)), reject="none"
    )


def _final(task: _Task, part: Network, estimate: Estimate) -> Adjustment:
    """Return the last adjustment with its covariance.

    Where other observations take part, the image points are weighted by their own variance component, unless
    the survey wants all weights as stated.
    """
    part, estimate = without_idle_cameras(part, estimate, cameras=len(task.survey.cameras))

    def adjust_part(factor: FloatArray) -> Adjustment:
        return _tested(task, part, estimate, covariance=True, factor=factor)

    outer = (part.control, part.exterior) if task.datum.kind == "control" else ()
    weighted = any(observed(np.einsum("nii->ni", one.covariance)).any() for one in outer)
    others = len(part.scale_bars) or len(part.interior) or weighted
    if others and task.survey.adjust.weights == "components":
        return _weighed(adjust_part, len(part.image_points))
    return _tested(task, part, estimate, covariance=True)


def _contradiction(task: _Task, adjustment: Adjustment) -> Contradiction | None:
    """Return control or a scale bar that cost a point most of its rays; None where nothing was tested."""
    if task.reject == "none":
        return None
    untested, factor = replace(task, reject="none"), adjustment.weight_factor

    def readjust(one: Network) -> Adjustment:
        return _tested(untested, one, adjustment.estimate, covariance=False, factor=factor)

    return find_contradiction(task.network, adjustment, readjust, unit=task.survey.unit)


def _tested(
    task: _Task, network: Network, estimate: Estimate, *, covariance: bool, factor: float | FloatArray = 1.0
) -> Adjustment:
    """Adjust with data snooping, the level of the single test shared out among all image coordinates."""
    tests = 2 * len(network.image_points)
    return adjust(
        network,
        estimate,
        datum=_on_points(task.survey, network, estimate, task.datum),
        sigma_px=task.survey.adjust.sigma_px,
        image_sigma_factor=factor,
        reject=task.reject,
        alpha=1 - (1 - FALSE_ALARM) ** (1 / tests),
        covariance=covariance,
    )


def _on_points(survey: Survey, network: Network, estimate: Estimate, datum: Datum) -> Datum:
    """Return the datum on the points that the survey names, else on all but those at very small angles.

    Raises:
        GeometryError: fewer than three of the named ones are in the network.
    """
    named = survey.datum.points
    if not named and datum.kind == "control":
        return datum
    if not named:
        angles = ray_angles(network, estimate, np.ones(len(network.image_points), dtype=bool))
        return replace(datum, points=datum_carriers(angles, CARRYING_DEG))
    on = np.isin(network.points, named)
    if on.sum() < MIN_DATUM_POINTS:
        raise GeometryError(
            f"{on.sum()} of the {len(named)} datum.points are in the network, at least "
            f"{MIN_DATUM_POINTS} are needed"
        )
    return replace(datum, points=on)


def _weighed(adjust_part: Callable[[FloatArray], Adjustment], count: int) -> Adjustment:
    """Return the adjustment with the image points weighted by their own variance component.

    Lengths and control have the standard deviations that were stated for them; without this, sigma0 a
    posteriori, which the image points decide, would scale these too. The component is that of the image
    points that the last adjustment accepts.

    Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.2.4.
    """
    group = np.zeros(count, dtype=np.int64)
    final, _, settled = estimate_components(adjust_part, group, (IMAGE_POINTS,))
    if not settled:
        line = "the weights of the image points did not converge: each of them rejects other image points"
        final = replace(final, remarks=(*final.remarks, line))
    return final


def determined(
    network: Network,
    estimate: Estimate,
    accepted: BoolArray,
    min_rays: IntArray,
    min_points: int | IntArray = MIN_IMAGE_POINTS,
) -> tuple[BoolArray, BoolArray]:
    """Return the photographs (m,) and points (n,) that accepted image points determine.

    Raises:
        GeometryError: fewer than two photographs are left.
    """
    images, points = supported(network, estimate, accepted, min_points=min_points, min_rays=min_rays)
    if images.sum() < 2:
        raise GeometryError(
            f"{images.sum()} of {len(images)} photographs see at least {MIN_IMAGE_POINTS} points of the "
            "network, at least 2 photographs are needed"
        )
    return images, points


def merge_estimate(estimate: Estimate, part: Estimate, images: BoolArray, points: BoolArray) -> Estimate:
    """Return the estimate of all photographs and points with an adjusted part of it put in; NaN elsewhere."""
    position, rotation = np.full_like(estimate.position, np.nan), np.full_like(estimate.rotation, np.nan)
    xyz = np.full_like(estimate.points, np.nan)
    position[images], rotation[images], xyz[points] = part.position, part.rotation, part.points
    return Estimate(part.cameras, position, rotation, xyz)


def _pixels_unlike_squares(survey: Survey, estimate: Estimate) -> tuple[str, ...]:
    """Return what is told of pixels by nominal sensor sizes, of the first camera of each of the survey's."""
    first = {one.name: camera for one in survey.cameras for camera in reversed(estimate.cameras)
             if camera.name == one.name or camera.name.startswith(f"{one.name} ")}  # fmt: skip
    settings = [one for one in survey.cameras if one.name in first]
    pixels = [(float(first[one.name].pixel_mm[0]), float(first[one.name].pixel_mm[1])) for one in settings]
    return unlike_squares(settings, pixels, [one.adjusted for one in settings])


def _accepted(network: Network, adjustment: Adjustment, images: BoolArray, points: BoolArray) -> BoolArray:
    """Return which image points of the whole network the adjustment of a part of it accepted."""
    seen = network.image_points
    part = images[seen.image] & points[seen.point]
    accepted = part.copy()
    accepted[part] = ~adjustment.rejected
    return accepted


def _warnings(
    survey: Survey, left_out: tuple[LeftOutPoint, ...], measured: int, adjustment: Adjustment
) -> tuple[str, ...]:
    """Return what a person must know beyond the numbers."""
    lines = list(adjustment.remarks)
    if not adjustment.converged:
        lines.append(f"the adjustment did NOT converge within {adjustment.iterations} iterations")
    if adjustment.undetermined:
        lines.append(f"not determined by the observations: {', '.join(adjustment.undetermined)}")
    if left_out:
        lines.append(words_of_left_out(left_out, measured))
    absent = [name for name in survey.datum.points if name not in set(adjustment.network.points)]
    if absent:
        lines.append(f"datum points that are not in the network: {', '.join(absent[:MAX_NAMES])}")
    lines += far_principal_distances(survey, adjustment.estimate)
    lines += _pixels_unlike_squares(survey, adjustment.estimate)
    return (*lines, *datum_warnings(survey, adjustment.network))
