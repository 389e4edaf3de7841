"""Covariances of image points that are stated by matching, and what they leave unsaid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.quality.variance_components import estimate_common_part
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import FloatArray
from tests.synthetic import make_network, seed_of


@pytest.mark.parametrize(("factor", "common_px"), [(1.0, 0.05), (3.0, 0.05), (2.0, 0.0), (0.0, 0.1)])
def test_factor_and_common_part_are_found(factor: float, common_px: float) -> None:
    """Within three standard deviations of what 2,000 image points can tell."""
    rng = seed_of(f"common part {factor} {common_px}")
    network, truth = make_network(seed_of("common part"), images=12, points=180, free=("c",), noise_px=0.0)
    seen = network.image_points
    sigma = 0.02 * 10.0 ** rng.random(len(seen))
    noise = np.sqrt((factor * sigma) ** 2 + common_px**2)[:, None] * rng.standard_normal((len(seen), 2))
    network = replace(network, image_points=replace(seen, xy=seen.xy + noise))

    def adjust_with(covariance: FloatArray) -> Adjustment:
        return adjust(
            replace(network, image_points=replace(network.image_points, covariance=covariance)),
            truth,
            reject="none",
        )

    found = estimate_common_part(adjust_with, sigma[:, None, None] ** 2 * np.eye(2), 0.1)
    assert found[0] == pytest.approx(factor, abs=0.15 if factor else 0.3)
    assert found[1] == pytest.approx(common_px, abs=0.01)
