"""The solution of a survey: what control, scale bars and the other adjuster do to it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.adjustment.quality import variance_components
from sfm.adjustment.quality.variance_components import by_kind
from sfm.errors import BackendError
from sfm.network import Estimate, Network, ObjectPoints, ScaleBars
from sfm.pipeline import run_survey
from sfm.remarks.remark import of_kind
from sfm.report.findings.bundle_statistics import statistics_of
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.tables.csv_files import write_tables
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.survey import read_survey
from sfm.survey.placing import object_scale
from tests.surveys import write_observed_survey
from tests.synthetic import make_network, seed_of


def test_a_failing_comparison_leaves_the_survey(tmp_path: Path) -> None:
    def refuse(network: Network, estimate: Estimate) -> object:
        raise BackendError("COLMAP is not installed")

    survey = read_survey(write_observed_survey(tmp_path / "alone", "alone"))
    result = run_survey(survey, others=OtherPrograms(refuse))  # type: ignore[arg-type]
    assert result.comparison is None
    assert result.adjustment.converged
    (failed,) = of_kind(result.remarks, "adjuster_failed")
    assert failed.names("reason") == ("COLMAP is not installed",)


def test_scale_comes_from_bars_before_control_and_two_control_points_are_enough() -> None:
    rng = seed_of("scale")
    network, truth = make_network(rng, images=4, points=10)
    half = replace(truth, points=truth.points / 2)
    two = ObjectPoints(np.array([0, 1]), truth.points[:2], np.zeros((2, 3, 3)))
    assert object_scale(replace(network, control=two), half) == pytest.approx(2.0)
    length = np.linalg.norm(truth.points[3] - truth.points[2])
    bar = ScaleBars(np.array([2]), np.array([3]), np.array([3 * length]), np.array([1e-3]))
    assert object_scale(replace(network, control=two, scale_bars=bar), half) == pytest.approx(6.0)
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
    image, bars = statistics_of(result).global_tests
    assert image.passed is False and image.statistic < image.lower
    assert bars.passed


def test_weights_that_do_not_converge_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variance_components, "MAX_ROUNDS", 0)
    result = run_survey(read_survey(barred_survey(tmp_path / "barred")))
    assert of_kind(result.remarks, "weights_not_converged")


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
