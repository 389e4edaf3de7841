"""Similarity in space: exact on exact points, least squares on noisy ones, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.model.camera import project
from sfm.model.conventions import rotation_from_angles
from sfm.model.errors import GeometryError
from sfm.model.similarity import (
    Similarity,
    extended_axes,
    fit_motions,
    fit_similarities,
    fit_similarity,
    similarity_motions,
    without_motions,
)
from tests.synthetic import make_network, seed_of

TRUE = Similarity(2.5, rotation_from_angles(0.3, -1.1, 2.9), np.array([10.0, -4.0, 7.0]))


@pytest.mark.parametrize("planar", [False, True])
def test_exact_points_give_the_exact_similarity(planar: bool) -> None:
    source = seed_of("exact").normal(size=(6, 3)) * (1, 1, 0 if planar else 1)
    found = fit_similarity(source, TRUE.apply(source))
    assert found.scale == pytest.approx(TRUE.scale, rel=1e-12)
    assert np.abs(found.rotation - TRUE.rotation).max() < 1e-12
    assert np.abs(found.translation - TRUE.translation).max() < 1e-11


def test_no_other_similarity_fits_noisy_points_better() -> None:
    rng = seed_of("least squares")
    source = rng.normal(size=(12, 3))
    target = TRUE.apply(source) + rng.normal(0, 0.05, (12, 3))
    weights = rng.uniform(0.2, 2.0, 12)
    found = fit_similarity(source, target, weights=weights)

    def cost(s: Similarity) -> float:
        return float(weights @ ((s.apply(source) - target) ** 2).sum(axis=1))

    best = cost(found)
    for _ in range(50):
        turn = rotation_from_angles(*rng.normal(0, 1e-3, 3))
        other = Similarity(
            found.scale * (1 + rng.normal(0, 1e-3)),
            turn @ found.rotation,
            found.translation + rng.normal(0, 1e-3, 3),
        )
        assert cost(other) > best


def test_inverse_undoes() -> None:
    points = seed_of("inverse").normal(size=(5, 3))
    assert np.abs(TRUE.inverse().apply(TRUE.apply(points)) - points).max() < 1e-13


def test_a_transformed_network_takes_the_same_photographs() -> None:
    network, truth = make_network(seed_of("photographs"), images=3, points=10)
    moved = TRUE.apply_estimate(truth)
    camera = truth.cameras[network.camera[0]]
    before = project(camera, truth.position[0], truth.rotation[0], truth.points)
    after = project(camera, moved.position[0], moved.rotation[0], moved.points)
    assert np.abs(before - after).max() < 1e-9


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((2, 3)), "2 common points, at least 3"),
        (np.outer(np.arange(4.0), [1, 2, 3]), "lie on a line"),
    ],
)
def test_too_little_is_refused(points: np.ndarray, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        fit_similarity(points, points)


def test_many_sets_of_points_have_the_similarities_of_each() -> None:
    rng = np.random.default_rng(8)
    source, target = rng.standard_normal((2, 6, 4, 3))
    source[2] = np.outer(np.arange(4.0), np.ones(3))  # on a line
    target[4, 1, 0] = np.nan
    found = fit_similarities(source, target)
    assert [k for k, one in enumerate(found) if one is None] == [2, 4]
    for k in (0, 1, 3, 5):
        one, alone = found[k], fit_similarity(source[k], target[k])
        assert one is not None
        np.testing.assert_allclose(one.apply(source[k]), alone.apply(source[k]), atol=1e-12)


@pytest.mark.parametrize("degrees", [0.1, 100.0, 179.0])
def test_only_motions_that_are_open_are_fitted(degrees: float) -> None:
    """Of a levelled network with a scale: shifts and the turn about the vertical; other errors remain."""
    rng = seed_of("levelled")
    target = rng.normal(size=(20, 3))
    G = similarity_motions(target, centre=target.mean(axis=0)).reshape(-1, 7)
    small = 1e-6 * rng.normal(size=7) + 1e-3 * np.eye(7)[6] + 1e-3 * np.eye(7)[3]  # scale, and a tilt
    error = (G @ small).reshape(-1, 3)
    moved = Similarity(1.0, rotation_from_angles(0, 0, np.radians(degrees)), np.array([5.0, -3.0, 2.0]))
    source = moved.apply(target + error)
    open_ = similarity_motions(source, centre=np.zeros(3))[:, :, [0, 1, 2, 5]]
    found = fit_motions(source, target, open_)
    H = np.linalg.qr(G[:, [0, 1, 2, 5]])[0]
    left = error.ravel() - H @ (H.T @ error.ravel())
    np.testing.assert_allclose((found.apply(source) - target).ravel(), left, atol=1e-5)
    assert found.scale == pytest.approx(1.0, abs=1e-12) and np.abs(left).max() > 5e-4


def test_all_seven_motions_are_the_similarity_and_none_is_none() -> None:
    rng = seed_of("all or none")
    source = rng.normal(size=(12, 3))
    target = TRUE.apply(source) + rng.normal(0, 0.05, (12, 3))
    motions = similarity_motions(source, centre=np.zeros(3))
    found, whole = fit_motions(source, target, motions), fit_similarity(source, target)
    np.testing.assert_allclose(found.apply(source), whole.apply(source), atol=1e-9)
    np.testing.assert_array_equal(fit_motions(source, target, motions[:, :, :0]).apply(source), source)


@pytest.mark.parametrize(("depth", "axes"), [(0.04, 2), (0.06, 3)])
def test_points_have_depth_from_a_twentieth_of_their_extent(depth: float, axes: int) -> None:
    box = np.array([[x, y, z] for x in (-1, 1) for y in (-0.8, 0.8) for z in (-depth, depth)])
    found, along = extended_axes(box)
    assert found.shape == (axes, 3) and along.shape == (8, axes)


def test_displacements_without_motions_keep_what_no_motion_explains() -> None:
    rng = seed_of("without motions")
    xyz = rng.normal([5.0, -3.0, 8.0], size=(12, 3))
    xyz[4] = np.nan
    motion = np.zeros((12, 3, 1))
    motion[..., 0] = np.cross([0.1, -0.2, 0.3], xyz) + 0.05 * xyz + [1.0, 2.0, 3.0]
    motion[4] = 0.0
    assert np.abs(without_motions(xyz, motion)).max() < 1e-12
    away = rng.normal(size=(12, 3, 2))
    left = without_motions(xyz, away)
    assert not left[4].any()
    known = np.arange(12) != 4
    np.testing.assert_allclose(without_motions(xyz, left)[known], left[known], atol=1e-12)
    assert ((left[known] ** 2).sum(axis=(0, 1)) < (away[known] ** 2).sum(axis=(0, 1))).all()
