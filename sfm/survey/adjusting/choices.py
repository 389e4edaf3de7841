"""Solves a survey, also with other models that its solution suggests, and takes the likeliest.

Copies of photographs are left out, as they are no second observation. Photographs of a rig that lose their
points, while others of their moment fit, are adjusted free of the rig. If texture shows that photographs were
zoomed, c is adjusted per photograph. Points that moved so far that their coordinates are wrong keep the image
points of one state, that of the middle of the sequence, and the rest is judged with these.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sfm.adjustment.quality.statistics import more_than_chance
from sfm.judgement.model_choice import Choice, choose
from sfm.judgement.verdict import judge_adjustment
from sfm.model.camera import base_name
from sfm.model.conventions import IntArray
from sfm.model.estimate import Mounts
from sfm.model.remarks.remark import of_kind, remark
from sfm.model.remarks.row import Quantity
from sfm.runtime.progress import report_step
from sfm.survey.adjusting.solved_survey import SolvedSurvey, SurveyModel, log_likelihood_of_all, solve_model
from sfm.survey.inputs.checks.copies import find_copies, without_copies
from sfm.survey.inputs.survey import Survey
from sfm.survey.sources.source import Correspondences

POSE = 6  # parameters of the pose of a photograph
OF_CAMERAS = ("other_camera", "camera_varies", "camera_drift")
# Ratio of principal distances by focusing a thin lens from far to 34 c. A difference up to this ratio is only
# reported. With c free in each photograph, photographs that determine it badly do more harm than good: two
# halves of a video whose c differs by 2 % then differ by 4 % of the distance, and by 0.04 % with one c.
MAX_FOCUS_CHANGE = 1.03


def solve_survey(survey: Survey, matched: Correspondences) -> SolvedSurvey:
    """Adjust the network in the datum of the survey, with rejection of outliers and full covariance.

    Points with too few accepted rays and photographs with too few accepted points are removed, and the rest
    is adjusted again. A free network is placed on the scale bars and the control, if there are any, without a
    change of shape.

    Args:
        survey: states the datum, the a priori sigma and observed exterior orientation.
        matched: all image points, and approximate values of all unknowns.

    Raises:
        GeometryError: too little is left to adjust, or the datum is control but no control is seen.
    """
    usual = solve_model(SurveyModel(survey, matched))
    return choose(usual, CHOICES, solve_model, false_alarm=survey.adjust.false_alarm)


def _models_without_copies(solved: SolvedSurvey) -> Iterator[SurveyModel]:
    """Yield the model without the photographs whose errors are those of another one."""
    copies = find_copies(solved.adjustment)
    if copies:
        matched = solved.model.matched
        network, estimate = without_copies(matched.network, matched.estimate, copies)
        left_out = tuple(
            (name, remark("copies", original=first, same="errors of the image points"))
            for name, (first, _) in copies.items()
        )
        yield replace(
            solved.model,
            matched=replace(matched, network=network, estimate=estimate),
            left_out=solved.model.left_out + left_out,
        )


def _models_with_varying_c(solved: SolvedSurvey) -> Iterator[SurveyModel]:
    """Yield the model in which c, as texture shows, differs among the photographs of a camera."""
    survey = solved.model.survey
    differs = any(said.kind in OF_CAMERAS and "change" in said.numbers for said in solved.remarks)
    varying = frozenset(camera.name for camera in survey.cameras if not camera.states_free)
    if differs and varying and solved.adjustment.network.has_common_errors and not survey.rigs:
        report_step("adjusting c of each photograph")
        yield replace(solved.model, varying=varying)


def _models_free_of_rigs(solved: SolvedSurvey) -> Iterator[SurveyModel]:
    """Yield models in which photographs that contradict their rig, or lost their points to it, are free.

    Where all photographs of a moment lost points, the one that lost the smallest share stays. The free
    photographs of a moment keep the mounts among themselves, or each is free. The larger part of a moment
    counts as that of the rig, and of two photographs that of the reference camera.
    """
    network, estimate = solved.model.matched.network, solved.model.matched.estimate
    stated, oriented = network.moment, estimate.oriented
    if stated is None:
        return
    seen, m = network.image_points, len(network.images)
    known = np.isin(network.points, solved.adjustment.network.points)[seen.point]
    count = np.bincount(seen.image[known], minlength=m)
    against = np.bincount(seen.image[known & ~solved.accepted], minlength=m)
    share = np.where(oriented, against / np.maximum(count, 1), np.inf)
    least = np.full(int(stated.max()) + 1, np.inf)
    np.minimum.at(least, stated, share)
    names = [
        name for said in of_kind(solved.remarks, "rig_contradicted") for name in said.names("photographs")
    ]
    named = np.isin(network.images, names)  # never all of a moment
    level = solved.adjustment.levels.family
    free = oriented & (more_than_chance(against, count, level) & (share > least[stated]) | named)
    left = np.bincount(stated[oriented & ~free], minlength=len(least))
    free &= (left[stated] > 0) | named
    free &= np.bincount(stated[oriented], minlength=len(least))[stated] > 1  # not free already
    if not free.any():
        return
    report_step("adjusting photographs free of their rig")
    together = np.where(free, stated + len(least), stated)
    references = [rig.cameras[0] for rig in solved.model.survey.rigs]
    of_reference = np.isin([camera.name for camera in estimate.cameras], references)[network.camera]
    # photographs of each moment, and half of one more with the reference camera
    size = np.bincount(together, oriented * (1 + of_reference / 2), minlength=2 * len(least))
    smaller = size[: -len(least)] < size[len(least) :]
    together = np.where(smaller[stated], (together + len(least)) % (2 * len(least)), together)
    yield _with_moments(solved.model, together)
    if (np.bincount(together[oriented], minlength=2 * len(least))[len(least) :] > 1).any():
        yield _with_moments(solved.model, np.where(free, len(least) + np.arange(m), stated))


def _with_moments(model: SurveyModel, moment: IntArray) -> SurveyModel:
    """Return the model with other moments; cameras without others at any moment are on no rig."""
    matched = model.matched
    network, mounts = replace(matched.network, moment=moment), matched.estimate.mounts
    if mounts is not None:
        together = np.bincount(moment[matched.estimate.oriented], minlength=int(moment.max()) + 1)
        paired = np.isin(np.arange(len(mounts.rig)), network.camera[together[moment] > 1])
        mounts = Mounts(
            np.where(paired[:, None], mounts.position, 0.0),
            np.where(paired[:, None, None], mounts.rotation, np.eye(3)),
            mounts.free & paired[:, None],
            tuple(rig if on else "" for rig, on in zip(mounts.rig, paired, strict=True)),
        )
    estimate = replace(matched.estimate, mounts=mounts)
    return replace(
        model,
        matched=replace(matched, network=network, estimate=estimate),
        stated_moment=matched.network.moment if model.stated_moment is None else model.stated_moment,
    )


# Largest share of the image points that is left out. Which of two states is the object, a person decides.
MAX_MOVED = 0.1


def _models_with_one_state(solved: SolvedSurvey) -> Iterator[SurveyModel]:
    """Yield the model without the image points of another state of points that moved, if these are few.

    Of the photographs before a move and those after it, those with the middle of the sequence stay. So the
    coordinates of all points describe one state. Control and ends of bars are left to a person.
    """
    model, network = solved.model, solved.model.matched.network
    moved = tuple(move for move in of_kind(solved.remarks, "points_moved") if move not in model.moved)
    if model.survey.reject == "none" or not any(move.severity == "error" for move in moved):
        return
    seen, bars, middle = network.image_points, network.scale_bars, (len(network.images) - 1) // 2
    gone, states = np.zeros(len(seen), dtype=bool), []
    for move in moved:
        start = network.image_index(move.names("from")[0])
        another = seen.image >= start if middle < start else seen.image < start
        gone |= another & np.isin(network.points, move.names("points"))[seen.point]
        state = ("before" if middle < start else "after",)
        numbers = {**move.numbers, "wrong": Quantity(0.0)}  # they shift the others no longer
        states.append(replace(move, subjects={**move.subjects, "state": state}, numbers=numbers))
    given = np.isin(seen.point, np.concatenate([network.control.point, bars.start, bars.end]))
    unused = model.unused + int(gone.sum())
    if gone.any() and not (gone & given).any() and unused < MAX_MOVED * (len(seen) + model.unused):
        report_step("adjusting one state of the points that moved")
        matched = replace(model.matched, network=replace(network, image_points=seen.select(~gone)))
        yield replace(model, matched=matched, moved=(*model.moved, *states), unused=unused)


def _gain_of_one_state(_: SolvedSurvey, after: SolvedSurvey) -> float:
    """Return whether the rest fits; a test has decided before that the points moved.

    Points that moved again are in several states still.
    """
    verdict = judge_adjustment(after.adjustment).verdict
    fits = verdict is not None and verdict.level != "bad"
    fits &= not any(named.severity == "error" for named in after.remarks)
    once = {name for moved in after.model.moved for name in moved.names("points")}
    again = {
        name
        for moved in after.remarks
        if moved not in after.model.moved
        for name in (*moved.names("points"), *moved.names("point"))
        if moved.kind in ("points_moved", "two_places")
    }
    fits &= once.isdisjoint(again)
    return float("inf") if fits else -float("inf")


def _gain_of_free_photographs(before: SolvedSurvey, after: SolvedSurvey) -> float:
    """Return the gain of ln likelihood."""
    freed = POSE * len(_further_poses(before, after)) + _free_of_mounts(after) - _free_of_mounts(before)
    return _gain_of_parameters(before, after, freed)


def _further_poses(before: SolvedSurvey, after: SolvedSurvey) -> list[tuple[int, int]]:
    """Return the parameters of each further pose, and the number of its image points."""
    network, earlier = after.model.matched.network, before.model.matched.network.moment
    moment = network.moment
    if moment is None:
        return []
    count = np.bincount(moment[network.image_points.image], minlength=int(moment.max()) + 1)
    further = np.setdiff1d(moment, moment if earlier is None else earlier)
    return [(POSE, int(count[k])) for k in further]


def _free_of_mounts(solved: SolvedSurvey) -> int:
    """Return the number of free parameters of mounts."""
    mounts = solved.adjustment.estimate.mounts
    return 0 if mounts is None else int(mounts.free.sum())


def _gain_of_varying_c(before: SolvedSurvey, zoomed: SolvedSurvey) -> float:
    """Return the gain of ln likelihood, if c differs by more than focusing changes it."""
    if not any(max(c) > MAX_FOCUS_CHANGE * min(c) for _, c, _ in _c_per_photograph(zoomed)):
        return -float("inf")
    return _gain_of_parameters(before, zoomed, _freed_of_cameras(before, zoomed))


def _freed_by_varying_c(before: SolvedSurvey, zoomed: SolvedSurvey) -> list[tuple[int, int]]:
    """Return the further parameters, and the number of image points of a photograph."""
    a = zoomed.adjustment
    return [(_freed_of_cameras(before, zoomed), len(a.rejected) // len(a.network.images))]


def _freed_of_cameras(before: SolvedSurvey, after: SolvedSurvey) -> int:
    """Return the number of further interior parameters that are adjusted."""
    return after.adjustment.unknown_counts[1] - before.adjustment.unknown_counts[1]


def _gain_of_parameters(before: SolvedSurvey, after: SolvedSurvey, freed: int) -> float:
    """Return the gain of ln likelihood by further parameters, if the network determines them."""
    if not after.adjustment.converged or after.adjustment.undetermined:
        return -float("inf")
    return _log_likelihood(after, freed) - _log_likelihood(before)


def _log_likelihood(solved: SolvedSurvey, freed: int = 0) -> float:
    """Return ln of the likelihood of all image points of a survey, see `log_likelihood_of_all`."""
    matched = solved.model.matched
    return log_likelihood_of_all(solved.adjustment, matched.network, matched.estimate, solved.accepted, freed)


def _report_varying_c(_: SolvedSurvey, zoomed: SolvedSurvey) -> SolvedSurvey:
    """Return the solution with a remark on each camera with c per photograph."""
    said = (
        remark("c_per_photograph", camera=name, least=(min(c), unit), most=(max(c), unit))
        for name, c, unit in _c_per_photograph(zoomed)
    )
    return replace(zoomed, remarks=(*zoomed.remarks, *said))


def _c_per_photograph(solved: SolvedSurvey) -> Iterator[tuple[str, list[float], str]]:
    """Yield the name of each camera with c per photograph, the values of c, and their unit."""
    for name in sorted(solved.model.varying):
        cameras = [
            camera
            for camera in solved.adjustment.estimate.cameras
            if camera.name != name and base_name(camera.name, [name]) == name
        ]
        if cameras:
            yield name, [float(camera.parameters[0]) for camera in cameras], cameras[0].units[0]


FREE_OF_RIGS = Choice(_models_free_of_rigs, _gain_of_free_photographs, _further_poses)
CHOICES = (
    Choice(_models_without_copies),
    FREE_OF_RIGS,
    FREE_OF_RIGS,  # others, which those found first concealed
    Choice(_models_with_one_state, _gain_of_one_state, onward=True),
    Choice(_models_with_varying_c, _gain_of_varying_c, _freed_by_varying_c, _report_varying_c),
)
