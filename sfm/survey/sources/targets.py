"""Targets of a survey: coded ones first; uncoded ones once the photographs are oriented."""

from __future__ import annotations

from pathlib import Path

from sfm.photographs.masks import Masks
from sfm.survey.inputs.settings import Section
from sfm.survey.inputs.survey import Survey, survey_family
from sfm.survey.inputs.survey_file import SurveyFile
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.measuring.targets import measure_photograph
from sfm.survey.sources.source import SurveySource
from sfm.survey.sources.target_matching import match_targets_of
from sfm.survey.target_network import measure_targets


def _measure_one(
    survey: Survey | SurveyFile, image: str, path: Path, store: MeasuredStore
) -> tuple[dict[str, int], bool]:
    if isinstance(survey, Survey):  # which has read the table of its codes
        family = survey.family
    else:
        family = survey_family(survey.targets, survey.codes, survey.plates)
    targets, stored = measure_photograph(
        path, survey.targets, family, store, name=image, masks=Masks(survey.masks)
    )
    return {"targets": len(targets), "rejected": len(targets.rejected_xy)}, stored


def _settings(survey: Survey) -> tuple[tuple[str, Section], ...]:
    plates = tuple((f"plate {k}", plate) for k, plate in enumerate(survey.plates, 2))
    return (("targets", survey.targets), *plates)


SOURCE = SurveySource(measure_targets, match_targets_of, _settings, _measure_one)
