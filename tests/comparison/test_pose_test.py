"""The test of exterior orientations of two results: its level, its power, and when nothing is tested."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.comparison.pose_test import compare_poses
from sfm.model.conventions import FloatArray, rotation_from_angles
from sfm.model.solution import Solution
from tests.synthetic import make_network, seed_of

ALPHA = 0.05


def results(count: int, off: float = 0.0, seed: int = 5) -> tuple[Solution, Solution]:
    """Return two results of photographs whose poses differ by their noise, and X0 by off sigma."""
    rng = np.random.default_rng(seed)
    network, estimate = make_network(seed_of("poses"), images=4, points=10)
    images = tuple(f"{k}" for k in range(count))
    angles = np.array([0.2, -0.3, 3.1]) + np.zeros((count, 3))
    pair = []
    for k in range(2):
        root = rng.normal(size=(count, 6, 6)) * np.array([1e-2] * 3 + [1e-4] * 3)[:, None]
        Q = root @ root.transpose(0, 2, 1)
        noise = np.einsum("kij,kj->ki", root, rng.normal(size=(count, 6)))
        noise[:, 0] += k * off * np.sqrt(2 * Q[:, 0, 0])
        pair.append(
            Solution(
                f"{k}",
                replace(network, images=images, camera=np.zeros(count, dtype=np.int64)),
                replace(
                    estimate,
                    position=noise[:, :3],
                    rotation=np.array([rotation_from_angles(*row) for row in angles + noise[:, 3:]]),
                ),
                exterior_covariance=Q,
                datum="control",
            )
        )
    return pair[0], pair[1]


def pairs(count: int) -> FloatArray:
    return np.column_stack([np.arange(count)] * 2)


def test_the_level_is_that_of_all_photographs_together() -> None:
    count, alarms = 4, 0
    for seed in range(400):
        tested = compare_poses(*results(count, seed=seed), pairs(count), ALPHA)
        assert tested is not None
        alarms += bool(tested.significant.any())
    assert abs(alarms - 400 * ALPHA) < 3.5 * np.sqrt(400 * ALPHA)


def test_chi_square_has_six_degrees_of_freedom() -> None:
    tested = compare_poses(*results(2000), pairs(2000), ALPHA)
    assert tested is not None
    assert np.mean(tested.statistic) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 6 / 2000))
    assert np.std(tested.sigmas, axis=0) == pytest.approx(np.ones(6), abs=0.1)


def test_an_orientation_that_moved_is_found() -> None:
    tested = compare_poses(*results(200, off=8.0), pairs(200), ALPHA)
    assert tested is not None and tested.significant.mean() > 0.95


def test_one_covariance_stands_for_both_and_a_free_datum_tests_nothing() -> None:
    a, b = results(3)
    of_one = compare_poses(a, replace(b, exterior_covariance=None), pairs(3), ALPHA)
    assert of_one is not None and a.exterior_covariance is not None
    variance = np.diagonal(a.exterior_covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(of_one.sigma**2, variance)
    for other in (replace(b, datum="free"), replace(b, datum="")):
        assert compare_poses(a, other, pairs(3), ALPHA) is None
    without = replace(a, exterior_covariance=None)
    assert compare_poses(without, without, pairs(3), ALPHA) is None


def test_the_fewest_observations_decide_the_distribution() -> None:
    a, b = results(3)
    few = compare_poses(replace(a, redundancy=4), replace(b, redundancy=40), pairs(3), ALPHA)
    known = compare_poses(a, b, pairs(3), ALPHA)
    assert few is not None and known is not None
    assert few.redundancy == 4 and known.redundancy is None and few.critical > 2 * known.critical
