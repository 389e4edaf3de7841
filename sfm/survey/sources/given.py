"""Given image points of a survey, of another program or measured by hand; they do not change."""

from __future__ import annotations

from sfm.runtime.progress import SILENT, Progress
from sfm.survey.inputs.measurements import Measurements, PhotographList
from sfm.survey.inputs.start import measurements_from_observations
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.sources.source import SurveySource, complete_as_measured


def _read(
    survey: Survey,
    files: PhotographList,
    *,
    jobs: int = 1,
    store: MeasuredStore | None = None,
    progress: Progress = SILENT,
) -> Measurements:
    return measurements_from_observations(survey)


SOURCE = SurveySource(_read, complete_as_measured)
