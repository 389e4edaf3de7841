"""Pipeline: runs a survey from photographs to the result.

    given data, photographs -> targets -> orientation -> correspondences -> adjustment -> comparison -> result

Every stage is one call, the same for coded targets, natural texture and given image points. The module of a
stage describes its method and cites the source.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm.display import counted
from sfm.errors import GeometryError
from sfm.kernels.threads import own_threads
from sfm.orientation.incremental.sequence import Orientation
from sfm.result import SurveyResult
from sfm.runtime.progress import SILENT, Progress, StageClock
from sfm.survey.adjusting.solution import SolvedSurvey, solve_survey
from sfm.survey.assembly import ALONE, OtherPrograms, assemble_result, compare_solution
from sfm.survey.board_turns import agree_on_turns
from sfm.survey.clock_offsets import agree_on_clocks
from sfm.survey.correspondences import Correspondences, find_correspondences
from sfm.survey.inputs.checks.copies import find_copies, without_copies
from sfm.survey.inputs.from_exif import exterior_from_exif, moments_from_exif
from sfm.survey.inputs.measurements import Measurements, find_photographs, refuse_incomplete_cameras
from sfm.survey.inputs.start import measurements_from_observations, refuse_unknown_photographs
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.measuring.targets import separate_sizes
from sfm.survey.measuring.tie_points import tie_photographs
from sfm.survey.orientation import orient_with_models
from sfm.survey.target_network import measure_targets


def run_survey(
    survey: Survey,
    *,
    images_dir: Path | None = None,
    jobs: int = 1,
    others: OtherPrograms = ALONE,
    store: MeasuredStore | None = None,
    progress: Progress = SILENT,
) -> SurveyResult:
    """Run a survey from its photographs, or from the image points that it gives in place of them.

    Args:
        survey: settings and given data.
        images_dir: folder of the photographs; the folder named in the survey if not given.
        jobs: number of threads, which is the number of photographs measured at the same time.
        others: programs that the result is compared with.
        store: keeps the measurements, so that no photograph is measured twice.
        progress: receives stages and photographs.

    Raises:
        KolinearError: the survey cannot be run; the message states the remedy.
    """
    clock = StageClock(progress)
    reached: list[str] = []
    with _stating_progress(survey, reached), own_threads(jobs):
        survey, measured = _measure(survey, images_dir, jobs, store, clock)
        survey, measured, start, matched, solution = _solve(survey, measured, jobs, clock, reached)
        copies = find_copies(solution.adjustment)
        if copies:
            measured = without_copies(measured, copies)
            survey, measured, start, matched, solution = _solve(survey, measured, jobs, clock, reached)
        compared = compare_solution(solution, others, clock, files=measured.files)
        return assemble_result(survey, measured, start, matched, solution, compared, clock)


def _solve(
    survey: Survey, measured: Measurements, jobs: int, clock: StageClock, reached: list[str]
) -> tuple[Survey, Measurements, Orientation, Correspondences, SolvedSurvey]:
    """Orient, match and adjust the image points; orientation may change the survey and the image points.

    `reached` receives what each stage reached, for the message of a stage that cannot go on.
    """
    network = measured.network
    seen = len(np.unique(network.image_points.image))
    measured_points = counted(len(network.image_points), "image point")
    reached[:] = [f"{measured_points} in {seen} of {counted(len(network.images), 'photograph')}"]
    with clock.stage("orientation"):
        survey, measured, start = orient_with_models(survey, measured)
        survey, measured, start = agree_on_clocks(survey, measured, start)
        measured, start = agree_on_turns(survey, measured, start)
    oriented = f"{start.estimate.oriented.sum()} of {len(start.estimate.oriented)} photographs oriented"
    reached.append(f"{oriented}, {counted(int(start.estimate.determined.sum()), 'object point')}")
    with clock.stage("matching"):
        matched = find_correspondences(survey, measured, start, jobs=jobs)
    reached.append(f"{counted(len(matched.network.image_points), 'image point')} matched")
    with clock.stage("adjustment"):
        solution = solve_survey(survey, matched)
    return survey, measured, start, matched, solution


def _measure(
    survey: Survey, images_dir: Path | None, jobs: int, store: MeasuredStore | None, clock: StageClock
) -> tuple[Survey, Measurements]:
    """Return the survey, with one camera for each size of photographs, and its image points."""
    if survey.observations is not None:
        return survey, measurements_from_observations(survey)
    files = find_photographs(survey, images_dir=images_dir)
    survey, clocks = moments_from_exif(survey, files)
    survey, positions = exterior_from_exif(survey, files)
    refuse_unknown_photographs(survey, files.names)
    sizes = separate_sizes(survey, files)
    survey = sizes.survey
    if survey.start_cameras is None:
        refuse_incomplete_cameras(survey.cameras, survey.source, sizes.files)
    if survey.tie_points is not None:
        with clock.stage("tie points", len(sizes.files)):
            measured = tie_photographs(survey, sizes.files, jobs=jobs, store=store, progress=clock.progress)
    else:
        with clock.stage("targets", len(sizes.files)):
            measured = measure_targets(survey, sizes.files, jobs=jobs, store=store, progress=clock.progress)
    return survey, replace(
        measured,
        images=files.names,
        failed=sizes.left_out + measured.failed,
        remarks=clocks + positions + sizes.remarks + measured.remarks,
    )


@contextmanager
def _stating_progress(survey: Survey, reached: list[str]) -> Iterator[None]:
    """Add to the message of a GeometryError the name of the survey, and how far the survey came."""
    try:
        yield
    except GeometryError as error:
        so_far = f"; reached before: {'; '.join(reached)}" if len(reached) > 1 else ""
        raise GeometryError(f"survey {survey.name}: {error}{so_far}") from error
