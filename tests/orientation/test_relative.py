"""Relative orientation: kinds of scenes, planar solutions, dependent and independent pair, covariance."""

import numpy as np
import pytest

from sfm.model.conventions import rotation_from_angles, rotation_from_vector
from sfm.model.errors import GeometryError
from sfm.orientation.image_rays import decompose_homography, fit_homography
from sfm.orientation.relative import (
    coplanarity_residuals,
    model_points,
    refine_coplanarity,
    relative_orientations,
    turned_pair,
)
from sfm.textbook.pair import orient_dependent, orient_independent
from tests.synthetic import seed_of

SIGMA = 1e-5
TOLERANCE = 20 * SIGMA


def two_photographs(rng, n, kind, *, sigma=SIGMA, outliers=0):
    """Conjugate rays of a convergent pair 4 to 8 base lengths from its points, seen in +-22 deg."""
    base = rng.normal(size=3) * (1, 1, 0.3)
    base /= np.linalg.norm(base)
    uv1 = rng.uniform(-0.4, 0.4, (n, 2))
    depth = rng.uniform(4, 8, n)
    if kind == "planar":
        normal = np.array([0.3, 0.2, -1]) + 0.1 * rng.normal(size=3)
        depth = 6 / (np.c_[uv1, -np.ones(n)] @ normal)
    points = np.c_[uv1, -np.ones(n)] * depth[:, None]
    if kind == "infinite":
        base = 0 * base
    R = rotation_from_vector(0.15 * rng.normal(size=3))
    UVW = (points - base) @ R
    uv2 = -UVW[:, :2] / UVW[:, 2:]
    uv1, uv2 = (uv + sigma * rng.standard_normal(uv.shape) for uv in (uv1, uv2))
    uv2[:outliers] += rng.uniform(0.02, 0.2, (outliers, 2))
    return uv1, uv2, base, R, points


def error_of(solution, base, R):
    return max(np.linalg.norm(solution.base - base), np.abs(solution.rotation - R).max())


@pytest.mark.parametrize("kind", ["spatial", "planar", "infinite"])
@pytest.mark.parametrize("n", [7, 12, 40])
def test_kinds_are_recognised(kind, n):
    rng = seed_of(f"kind {kind} {n}")
    right = 0
    for _ in range(40):
        uv1, uv2, base, R, _ = two_photographs(rng, n, kind)
        found = relative_orientations(uv1, uv2, tolerance=TOLERANCE)
        right += found[0].kind == kind
        if kind == "infinite":
            assert np.abs(found[0].rotation - R).max() < 20 * SIGMA
        else:
            # 1e-5 over rays of some 10 deg, and some points in weak places
            assert min(error_of(one, base, R) for one in found) < 0.02
    assert right >= 37


def test_gross_errors_are_put_aside():
    rng = seed_of("relative gross")
    uv1, uv2, base, R, _ = two_photographs(rng, 60, "spatial", outliers=15)
    (best, *_) = relative_orientations(uv1, uv2, tolerance=TOLERANCE)
    assert best.kind == "spatial" and best.inliers[15:].all()
    # a wrong pair may lie in its epipolar plane by chance
    assert best.inliers[:15].sum() <= 1
    assert error_of(best, base, R) < 2e-3
    assert best.sigma0 == pytest.approx(SIGMA, rel=0.3) and best.redundancy == best.inliers.sum() - 5


@pytest.mark.parametrize("seed", range(6))
def test_a_shallow_relief_within_a_wide_tolerance_is_not_taken_for_its_mirror_image(seed):
    """Both orientations of the mean plane fit within the tolerance; only one has small residuals."""
    rng = seed_of(f"shallow relief {seed}")
    base = np.array([0.92, 0.38, 0.05]) / np.linalg.norm([0.92, 0.38, 0.05])
    uv1 = rng.uniform(-0.15, 0.15, (200, 2))
    depth = 12 * (1 + 0.2 * uv1[:, 0] + 0.3 * uv1[:, 1] + 0.6 * uv1[:, 0] * uv1[:, 1] - 0.8 * uv1[:, 1] ** 2)
    points = np.c_[uv1, -np.ones(200)] * depth[:, None] - base
    uv2 = -points[:, :2] / points[:, 2:]
    uv1, uv2 = (uv + 1e-5 * rng.standard_normal(uv.shape) for uv in (uv1, uv2))
    best = relative_orientations(uv1, uv2, tolerance=1e-3)[0]
    assert best.kind == "spatial" and best.sigma0 == pytest.approx(1e-5, rel=0.2)
    assert error_of(best, base, np.eye(3)) < 0.05


def test_both_solutions_of_a_plane_fit_and_a_third_photograph_decides():
    rng = seed_of("plane")
    uv1, uv2, base, R, points = two_photographs(rng, 4, "planar", sigma=0)
    H, used = fit_homography(uv1, uv2, tolerance=TOLERANCE)
    assert used.all()
    both = decompose_homography(H, uv1)
    assert len(both) == 2
    for b, R2, normal in both:
        assert np.abs(coplanarity_residuals(uv1, uv2, b, R2)[0]).max() < 1e-12
        assert (np.c_[uv1, -np.ones(4)] @ normal > 0).all()
    errors = [np.linalg.norm(b - base) + np.abs(R2 - R).max() for b, R2, _ in both]
    assert min(errors) < 1e-9 < 1e-3 < max(errors)
    found = relative_orientations(uv1, uv2, tolerance=TOLERANCE)
    true = min(found, key=lambda one: error_of(one, base, R))
    np.testing.assert_allclose(model_points(uv1, uv2, true), points, atol=1e-8)


