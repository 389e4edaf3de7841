"""Features of weak texture: their contrast sinks to that of noise, and not below."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.matching.tracks.features import sift_features
from sfm.matching.tracks.interest import natural_points
from sfm.model.errors import GeometryError
from sfm.pipeline import run_survey
from sfm.products.drafting.draft import draft_survey
from sfm.survey.inputs.survey import read_survey
from sfm.survey.measuring import tie_points
from tests.survey.texture_scenes import outcome_of, usual, write_scene
from tests.synthetic import seed_of


def _texture(contrast: float, noise: float, seed: int = 0) -> np.ndarray:
    """Return a photograph of a random texture of a standard deviation, grey values, with noise."""
    rng = np.random.default_rng(seed)
    smooth = cv2.GaussianBlur(rng.normal(0, 1, (400, 600)), (0, 0), 3.0)
    grey = 120 + contrast * smooth / smooth.std() + rng.normal(0, noise, smooth.shape)
    return np.rint(np.clip(grey, 0, 255)).astype(np.uint8)


@pytest.mark.parametrize("contrast", [1.5, 3.0])
def test_weak_texture_has_features(contrast: float) -> None:
    """A shiny object has a fifth of the contrast of a wall: hardly any feature was found on it."""
    photograph = _texture(contrast, 0.5)
    before, now = (len(sift_features(photograph, noise=noise)) for noise in (None, 0.5 / 255))
    assert now > 3 * max(before, 50)
    far = sift_features(_texture(contrast, 0.5, seed=1), noise=0.5 / 255)  # another photograph's noise
    assert len(far) > 0.5 * now


@pytest.mark.parametrize("noise", [0.5, 1.0, 3.0])
def test_noise_has_hardly_any_features(noise: float) -> None:
    photograph = _texture(0.0, noise)
    megapixels = photograph.size / 1e6
    assert len(sift_features(photograph, noise=noise / 255)) < 120 * megapixels


def test_strong_texture_keeps_its_features() -> None:
    photograph = _texture(30.0, 1.0)
    before, now = (sift_features(photograph, max_features=200, noise=noise) for noise in (None, 1 / 255))
    np.testing.assert_array_equal(before.xy, now.xy)


@pytest.mark.parametrize("contrast", [0.0, 30.0])
def test_photographs_that_show_nothing_in_common_are_searched_once(
    contrast: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither those without texture, which has no more features, nor those of different places."""
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number}.png"), _texture(contrast, 1.0, seed=number))
    (tmp_path / "survey.toml").write_text(draft_survey(tmp_path).text, encoding="utf-8")
    searched: list[int] = []
    monkeypatch.setattr(
        tie_points,
        "natural_points",
        lambda photograph, **options: (
            searched.append(options["max_features"]) or natural_points(photograph, **options)
        ),
    )
    with pytest.raises(GeometryError, match="no texture that two photographs have in common"):
        run_survey(read_survey(tmp_path / "survey.toml"))
    assert searched == [2000] * 4


@pytest.mark.slow
def test_an_object_of_a_tenth_of_the_contrast_is_oriented(tmp_path: Path) -> None:
    rng = seed_of("weak 0")
    scene = usual(rng)
    scene.finish = lambda _, grey: 128 + (grey - 128) / 10
    write_scene(tmp_path, scene, rng)
    found = outcome_of(tmp_path, scene)
    assert found.oriented == len(scene.position) and not found.is_wrong and found.level in ("good", "fair")


@pytest.mark.parametrize(
    ("rows", "columns"), [(slice(150, 320), slice(200, 420)), (slice(0, 400), slice(300, 600))]
)
def test_what_is_masked_has_no_features_and_changes_no_others(rows: slice, columns: slice) -> None:
    photograph = _texture(30.0, 1.0)
    hidden = np.ones(photograph.shape, dtype=bool)
    hidden[rows, columns] = False
    whole = natural_points(photograph, max_features=20_000, noise=1 / 255)
    found = natural_points(photograph, max_features=20_000, noise=1 / 255, hidden=hidden)
    for xy in (found.xy, found.corners):
        column, row = np.rint(xy).astype(int).T
        assert len(xy) > 50 and not hidden[row, column].any()
    column, row = np.rint(whole.xy).astype(int).T
    there = {tuple(xy) for xy in whole.xy[~hidden[row, column] & (whole.scale < 16)].round(2).tolist()}
    same = there & {tuple(xy) for xy in found.xy.round(2).tolist()}
    assert len(same) > 0.99 * len(there)
    few = natural_points(photograph, max_features=400, noise=1 / 255, hidden=hidden)
    assert len(few) == round(400 * (1 - hidden.mean()))
    hidden[:] = True
    none = natural_points(photograph, hidden=hidden)
    assert len(none) == 0 and len(none.corners) == 0
