"""Fischler-Bolles P3P: every real solution, exact, also near degenerate triples."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm.model.conventions import rotation_from_vector
from sfm.orientation.resection import fischler_bolles
from sfm.orientation.resection.fischler_bolles import leg_quartic, rays_from_tangents, resect_triples
from sfm.runtime.small_algebra import positive_roots
from tests.places import ROOT
from tests.synthetic import seed_of

TABLE = np.loadtxt(ROOT / "datasets/resection4/resection4_points.csv", delimiter=",", skiprows=1)
POINTS, TANGENTS = TABLE[:, 1:4], TABLE[:, 4:6] / 24.0
FIRST = (0.03701365, 0.69538531, -0.71768222)  # datasets/resection4/README.md
SECOND = (0.21604886, -0.17426138, 0.03567370)


def _random_triples(rng, k, *, field=1.0, near=0.1, far=100.0):
    uv = rng.uniform(-field, field, (k, 3, 2))
    depth = np.exp(rng.uniform(np.log(near), np.log(far), (k, 3, 1)))
    axis = rng.standard_normal((k, 3))
    R = rotation_from_vector(
        axis / np.linalg.norm(axis, axis=1, keepdims=True) * rng.uniform(0, np.pi, (k, 1))
    )
    X0 = rng.normal(size=(k, 3))
    in_image = np.concatenate([uv, -np.ones((k, 3, 1))], axis=2) * depth
    return rays_from_tangents(uv), X0[:, None] + np.einsum("kij,knj->kni", R, in_image), X0, R


def test_both_solutions_of_document_001():
    poses = resect_triples(rays_from_tangents(TANGENTS[:3])[None], POINTS[None, :3])
    assert poses.count[0] == 2
    order = np.argsort(poses.position[0, :2, 0])
    position, legs = poses.position[0][order], poses.legs[0][order]
    np.testing.assert_allclose(position, [FIRST, SECOND], atol=1e-8)
    expected = [[0.778546, 0.770247, 0.615352], [0.773059, 0.722135, 0.863515]]
    np.testing.assert_allclose(legs, expected, atol=5e-7)
    M = poses.rotation[0][order[0]].T
    printed = [
        [-0.998033, 0.051274, 0.036079],
        [0.034382, -0.033600, 0.998844],
        [0.052427, 0.998119, 0.031771],
    ]
    np.testing.assert_allclose(M, printed, atol=1e-6)
    # the fourth point tells them apart: 0.0000 mm, and (-2.40, 0.20) mm
    for k, misfit in zip(order, ((0, 0), (-2.40, 0.20)), strict=True):
        UVW = (POINTS[3] - poses.position[0, k]) @ poses.rotation[0, k]
        xy = -24.0 * UVW[:2] / UVW[2] - 24.0 * TANGENTS[3]
        np.testing.assert_allclose(np.abs(xy), np.abs(misfit), atol=0.006)


def test_quartic_of_document_001():
    g = leg_quartic(rays_from_tangents(TANGENTS[:3]), POINTS[:3])
    expected = [-0.94382554, 3.70087942, -5.47462417, 3.61930028, -0.90175394]
    np.testing.assert_allclose(g, expected, atol=1e-7)
    np.testing.assert_allclose(positive_roots(g), [0.93412717, 0.98934097], atol=1e-8)


def test_hundred_thousand_random_triples():
    rays, points, X0, R = _random_triples(seed_of("triples"), 100_000)
    poses = resect_triples(rays, points)
    error = np.linalg.norm(poses.position - X0[:, None], axis=2)
    turn = np.abs(poses.rotation - R[:, None]).max(axis=(2, 3))
    best = np.nanmin(np.where(poses.count[:, None] > 0, np.fmax(error, turn), np.inf), axis=1)
    assert np.mean(best < 1e-6) >= 0.9999
    filled = np.arange(4) < poses.count[:, None]
    assert np.isfinite(poses.position[filled]).all() and np.isfinite(poses.rotation[filled]).all()
    assert np.isnan(poses.position[~filled]).all()


def test_narrow_angles():
    # a field of 2 deg from 50 to 60 base lengths away: cosines that agree in their first four digits
    rays, points, X0, _ = _random_triples(seed_of("narrow"), 20_000, field=0.02, near=50, far=60)
    poses = resect_triples(rays, points)
    error = np.nanmin(np.linalg.norm(poses.position - X0[:, None], axis=2), axis=1, initial=1e9)
    assert np.mean(error < 1e-4) >= 0.995


def test_every_solution_reproduces_the_rays():
    rays, points, _, _ = _random_triples(seed_of("all solutions"), 5000)
    poses = resect_triples(rays, points)
    assert set(np.unique(poses.count)) >= {1, 2, 3, 4}
    k, s = np.nonzero(np.arange(4) < poses.count[:, None])
    P = np.einsum("kji,knj->kni", poses.rotation[k, s], points[k] - poses.position[k, s][:, None])
    P /= np.linalg.norm(P, axis=2, keepdims=True)
    assert np.quantile(np.abs(P - rays[k]).max(axis=(1, 2)), 0.999) < 1e-9
    det = np.linalg.det(poses.rotation[k, s])
    np.testing.assert_allclose(det, 1.0, atol=1e-9)


@pytest.mark.parametrize(
    "points",
    [[[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 0, 0], [0, 0, 0], [1, 1, 0]], [[1, 1, 1]] * 3],
    ids=["collinear", "two coincide", "all coincide"],
)
def test_degenerate_triples_have_no_solution(points):
    rays = rays_from_tangents(np.array([[0.1, 0.0], [0.0, 0.1], [-0.1, -0.1]]))
    assert resect_triples(rays[None], np.array([points], dtype=float)).count[0] == 0
    same = np.repeat(rays[:1], 3, axis=0)
    assert resect_triples(same[None], np.eye(3)[None]).count[0] == 0


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(0.01, 50.0), min_size=4, max_size=4), st.floats(0.1, 10.0))
def test_quartic_finds_the_roots_it_was_made_of(roots, factor):
    found = positive_roots(factor * np.poly(roots))
    spread = np.diff(np.sort(roots)).min() / max(roots)
    if spread > 0.02:
        np.testing.assert_allclose(np.sort(found), np.sort(roots), rtol=1e-5)


def test_quartic_with_a_double_root():
    found = positive_roots(np.poly([0.7, 0.7, 3.0, -2.0]))
    assert np.abs(found - 0.7).min() < 1e-6 and np.abs(found - 3.0).min() < 1e-9
    assert len(positive_roots(np.array([1.0, 0.0, 1.0, 0.0, 1.0]))) == 0


def _equations(ray, X, legs):
    """Squared sides, 1 - cos of the angles, and derivatives of the three equations by the legs."""
    pairs = ((0, 1), (0, 2), (1, 2))
    squares = [float(((X[i] - X[j]) ** 2).sum()) for i, j in pairs]
    g = [1.0 - float(ray[i] @ ray[j]) for i, j in pairs]
    J = np.zeros((3, 3))
    for k, (i, j) in enumerate(pairs):
        J[k, i] = 2 * (legs[i] - legs[j] + legs[j] * g[k])
        J[k, j] = 2 * (legs[j] - legs[i] + legs[i] * g[k])
    misfit = [
        (legs[i] - legs[j]) ** 2 + 2 * legs[i] * legs[j] * g[k] - squares[k] for k, (i, j) in enumerate(pairs)
    ]
    return squares, g, J, np.array(misfit)


def test_legs_are_polished_quadratically(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four steps of Newton's method leave next to nothing of a relative error of 1 %."""
    monkeypatch.setattr(fischler_bolles, "NEWTON_STEPS", 4)
    rng = seed_of("polish")
    rays, points, X0, _ = _random_triples(rng, 50, field=0.5, near=1.0, far=3.0)
    for ray, X, centre in zip(rays, points, X0, strict=True):
        legs = np.linalg.norm(X - centre, axis=1)
        squares, g, J, _ = _equations(ray, X, legs)
        if np.linalg.cond(J) > 30:  # near the danger cylinder Newton's method begins slowly
            continue
        start = legs * (1 + 0.01 * rng.uniform(-1, 1, 3))
        fits, *found = fischler_bolles.polish_legs.py_func(*start, *squares, *g)
        assert fits
        np.testing.assert_allclose(found, legs, rtol=1e-9)


