"""What the report states about a result, judged as it is now: tests change parts of results."""

from __future__ import annotations

from sfm.judgement.survey_result import SurveyResult
from sfm.judgement.verdict import judge_survey
from sfm.report import findings


def findings_of(result: SurveyResult) -> findings.Findings:
    """Return the findings of a result after judging it anew."""
    return findings.findings_of(judge_survey(result))
