"""Orientation of a survey: approximate values of its network, and the distortion model of its cameras.

The photographs are oriented on their control, if that fits, else without it. Lost photographs get a reason.
If nothing works, other principal distances are tried. What the survey leaves open is a table of choices.

Where the survey does not state the distortion model, it is central perspective or fisheye. A fisheye lens
images equal angles as nearly equal lengths. No polynomial of the tangents describes such a lens over a wide
field, and with one the object is bent. The image points decide between the two models.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.solvers.choice import refuse_too_large
from sfm.adjustment.solve import adjust
from sfm.judgement.model_choice import Choice, solve_likeliest
from sfm.model.camera import camera_from_values
from sfm.model.conventions import BoolArray, IntArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.likelihood import areas_of_photographs, log_likelihood
from sfm.model.network import ExteriorObservations, Network, ObjectPoints, ScaleBars, rows_of
from sfm.model.reduced_network import reduce_network
from sfm.model.remarks.remark import Remark, remark
from sfm.model.similarity import fit_similarity
from sfm.orientation.image_rays import intersect_image_points
from sfm.orientation.incremental.growth import residual_lengths
from sfm.orientation.incremental.sequence import FINAL_TOLERANCE_PX, MIN_POINTS, Judge, Orientation, orient
from sfm.survey.board_turns import agree_on_turns
from sfm.survey.circles import circle_misfit
from sfm.survey.clock_offsets import agree_on_clocks
from sfm.survey.diagnosis.codes_found import describe_codes
from sfm.survey.diagnosis.lost_photographs import (
    MIN_FITTING_FRACTION,
    explain_lost_photographs,
    find_second_motion,
    find_second_objects,
    refuse_no_base,
    try_other_principal_distances,
)
from sfm.survey.free_parameters import choose_free_parameters
from sfm.survey.inputs.measurements import Measurements
from sfm.survey.inputs.start import start_values
from sfm.survey.inputs.survey import Survey
from sfm.survey.placing import place_on_observations
from sfm.survey.rigs import mount_cameras

FISHEYE = "opencv_fisheye"
# c of a central perspective over half the diagonal. Below it the corner is more than 45 degrees off the axis,
# where equal angles and equal tangents differ by more than a tenth of the half diagonal.
WIDE_C = 1.0
# Points of natural texture that take part in the orientation: those with the most rays, and at least so many
# of every photograph.
ORIENTATION_POINTS, POINTS_PER_PHOTOGRAPH = 400, 100
CONTROL_OF_CAMERA = 6  # control points in the datum with which two photographs determine their camera


@dataclass(frozen=True)
class Oriented:
    """An oriented survey, with what its orientation decided."""

    survey: Survey  # with the lens models of its cameras, and the moments of its photographs
    measured: Measurements  # start values of these cameras, names of the points, remarks on choices
    orientation: Orientation


Model = tuple[Survey, Measurements]
Present = Oriented | None  # None if the usual model has no orientation


def orient_survey(survey: Survey, measured: Measurements) -> Oriented:
    """Return approximate values of a survey's network, for the likeliest of the models that it leaves open.

    Open are the lens models of cameras without a stated one, the offset of clocks that fit at two, and the
    turns of a plate that looks alike turned.

    Args:
        survey: may give start values and lens models; error messages name its settings.
        measured: all named image points.

    Raises:
        GeometryError: no two photographs could be oriented, the connected photographs could not be adjusted,
            or the photographs have no base.
    """
    fisheyes = Choice[Model, Present](
        partial(_models_with_fisheyes, survey, measured), _gain, partial(_freed_by_fisheyes, survey),
        partial(_report_fisheyes, survey),
    )  # fmt: skip
    oriented = solve_likeliest(
        (survey, measured), (fisheyes, CLOCKS, TURNS), _orient_model, false_alarm=survey.adjust.false_alarm
    )
    start = oriented.orientation
    uncertain = agree_on_turns(oriented.survey, oriented.measured, start.estimate).uncertain
    if uncertain is None:
        return oriented
    return replace(oriented, orientation=replace(start, remarks=(*start.remarks, uncertain)))


def _models_by_other_clocks(present: Present) -> Iterator[Model]:
    """Yield the model with the second offset of clocks, if the cameras keep their mounts better by it."""
    if present is not None:
        other = agree_on_clocks(present.survey, present.measured, present.orientation.estimate)
        if other is not None:
            yield other


def _models_with_other_turns(present: Present) -> Iterator[Model]:
    """Yield the model with the image points of plates renamed as the first camera sees them."""
    if present is not None:
        renamed = agree_on_turns(present.survey, present.measured, present.orientation.estimate).measured
        if renamed is not None:
            yield present.survey, renamed


CLOCKS = Choice[Model, Present](_models_by_other_clocks)
TURNS = Choice[Model, Present](_models_with_other_turns)


def _orient_model(model: Model) -> Oriented:
    """Return the orientation of a survey with one model of its lenses, clocks and turns."""
    survey, measured = model
    refuse_too_large(measured.network)
    if not measured.network.named.all():
        refuse_no_base(measured.network, measured.cameras)
    # left out here: the adjustment judges these first
    network = measured.network.with_given(ExteriorObservations(), ScaleBars(), further=())
    orientation, wrong_c = _orient_with_best_c(survey, measured, network)
    chosen = choose_free_parameters(survey, network, orientation.estimate, extend=False)
    orientation, held = _hold_cameras_of_two(survey, network, replace(orientation, estimate=chosen.estimate))
    if held and len(network.images) > 2:
        held += (remark("pair_contradicted", others=len(network.images) - 2),)
    elif held:
        of_pair = {"pair": ("c",)}
        wrong_c = tuple(replace(said, subjects={**said.subjects, **of_pair}) for said in wrong_c)
    orientation = replace(orientation, remarks=(*orientation.remarks, *wrong_c, *held))
    if not network.named.all():
        moving = find_second_motion(network, orientation, _orient_strongest)
        orientation = replace(orientation, remarks=(*orientation.remarks, *moving))
    if not wrong_c:
        second = find_second_objects(network, orientation, partial(orient, refine=refine))
        failures = tuple((image, second.get(image, reason)) for image, reason in orientation.failures)
        orientation = replace(orientation, failures=failures)
    estimate = mount_cameras(survey, network, orientation.estimate)
    if survey.datum.kind != "control":
        estimate = place_on_observations(measured.network, estimate)
    orientation = replace(orientation, estimate=estimate)
    return Oriented(survey, measured, explain_lost_photographs(network, orientation))


def _orient_with_best_c(
    survey: Survey, measured: Measurements, network: Network
) -> tuple[Orientation, tuple[Remark, ...]]:
    """Return the orientation, with another principal distance if that is likelier, and remarks on it."""
    estimate = start_values(survey, network, measured.cameras)
    given = survey.start_orientations is not None or survey.start_points is not None

    exact = all(source.is_exact for source in network.sources)
    orient_from = partial(_orient_on_control, measured, given=exact)

    orientation, failure = None, None
    try:
        orientation = orient_from(network, estimate)
    except GeometryError as error:
        failure = error
        if measured.photographs is not None:
            every = np.ones(len(network.image_points), dtype=bool)
            most = max(int(common.max(initial=0)) for _, _, common in network.common_points(every))
            if most < MIN_POINTS:  # points that two photographs share
                raise GeometryError(describe_codes(survey, measured.photographs)) from error
    wrong_c: tuple[Remark, ...] = ()
    if not given:
        orientation, wrong_c = try_other_principal_distances(
            network, estimate, orientation, orient_from, survey.adjust.false_alarm
        )
    if orientation is None:
        hint = " (correct or complete [approximate], or leave it out)" if given else ""
        hint += "".join(f"; {said.text}" for said in wrong_c)
        raise GeometryError(f"{failure}{hint}") from failure
    return orientation, wrong_c


def _orient_on_control(
    measured: Measurements, network: Network, estimate: Estimate, *, given: bool
) -> Orientation:
    """Orient all photographs, on their control if it fits them, else without it.

    measured: has the outlines of the targets, which choose between two orientations of a plane.
    given: whether the image points were given; the adjustment, not the orientation, then judges
    contradictions.
    """
    named = network.named[network.image_points.point]  # those of texture cannot contradict the control

    def orient_part(part: Network) -> Orientation:
        values = estimate
        if len(part.control) < len(network.control):
            values = replace(estimate, points=estimate.points.copy())
            values.points[network.control.point] = np.nan
        return _orient_strongest(part, values, measured=measured, contradicting=given)

    def without_control(before: Orientation | None) -> Iterator[Network]:
        if len(network.control) and (before is None or not _fits(network, before)[named].all()):
            yield network.with_given(ObjectPoints())

    def more_fit(before: Orientation | None, after: Orientation | None) -> float:
        if before is None or after is None:
            return math.inf
        return float(_fits(network, after)[named].sum() - _fits(network, before)[named].sum())

    def placed(_: Orientation | None, after: Orientation | None) -> Orientation | None:
        with suppress(GeometryError):  # fewer than three control points, or on a line
            if after is not None:
                control = network.control.complete
                known = after.estimate.determined[control.point]
                placing = fit_similarity(after.estimate.points[control.point[known]], control.xyz[known])
                return replace(after, estimate=placing.apply_estimate(after.estimate))
        return after

    row = Choice[Network, Orientation | None](without_control, more_fit, report=placed)
    return solve_likeliest(network, (row,), orient_part)


def _fits(network: Network, orientation: Orientation) -> BoolArray:
    """Return which image points fit an orientation within the final tolerance, (k,)."""
    return np.asarray(residual_lengths(network, orientation.estimate) <= FINAL_TOLERANCE_PX)


def _hold_cameras_of_two(
    survey: Survey, network: Network, orientation: Orientation
) -> tuple[Orientation, tuple[Remark, ...]]:
    """Hold the free interior parameters if only two photographs are oriented, and report it.

    The image points of a pair determine seven parameters, five of them the relative orientation (Hartley and
    Zisserman 2003, sec. 11.1). They hardly determine c. They do not determine principal point or distortion,
    which bend the object instead. A control field in the datum determines them, and observed parameters have
    the stated precision. The parameters are also held where the survey does not state what is free, as in a
    drafted survey.
    """
    estimate = orientation.estimate
    fixed = len(network.control) if survey.datum.kind == "control" else 0
    if estimate.oriented.sum() != 2 or fixed >= CONTROL_OF_CAMERA:
        return orientation, ()
    used = np.unique(network.camera[estimate.oriented])
    remarks = []
    cameras = list(estimate.cameras)
    for index in used.tolist():
        camera = cameras[index]
        said = survey.cameras[index].states_free
        free = set(np.array(camera.names)[camera.free]) if said else set(survey.cameras[index].may_be_free)
        names = [name for name in camera.names if name in free]
        if names:
            cameras[index] = replace(camera, free=np.zeros_like(camera.free))
            remarks.append(remark("interior_held_of_pair", camera=camera.name, parameters=names))
    return replace(orientation, estimate=replace(estimate, cameras=tuple(cameras))), tuple(remarks)


def _circle_judge(measured: Measurements, network: Network) -> Judge | None:
    """Return a function for the misfit of the outlines as circles; None without circular targets.

    network: the network of the judged estimate, which may have fewer points, and those of other sources.
    """
    of_targets = next((part for part in measured.parts if part.photographs is not None), measured)
    photographs, naming = of_targets.photographs, of_targets.naming
    if photographs is None or naming.corners:
        return None
    images = _places(network.images, of_targets.network.images)
    points = _places(network.points, of_targets.network.points)

    def misfit(estimate: Estimate) -> float:
        position, xyz = estimate.position[images], estimate.points[points]
        position[images < 0], xyz[points < 0] = np.nan, np.nan
        of_part = replace(estimate, position=position, rotation=estimate.rotation[images], points=xyz)
        return circle_misfit(photographs, naming, of_targets.network, of_part)

    return misfit


def _places(names: Sequence[str], of: Sequence[str]) -> IntArray:
    """Return the index of names among others, -1 for those that are not there."""
    index = {name: k for k, name in enumerate(names)}
    return np.array([index.get(name, -1) for name in of], dtype=np.int64)


def _orient_strongest(
    network: Network, estimate: Estimate, *, measured: Measurements | None = None, contradicting: bool = False
) -> Orientation:
    """Orient the photographs on points with names and those with the most rays, then intersect all others.

    Thousands of points orient a survey no better than hundreds do, and slow down every trial.
    """
    images = np.ones(len(network.images), dtype=bool)
    image_points = np.ones(len(network.image_points), dtype=bool)
    part, start = network, estimate
    if not network.named.all():
        seen = network.image_points
        order = np.argsort(-network.rays(), kind="stable")
        chosen = network.named.copy()
        chosen[order[:ORIENTATION_POINTS]] = True
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        for rows in rows_of(seen.image, len(network.images)):
            points = seen.point[rows]
            chosen[points[np.argsort(rank[points], kind="stable")][:POINTS_PER_PHOTOGRAPH]] = True
        part, start = reduce_network(network, estimate, images, chosen, image_points)
    judge = None if measured is None else _circle_judge(measured, part)
    orientation = orient(part, start, refine=refine, contradicting=contradicting, judge=judge)
    if part is network:
        return orientation
    rays = intersect_image_points(
        network.image_points,
        network.camera,
        orientation.estimate,
        n_points=len(network.points),
        tolerance_px=float(orientation.tolerance_px.max()),
    )
    estimate = replace(orientation.estimate, points=rays.points)
    limit = orientation.tolerance_px[network.camera[network.image_points.image]]
    fits = residual_lengths(network, estimate) <= limit  # the RMS is that of the strongest points
    undetermined = set(np.array(network.points, dtype=object)[network.named & ~estimate.determined])
    failures = tuple(failure for failure in orientation.point_failures if failure[0] in undetermined)
    return replace(orientation, estimate=estimate, fits=fits, point_failures=failures)


def refine(network: Network, estimate: Estimate) -> Estimate:
    """Adjust a growing network for its approximate values only; see `incremental.sequence.orient`."""
    return adjust(network, estimate, datum=Datum("free"), reject="none", covariance=False).estimate


def _models_with_fisheyes(survey: Survey, measured: Measurements, present: Present) -> Iterator[Model]:
    """Yield the model with fisheyes where the survey states no model, if it may be likelier."""
    wide = [a for a, camera in enumerate(survey.cameras) if not camera.states_model]
    if present is not None and _likelihood(present)[1] >= MIN_FITTING_FRACTION * len(
        measured.network.image_points
    ):
        known = present.orientation.estimate.cameras
        wide = [a for a in wide if known[a].c_px < WIDE_C * np.hypot(*known[a].size_px) / 2]
    if not wide:
        return
    known = measured.cameras if present is None else present.orientation.estimate.cameras
    cameras, starts = list(survey.cameras), list(measured.cameras)
    for a in wide:  # with the same c, and the principal point in the middle
        camera = known[a]
        cameras[a] = cameras[a].model_copy(update={"model": FISHEYE})
        pixel = (float(camera.pixel_mm[0]), float(camera.pixel_mm[1]))
        starts[a] = camera_from_values(
            camera.name,
            FISHEYE,
            camera.size_px,
            pixel,
            c_mm=camera.c_px * float(np.mean(pixel)),
            free=cameras[a].may_be_free,
        )
    yield replace(survey, cameras=tuple(cameras)), replace(measured, cameras=tuple(starts))


def _gain(before: Present, after: Present) -> float:
    """Return the gain of ln likelihood of all image points."""
    if before is None or after is None:
        return math.inf
    return _likelihood(after)[0] - _likelihood(before)[0]


def _freed_by_fisheyes(survey: Survey, _: Present, after: Present) -> list[tuple[int, int]]:
    """Return a parameter for each fisheye, all together, and the number of image points."""
    if after is None:
        return []
    return [(len(_fisheyes_of(survey, after)), len(after.measured.network.image_points))]


def _report_fisheyes(survey: Survey, before: Present, after: Present) -> Present:
    """Return the orientation with a remark on each camera that has the fisheye model now."""
    if after is None:
        return None
    taken = tuple(
        remark(
            "fisheye_taken",
            camera=name,
            fitting=_likelihood(after)[1],
            total=len(after.measured.network.image_points),
            before=0 if before is None else _likelihood(before)[1],
        )
        for name in _fisheyes_of(survey, after)
    )
    return replace(after, measured=replace(after.measured, remarks=(*after.measured.remarks, *taken)))


def _fisheyes_of(survey: Survey, after: Oriented) -> list[str]:
    """Return the names of the cameras that have another model than in the survey."""
    pairs = zip(survey.cameras, after.survey.cameras, strict=True)
    return [camera.name for usual, camera in pairs if camera.model != usual.model]


def _likelihood(oriented: Oriented) -> tuple[float, int]:
    """Return the log-likelihood of all image points, and how many of them fit."""
    network, estimate = oriented.measured.network, oriented.orientation.estimate
    length = residual_lengths(network, estimate)
    fits = length <= FINAL_TOLERANCE_PX
    areas = areas_of_photographs(network, estimate.cameras)
    return log_likelihood(float((length[fits] ** 2).sum()), fits, areas), int(fits.sum())
