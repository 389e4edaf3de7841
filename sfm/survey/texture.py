"""A survey of natural texture from photographs to result, start to end, without any target.

    photographs -> tie points -> orientation -> adjustment -> comparison -> result

From the orientation on it is the way of `sfm.pipeline`: the same adjustment, the same comparison.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfm.adjustment.quality.correlations import orientation_correlations
from sfm.progress import SILENT, Progress, StageClock
from sfm.result import FailedImage, StageTime, SurveyResult
from sfm.survey.comparison import ALONE, OtherPrograms, compare_solution
from sfm.survey.exterior import with_exterior
from sfm.survey.inputs.settings import TiePointSettings
from sfm.survey.inputs.start import find_photographs
from sfm.survey.inputs.survey_file import Survey
from sfm.survey.solution import solve
from sfm.survey.tie_points import MIN_RAYS, orient_tied, tie_photographs


def run_textured_survey(
    survey: Survey,
    *,
    images_dir: Path | None = None,
    jobs: int = 1,
    others: OtherPrograms = ALONE,
    progress: Progress = SILENT,
) -> SurveyResult:
    """Run a survey with [tie_points] from its photographs.

    Args, Raises: as `sfm.pipeline.run_survey`.
    """
    settings = survey.tie_points or TiePointSettings()
    clock = StageClock(progress)
    files = find_photographs(survey, images_dir=images_dir)
    with clock.stage("tie points"):
        tied = tie_photographs(survey, settings, files, jobs=jobs, progress=progress)
    network = tied.network
    with clock.stage("orientation"):
        start = orient_tied(survey, tied, files)
    with clock.stage("adjustment"):
        rays = np.full(len(network.points), MIN_RAYS)
        placed = with_exterior(survey, network, start.estimate, files.names)
        solution = solve(survey, placed.network, placed.estimate, min_rays=rays)
    compared = compare_solution(solution, others, clock, files=files)
    return SurveyResult(
        survey=survey.name,
        unit=survey.unit,
        images_total=len(files),
        failed=tied.failed + tuple(FailedImage(*one) for one in (*start.failures, *solution.dropped_images)),
        adjustment=solution.adjustment,
        code=np.full(len(solution.adjustment.network.points), -1),
        comparison=compared.adjusters,
        baseline=compared.baseline,
        photographs=tied.overlays(settings.window_px),
        control_check=solution.control_check,
        warnings=start.warnings + placed.warnings + solution.warnings + compared.failures,
        reject=survey.reject,
        orientation_correlations=orientation_correlations(solution.adjustment),
        seconds=tuple(StageTime(*one) for one in clock.seconds),
    )
