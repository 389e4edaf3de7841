"""A plate whose points are free, from start values; a stereo pair calibrated from photographs of a plate."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.camera import Camera
from sfm.pipeline import run_survey
from sfm.rendering.render import corner_rays, render_photograph
from sfm.rendering.scene import Optics
from sfm.similarity import fit_similarity
from sfm.survey.inputs.survey import read_survey
from tests.plates import GRID, NOISE, PITCH, PIXEL_MM, SURVEY, TRUTH, camera, plate_scene, stations
from tests.synthetic import seed_of

OPTICS = Optics(blur_px=0.8, exposure=0.9, noise=NOISE, oversampling=2)
BASE_MM, RIGHT_C_MM = 60.0, 8.4


def survey_text(datum: str) -> str:
    """Return the survey file of a plate."""
    return SURVEY.format(
        name="plate", polarity="dark", pixel=PIXEL_MM, codes="grid", rows=9, columns=11, pitch=PITCH,
        marks=[list(mark) for mark in GRID.marks], datum=datum,
    )  # fmt: skip


def off(adjusted: Camera, sigma: np.ndarray, truth: dict[str, float]) -> np.ndarray:
    """Return the errors of parameters over their standard deviations."""
    rows = [adjusted.names.index(name) for name in truth]
    return np.asarray((adjusted.parameters[rows] - list(truth.values())) / sigma[rows])


@pytest.mark.slow
def test_a_plate_that_is_not_true_is_determined_with_the_camera(tmp_path: Path) -> None:
    """Dots up to 0.1 mm from their places: as control they spoil the calibration, free they are found."""
    rng = seed_of("not true")
    move = np.zeros((GRID.count, 3))
    move[:, :2] = rng.uniform(-0.1, 0.1, (GRID.count, 2))
    scene, truth = plate_scene(GRID, move=move), camera()
    position, rotation = stations(rng, 6, GRID)
    rays = corner_rays(truth)
    for i in range(6):
        picture, _ = render_photograph(
            scene, truth, position[i], rotation[i], optics=OPTICS, rng=rng, rays=rays
        )
        cv2.imwrite(str(tmp_path / f"photo {i}.png"), picture)
    (tmp_path / "survey.toml").write_text(survey_text("free"), encoding="utf-8")
    a = run_survey(read_survey(tmp_path / "survey.toml")).adjustment
    assert np.abs(off(a.estimate.cameras[0], a.interior_sigma(0), TRUTH)).max() < 4
    names = [int(name) for name in a.network.points]
    true = (GRID.plane(PITCH) + move)[names]
    error = fit_similarity(true, a.estimate.points).apply(true) - a.estimate.points
    sigma = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
    print(
        "points, RMS:", np.sqrt((error**2).mean()), "mm, over sigma:", np.sqrt(((error / sigma) ** 2).mean())
    )
    assert np.sqrt(((error / sigma) ** 2).mean()) < 1.3
    (tmp_path / "survey.toml").write_text(survey_text("control"), encoding="utf-8")
    held = run_survey(read_survey(tmp_path / "survey.toml")).adjustment
    assert held.sigma0_px > 5 * a.sigma0_px


@pytest.mark.slow
def test_a_stereo_pair_is_calibrated_from_a_plate(tmp_path: Path) -> None:
    """Both cameras, and their orientation to each other, the same at every place of the plate."""
    rng, left = seed_of("stereo"), camera()
    right = left.with_parameters(np.where(np.array(left.names) == "c", RIGHT_C_MM, left.parameters))
    position, rotation = stations(rng, 6, GRID)
    for side, one, shift in (("left", left, -0.5), ("right", right, 0.5)):
        rays = corner_rays(one)
        for i in range(6):
            X0 = position[i] + shift * BASE_MM * rotation[i][:, 0]
            picture, _ = render_photograph(
                plate_scene(GRID), one, X0, rotation[i], optics=OPTICS, rng=rng, rays=rays
            )
            cv2.imwrite(str(tmp_path / f"{side} {i}.png"), picture)
    text = survey_text("control")
    begin, end = text.index("[[camera]]"), text.index("[targets]")
    cameras = [
        text[begin:end].replace('"small"', f'"{side}"').replace("*.png", f"{side}*.png")
        for side in ("left", "right")
    ]
    (tmp_path / "survey.toml").write_text(text[:begin] + "".join(cameras) + text[end:], encoding="utf-8")
    result = run_survey(read_survey(tmp_path / "survey.toml"))
    a = result.adjustment
    assert result.failed == ()
    for k, true in enumerate((TRUTH, {**TRUTH, "c": RIGHT_C_MM})):
        assert np.abs(off(a.estimate.cameras[k], a.interior_sigma(k), true)).max() < 4
    at = {name: k for k, name in enumerate(a.network.images)}
    for i in range(6):
        one, two = at[f"left {i}.png"], at[f"right {i}.png"]
        base = a.estimate.rotation[one].T @ (a.estimate.position[two] - a.estimate.position[one])
        print("base:", base, "mm")
        assert np.abs(base - (BASE_MM, 0, 0)).max() < 0.2