def test_a_step_of_a_leg_is_halved_until_it_is_at_most_half_the_leg(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fischler_bolles, "NEWTON_STEPS", 1)
    rng, halved = seed_of("halving"), 0
    rays, points, X0, _ = _random_triples(rng, 30, field=0.5, near=1.0, far=3.0)
    for ray, X, centre in zip(rays, points, X0, strict=True):
        start = np.linalg.norm(X - centre, axis=1) * rng.uniform(0.3, 3.0, 3)
        squares, g, J, misfit = _equations(ray, X, start)
        step = np.linalg.solve(J, misfit)
        while (np.abs(step) > 0.5 * start).any():
            step, halved = 0.5 * step, halved + 1
        _, *found = fischler_bolles.polish_legs.py_func(*start, *squares, *g)
        np.testing.assert_allclose(found, start - step, rtol=1e-6)
    assert halved > 30


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_legs_are_known_within_a_share_of_their_length(size: float) -> None:
    legs = size * np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    limit = fischler_bolles.MAX_SAME_DIFFERENCE * 15.0 * size
    assert fischler_bolles.is_known(*(legs[1] + [0.9 * limit, 0, 0]), legs, 2)
    assert not fischler_bolles.is_known(*(legs[1] + [1.1 * limit, 0, 0]), legs, 2)
    assert not fischler_bolles.is_known(*legs[1], legs, 1)
