"""The solution of a survey: matching and adjusting in turn, then the final adjustment in its datum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.observed_unknowns import observed
from sfm.adjustment.quality.variance_components import IMAGE_POINTS, estimate_components
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.reduced_network import reduce_network, supported
from sfm.result import ControlCheck, Eccentricity
from sfm.survey.datum_definition import (
    Contradiction,
    datum_warnings,
    find_contradiction,
    place_on_control,
    refuse_other_units,
    scale_to_bars,
)
from sfm.survey.exterior import add_exterior
from sfm.survey.inputs.interior import split_cameras, without_idle_cameras
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.measurements import Naming

TOLERANCE_FACTOR = 6.0  # of the robust spread of the residuals
FALSE_ALARM = 0.05  # chance that a survey without any outlier loses an image coordinate; Pope (1976)
MIN_IMAGE_POINTS = 4  # of a photograph in the final adjustment: three determine it, the fourth checks
MIN_DATUM_POINTS = 3  # that fix position, attitude and scale
MOST_NAMES = 10  # points named in one line


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


@dataclass(frozen=True)
class Solution:
    """The final adjustment, and what happened on the way to it."""

    adjustment: Adjustment
    control_check: ControlCheck | None  # None without control or where the datum is control
    dropped_images: tuple[tuple[str, str], ...]  # photographs that lost their points, with the reason
    warnings: tuple[str, ...]  # one line each


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
    needed = matched.min_rays.copy()
    if datum.kind == "control":
        needed[network.control.point] = 1
    known = tuple(name for name, is_in in zip(network.points, estimate.determined, strict=True) if is_in)
    single = tuple(network.points[j] for j in np.flatnonzero((network.rays() == 1) & (needed > 1)))
    oriented = estimate.oriented
    estimate = scale_to_bars(network, estimate, datum)
    network, estimate = split_cameras(survey.cameras, network, estimate)
    task = _Task(survey, datum, network, needed, survey.reject)
    iterations = 0
    contradictions: list[str] = []
    while True:
        settled = _settle(task, estimate)
        iterations += settled.iterations
        found = settled.contradiction
        if found is None:
            last, check = settled.estimate, None
            if datum.kind != "control" and len(settled.part.control) >= 3:
                last, check = place_on_control(settled.part, last)
            final = _final(task, settled.part, last)
            found = _contradiction(task, final)
        if found is None:
            break
        contradictions.append(found.line)
        task = _resolved(task, found, settled.accepted)
    dropped = tuple(
        (name, f"fewer than {MIN_IMAGE_POINTS} accepted image points of the network")
        for name, was, is_in in zip(network.images, oriented, settled.images, strict=True)
        if was and not is_in
    )
    final = replace(final, iterations=iterations + final.iterations)
    warnings = (*placed.warnings, *contradictions, *_warnings(survey, known, single, final))
    return Solution(final, check, dropped, warnings)


@dataclass(frozen=True)
class _Task:
    """What is adjusted and how; contradictions change it."""

    survey: Survey
    datum: Datum
    network: Network
    needed: IntArray  # rays that each point needs to stay, (n,)
    reject: str  # how gross errors are treated


@dataclass(frozen=True)
class _Settled:
    """An adjustment after which no point or photograph leaves, or in which there is a contradiction."""

    part: Network  # what was adjusted
    estimate: Estimate  # of it
    images: BoolArray  # photographs in it, (m,)
    accepted: BoolArray  # image points of the whole network, (k,)
    contradiction: Contradiction | None
    iterations: int  # of all adjustments on the way


def _settle(task: _Task, estimate: Estimate) -> _Settled:
    """Adjust until the points and photographs that are left stay, or control or a bar is contradicted."""
    network, iterations = task.network, 0
    accepted = np.ones(len(network.image_points), dtype=bool)
    images, points = determined(network, estimate, accepted, task.needed)
    while True:
        part, start = reduce_network(network, estimate, images, points, np.ones_like(accepted))
        adjustment = _tested(task, part, start, covariance=False)
        iterations += adjustment.iterations
        found = _contradiction(task, adjustment)
        estimate = merge_estimate(estimate, adjustment.estimate, images, points)
        accepted = _accepted(network, adjustment, images, points)
        left_images, left_points = determined(network, estimate, accepted, task.needed)
        if found is not None or ((left_images == images).all() and (left_points == points).all()):
            return _Settled(part, adjustment.estimate, images, accepted, found, iterations)
        images, points = left_images, left_points


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

    Where other observations take part, the image points are weighted by their own variance component.
    """
    part, estimate = without_idle_cameras(part, estimate, cameras=len(task.survey.cameras))

    def adjust_part(factor: FloatArray) -> Adjustment:
        return _tested(task, part, estimate, covariance=True, factor=factor)

    outer = (part.control, part.exterior) if task.datum.kind == "control" else ()
    weighted = any(observed(np.einsum("nii->ni", one.covariance)).any() for one in outer)
    if len(part.scale_bars) or len(part.interior) or weighted:
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
        datum=_on_points(task.survey, network, task.datum),
        sigma_px=task.survey.adjust.sigma_px,
        image_sigma_factor=factor,
        reject=task.reject,
        alpha=1 - (1 - FALSE_ALARM) ** (1 / tests),
        covariance=covariance,
    )


def _on_points(survey: Survey, network: Network, datum: Datum) -> Datum:
    """Return the datum on the points that the survey names, on all if it names none.

    Raises:
        GeometryError: fewer than three of them are in the network.
    """
    named = survey.datum.points
    if not named:
        return datum
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
    network: Network, estimate: Estimate, accepted: BoolArray, min_rays: IntArray
) -> tuple[BoolArray, BoolArray]:
    """Return the photographs (m,) and points (n,) that accepted image points determine.

    Raises:
        GeometryError: fewer than two photographs are left.
    """
    images, points = supported(network, estimate, accepted, min_points=MIN_IMAGE_POINTS, min_rays=min_rays)
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


def _accepted(network: Network, adjustment: Adjustment, images: BoolArray, points: BoolArray) -> BoolArray:
    """Return which image points of the whole network the adjustment of a part of it accepted."""
    seen = network.image_points
    part = images[seen.image] & points[seen.point]
    accepted = part.copy()
    accepted[part] = ~adjustment.rejected
    return accepted


def _warnings(
    survey: Survey, known: tuple[str, ...], single: tuple[str, ...], adjustment: Adjustment
) -> tuple[str, ...]:
    """Return what a person must know beyond the numbers."""
    lines = list(adjustment.remarks)
    if not adjustment.converged:
        lines.append(f"the adjustment did NOT converge within {adjustment.iterations} iterations")
    if adjustment.undetermined:
        lines.append(f"not determined by the observations: {', '.join(adjustment.undetermined)}")
    gone = [name for name in known if name not in set(adjustment.network.points)]
    if gone:
        shown = ", ".join(gone[:MOST_NAMES]) + (" ..." if len(gone) > MOST_NAMES else "")
        lines.append(f"{len(gone)} points left out, too few of their image points were accepted: {shown}")
    if single:
        shown = "; ".join(f"point {name}: 1 ray, 2 are needed" for name in single[:MOST_NAMES])
        lines.append(shown + (f"; and {len(single) - MOST_NAMES} more" if len(single) > MOST_NAMES else ""))
    absent = [name for name in survey.datum.points if name not in set(adjustment.network.points)]
    if absent:
        lines.append(f"datum points that are not in the network: {', '.join(absent[:MOST_NAMES])}")
    return (*lines, *datum_warnings(survey, adjustment.network))
