"""The solution of a survey: control, scale bars, the other adjuster, other programs beside it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.colmap.mapper import MapperBaseline
from sfm.adjustment.quality import variance_components
from sfm.adjustment.quality.variance_components import by_kind
from sfm.judgement.bundle_statistics import statistics_of
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import rotation_from_vector
from sfm.model.errors import BackendError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, ObjectPoints, ScaleBars
from sfm.model.remarks.remark import of_kind
from sfm.model.similarity import Similarity
from sfm.pipeline import run_survey
from sfm.report.output import write_result
from sfm.report.tables.csv_files import write_tables
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.placing import object_scale
from tests.findings import findings_of
from tests.surveys import write_observed_survey, write_photograph_survey
from tests.synthetic import make_network, seed_of


def test_a_failing_comparison_leaves_the_survey(tmp_path: Path) -> None:
    def refuse(network: Network, estimate: Estimate) -> object:
        raise BackendError("COLMAP is not installed")

    survey = read_survey(write_observed_survey(tmp_path / "alone", "alone"))
    result = run_survey(survey, others=OtherPrograms(refuse))  # type: ignore[arg-type]
    assert result.comparison is None
    assert result.adjustment.converged
    (failed,) = of_kind(result.remarks, "comparison_failed")
    assert failed.names("reason") == ("COLMAP is not installed",)


def test_scale_comes_from_bars_before_control_and_two_control_points_are_enough() -> None:
    rng = seed_of("scale")
    network, truth = make_network(rng, images=4, points=10)
    half = replace(truth, points=truth.points / 2)
    two = ObjectPoints(np.array([0, 1]), truth.points[:2], np.zeros((2, 3, 3)))
    assert object_scale(network.with_given(two), half) == pytest.approx(2.0)
    length = np.linalg.norm(truth.points[3] - truth.points[2])
    bar = ScaleBars(np.array([2]), np.array([3]), np.array([3 * length]), np.array([1e-3]))
    assert object_scale(network.with_given(two, bar), half) == pytest.approx(6.0)
    assert np.isnan(object_scale(network, half))


def barred_survey(folder: Path, *, sigma_px: float = 10.0) -> Path:
    """Write a survey with a sigma of its image points, by default 100 times too large, and scale bars."""
    path = write_observed_survey(folder, "barred", images=8, points=30)
    network, truth = make_network(seed_of("barred"), images=8, points=30, free=("c",))
    rng = seed_of("bars of the barred survey")
    bars = ""
    for i, j in ((0, 10), (1, 11), (2, 12), (3, 13), (4, 14), (5, 15)):
        length = np.linalg.norm(truth.points[i] - truth.points[j]) + rng.normal(0, 1e-3)
        ends = f'from = "{network.points[i]}"\nto = "{network.points[j]}"'
        bars += f"[[scale_bar]]\n{ends}\nlength = {length}\nsigma = 1e-3\n"
    with path.open("a", encoding="utf-8") as file:
        file.write(f'{bars}[adjust]\nsigma_px = {sigma_px}\nreject = "tau"\n')
    return path


def test_stated_sigmas_are_written_as_stated_whatever_the_weights_were(tmp_path: Path) -> None:
    """A survey of sigmas twice too large has factor 0.5; its tables as [observations] state the same ones."""
    path = barred_survey(tmp_path / "first", sigma_px=1.0)
    table = path.parent / "image_points.csv"
    lines = table.read_text(encoding="utf-8").splitlines()
    sigma = 2 * 0.1 * seed_of("stated").uniform(0.9, 1.1, (len(lines) - 1, 2))
    rows = [f"{line},{sx!r},{sy!r}" for line, (sx, sy) in zip(lines[1:], sigma.tolist(), strict=True)]
    table.write_text("\n".join([f"{lines[0]},sx_px,sy_px", *rows]) + "\n", encoding="utf-8")
    first = run_survey(read_survey(path))
    assert first.adjustment.weight_factor == pytest.approx(0.5, rel=0.1)
    stated = np.sqrt(np.einsum("kii->ki", first.adjustment.network.image_points.covariance))
    np.testing.assert_allclose(stated, sigma, rtol=1e-14)

    (tmp_path / "out").mkdir()
    write_tables(findings_of(first), tmp_path / "out")
    again = barred_survey(tmp_path / "again", sigma_px=1.0)
    written = (tmp_path / "out" / "image_points.csv").read_text(encoding="utf-8")
    (again.parent / "image_points.csv").write_text(written, encoding="utf-8")
    second = run_survey(read_survey(again))
    a, b = first.adjustment, second.adjustment
    covariance = b.network.image_points.covariance
    np.testing.assert_allclose(covariance, a.network.image_points.covariance, rtol=1e-14)
    assert b.stated_px == pytest.approx(a.stated_px) and b.weight_factor == pytest.approx(a.weight_factor)
    np.testing.assert_allclose(by_kind(b).sigma0, by_kind(a).sigma0, rtol=1e-6)


def test_weights_converge_on_the_image_points_that_are_accepted(tmp_path: Path) -> None:
    """A single estimate has the image points bent by bars that were 100 times too heavy."""
    result = run_survey(read_survey(barred_survey(tmp_path / "barred")))
    a = result.adjustment
    assert by_kind(a).sigma0[0] == pytest.approx(a.weight_factor, rel=1e-3)
    freedom = 2 * np.nansum(a.redundancy_numbers)
    assert a.weight_factor == pytest.approx(0.01, rel=4 / np.sqrt(freedom))
    assert not a.remarks
    image, bars = statistics_of(result.adjustment).global_tests
    assert image.passed is False and image.statistic < image.lower
    assert bars.passed


def test_weights_that_do_not_converge_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variance_components, "MAX_ROUNDS", 0)
    result = run_survey(read_survey(barred_survey(tmp_path / "barred")))
    assert of_kind(result.remarks, "rejection_not_converging")


def test_a_point_with_one_ray_is_named(tmp_path: Path) -> None:
    path = write_observed_survey(tmp_path / "one ray", "one ray")
    table = path.parent / "image_points.csv"
    header, *rows = table.read_text(encoding="utf-8").splitlines()
    name = rows[0].split(",")[1]
    own = [row for row in rows if row.split(",")[1] == name]
    left = [header, own[0], *(row for row in rows if row not in own)]
    table.write_text("\n".join(left) + "\n", encoding="utf-8")
    result = run_survey(read_survey(path))
    assert name not in result.adjustment.network.points
    (few,) = of_kind(result.remarks, "points_not_determined")
    assert few.names("points") == (name,) and few.severity == "note"


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
    (failed,) = of_kind(result.remarks, "comparison_failed")
    assert failed.names("reason") == ("COLMAP's mapper found no model",)
    page = write_result(findings_of(result), tmp_path / "out").read_text(encoding="utf-8")
    assert "And COLMAP mapper by itself?" not in page and "found no model" in page


def test_another_pipeline_needs_photographs(tmp_path: Path) -> None:
    path = write_observed_survey(tmp_path / "s", "observed")
    text = path.read_text(encoding="utf-8").replace("[compare]", '[compare]\nbaseline = "mapper"')
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"baseline = 'mapper' needs photographs, the survey has \[obs"):
        read_survey(path)
