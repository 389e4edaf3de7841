"""Surveys of two photographs, and points that only two of more show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.adjustment.result import Adjustment
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.model.remarks.remark import kinds_of, of_kind
from sfm.model.similarity import fit_similarity
from sfm.orientation.incremental.starting_pair import TWOFOLD
from sfm.pipeline import run_survey
from sfm.products.drafting.draft import draft_survey
from sfm.report.findings import Findings
from sfm.report.tables.csv_files import write_tables
from sfm.survey.circles import circle_misfit
from sfm.survey.inputs.measurements import Measurements, find_photographs
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.orientation import orient_survey
from sfm.survey.target_network import measure_targets
from tests.findings import findings_of
from tests.survey.texture_scenes import (
    C_PX,
    NOISE,
    SIZE_PX,
    Plane,
    Scene,
    _photograph,
    around,
    corner_of_walls,
    upright,
)
from tests.surveys import C_MM, code_centres, write_observed_survey, write_photograph_survey
from tests.synthetic import seed_of
from tests.tables import rows_of
from tests.textures import natural_texture

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
    assert verdict.level == "bad" and of_kind(verdict.tests, "third_ray_missing")


def test_a_calibrated_pair_is_good_and_says_what_it_rests_on(survey: Survey) -> None:
    cameras = tuple(one.model_copy(update={"c_mm": C_MM, "free": ()}) for one in survey.cameras)
    result = run_survey(replace(survey, cameras=cameras))
    a = result.adjustment
    assert len(a.network.images) == 2
    verdict = findings_of(result).verdict
    assert verdict.level == "good"
    assert len(of_kind(verdict.tests, "held_weakly_tested", "third_ray_missing")) == 2
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
    found = orient_survey(survey, replace(measured, network=network, naming=naming)).orientation
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


SURVEY = f"""
[survey]
name = "two rays"
unit = "m"
[[camera]]
name = "lens"
images = "*.png"
pixel_mm = [0.01, 0.01]
c_mm = {C_PX / 100}
free = []
[tie_points]
[compare]
backend = "none"
"""
MIDDLE = (np.array(SIZE_PX) - 1) / 2


def photographs(folder: Path, scene: Scene, stations: list[int]) -> None:
    """Write the photographs from some stations of a scene."""
    rng = seed_of("two rays")
    for i in stations:
        grey = _photograph(scene, i) + rng.normal(0, NOISE, SIZE_PX[::-1])
        cv2.imwrite(str(folder / f"{i}.png"), np.clip(np.rint(grey), 0, 255).astype(np.uint8))


def run(folder: Path, scene: Scene, stations: list[int]) -> Findings:
    """Return what a survey finds with the true camera in photographs from some stations of a scene."""
    photographs(folder, scene, stations)
    (folder / "survey.toml").write_text(SURVEY, encoding="utf-8")
    return findings_of(run_survey(read_survey(folder / "survey.toml")))


def on_planes(scene: Scene, i: int, xy: FloatArray) -> FloatArray:
    """Return what a photograph shows at places, NaN where it shows no plane, (k, 3)."""
    u, v = ((xy - MIDDLE) / C_PX).T
    d = np.column_stack([u, -v, -np.ones(len(xy))]) @ scene.rotation[i].T
    points = np.full((len(xy), 3), np.nan)
    for one in scene.planes:  # from back to front
        normal = np.cross(one.right, one.up)
        t = ((one.corner - scene.position[i]) @ normal) / (d @ normal)
        X = scene.position[i] + t[:, None] * d
        right, up = ((X - one.corner) @ side / (side @ side) for side in (one.right, one.up))
        on = (t > 0) & (right > 0) & (right < 1) & (up > 0) & (up < 1)
        points[on] = X[on]
    return points


def errors_in_sigmas(scene: Scene, a: Adjustment) -> tuple[FloatArray, IntArray]:
    """Return the error of each point over its standard deviation, after a similarity, and its rays, (n,)."""
    seen = a.network.image_points
    first = np.unique(seen.point, return_index=True)[1]
    truth = np.full((len(first), 3), np.nan)
    for i, name in enumerate(a.network.images):
        own = seen.image[first] == i
        truth[own] = on_planes(scene, int(name.removesuffix(".png")), seen.xy[first[own]])
    known = np.isfinite(truth).all(axis=1)
    placed = fit_similarity(a.estimate.points[known], truth[known])
    sigma = placed.scale * np.sqrt(np.einsum("nii->n", a.covariance.points))
    rays = np.bincount(seen.point[~a.rejected], minlength=len(first))
    return np.linalg.norm(placed.apply(a.estimate.points) - truth, axis=1)[known] / sigma[known], rays[known]


def test_two_photographs_of_walls_make_a_survey_that_says_what_it_rests_on(tmp_path: Path) -> None:
    scene = Scene(corner_of_walls(seed_of("walls")), *around(seed_of("stations"), 8))
    found = run(tmp_path, scene, [2, 3])
    a = found.result.adjustment
    assert found.verdict.level in ("good", "fair") and len(a.network.points) > 800
    (two,) = of_kind(found.verdict.tests, "third_ray_missing")
    assert two.number("two") == two.number("total") == len(a.network.points)
    over, rays = errors_in_sigmas(scene, a)
    assert (rays == 2).all() and 0.8 < np.sqrt(np.mean(over**2)) < 1.3
    assert (over > 6).sum() <= 1  # no false match
    assert not of_kind(found.verdict.remarks, "interior_held_of_pair")
    write_tables(found, tmp_path)
    assert {row["rays"] for row in rows_of(tmp_path / "points.csv")} == {"2"}


@pytest.mark.slow
def test_a_strip_of_which_most_is_in_two_photographs_is_covered_by_points_of_two_rays(tmp_path: Path) -> None:
    """Photographs overlap by 59 percent: 17 percent of one are in three, which carry the scale onwards."""
    rng = seed_of("strip")
    texture = natural_texture(rng, (4000, 1000))
    wall = Plane(np.array([-14.0, -3.5, 0.0]), np.array([28.0, 0.0, 0.3]), np.array([0.0, 7.0, 0.0]), texture)
    position = np.column_stack([2.3 * np.arange(-2, 3), rng.uniform(-0.2, 0.2, 5), np.full(5, 5.0)])
    directions = np.column_stack([rng.normal(0, 0.02, (5, 2)), -np.ones(5)])
    scene = Scene([wall], position, np.array([upright(one) for one in directions]))
    found = run(tmp_path, scene, list(range(5)))
    a = found.result.adjustment
    assert len(a.network.images) == 5 and found.verdict.level == "good"
    over, rays = errors_in_sigmas(scene, a)
    assert (rays == 2).sum() > 2 * (rays > 2).sum() > 200
    assert (over > 6).sum() <= 1
    for some in (rays == 2, rays > 2):
        assert 0.7 < np.sqrt(np.mean(over[some] ** 2)) < 1.3


@pytest.mark.slow
def test_two_photographs_from_a_folder_do_not_calibrate_their_camera(tmp_path: Path) -> None:
    """The draft assumes c, which scales the depth, and no residual shows it."""
    scene = Scene(corner_of_walls(seed_of("walls")), *around(seed_of("stations"), 8))
    photographs(tmp_path, scene, [2, 3])
    (tmp_path / "survey.toml").write_text(draft_survey(tmp_path).text, encoding="utf-8")
    found = findings_of(run_survey(read_survey(tmp_path / "survey.toml")))
    assert len(found.result.adjustment.network.images) == 2 and found.verdict.level == "bad"
    (held,) = of_kind(found.verdict.remarks, "interior_held_of_pair")
    assert "c" in held.names("parameters") and held.severity == "error"
