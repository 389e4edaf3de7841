"""Slopes of windows: their errors are those stated, and planes count as much as they are right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.matching.lsm.surface_planes import Planes, planes_at, tilted_planes
from sfm.matching.lsm.two_photo import LinearParts
from sfm.matching.lsm.window_slopes import (
    ShiftedWindows,
    SlopeEquations,
    estimate_slopes,
    slope_equations,
)
from sfm.model.camera import tangents_from_pixel
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints
from sfm.survey.measuring.covering_points import covariance_with_slopes
from tests.synthetic import make_network, seed_of

WINDOWS = 2000
PLANE = np.eye(2) * 2e-6**2
UNKNOWN = np.eye(2) * 1e-3**2


def _matches(
    slope: FloatArray, parallaxes: list[tuple[float, float]], *, noise: float = 1.0
) -> list[ShiftedWindows]:
    """Return windows in photographs of such parallaxes; half of the noise is that of the template."""
    rng, n = seed_of("slopes of windows"), len(slope)
    root = rng.normal(size=(n, 4, 4)) * 1e3
    C = root @ root.transpose(0, 2, 1)

    def distortion() -> FloatArray:
        return np.asarray((root @ rng.normal(size=(n, 4, 1)))[:, :, 0] * noise * np.sqrt(0.5))

    template, found = distortion(), []
    for parallax in parallaxes:
        linear = LinearParts(
            np.zeros((n, 4)), C.copy(), C, np.full(n, noise**2), np.tile(np.eye(2, 4), (n, 1, 1))
        )
        windows = ShiftedWindows(
            np.arange(n), np.tile(np.eye(2), (n, 1, 1)), np.tile(np.array(parallax), (n, 1)), linear
        )
        A = windows.linear_per_slope()
        score = (C @ A @ slope[:, :, None])[:, :, 0] + template + distortion()
        linear.score[:] = score
        found.append(windows)
    return found


def _over_stated(error: FloatArray, covariance: FloatArray) -> float:
    square = np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error)
    return float(np.sqrt(square.mean() / 2))


@pytest.mark.parametrize(
    "parallaxes",
    [
        [(300.0, 50.0)],
        [(300.0, 0.0), (320.0, 10.0), (280.0, -20.0), (310.0, 0.0)],  # on one side: the template counts fully
        [(300.0, 0.0), (-300.0, 0.0), (0.0, 300.0), (0.0, -300.0)],  # on all sides: it cancels
    ],
)
def test_slopes_have_the_errors_that_are_stated(parallaxes: list[tuple[float, float]]) -> None:
    slope = seed_of("true slopes").normal(size=(WINDOWS, 2)) * 2e-6
    matches = _matches(slope, parallaxes)
    equations = slope_equations(matches, WINDOWS)
    nothing = np.zeros((WINDOWS, 2))
    alone = np.linalg.solve(equations.N, equations.right[:, :, None])[:, :, 0]
    assert _over_stated(alone - slope, np.linalg.inv(equations.N)) == pytest.approx(1, abs=0.06)
    planes = np.tile(PLANE, (WINDOWS, 1, 1))
    slopes = estimate_slopes(equations, planes, UNKNOWN, nothing)
    assert _over_stated(slopes.slope - slope, slopes.covariance) == pytest.approx(1, abs=0.06)
    assert ((slopes.slope - slope) ** 2).mean() < min(((alone - slope) ** 2).mean(), (slope**2).mean())
    # matched on planes that are corrected already, the windows say the same
    changed = slope / 2
    again = estimate_slopes(
        slope_equations(_matches(slope - changed, parallaxes), WINDOWS), planes, UNKNOWN, changed
    )
    assert again.slope == pytest.approx(slopes.slope, abs=1e-12)


def test_planes_that_photographs_contradict_count_for_nothing() -> None:
    slope = np.zeros((WINDOWS, 2))
    slope[::2] = 1e-4  # fifty times the standard deviation of a plane
    equations = slope_equations(_matches(slope, [(300.0, 0.0), (-300.0, 50.0)]), WINDOWS)
    slopes = estimate_slopes(equations, np.tile(PLANE, (WINDOWS, 1, 1)), UNKNOWN, np.zeros((WINDOWS, 2)))
    variance = np.einsum("naa->n", slopes.covariance)
    alone = np.einsum("naa->n", np.linalg.inv(equations.N + np.linalg.inv(UNKNOWN)))
    plain = alone < 1e-9  # windows whose texture shows slopes of this size
    assert plain.mean() > 0.6
    assert variance[::2][plain[::2]] == pytest.approx(alone[::2][plain[::2]])
    assert (variance[1::2] <= np.trace(PLANE)).mean() > 0.99
    # the slope of a plane of which nothing is known is that of the matches
    unknown = estimate_slopes(equations, np.full((WINDOWS, 2, 2), np.nan), UNKNOWN, np.zeros((WINDOWS, 2)))
    assert np.einsum("naa->n", unknown.covariance) == pytest.approx(alone)


def test_without_texture_or_matches_the_plane_stays_as_it_is() -> None:
    slopes = estimate_slopes(
        SlopeEquations(np.zeros((3, 2, 2)), np.zeros((3, 2))),
        np.tile(PLANE, (3, 1, 1)),
        UNKNOWN,
        np.zeros((3, 2)),
    )
    assert (slopes.slope == 0).all() and slopes.covariance == pytest.approx(np.tile(PLANE, (3, 1, 1)))
    assert (slope_equations([], 3).N == 0).all()
    noise = _matches(np.ones((3, 2)), [(300.0, 0.0)])
    linear = noise[0].linear
    linear.derivative[:] = -linear.spread  # less than noise has by chance
    equations = slope_equations(noise, 3)
    assert np.abs(equations.N).max() < 1e-3 and np.abs(equations.right).max() < 1e-3
    exact = slope_equations(_matches(np.ones((3, 2)) * 1e-6, [(300.0, 0.0)], noise=0.0), 3)
    assert np.isfinite(exact.N).all() and np.isfinite(exact.right).all()


def test_stripes_without_noise_have_a_singular_spread() -> None:
    """Rounding leaves eigenvalues of either sign where the texture shows nothing."""
    matches = _matches(np.full((WINDOWS, 2), 1e-6), [(300.0, 0.0), (-100.0, 200.0)])
    for match in matches:
        values, vectors = np.linalg.eigh(match.linear.spread)
        values[:, :2] = 0.0
        values[:, 0] = np.where(np.arange(WINDOWS) % 2 == 0, -1.1e-6, 1.1e-6) * values.sum(axis=1)
        match.linear.spread[:] = vectors @ (values[:, :, None] * vectors.transpose(0, 2, 1))
        match.linear.derivative[:] = match.linear.spread
    equations = slope_equations(matches, WINDOWS)
    assert np.isfinite(equations.N).all() and np.isfinite(equations.right).all()
    assert np.linalg.eigvalsh(equations.N).min() > -1e-9 * np.abs(equations.N).max()


def _inverse_depths(truth: Estimate, planes: Planes, xy: FloatArray, beside: FloatArray) -> FloatArray:
    """Return the inverse depths of planes beside their positions in photograph 0, relative to those there."""
    lens, R = truth.cameras[0], truth.rotation[0]
    at, there = (
        np.column_stack([tangents_from_pixel(lens, places), -np.ones(len(xy))]) @ R.T
        for places in (xy, xy + beside)
    )
    return np.asarray((there * planes.normal).sum(axis=1) / (at * planes.normal).sum(axis=1))


def test_planes_state_their_slopes_and_are_tilted_by_them() -> None:
    network, truth = make_network(seed_of("planes"), images=1, points=4000)
    rng, lens, R = seed_of("points of planes"), truth.cameras[0], truth.rotation[0]
    xy = rng.uniform(20, np.array(lens.size_px) - 20, (4000, 2))
    uv = tangents_from_pixel(lens, xy)
    for larger in (1.0, 5.0):  # the noise of a tenth of the points, over that of the others
        noise = 1e-5 * np.where(rng.random(4000) < 0.1, larger, 1.0) * rng.normal(size=4000)
        depth = 1 / (0.002 + 0.0004 * uv[:, 0] - 0.0003 * uv[:, 1] + noise)
        points = truth.position[0] + (depth[:, None] * np.column_stack([uv, -np.ones(4000)])) @ R.T
        estimate = replace(truth, points=points)
        places = rng.uniform(100, np.array(lens.size_px) - 100, (500, 2))
        planes = planes_at(estimate, network.camera, 0, places, np.arange(4000))
        at = tangents_from_pixel(lens, places)
        true = np.array([0.0004, -0.0003]) / (0.002 + at @ [0.0004, -0.0003])[:, None]
        T = np.stack([tangents_from_pixel(lens, places + d) - at for d in np.eye(2)], axis=1)
        stated = np.stack([_inverse_depths(estimate, planes, places, d) - 1 for d in np.eye(2)], axis=1)
        error = stated - np.einsum("kab,kb->ka", T, true)
        square = np.einsum("ka,kab,kb->k", error, np.linalg.inv(planes.slope_covariance), error) / 2
        assert 0.4 < np.median(square) < 1.0 and np.quantile(square, 0.9) < 3.0  # 2.3 by chance
    slope = rng.normal(size=(500, 2)) * 1e-4
    moved = tilted_planes(estimate, network.camera, 0, places, planes, slope)
    assert np.linalg.norm(moved.normal, axis=1) == pytest.approx(np.ones(500))
    for d in (np.array([3.0, 0.0]), np.array([-2.0, 4.0])):
        change = _inverse_depths(estimate, moved, places, d) - _inverse_depths(estimate, planes, places, d)
        assert change == pytest.approx(slope @ d, rel=0.01, abs=1e-6)


def test_slopes_count_as_often_as_a_point_has_rays() -> None:
    """The mean of n rays has the covariance of matching over n, and that of slopes as it is."""
    number = np.array([0, 0, 0, 0, 1, 1])
    C, S = np.diag([0.04, 0.09]), np.diag([0.01, 0.02])
    of_slopes = np.array([np.zeros((2, 2)), S, S, S, np.zeros((2, 2)), S])
    seen = ImagePoints(np.array([0, 1, 2, 3, 0, 1]), number, np.zeros((6, 2)), np.tile(C, (6, 1, 1)))
    whole = covariance_with_slopes(seen, of_slopes)
    assert whole[[0, 4]] == pytest.approx(np.array([C, C]))
    assert np.linalg.inv(np.linalg.inv(whole[1:4]).sum(axis=0)) == pytest.approx(C / 3 + S)
    assert whole[5] == pytest.approx(C + S)
