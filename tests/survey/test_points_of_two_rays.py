"""Natural texture that two photographs show, and no third: what is measured there, and how good it is."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, IntArray
from sfm.pipeline import run_survey
from sfm.remarks.remark import of_kind
from sfm.report.findings.survey_remarks import Findings, findings_of
from sfm.report.tables.csv_files import write_tables
from sfm.similarity import fit_similarity
from sfm.survey.drafting.draft import draft_survey
from sfm.survey.inputs.survey import read_survey
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
from tests.synthetic import seed_of
from tests.textures import natural_texture

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
    assert len(of_kind(found.verdict.remarks, "two_photographs")) == 1
    (two,) = of_kind(found.verdict.remarks, "two_rays")
    assert two.number("two") == two.number("total") == len(a.network.points)
    over, rays = errors_in_sigmas(scene, a)
    assert (rays == 2).all() and 0.8 < np.sqrt(np.mean(over**2)) < 1.3
    assert (over > 6).sum() <= 1  # no false match
    assert not of_kind(found.verdict.remarks, "interior_held_of_pair")
    write_tables(found, tmp_path)
    with (tmp_path / "points.csv").open(encoding="utf-8") as file:
        assert {row["rays"] for row in csv.DictReader(file)} == {"2"}


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


def test_two_photographs_from_a_folder_do_not_calibrate_their_camera(tmp_path: Path) -> None:
    """The draft assumes c, which scales the depth, and no residual shows it."""
    scene = Scene(corner_of_walls(seed_of("walls")), *around(seed_of("stations"), 8))
    photographs(tmp_path, scene, [2, 3])
    (tmp_path / "survey.toml").write_text(draft_survey(tmp_path).text, encoding="utf-8")
    found = findings_of(run_survey(read_survey(tmp_path / "survey.toml")))
    assert len(found.result.adjustment.network.images) == 2 and found.verdict.level == "bad"
    (held,) = of_kind(found.verdict.remarks, "interior_held_of_pair")
    assert "c" in held.names("parameters") and held.severity == "error"
