"""Assembly of the survey result from its stages, and comparison with other programs.

The result also lists the settings that the survey was run with, for its report.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sfm.adjustment.quality.correlations import exterior_correlations, strong_correlations
from sfm.comparison.solutions import Baseline, BaselineComparison, compare_baseline
from sfm.comparison.two_adjusters.adjusters import AdjusterComparison, BackendAdjustment, compare_adjusters
from sfm.judgement.survey_result import SeenPlate, StageTime, SurveyResult
from sfm.judgement.verdict import judge_survey
from sfm.model.errors import KolinearError, MissingLibraryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import Remark, remark
from sfm.runtime.progress import StageClock
from sfm.survey.adjusting.solved_survey import SolvedSurvey
from sfm.survey.diagnosis.codes_found import plates_not_in_result
from sfm.survey.inputs.measurements import PhotographList, remarks_on_contradicting
from sfm.survey.inputs.settings import Section
from sfm.survey.inputs.sources import given_tables
from sfm.survey.inputs.survey import Survey
from sfm.survey.orientation import Oriented
from sfm.survey.sources.joined import sources_of
from sfm.survey.sources.source import Correspondences
from sfm.targets.codes.plates import points_of_plates

Adjuster = Callable[[Network, Estimate], BackendAdjustment]
"""another adjuster: takes a network and start values, returns its solution"""


def assemble_result(
    oriented: Oriented,
    matched: Correspondences,
    solution: SolvedSurvey,
    compared: SurveyComparison,
    clock: StageClock,
) -> SurveyResult:
    """Return the judged result of a survey; each argument is what the stage of that name returned."""
    survey, measured, start = oriented.survey, oriented.measured, oriented.orientation
    adjustment, naming = solution.adjustment, matched.naming
    is_in = set(adjustment.network.images)  # a failed photograph may fit later with a per-photograph camera
    reasons: dict[str, Remark] = {}  # of a photograph placed by its rig: that of its orientation
    for name, reason in (*start.failures, *matched.left_out, *solution.dropped_images):
        if name not in is_in:
            reasons.setdefault(name, reason)
    failed = (*measured.failed, *(measured.not_in_result(image, reason) for image, reason in reasons.items()))
    before = (*measured.left_out, *matched.left_out_image_points)
    correlations = exterior_correlations(adjustment)
    code = naming.codes(adjustment.network)
    plates = points_of_plates(survey.family, code)
    sigmas = [plate.plate_sigma or 0.0 for plate in (survey.targets, *survey.plates) if plates]
    result = SurveyResult(
        survey=survey.name,
        unit=survey.unit,
        images_total=len(measured.images) - sum(not photograph.is_counted for photograph in failed),
        failed=failed,
        adjustment=adjustment,
        code=code,
        comparison=compared.adjusters,
        baseline=compared.baseline,
        photographs=measured.overlays if matched.overlays is None else matched.overlays,
        control_check=solution.control_check,
        stage_remarks=(
            *measured.remarks,
            *remarks_on_contradicting(before, measured.network),
            *start.remarks,
            *matched.remarks,
            *solution.remarks,
            *plates_not_in_result(survey.family, code),
            *compared.remarks,
        ),
        eccentricity=matched.eccentricity,
        no_circles=matched.no_circles,
        left_out=(*before, *solution.left_out),
        settings=settings_by_table(solution.model.survey),
        given_tests=solution.given_tests,
        other_solutions=solution.others,
        unused_image_points=solution.unused_image_points + sum(point.image_points for point in before),
        reject=survey.reject,
        weights=survey.adjust.weights,
        plates=tuple(SeenPlate(points, sigma) for points, sigma in zip(plates, sigmas, strict=True)),
        check_points=survey.check_points,
        equipment=survey.equipment,
        balance_radius_mm=tuple(
            (camera.name, dict(camera.balanced)["R0"]) for camera in survey.cameras if camera.balanced
        ),
        exterior_correlations=correlations,
        orientation_correlations=strong_correlations(correlations),
        seconds=tuple(StageTime(stage, seconds) for stage, seconds in clock.seconds),
    )
    return judge_survey(result)


def settings_by_table(survey: Survey) -> tuple[tuple[str, str], ...]:
    """Return (table of the survey file, its keys and values) of all stated and default settings.

    Args:
        survey: the survey that was run.
    """
    sections: list[tuple[str, Section]] = [(f"camera {camera.name}", camera) for camera in survey.cameras]
    sections += [section for _, source in sources_of(survey) for section in source.settings(survey)]
    sections += [("datum", survey.datum), ("adjust", survey.adjust), ("compare", survey.compare)]
    rows = []
    for name, section in sections:
        stated = [
            f"{key} = {_format_value(value)}"
            for key, value in section.model_dump().items()
            if key != "name" and value is not None and value != ()
        ]
        rows.append((name, "; ".join(stated)))
    given = (
        ("control points", survey.control and survey.control.names),
        ("photographs of [exterior]", survey.exterior and survey.exterior.names),
        ("scale bars", survey.scale_bars),
        ("named points", dict.fromkeys(mark.name for mark in survey.marks)),
        ("image points", [name for given in given_tables(survey) for name in given.point]),
    )
    counts = [f"{len(values)} {name}" for name, values in given if values]
    if counts:
        rows.append(("given", ", ".join(counts)))
    return tuple(rows)


def _format_value(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_format_value(part) for part in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


Mapper = Callable[[Path, tuple[tuple[str, ...], ...]], Baseline]
"""another pipeline: takes a folder and the names of each camera's photographs in it, returns its solution"""


