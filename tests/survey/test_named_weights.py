"""Weights of named points: those of their windows, as far as residuals confirm them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.model.conventions import FloatArray
from sfm.model.network import ImagePoints, Network
from sfm.survey.inputs.settings import AdjustSettings
from sfm.survey.inputs.sources import MARKS, TARGETS
from sfm.survey.measuring.covering_points import SquareRays
from sfm.survey.measuring.templates import _shares_of_noise
from sfm.survey.sources.joined import _balanced
from tests.synthetic import make_network, seed_of

POINTS = 60  # the first half are targets, then named points with sharp and with flat windows by turns
TARGET_PX, SHARP_PX, FLAT_PX = 0.01, 0.02, 0.08


def balanced(matched: float, common_px: float) -> tuple[Network, FloatArray]:
    """Return a network after its sources are balanced, and the true sigma of each image point, px, (k,).

    Args:
        matched: true standard deviation of a match over the stated one.
        common_px: sigma of errors of named points that matching does not see.
    """
    rng, settings = seed_of(f"named {matched} {common_px}"), AdjustSettings()
    network, truth = make_network(rng, images=12, points=POINTS, noise_px=0.0, free=("c",))
    seen = network.image_points
    named = seen.point >= POINTS // 2
    stated = np.where(named, np.where(seen.point % 2 == 0, SHARP_PX, FLAT_PX), TARGET_PX)
    true = np.where(named, np.hypot(matched * stated, common_px), stated)
    image_points = replace(
        seen,
        xy=seen.xy + true[:, None] * rng.standard_normal(seen.xy.shape),
        covariance=(stated**2 + settings.sigma_px**2)[:, None, None] * np.eye(2),
        source=named.astype(np.int64),
    )
    network = replace(network, image_points=image_points, sources=(TARGETS, MARKS))
    return _balanced(network, truth, np.full(POINTS, 3), settings), true


@pytest.mark.parametrize(("matched", "common_px"), [(1.0, 0.0), (1.5, 0.03)])
def test_a_flat_window_has_a_smaller_weight_than_a_sharp_one(matched: float, common_px: float) -> None:
    """The sigma expected of any image point, 0.1 px, must not hide that of matching."""
    network, true = balanced(matched, common_px)
    seen = network.image_points
    found = np.sqrt(np.trace(seen.covariance, axis1=1, axis2=2) / 2)
    targets = seen.source == 0
    for flat in (False, True):
        windows = ~targets & ((seen.point % 2 == 1) == flat)
        ratio = np.median(found[windows] / true[windows]) / np.median(found[targets] / true[targets])
        assert 0.85 < ratio < 1.15


def test_a_smaller_window_has_more_of_the_noise_of_its_match() -> None:
    """Of a quarter of the area, each pixel is used four times: four parts of five of the variance are its."""
    image = np.array([0, 1, 2])
    rays = ImagePoints(image, np.zeros(3, dtype=np.int64), np.zeros((3, 2)), np.tile(np.eye(2), (3, 1, 1)))
    measured = SquareRays(rays, np.zeros((3, 2, 2)), np.array([1.0, 0.5, 1.4]), np.ones(3))
    template, small, large = _shares_of_noise(measured, 0).tolist()
    assert small == pytest.approx(2 * 4 / 5) and large == 1.0
    assert template == pytest.approx((2 * 1 / 5 + 1) / 2)
