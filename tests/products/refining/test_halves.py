"""Halves of the points of a model: they differ as much as its image points err."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.solve import adjust
from sfm.products.refining.halves import halves_apart
from tests.synthetic import make_network, seed_of

SIGMA_PX = 0.3


def test_halves_differ_in_proportion_to_the_noise() -> None:
    """Also the noise of neighbours in common, which no residual shows."""
    network, truth = make_network(seed_of("halves"), images=8, points=60, noise_px=0.0, free=())
    seen = network.image_points
    accepted = np.ones(len(seen), dtype=bool)
    noise = SIGMA_PX * seed_of("noise of halves").standard_normal(seen.xy.shape)
    middle = np.median(truth.points, axis=0)
    near = ((truth.points - middle) @ np.linalg.svd(truth.points - middle)[2][0])[seen.point] > 0
    shared = np.where(near, 1.0, -1.0)[:, None] * SIGMA_PX * np.array([1.0, 0.0])

    def apart(off: np.ndarray) -> float:
        part = replace(network, image_points=replace(seen, xy=seen.xy + off))
        a = adjust(part, truth, reject="none")
        return halves_apart(part, a.estimate, accepted)

    assert apart(2 * noise) == pytest.approx(2 * apart(noise), rel=0.05)
    assert apart(noise + 3 * shared) > apart(noise)
    assert apart(0 * noise) < 1e-6 * apart(noise)


def test_too_few_points_for_halves_are_not_compared() -> None:
    network, truth = make_network(seed_of("few for halves"), images=3, points=6, free=())
    assert np.isnan(halves_apart(network, truth, np.ones(len(network.image_points), dtype=bool)))