@dataclass(frozen=True)
class OtherPrograms:
    """Programs to compare a survey with, as functions: the survey imports none of their libraries."""

    adjuster: Adjuster | None = None
    mapper: Mapper | None = None


ALONE = OtherPrograms()
"""no comparison"""


@dataclass(frozen=True)
class SurveyComparison:
    """Comparisons of a survey with other programs; None for a comparison that was not made."""

    adjusters: AdjusterComparison | None = None
    baseline: BaselineComparison | None = None
    remarks: tuple[Remark, ...] = ()  # on requested comparisons that failed or were left out


def compare_solution(
    solution: SolvedSurvey, others: OtherPrograms, clock: StageClock, *, files: PhotographList | None = None
) -> SurveyComparison:
    """Compare a solution with those of other programs.

    The survey is valid without them: if one of them fails, the result has a warning. A library that is not
    installed gives a remark but no warning, since that is not a defect of the survey.

    Args:
        solution: solution of the survey.
        others: programs to compare with.
        clock: times the stages; the stages timed so far are the time of the survey.
        files: photographs for another pipeline.
    """
    own_seconds = sum(seconds for _, seconds in clock.seconds)
    adjusters = baseline = None
    remarks: list[Remark] = []
    if others.adjuster is not None:
        with clock.stage("comparison"):
            try:
                adjusters = compare_adjusters(solution.adjustment, others.adjuster)
            except MissingLibraryError as error:
                remarks.append(remark("not_compared", what="adjuster", reason=str(error)))
            except KolinearError as error:
                remarks.append(remark("comparison_failed", what="adjuster", reason=str(error)))
    if others.mapper is not None and files is not None:
        with clock.stage("baseline"):
            try:
                mapped = others.mapper(files.folder, files.by_camera())
                baseline = compare_baseline(solution.adjustment, mapped, seconds=own_seconds)
            except MissingLibraryError as error:
                remarks.append(remark("not_compared", what="pipeline", reason=str(error)))
            except KolinearError as error:
                remarks.append(remark("comparison_failed", what="pipeline", reason=str(error)))
    return SurveyComparison(adjusters, baseline, tuple(remarks))
