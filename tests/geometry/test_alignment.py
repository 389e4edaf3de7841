"""Alignment: by points, by features, to nominal points; what it does to the covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.conventions import FloatArray, rotation_from_vector
from sfm.errors import GeometryError
from sfm.geometry.alignment import Alignment, Nominal, align_321, align_features, align_points
from sfm.geometry.measured import MeasuredPoints, difference, distance, point_function
from sfm.geometry.shapes.fit import fit_shape
from sfm.similarity import Similarity
from tests.geometry.simulated import in_free_datum, random_covariance
from tests.synthetic import seed_of

COUNT = 12
NAMES = tuple(f"{k}" for k in range(COUNT))
MOVED = Similarity(1.0, rotation_from_vector(np.array([0.3, -0.5, 0.8])), np.array([100.0, -50, 20]))


def nominal_points() -> FloatArray:
    rng = seed_of("nominal")
    xyz = rng.uniform(-300, 300, (COUNT, 3))
    xyz[:5, 2] = 0  # a base
    xyz[5] = (-250, 0, 70)
    xyz[6] = (250, 0, 70)
    return xyz


def measured(xyz: FloatArray, *, sigma: float = 0.1) -> MeasuredPoints:
    Q = random_covariance(COUNT, sigma, seed_of("alignment"))
    return MeasuredPoints(NAMES, MOVED.apply(xyz), Q, "mm", "control")


def aligned_321(points: MeasuredPoints) -> Alignment:
    return align_321(points, ["0", "1", "2"], ["5", "6"], "5")


def aligned_features(points: MeasuredPoints) -> Alignment:
    base = fit_shape(points, "plane", ["0", "1", "2", "3", "4"], weights="equal")
    x = difference(point_function(points, "5"), point_function(points, "6"))
    place, direction = (base.function[base.parameters.rows(name)] for name in ("point", "direction"))
    return align_features(direction, x, point_function(points, "5"), on_plane=place)


def aligned_points(points: MeasuredPoints, **options: object) -> Alignment:
    covariance = np.tile(0.05**2 * np.eye(3), (COUNT, 1, 1))
    return align_points(points, Nominal(NAMES, nominal_points(), covariance), **options)  # type: ignore[arg-type]


METHODS = {"3-2-1": aligned_321, "features": aligned_features, "points": aligned_points}


@pytest.mark.parametrize("method", METHODS)
def test_the_covariance_goes_along(method: str) -> None:
    """Against differences: each coordinate is moved a little, and the alignment done anew."""
    points = measured(nominal_points())
    found = METHODS[method](points)
    J = np.empty((3 * COUNT, 3 * COUNT))
    for k in range(3 * COUNT):
        h = np.zeros(3 * COUNT)
        h[k] = 1e-3
        up, down = (replace(points, xyz=points.xyz + s * h.reshape(-1, 3)) for s in (1, -1))
        J[:, k] = (METHODS[method](up).apply(up).xyz - METHODS[method](down).apply(down).xyz).ravel() / 2e-3
    Q = J @ points.covariance @ J.T
    if method == "points":  # the nominal points add their own, by the same 7 as the measured ones
        own = replace(points, covariance=np.zeros_like(points.covariance))
        Q = Q + found.apply(own).covariance
    np.testing.assert_allclose(found.apply(points).covariance, Q, atol=1e-6 * np.abs(Q).max())


@pytest.mark.parametrize("method", METHODS)
def test_it_brings_points_home_whatever_their_datum(method: str) -> None:
    points = measured(nominal_points())
    there = METHODS[method](points).apply(points)
    wanted = nominal_points() if method == "points" else nominal_points() - [*nominal_points()[5, :2], 0]
    if there.xyz[-1, 2] * wanted[-1, 2] < 0:
        wanted = wanted * [1, -1, -1]  # the normal of the base has either sign
    np.testing.assert_allclose(there.xyz, wanted, atol=1e-8)
    free = replace(points, covariance=in_free_datum(points.covariance, points.xyz), datum="free")
    again = METHODS[method](free).apply(free)
    assert again.datum == "aligned"
    if method == "points":
        noisy = points.xyz + seed_of("noise").normal(scale=0.1, size=(COUNT, 3))
        fit, other = (METHODS[method](replace(m, xyz=noisy)).fitted for m in (points, free))
        assert fit is not None and other is not None and fit.statistic > 0.1
        assert fit.statistic == pytest.approx(other.statistic, rel=1e-3)
    else:
        np.testing.assert_allclose(again.covariance, there.covariance, atol=1e-9)
    before, after = (distance(point_function(m, "1"), point_function(m, "9")) for m in (points, there))
    np.testing.assert_allclose(there.covariance_between([after]), points.covariance_between([before]))


def test_what_a_system_is_defined_by_has_no_variance() -> None:
    points = measured(nominal_points())
    there = aligned_321(points).apply(points)
    sigma = np.sqrt(np.maximum(np.diagonal(there.covariance), 0)).reshape(-1, 3)
    held = np.zeros((COUNT, 3), dtype=bool)
    held[[0, 1, 2], 2] = held[[5, 6], 1] = held[5, 0] = True
    assert sigma[held].max() < 1e-6 < 1e-3 < sigma[~held].min()


def test_points_that_others_contradict_are_held_out() -> None:
    rng = seed_of("held out")
    points = measured(nominal_points())
    xyz = points.xyz + (np.linalg.cholesky(points.covariance) @ rng.normal(size=3 * COUNT)).reshape(-1, 3)
    xyz[[3, 8]] += [[5.0, 0, 0], [0, -4.0, 3]]
    moved = replace(points, xyz=xyz)
    fit = aligned_points(moved, robust=True).fitted
    assert fit is not None and set(np.flatnonzero(~fit.used)) == {3, 8}
    assert fit.statistic < fit.critical and fit.redundancy == 24
    errors = np.array([[5.0, 0, 0], [0, -4, 3]]) @ MOVED.rotation
    np.testing.assert_allclose(fit.difference[[3, 8]], errors, atol=1.0)
    every = aligned_points(moved).fitted
    assert every is not None and every.statistic > every.critical


def test_the_scale_is_fitted_where_it_is_asked_for() -> None:
    points = measured(nominal_points())
    half = replace(points, xyz=points.xyz / 2, covariance=points.covariance / 4, has_scale=False)
    found = aligned_points(half, scale=True)
    assert found.aligned_from_object.scale == pytest.approx(2.0, rel=1e-12)
    assert found.apply(half).has_scale
    kept = aligned_points(half, weights="equal")
    with pytest.raises(GeometryError, match="the best fit did not converge, measured and nominal points are"):
        aligned_points(half)
    assert kept.aligned_from_object.scale == 1 and not kept.apply(half).has_scale


def test_single_covariances_give_single_covariances() -> None:
    points = measured(nominal_points())
    blocks = points.blocks
    full = np.zeros_like(points.covariance)
    for k in range(COUNT):
        full[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = blocks[k]
    one, other = (aligned_points(replace(points, covariance=Q)).apply(replace(points, covariance=Q))
                  for Q in (blocks, full))  # fmt: skip
    np.testing.assert_allclose(one.blocks, other.blocks, rtol=1e-9)


def test_bad_input_is_one_line() -> None:
    points = measured(nominal_points())
    with pytest.raises(GeometryError, match="2 points of the plane and 2 of the line, expected 3 and 2"):
        align_321(points, ["0", "1"], ["5", "6"], "5")
    with pytest.raises(GeometryError, match="lie on a line"):
        align_321(points, ["0", "1", "0"], ["5", "6"], "5")
    with pytest.raises(GeometryError, match="2 nominal points measured, a best fit needs 3"):
        align_points(points, Nominal(("0", "1", "x"), np.eye(3)))
    bare = replace(points, covariance=None)
    with pytest.raises(GeometryError, match='expected weights = "equal"'):
        align_points(bare, Nominal(NAMES, nominal_points()))
    assert (
        align_points(bare, Nominal(NAMES, nominal_points()), weights="equal").apply(bare).covariance is None
    )
    z = difference(point_function(points, "5"), point_function(points, "6"))
    with pytest.raises(GeometryError, match="the direction of X is that of Z"):
        align_features(z, z, point_function(points, "0"))
