"""Surveys of two rendered photographs: the result, what a pair cannot show, and the solutions of a plane."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.errors import GeometryError
from sfm.orientation.incremental.starting_pair import TWOFOLD
from sfm.pipeline import run_survey
from sfm.remarks.remark import kinds_of, of_kind
from sfm.report.findings.survey_remarks import findings_of
from sfm.result import SurveyResult
from sfm.similarity import fit_similarity
from sfm.survey.circles import circle_misfit
from sfm.survey.inputs.measurements import Measurements, find_photographs
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.orientation import orient_survey
from sfm.survey.target_network import measure_targets
from tests.surveys import C_MM, code_centres, write_observed_survey, write_photograph_survey

FREE = '["c", "x0", "y0", "K1", "K2", "K3", "P1", "P2"]'


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    path = write_photograph_survey(tmp_path_factory.mktemp("two") / "survey", "two", photographs=2)
    path.write_text(path.read_text(encoding="utf-8").replace('free = ["c"]', f"free = {FREE}"))
    return read_survey(path)


@pytest.fixture(scope="module")
def measured(survey: Survey) -> Measurements:
    return measure_targets(survey, find_photographs(survey))


def error_mm(names: tuple[str, ...], points: np.ndarray) -> float:
    """Largest distance from the rendered places of the codes after a similarity, mm."""
    truth = code_centres()
    places = np.array([truth[int(name)] for name in names])
    known = np.isfinite(points[:, 0])
    moved = fit_similarity(points[known], places[known]).apply(points[known])
    return float(np.linalg.norm(moved - places[known], axis=1).max())


def test_two_photographs_are_a_survey_that_says_what_it_cannot_tell(survey: Survey) -> None:
    result: SurveyResult = run_survey(survey)
    a = result.adjustment
    assert result.failed == () and len(a.network.images) == 2 and a.converged
    assert a.defect == a.expected_defect
    # 0.01 px of 800 px at 600 mm, and the depth of rays that meet at 50 degrees
    assert error_mm(a.network.points, a.estimate.points) < 0.1
    (held,) = of_kind(result.remarks, "interior_held_of_pair")
    assert held.names("parameters") == ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2")
    verdict = findings_of(result).verdict
    assert verdict.level == "bad" and of_kind(verdict.remarks, "two_photographs")


def test_a_calibrated_pair_is_good_and_says_what_it_rests_on(survey: Survey) -> None:
    cameras = tuple(one.model_copy(update={"c_mm": C_MM, "free": ()}) for one in survey.cameras)
    result = run_survey(replace(survey, cameras=cameras))
    a = result.adjustment
    assert len(a.network.images) == 2
    verdict = findings_of(result).verdict
    assert verdict.level == "good"
    assert len(of_kind(verdict.remarks, "held_weakly_tested", "two_photographs")) == 2
    truth = np.array([code_centres()[int(name)] for name in a.network.points])
    error = fit_similarity(truth, a.estimate.points).apply(truth) - a.estimate.points
    sigma = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 1.5


def test_points_of_a_plane_and_the_circles_in_it(survey: Survey, measured: Measurements) -> None:
    """Without the four codes of the upper plate; circles look like ellipses on a model that is stretched."""
    on_plane = [abs(code_centres()[int(name)][2]) < 1 for name in measured.network.points]
    seen = measured.network.image_points
    network = replace(measured.network, image_points=seen.select(np.array(on_plane)[seen.point]))
    assert measured.naming is not None and measured.photographs is not None
    point = tuple(
        np.where((named >= 0) & np.append(on_plane, True)[named], named, -1)
        for named in measured.naming.point
    )
    naming = replace(measured.naming, point=point)
    found = orient_survey(survey, replace(measured, network=network, naming=naming))
    assert found.kind == "planar" and kinds_of(found.remarks) == ("interior_held_of_pair",)
    assert error_mm(network.points, found.estimate.points) < 0.3
    true = circle_misfit(measured.photographs, naming, network, found.estimate)
    stretched = replace(
        found.estimate,
        position=found.estimate.position * [1.0, 1.0, 1.5],
        points=found.estimate.points * [1.0, 1.0, 1.5],
    )
    assert true < 0.03
    assert circle_misfit(measured.photographs, naming, network, stretched) > TWOFOLD * true


def test_photographs_without_anything_in_common_are_named(tmp_path: Path) -> None:
    path = write_observed_survey(tmp_path / "s", "apart", images=3, points=20)
    table = path.parent / "image_points.csv"
    lines = table.read_text(encoding="utf-8").splitlines()
    renamed = [line.replace(",", ",x", 1) if line.startswith("image 2") else line for line in lines]
    few = [line for line in renamed if not line.startswith("image 3") or ",3," in line or ",4," in line]
    table.write_text("\n".join(few) + "\n", encoding="utf-8")
    with pytest.raises(GeometryError, match="no two of the 3 photographs have 4 points in common") as error:
        run_survey(read_survey(path))
    assert error.match(r"image 2: none of its 2\d? points is in another photograph")
    assert error.match(r"image 1: 2 points in common with image 3")
