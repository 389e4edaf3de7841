"""The result of a survey, put together from what its stages returned.

The settings that a survey was run with, as its report lists them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sfm.adjustment.quality.correlations import exterior_correlations, strong_correlations
from sfm.conventions import IntArray
from sfm.orientation.incremental.sequence import Orientation
from sfm.result import CheckPoint, FailedImage, SeenPlate, StageTime, SurveyResult
from sfm.runtime.progress import StageClock
from sfm.survey.adjusting.solution import SolvedSurvey
from sfm.survey.correspondences import Correspondences
from sfm.survey.diagnosis.codes_found import plates_not_in_result
from sfm.survey.inputs.measurements import Measurements
from sfm.survey.inputs.settings import Section
from sfm.survey.inputs.survey import Survey
from sfm.survey.other_programs import SurveyComparison
from sfm.targets.codes.plates import points_of_plates


def assemble_result(
    survey: Survey,
    measured: Measurements,
    start: Orientation,
    matched: Correspondences,
    solution: SolvedSurvey,
    compared: SurveyComparison,
    clock: StageClock,
) -> SurveyResult:
    """Return everything that a survey ends with; each argument is what the stage of that name returned."""
    adjustment, naming = solution.adjustment, matched.naming
    points = adjustment.network.points
    is_in = set(adjustment.network.images)  # a photograph may fit at last, with a per-photograph camera
    failed = tuple(
        FailedImage(*one)
        for one in (*start.failures, *matched.left_out, *solution.dropped_images)
        if one[0] not in is_in
    )
    correlations = exterior_correlations(adjustment)
    code = np.full(len(points), -1) if naming is None else naming.codes(adjustment.network)
    return SurveyResult(
        survey=survey.name,
        unit=survey.unit,
        images_total=len(measured.images) - sum(one.is_copy for one in measured.failed),
        failed=measured.failed + failed,
        adjustment=adjustment,
        code=code,
        comparison=compared.adjusters,
        baseline=compared.baseline,
        photographs=measured.overlays if matched.overlays is None else matched.overlays,
        control_check=solution.control_check,
        remarks=(
            *measured.remarks,
            *start.remarks,
            *matched.remarks,
            *solution.remarks,
            *(() if naming is None else plates_not_in_result(survey.family, code)),
            *compared.remarks,
        ),
        eccentricity=matched.eccentricity,
        no_circles=matched.no_circles,
        left_out=(*measured.left_out, *solution.left_out),
        settings=settings_by_table(survey),
        given_tests=solution.given_tests,
        other_solutions=solution.others,
        unused_image_points=solution.unused_image_points + sum(one.image_points for one in measured.left_out),
        reject=survey.reject,
        weights=survey.adjust.weights,
        plates=_plates(survey, code),
        check_points=_check_points(survey),
        equipment=survey.equipment,
        balance_radius_mm=tuple(
            (one.name, dict(one.balanced)["R0"]) for one in survey.cameras if one.balanced
        ),
        exterior_correlations=correlations,
        orientation_correlations=strong_correlations(correlations),
        seconds=tuple(StageTime(*one) for one in clock.seconds),
    )


def _plates(survey: Survey, code: IntArray) -> tuple[SeenPlate, ...]:
    """Return the plates of a survey with their points in the result."""
    plates = points_of_plates(survey.family, code)
    if not plates:
        return ()
    sigma = [one.plate_sigma or 0.0 for one in (survey.targets, *survey.plates)]
    return tuple(SeenPlate(*one) for one in zip(plates, sigma, strict=True))


def _check_points(survey: Survey) -> tuple[CheckPoint, ...]:
    """Return the points of which the control table marks coordinates to check with."""
    control = survey.control
    if control is None or control.check is None:
        return ()
    return tuple(
        CheckPoint(control.names[k], np.where(control.check[k], control.xyz[k], np.nan), control.sigma[k])
        for k in np.flatnonzero(control.check.any(axis=1))
    )


def settings_by_table(survey: Survey) -> tuple[tuple[str, str], ...]:
    """Return (table of the survey file, its keys and values) of all that was stated or has a default.

    Args:
        survey: as it was run.
    """
    sections: list[tuple[str, Section]] = [(f"camera {one.name}", one) for one in survey.cameras]
    if survey.observations is None:
        sections.append(("targets", survey.targets))
        sections += [(f"plate {k}", one) for k, one in enumerate(survey.plates, 2)]
    if survey.tie_points is not None:
        sections.append(("tie_points", survey.tie_points))
    sections += [("datum", survey.datum), ("adjust", survey.adjust), ("compare", survey.compare)]
    rows = [(name, _words(section.model_dump())) for name, section in sections]
    given = [
        (one, len(values.names))
        for one, values in (
            ("control points", survey.control),
            ("photographs of [exterior]", survey.exterior),
        )
        if values is not None
    ]
    if survey.scale_bars:
        given.append(("scale bars", len(survey.scale_bars)))
    if survey.observations is not None:
        given.append(("image points", len(survey.observations.xy)))
    if given:
        rows.append(("given", ", ".join(f"{count} {name}" for name, count in given)))
    return tuple(rows)


def _words(values: dict[str, Any]) -> str:
    """Return keys with values that are not empty."""
    return "; ".join(
        f"{key} = {_word(value)}"
        for key, value in values.items()
        if key != "name" and value is not None and value != ()
    )


def _word(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_word(one) for one in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
