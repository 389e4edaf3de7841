"""The demo from its scene file to object points, against the rendered truth."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from adapters.colmap.adjuster import adjust_with_colmap
from adapters.formats.result_tables import read_image_points, read_result, read_targets
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import SurveyFileError
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.products.rendering.render import write_photographs
from sfm.products.rendering.scene_file import Staging, read_scene
from sfm.report.tables.csv_files import write_tables
from sfm.report.tables.summary import write_summary
from sfm.report.viewer.embedded import scene_of_result, scene_of_stored
from sfm.report.viewer.pictures import Marks
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.survey import read_survey
from tests.findings import findings_of
from tests.places import ROOT

DEMO = ROOT / "datasets" / "demo"
SAME_MM = 1.0  # a point farther than this from every target is none; targets are 30 mm apart


@dataclass(frozen=True)
class Truth:
    """The survey's points beside the targets they are, both in the frame of the survey."""

    found: IntArray  # indices of the survey's points that are targets, (k,)
    target: IntArray  # the target of each, (k,)
    error: FloatArray  # survey minus truth after a similarity, mm, (k, 3)
    covariance: FloatArray  # mm^2, (k, 3, 3)
    scale: float  # truth over survey

    def normalised_square(self) -> float:
        """Mean of d' Q^-1 d / 3, 1 if errors are as large as their covariance says."""
        weight = np.linalg.inv(self.covariance)
        return float(np.einsum("ki,kij,kj->k", self.error, weight, self.error).mean() / 3)


def compare(result: SurveyResult, staging: Staging, *, scale: float | None = None) -> Truth:
    targets = staging.scene.targets
    places = staging.scene.faces.place(targets.face, targets.centre)
    points = result.adjustment.estimate.points
    coded = [(k, int(np.flatnonzero(targets.code == c)[0])) for k, c in enumerate(result.code) if c >= 0]
    start = fit_similarity(points[[k for k, _ in coded]], places[[t for _, t in coded]])
    distance = np.linalg.norm(start.apply(points)[:, None] - places, axis=2)
    target = distance.argmin(axis=1)
    found = np.flatnonzero(distance.min(axis=1) < SAME_MM)
    placed = fit_similarity(points[found], places[target[found]], scale=scale)
    error = points[found] - placed.inverse().apply(places[target[found]])
    covariance = result.adjustment.covariance.points[found]
    return Truth(found, target[found], error, covariance, placed.scale)


def run(folder: Path, **options: object) -> SurveyResult:
    return run_survey(read_survey(DEMO / "survey.toml"), images_dir=folder, jobs=2, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def staging() -> Staging:
    return read_scene(DEMO / "scene.toml")


@pytest.fixture(scope="module")
def demo(demo_photographs: Path) -> SurveyResult:
    return run(demo_photographs, others=OtherPrograms(adjust_with_colmap))


def test_the_readme_states_what_the_demo_reaches(demo: SurveyResult, staging: Staging) -> None:
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    figures = r"(\d+) measured targets .* deviation of ([\d.]+) µm; .* off by ([\d.]+) µm .* ([\d.]+) px\."
    (said,) = re.findall(figures, text.partition("## Your own survey")[0])
    truth = compare(demo, staging, scale=1.0)
    stated = 1000 * np.sqrt(np.einsum("kii->k", truth.covariance).mean() / 3)
    reached = 1000 * np.sqrt((truth.error**2).mean())
    assert said == (f"{len(truth.found)}", f"{stated:.1f}", f"{reached:.1f}", f"{demo.adjustment.rms_px:.3f}")


def test_every_photograph_is_oriented_and_the_optimum_is_colmaps(demo: SurveyResult) -> None:
    assert demo.failed == ()
    assert len(demo.adjustment.network.images) == demo.images_total == 12
    assert demo.adjustment.converged
    assert demo.adjustment.defect == demo.adjustment.expected_defect
    assert demo.comparison is not None
    assert demo.comparison.agree


def test_its_points_are_targets_each_once_and_with_their_codes(demo: SurveyResult, staging: Staging) -> None:
    codes = staging.scene.targets.code
    assert np.isin(demo.code[demo.code >= 0], codes).all()
    truth = compare(demo, staging)
    assert len(truth.found) == len(demo.code)
    assert len(np.unique(truth.target)) == len(truth.target)
    # Of 109 targets all but those on faces that are seen obliquely or by two photographs only.
    assert len(truth.found) >= 94
    read = demo.code[truth.found]
    assert (codes[truth.target][read >= 0] == read[read >= 0]).all()


def test_its_points_agree_with_the_truth_within_their_sigmas(demo: SurveyResult, staging: Staging) -> None:
    truth = compare(demo, staging)
    assert 0.7 < truth.normalised_square() < 1.4
    # With the scale of the bars, whose error all points share: over seeds the mean square is then between
    # 1.05 and 1.5, because one error of 17 in a million moves every point.
    assert 0.7 < compare(demo, staging, scale=1.0).normalised_square() < 1.4
    # Both bars are read to 0.004 mm and end in points of 0.005 mm: 16 in a million, at four sigma.
    assert abs(truth.scale - 1) < 4 * 16e-6


def test_its_interior_orientation_agrees_with_the_truth(demo: SurveyResult, staging: Staging) -> None:
    camera = demo.adjustment.estimate.cameras[0]
    error = (camera.parameters - staging.camera.parameters)[camera.free]
    Q = demo.adjustment.covariance.interior[0]
    # chi-square of 9 parameters, 99.99 %: 33.7
    assert error @ np.linalg.solve(Q, error) < 33.7


@pytest.mark.slow
def test_other_noise_gives_the_same_agreement(staging: Staging, tmp_path: Path) -> None:
    """The mean over surveys is near 1 after a similarity, which takes the common error of scale away."""
    squares = []
    for seed in range(10):
        other = replace(staging, seed=1000 + seed)
        write_photographs(other, tmp_path / str(seed))
        squares.append(compare(run(tmp_path / str(seed)), other).normalised_square())
    assert 0.85 < np.mean(squares) < 1.25
    assert max(squares) < 1.4


def test_a_stored_result_shows_the_ellipses_and_rejected_candidates_of_its_run(
    demo: SurveyResult, tmp_path: Path
) -> None:
    findings = findings_of(demo)
    write_tables(findings, tmp_path)
    write_summary(findings, tmp_path)
    stored = read_result(tmp_path)
    seen, rejected, w = read_image_points(tmp_path, stored.network)
    stored = replace(stored, network=replace(stored.network, image_points=seen))
    targets = read_targets(tmp_path, stored.network)
    assert targets is not None
    again = scene_of_stored(stored, w=w, rejected=rejected, seen_targets=targets)
    own = scene_of_result(findings)
    assert again.marks.reasons and np.isfinite(own.rays.ellipse).all(axis=1).mean() > 0.95
    rows = np.lexsort((again.rays.photo, again.rays.point)), np.lexsort((own.rays.photo, own.rays.point))
    assert again.rays.ellipse[rows[0]] == pytest.approx(own.rays.ellipse[rows[1]], abs=1e-4, nan_ok=True)

    def told(marks: Marks) -> list[tuple[int, str]]:
        return sorted((int(i), marks.reasons[k]) for i, k in zip(marks.photo, marks.reason, strict=True))

    assert told(again.marks) == told(own.marks)
    damaged = tmp_path / "targets.csv"
    damaged.write_text(damaged.read_text("utf-8").replace("part_01.jpg", "part_99.jpg", 1), encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"targets\.csv, line 2: image 'part_99.jpg' is not in images"):
        read_targets(tmp_path, stored.network)
