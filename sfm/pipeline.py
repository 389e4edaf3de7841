"""Pipeline: runs a survey from photographs to the result.

    given data, photographs -> image points -> orientation -> all image points -> adjustment -> comparison

Every stage is one call, the same for all sources of image points. The module of a stage describes its method
and cites the source.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from sfm.judgement.survey_result import SurveyResult
from sfm.model.errors import GeometryError
from sfm.runtime.progress import SILENT, Progress, StageClock
from sfm.runtime.threads import own_threads
from sfm.survey.adjusting.choices import solve_survey
from sfm.survey.assembly import ALONE, OtherPrograms, assemble_result, compare_solution
from sfm.survey.inputs.from_exif import exterior_from_exif, moments_from_exif
from sfm.survey.inputs.measurements import (
    NO_PHOTOGRAPHS,
    Measurements,
    find_photographs,
    masks_of,
    refuse_incomplete_cameras,
)
from sfm.survey.inputs.photograph_names import name_photographs
from sfm.survey.inputs.sources import reads_photographs
from sfm.survey.inputs.start import refuse_unknown_photographs
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.measuring.targets import find_changed_files, separate_sizes
from sfm.survey.orientation import Oriented, orient_survey
from sfm.survey.sources.joined import complete_sources, measure_sources
from sfm.survey.sources.source import Correspondences
from sfm.survey.unfinished import UnfinishedSurveyError, unfinished_survey


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
        UnfinishedSurveyError: a stage after the measurement cannot go on; `reached` states how far the survey
            came.
        KolinearError: the survey cannot be run; the message states the remedy.
    """
    clock, reached = StageClock(progress), _Reached(survey)
    with _stating_how_far(reached, clock), own_threads(jobs):
        reached.survey, reached.measured = survey, measured = _measure(survey, images_dir, jobs, store, clock)
        with clock.stage("orientation"):
            oriented = orient_survey(survey, measured)
        reached.oriented = oriented
        with clock.stage("matching"):
            reached.matched = matched = complete_sources(oriented, jobs=jobs)
        with clock.stage("adjustment"):
            solution = solve_survey(oriented.survey, matched)
        compared = compare_solution(solution, others, clock, files=measured.files)
        return assemble_result(oriented, matched, solution, compared, clock)


@dataclass
class _Reached:
    """What the stages of a survey returned so far, for a survey that stops."""

    survey: Survey
    measured: Measurements | None = None
    oriented: Oriented | None = None
    matched: Correspondences | None = None


def _measure(
    survey: Survey, images_dir: Path | None, jobs: int, store: MeasuredStore | None, clock: StageClock
) -> tuple[Survey, Measurements]:
    """Return the survey, with one camera for each size of photographs, and its image points."""
    if not reads_photographs(survey):
        return survey, measure_sources(survey, NO_PHOTOGRAPHS, jobs=jobs, store=store, clock=clock)
    files = find_photographs(survey, images_dir=images_dir)
    named = name_photographs(survey, files)
    survey, clocks = moments_from_exif(named.survey, files)
    survey, positions = exterior_from_exif(survey, files)
    refuse_unknown_photographs(survey, files.names)
    masks = masks_of(survey, images_dir=images_dir)
    masks.refuse_wrong(files.path_of())
    survey = replace(survey, masks=masks.folder)
    sizes = separate_sizes(survey, files)
    survey = sizes.survey
    if survey.start_cameras is None:
        refuse_incomplete_cameras(survey.cameras, survey.source, sizes.files)
    measured = measure_sources(survey, sizes.files, jobs=jobs, store=store, clock=clock)
    return named.without_unmarked(survey, measured.network.points), replace(
        measured,
        images=tuple(dict.fromkeys((*files.names, *measured.images))),
        failed=sizes.left_out + measured.failed,
        remarks=named.remarks
        + find_changed_files(files, survey.marked_hashes)
        + clocks
        + positions
        + sizes.remarks
        + measured.remarks,
    )


@contextmanager
def _stating_how_far(reached: _Reached, clock: StageClock) -> Iterator[None]:
    """Add to every GeometryError the name of the survey and, once it is measured, how far it came."""
    try:
        yield
    except GeometryError as error:
        name = f"survey {reached.survey.name}"
        if reached.measured is None:
            raise GeometryError(f"{name}: {error}") from error
        measured = reached.oriented or reached.measured
        state = unfinished_survey(reached.survey, measured, reached.matched, clock, error)
        before = f"; reached before: {'; '.join(state.steps)}" if state.oriented is not None else ""
        unfinished = UnfinishedSurveyError(f"{name}: {error}{before}")
        unfinished.reached = state
        raise unfinished from error