def test_derivatives_of_the_coplanarity_condition():
    """The gradient of the unnormalised sum, seen through the steps of Gauss-Newton."""
    rng = seed_of("coplanarity")
    uv1, uv2, base, R, _ = two_photographs(rng, 12, "spatial", sigma=0)
    h = 1e-6
    steps = np.eye(5) * h
    J = np.stack(
        [
            (
                coplanarity_residuals(uv1, uv2, *turned_pair(base, R, s))[0]
                - coplanarity_residuals(uv1, uv2, *turned_pair(base, R, -s))[0]
            )
            / (2 * h)
            for s in steps
        ],
        axis=1,
    )
    # at the truth the residuals vanish, and with them the derivatives of their weights
    _, N = coplanarity_residuals(uv1, uv2, base, R)
    np.testing.assert_allclose(N, J.T @ J, rtol=1e-6, atol=1e-8 * np.abs(N).max())


def test_covariance_of_the_five_parameters():
    rng = seed_of("five parameters")
    uv1, uv2, base, R, _ = two_photographs(rng, 20, "spatial", sigma=0)
    squares, variances = [], []
    for _ in range(300):
        noisy1, noisy2 = (uv + SIGMA * rng.standard_normal(uv.shape) for uv in (uv1, uv2))
        b, R2, v, Q = refine_coplanarity(noisy1, noisy2, base, R)
        turn = np.array([(R.T @ R2)[2, 1], (R.T @ R2)[0, 2], (R.T @ R2)[1, 0]])
        # the two turns of the base in the axes that the covariance is given in
        axes = np.stack([turned_pair(b, R2, e * 1e-7)[0] - b for e in np.eye(5)[:2]]) / 1e-7
        d = np.concatenate([-axes @ (base - b), turn])
        squares.append(d @ np.linalg.solve(SIGMA**2 * Q, d))
        variances.append(np.sum(v**2) / 15)
    assert np.mean(squares) == pytest.approx(5, abs=4 * np.sqrt(10 / 300))
    assert np.sqrt(np.mean(variances)) == pytest.approx(SIGMA, rel=0.1)


@pytest.mark.parametrize("given", [False, True], ids=["from nothing", "from approximate values"])
@pytest.mark.parametrize("kind", ["dependent", "independent"])
def test_pairs(kind, given):
    rng = seed_of(f"pair {kind}")
    n = 20
    if kind == "dependent":
        true = np.array([0.2, -0.15, 0.1, -0.05, 0.3])
        b, R2 = np.array([1, true[0], true[1]]), rotation_from_angles(*true[2:])
        positions, rotations = np.stack([np.zeros(3), b]), np.stack([np.eye(3), R2])
    else:
        true = np.array([0.08, -0.2, 0.05, -0.1, 0.15])
        positions = np.array([[0.0, 0, 0], [1, 0, 0]])
        rotations = np.stack([rotation_from_angles(0, true[0], true[1]), rotation_from_angles(*true[2:])])
    points = rng.uniform(-1.5, 1.5, (n, 3)) + np.array([0.5, 0, -6])
    exact = []
    for X0, R in zip(positions, rotations, strict=True):
        UVW = (points - X0) @ R
        exact.append(-UVW[:, :2] / UVW[:, 2:])
    orient = orient_dependent if kind == "dependent" else orient_independent
    start = true + 0.05 * rng.uniform(-1, 1, 5) if given else None
    squares = []
    for _ in range(100):
        noisy = [uv + SIGMA * rng.standard_normal(uv.shape) for uv in exact]
        pair = orient(*noisy, start=start)
        d = pair.parameters - true
        squares.append(d @ np.linalg.solve(pair.covariance * (SIGMA / pair.sigma0) ** 2, d))
    assert pair.redundancy == n - 5 and pair.kind == kind and len(pair.names) == 5
    np.testing.assert_allclose(pair.positions, positions, atol=0.01)
    np.testing.assert_allclose(pair.rotations, rotations, atol=0.01)
    assert np.mean(squares) == pytest.approx(5, abs=4 * np.sqrt(10 / 100))


def test_refusals():
    rng = seed_of("relative refusals")
    uv1, uv2, *_ = two_photographs(rng, 10, "spatial")
    with pytest.raises(GeometryError, match="3 common points, at least 4"):
        relative_orientations(uv1[:3], uv2[:3], tolerance=TOLERANCE)
    with pytest.raises(GeometryError, match="neither a plane nor a spatial scene fits"):
        relative_orientations(uv1[:5], rng.uniform(-0.4, 0.4, (5, 2)), tolerance=1e-6)
    with pytest.raises(GeometryError, match="4 pairs, at least 5"):
        refine_coplanarity(uv1[:4], uv2[:4], np.array([1.0, 0, 0]), np.eye(3))
    same1, same2, *_ = two_photographs(rng, 10, "infinite")
    with pytest.raises(GeometryError, match="there is no base to determine"):
        orient_independent(same1, same2)
    with pytest.raises(GeometryError, match="bx is 0"):
        orient_dependent(uv1, uv2, bx=0.0)
    line = np.c_[np.linspace(-0.3, 0.3, 8), np.zeros(8)]
    with pytest.raises(GeometryError, match="relative orientation"):
        orient_independent(line, line + np.array([0.1, 0.0]))
