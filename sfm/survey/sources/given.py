"""Given image points of a survey, of another program or measured by hand; they do not change."""

from __future__ import annotations

from sfm.survey.inputs.start import measurements_from_observations
from sfm.survey.sources.source import SurveySource, complete_as_measured

SOURCE = SurveySource(lambda survey, files, **_: measurements_from_observations(survey), complete_as_measured)
