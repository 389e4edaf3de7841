"""The likelihood of image points, and the price of parameters."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.model.likelihood import log_likelihood, price_of
from tests.synthetic import seed_of


def test_the_likelihood_is_the_density_of_what_was_measured() -> None:
    rng = seed_of("likelihood")
    v, fits = rng.normal(0, 0.3, (50, 2)), np.arange(50) > 4
    areas = np.where(np.arange(50) % 2, 640.0 * 480, 6000.0 * 4000)
    squares = float((v[fits] ** 2).sum())
    density = np.exp(-(v[fits] ** 2) / (2 * 0.09)) / np.sqrt(2 * np.pi * 0.09)
    expected = np.log(density).sum() - np.log(areas[:5]).sum()
    assert log_likelihood(squares, fits, areas, sigma_px=0.3) == pytest.approx(expected)


def test_the_estimated_sigma_is_the_likeliest() -> None:
    fits, areas = np.ones(20, dtype=bool), np.full(20, 1e6)
    estimated = log_likelihood(10.0, fits, areas)
    others = [log_likelihood(10.0, fits, areas, sigma_px=sigma) for sigma in (0.4, 0.499, 0.501, 0.6)]
    assert estimated == pytest.approx(log_likelihood(10.0, fits, areas, sigma_px=0.5))
    assert estimated > max(others)


def test_residuals_of_rounding_are_all_alike() -> None:
    fits, areas = np.ones(20, dtype=bool), np.full(20, 1e7)
    assert log_likelihood(0.0, fits, areas) == log_likelihood(1e-28, fits, areas)
    assert log_likelihood(0.0, fits, areas) > log_likelihood(1e-12, fits, areas)


def test_a_further_parameter_of_no_effect_does_not_pay_its_price() -> None:
    """A mean of two coordinates, estimated from samples whose true mean is 0, and is not."""
    rng, n = seed_of("price"), 50
    fits, areas = np.ones(n, dtype=bool), np.full(n, 1e6)

    def pays(offset: float) -> bool:
        x = rng.normal(offset, 1.0, (n, 2))
        gain = log_likelihood(float(((x - x.mean(axis=0)) ** 2).sum()), fits, areas)
        return gain - log_likelihood(float((x**2).sum()), fits, areas) > price_of(2, n)

    assert np.mean([pays(0.0) for _ in range(200)]) < 0.05
    assert np.mean([pays(1.0) for _ in range(200)]) > 0.95
