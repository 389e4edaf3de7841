"""Robust resection: gross errors, few points, planar scenes, reasons of failure, trial counts."""

import numpy as np
import pytest

from sfm.model.conventions import rotation_from_vector
from sfm.orientation.resection.ransac import expected_trials, resect_robust
from tests.synthetic import seed_of

SIGMA = 0.5 / 2000  # half a pixel at c = 2000 px


def scene(rng, n, *, outliers=0.0, sigma=SIGMA, planar=False):
    """Points 4 to 8 units away in a field of +-31 deg, from a random station; the first are wrong."""
    R = rotation_from_vector(rng.normal(size=3) * 2)
    X0 = rng.normal(size=3) * 5
    uv = rng.uniform(-0.6, 0.6, (n, 2))
    depth = rng.uniform(4, 8, (n, 1))
    if planar:
        depth = (6 / (1 - uv @ [0.5, 0.3]))[:, None]
    points = X0 + (np.c_[uv, -np.ones(n)] * depth) @ R.T
    uv = uv + sigma * rng.standard_normal(uv.shape)
    wrong = int(outliers * n)
    uv[:wrong] = rng.uniform(-0.6, 0.6, (wrong, 2))
    return uv, points, X0, R


def test_thirty_percent_gross_errors():
    rng = seed_of("thirty percent")
    outside, far, squares = 0, 0, []
    for k in range(1000):
        uv, points, X0, _ = scene(rng, 50, outliers=0.3, planar=k % 4 == 0)
        result = resect_robust(uv, points, tolerance=4 * SIGMA, seed=k, sigma=SIGMA)
        if not result.found:
            far += 1
            continue
        d = result.position - X0
        square = d @ np.linalg.solve(result.covariance[:3, :3], d)
        squares.append(square)
        far += np.linalg.norm(d) > 3 * np.sqrt(np.trace(result.covariance[:3, :3]))
        # the ellipsoid of the same probability, 0.9973, as 3 sigma of one variable
        outside += square > 14.16
    # within 3 sigma (of the position as a whole) in at least 999 of 1000 cases
    assert far <= 1
    # 1000 cases of probability 0.0027: expectation 2.7, and 10 is exceeded once in 10,000 times
    assert outside <= 10
    assert np.mean(squares) == pytest.approx(3, abs=4 * np.sqrt(6 / 1000))


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("n", [4, 5, 8, 9, 40])
def test_few_points_and_planes(n, planar):
    rng = seed_of(f"few {n} {planar}")
    right = 0
    for k in range(50):
        uv, points, X0, R = scene(rng, n, sigma=1e-6, planar=planar)
        result = resect_robust(uv, points, tolerance=1e-4, seed=k)
        assert result.found and result.inliers.all()
        right += np.linalg.norm(result.position - X0) < 1e-3 and np.abs(result.rotation - R).max() < 1e-3
    assert right == 50


def test_same_seed_same_result():
    uv, points, _, _ = scene(seed_of("seed"), 60, outliers=0.5)
    a, b = (resect_robust(uv, points, tolerance=1e-3, seed=7) for _ in range(2))
    assert (a.position == b.position).all() and a.trials == b.trials


def test_half_wrong_among_two_hundred():
    uv, points, X0, _ = scene(seed_of("half"), 200, outliers=0.5)
    result = resect_robust(uv, points, tolerance=4 * SIGMA)
    assert not result.inliers[:100].any() and result.inliers[100:].mean() > 0.99
    assert np.linalg.norm(result.position - X0) < 0.01
    assert result.sigma0 == pytest.approx(SIGMA, rel=0.2)


def test_distortion_that_only_a_wide_tolerance_bears():
    rng = seed_of("distorted")
    uv, points, X0, _ = scene(rng, 4, sigma=0)
    distorted = uv * (1 - 0.1 * (uv**2).sum(axis=1, keepdims=True))
    assert resect_robust(distorted, points, tolerance=0.02).found
    assert np.linalg.norm(resect_robust(distorted, points, tolerance=0.02).position - X0) < 1.0


def test_reasons():
    uv, points, X0, R = scene(seed_of("reasons"), 30)
    for least in ({}, {"min_inliers": 3}):  # a fourth point decides between the solutions of three
        few = resect_robust(uv[:3], points[:3], tolerance=1e-3, **least)
        assert few.reason == "3 points, resection needs 4"
    nothing = resect_robust(seed_of("noise").uniform(-0.6, 0.6, (30, 2)), points, tolerance=1e-5)
    assert "of 30 points fit within the tolerance, resection needs 4" in nothing.reason
    assert nothing.inliers.sum() < nothing.needed == 4
    assert np.isnan(nothing.position).all() and not nothing.found
    line = X0 + R @ np.array([0, 0, -5.0]) + np.outer(np.linspace(-1, 1, 10), R[:, 0])
    UVW = (line - X0) @ R
    flat = resect_robust(-UVW[:, :2] / UVW[:, 2:], line, tolerance=1e-3)
    assert "collinear or coincident" in flat.reason


def test_table_of_trials():
    # document 001, table 2.1 (Fischler, Bolles 1981): E(k) for w and n = 1 .. 6, rounded as printed
    table = {
        0.9: (1.1, 1.2, 1.4, 1.5, 1.7, 1.9),
        0.8: (1.3, 1.6, 2.0, 2.4, 3.0, 3.8),
        0.7: (1.4, 2.0, 2.9, 4.2, 5.9, 8.5),
        0.6: (1.7, 2.8, 4.6, 7.7, 13, 21),
        0.5: (2.0, 4.0, 8.0, 16, 32, 64),
        0.4: (2.5, 6.3, 16, 39, 98, 244),
        0.3: (3.3, 11, 37, 123, 412),
        0.2: (5.0, 25, 125, 625),
    }
    for w, row in table.items():
        for n, printed in enumerate(row, start=1):
            mean, deviation = expected_trials(w, n)
            assert mean == pytest.approx(printed, abs=0.06 if printed < 10 else 0.51)
            assert deviation == pytest.approx(np.sqrt(1 - w**n) / w**n)


@pytest.mark.parametrize(("n", "triples"), [(5, 10), (8, 56)])
def test_every_triple_of_few_points_is_tried_once(n: int, triples: int):
    uv, points, _, _ = scene(seed_of("every triple"), n, sigma=1e-4)
    uv[0] += 0.2
    assert resect_robust(uv, points, tolerance=1e-3, max_trials=3).trials == triples


def test_trials_are_those_expected_and_three_standard_deviations():
    """Of the share of points that fit: E(k) + 3 SD(k), Fischler and Bolles (1981)."""
    right = 0
    for k in range(10):
        uv, points, _, _ = scene(seed_of(f"trials {k}"), 200, outliers=0.5)
        found = resect_robust(uv, points, tolerance=6 * SIGMA, seed=k)
        mean, deviation = expected_trials(float(found.inliers.mean()), 3)
        right += found.trials == int(np.ceil(mean + 3 * deviation))
    assert right >= 8
