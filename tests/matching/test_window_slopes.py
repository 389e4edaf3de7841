"""Slopes of windows: their errors are those stated, and planes count as much as they are right."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.matching.lsm.two_photo import LinearParts
from sfm.matching.lsm.window_slopes import (
    ShiftedWindows,
    SlopeEquations,
    estimate_slopes,
    slope_equations,
)
from sfm.model.conventions import FloatArray
from tests.synthetic import seed_of

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
