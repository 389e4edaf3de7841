"""A survey from photographs to result, start to end.

    photographs -> targets -> orientation -> matching -> adjustment -> comparison -> result

Every stage is one call; what it does, and from which book, is told where it is written.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfm.adjustment.quality.correlations import orientation_correlations
from sfm.progress import SILENT, Progress, StageClock
from sfm.result import FailedImage, StageTime, SurveyResult
from sfm.survey.circles import check_circles
from sfm.survey.comparison import ALONE, OtherPrograms, compare_solution
from sfm.survey.exterior import with_exterior
from sfm.survey.inputs.start import find_photographs, network_from_observations
from sfm.survey.inputs.survey_file import Survey
from sfm.survey.network import build_network, codes_of, min_rays, name_coded
from sfm.survey.orientation import orient_photographs, orient_survey
from sfm.survey.solution import match_and_adjust, solve
from sfm.survey.target_store import TargetStore
from sfm.survey.targets import measure_photographs
from sfm.survey.texture import run_textured_survey


def run_survey(
    survey: Survey,
    *,
    images_dir: Path | None = None,
    jobs: int = 1,
    others: OtherPrograms = ALONE,
    store: TargetStore | None = None,
    progress: Progress = SILENT,
) -> SurveyResult:
    """Run a survey from its photographs.

    Args:
        survey: what was read from the survey file.
        images_dir: folder of the photographs in place of the survey file's own.
        jobs: photographs measured at a time.
        others: the programs to compare with.
        store: of measured targets, so that a photograph is not measured twice.
        progress: told of stages and photographs.

    Raises:
        KolinearError: the survey cannot be run; the message says what to do.
    """
    if survey.tie_points is not None:
        return run_textured_survey(survey, images_dir=images_dir, jobs=jobs, others=others, progress=progress)
    clock = StageClock(progress)
    files = find_photographs(survey, images_dir=images_dir)
    with clock.stage("targets"):
        photographs = measure_photographs(survey, files, jobs=jobs, store=store, progress=progress)
    with clock.stage("orientation"):
        naming = name_coded(photographs)
        network = build_network(survey, photographs, naming)
        start = orient_photographs(survey, network, files, photographs)
    with clock.stage("matching"):
        naming, network, estimate = match_and_adjust(survey, photographs, naming, start)
        circles = check_circles(survey, photographs, naming, network, estimate)
    with clock.stage("adjustment"):
        placed = with_exterior(survey, circles.network, circles.estimate, files.names)
        solution = solve(survey, placed.network, placed.estimate, min_rays=min_rays(naming))
    compared = compare_solution(solution, others, clock, files=files)
    return SurveyResult(
        survey=survey.name,
        unit=survey.unit,
        images_total=len(files),
        failed=photographs.failed + _failed(start.failures, solution.dropped_images),
        adjustment=solution.adjustment,
        code=codes_of(naming, solution.adjustment.network),
        comparison=compared.adjusters,
        baseline=compared.baseline,
        photographs=photographs.overlays(),
        control_check=solution.control_check,
        warnings=start.warnings + circles.warnings + placed.warnings + solution.warnings + compared.failures,
        eccentricity=circles.eccentricity,
        no_circles=circles.no_circles,
        reject=survey.reject,
        orientation_correlations=orientation_correlations(solution.adjustment),
        seconds=tuple(StageTime(*one) for one in clock.seconds),
    )


def adjust_survey(
    survey: Survey, *, others: OtherPrograms = ALONE, progress: Progress = SILENT
) -> SurveyResult:
    """Run what comes after the photographs on a survey's [observations]; Args, Raises: as `run_survey`."""
    clock = StageClock(progress)
    network, estimate = network_from_observations(survey)
    with clock.stage("orientation"):
        start = orient_survey(survey, network, estimate)
    with clock.stage("adjustment"):
        placed = with_exterior(survey, network, start.estimate, network.images)
        solution = solve(survey, placed.network, placed.estimate)
    compared = compare_solution(solution, others, clock)
    return SurveyResult(
        survey=survey.name,
        unit=survey.unit,
        images_total=len(network.images),
        failed=_failed(start.failures, solution.dropped_images),
        adjustment=solution.adjustment,
        code=np.full(len(solution.adjustment.network.points), -1),
        comparison=compared.adjusters,
        control_check=solution.control_check,
        warnings=start.warnings + placed.warnings + solution.warnings + compared.failures,
        reject=survey.reject,
        orientation_correlations=orientation_correlations(solution.adjustment),
        seconds=tuple(StageTime(*one) for one in clock.seconds),
    )


def _failed(*failures: tuple[tuple[str, str], ...]) -> tuple[FailedImage, ...]:
    return tuple(FailedImage(*one) for stage in failures for one in stage)
