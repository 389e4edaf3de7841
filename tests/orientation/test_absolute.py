"""Absolute orientation of a model."""

import numpy as np
import pytest

from sfm.model.conventions import rotation_from_vector
from sfm.model.errors import GeometryError
from sfm.model.similarity import Similarity, orient_absolute
from tests.synthetic import seed_of


def test_absolute_orientation_exact_and_weighted():
    rng = seed_of("absolute")
    model = rng.normal(size=(6, 3))
    true = Similarity(2.5, rotation_from_vector(np.array([1.0, -2, 0.5])), np.array([100.0, 200, 50]))
    control = true.apply(model)
    result = orient_absolute(model, control)
    assert result.similarity.scale == pytest.approx(2.5)
    assert np.abs(result.residuals).max() < 1e-12 and result.redundancy == 11
    control[0] += 1.0
    weights = np.array([1e-9, 1, 1, 1, 1, 1])
    assert np.abs(orient_absolute(model, control, weights=weights).residuals[1:]).max() < 1e-6
    assert np.abs(orient_absolute(model, control).residuals[1:]).max() > 0.01


def test_absolute_orientation_covariance():
    rng = seed_of("absolute covariance")
    model = rng.normal(size=(8, 3)) * (3, 2, 1)
    R = rotation_from_vector(np.array([0.3, -0.2, 2.0]))
    true = Similarity(0.8, R, np.array([10.0, 20, 5]))
    exact = true.apply(model)
    weights = rng.uniform(0.5, 2, 8)
    squares, variances = [], []
    for _ in range(400):
        noise = 0.01 * rng.standard_normal((8, 3)) / np.sqrt(weights)[:, None]
        result = orient_absolute(model, exact + noise, weights=weights)
        W = result.similarity.rotation @ R.T
        turn = np.array([W[2, 1], W[0, 2], W[1, 0]])
        centre = weights @ model / weights.sum()
        shift = result.similarity.apply(centre) - true.apply(centre)
        d = np.concatenate([[result.similarity.scale - 0.8], turn, shift])
        squares.append(d @ np.linalg.solve(result.covariance * (0.01 / result.sigma0) ** 2, d))
        variances.append(result.sigma0**2)
    assert np.mean(squares) == pytest.approx(7, abs=4 * np.sqrt(14 / 400))
    assert np.mean(variances) == pytest.approx(1e-4, rel=4 * np.sqrt(2 / 17 / 400))


def test_absolute_orientation_refusals():
    with pytest.raises(GeometryError, match="2 common points, at least 3"):
        orient_absolute(np.eye(3)[:2], np.eye(3)[:2])
    line = np.outer(np.arange(4.0), [1, 2, 3])
    with pytest.raises(GeometryError, match="on a line"):
        orient_absolute(line, line)
