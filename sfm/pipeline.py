"""Pipeline: runs a survey from photographs to the result.

    given data, photographs -> targets -> orientation -> correspondences -> adjustment -> comparison -> result

Every stage is one call, the same for coded targets, natural texture and given image points. The module of a
stage describes its method and cites the source.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

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
    clock = StageClock(progress)
    so_far = _SoFar(survey)
    with _stating_how_far(so_far, clock), own_threads(jobs):
        so_far.survey, so_far.measured = _measure(survey, images_dir, jobs, store, clock)
        solution = _solve(so_far, jobs, clock)
        copies = find_copies(solution.adjustment)
        if copies:
            so_far.measured = without_copies(so_far.measured, copies)
            solution = _solve(so_far, jobs, clock)
        compared = compare_solution(solution, others, clock, files=so_far.measured.files)
        survey, measured, start, matched = so_far.stages
        return assemble_result(survey, measured, start, matched, solution, compared, clock)


@dataclass
class _SoFar:
    """What the stages of a survey returned so far."""

    survey: Survey
    measured: Measurements | None = None
    start: Orientation | None = None
    matched: Correspondences | None = None

    @property
    def stages(self) -> tuple[Survey, Measurements, Orientation, Correspondences]:
        """What every stage before the adjustment returned."""
        assert self.measured is not None and self.start is not None and self.matched is not None
        return self.survey, self.measured, self.start, self.matched


def _solve(so_far: _SoFar, jobs: int, clock: StageClock) -> SolvedSurvey:
    """Orient, match and adjust the image points; orientation may change the survey and the image points."""
    survey, measured = so_far.survey, so_far.measured
    assert measured is not None
    so_far.start = so_far.matched = None
    with clock.stage("orientation"):
        survey, measured, start = orient_with_models(survey, measured)
        survey, measured, start = agree_on_clocks(survey, measured, start)
        measured, start = agree_on_turns(survey, measured, start)
    so_far.survey, so_far.measured, so_far.start = survey, measured, start
    with clock.stage("matching"):
        so_far.matched = find_correspondences(survey, measured, start, jobs=jobs)
    with clock.stage("adjustment"):
        return solve_survey(survey, so_far.matched)


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
def _stating_how_far(so_far: _SoFar, clock: StageClock) -> Iterator[None]:
    """Add to every GeometryError the name of the survey and, once it is measured, how far it came."""
    try:
        yield
    except GeometryError as error:
        name = f"survey {so_far.survey.name}"
        if so_far.measured is None:
            raise GeometryError(f"{name}: {error}") from error
        reached = unfinished_survey(
            so_far.survey, so_far.measured, so_far.start, so_far.matched, clock, error
        )
        before = f"; reached before: {'; '.join(reached.steps)}" if reached.oriented is not None else ""
        unfinished = UnfinishedSurveyError(f"{name}: {error}{before}")
        unfinished.reached = reached
        raise unfinished from error
