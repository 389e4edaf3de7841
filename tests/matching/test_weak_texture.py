"""Features of weak texture: their contrast sinks to that of noise, and not below."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sfm.matching.tracks.features import sift_features


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
