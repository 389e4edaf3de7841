"""A survey beside other programs: what the report says of them, and that it stands without them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.colmap.mapper import MapperBaseline
from sfm.conventions import rotation_from_vector
from sfm.errors import BackendError, SurveyFileError
from sfm.pipeline import run_survey
from sfm.remarks.remark import of_kind
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.output import write_result
from sfm.result import SurveyResult
from sfm.similarity import Similarity
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.survey import Survey, read_survey
from tests.surveys import write_observed_survey, write_photograph_survey

TURN = Similarity(30.0, rotation_from_vector(np.array([0.4, 1.0, -0.2])), np.array([5.0, -2.0, 8.0]))


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    return read_survey(write_photograph_survey(tmp_path_factory.mktemp("mapped") / "s", "mapped"))


@pytest.fixture(scope="module")
def alone(survey: Survey) -> SurveyResult:
    return run_survey(survey)


def test_another_pipeline_stands_beside_the_survey(
    survey: Survey, alone: SurveyResult, tmp_path: Path
) -> None:
    a = alone.adjustment

    def mapper(folder: Path, cameras: tuple[tuple[str, ...], ...]) -> MapperBaseline:
        assert folder == survey.folder
        assert cameras == (tuple(f"photo {k}.png" for k in range(1, 7)),)
        theirs = TURN.apply_estimate(a.estimate)
        c = theirs.cameras[0]
        worse = replace(
            theirs,
            cameras=(c.with_parameters(c.parameters * np.where(np.array(c.names) == "c", 1.001, 1.0)),),
        )
        return MapperBaseline(a.network, worse, total=6, rms_px=0.7, seconds=12.0)

    result = run_survey(survey, others=OtherPrograms(mapper=mapper))
    found = result.baseline
    assert found is not None and result.comparison is None
    assert found.photographs == (6, 6) and found.targets == len(a.network.points)
    assert found.rms_px == (a.rms_px, 0.7) and found.seconds[1] == 12.0
    assert a.rms_px < found.target_rms_px < 5.0  # its camera is wrong by 1/1000
    assert found.max_rotation_deg < 0.1
    page = write_result(findings_of(result), tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))["baseline"]
    assert summary["images"] == {"kolinear": 6, "COLMAP mapper": 6, "total": 6}
    assert summary["point_rms"] == pytest.approx(found.point_rms)
    text = page.read_text(encoding="utf-8")
    assert "And COLMAP mapper by itself?" in text and "12.0" in text


def test_a_pipeline_that_fails_does_not_lose_the_survey(survey: Survey, tmp_path: Path) -> None:
    def mapper(folder: Path, cameras: tuple[tuple[str, ...], ...]) -> MapperBaseline:
        raise BackendError("COLMAP's mapper found no model")

    result = run_survey(survey, others=OtherPrograms(mapper=mapper))
    assert result.baseline is None
    (failed,) = of_kind(result.remarks, "pipeline_failed")
    assert failed.names("reason") == ("COLMAP's mapper found no model",)
    page = write_result(findings_of(result), tmp_path / "out").read_text(encoding="utf-8")
    assert "And COLMAP mapper by itself?" not in page and "found no model" in page


def test_another_pipeline_needs_photographs(tmp_path: Path) -> None:
    path = write_observed_survey(tmp_path / "s", "observed")
    text = path.read_text(encoding="utf-8").replace("[compare]", '[compare]\nbaseline = "mapper"')
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"baseline = 'mapper' needs photographs, the survey has \[obs"):
        read_survey(path)
