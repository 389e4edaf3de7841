"""Observations, largest residuals and standard deviations of an adjustment, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sfm
from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.network import ExteriorObservations, InteriorObservations, ScaleBars
from sfm.report import precision
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def a() -> Adjustment:
    network, truth = make_network(seed_of("checks"), images=6, points=14, free=("c",))
    return adjust(network, truth, datum=Datum("free"), reject="none")


def test_observations_are_counted_by_kind() -> None:
    network, truth = make_network(seed_of("counted"), images=6, points=14, free=("c", "x0"))
    xyz = truth.points[:5]
    sigma = np.array([1e-3] * 4 + [0.0])[:, None]
    network = network.with_control(network.points[:5], xyz, sigma)
    given = InteriorObservations(
        np.array([0, 0]), np.array([0, 1]), truth.cameras[0].parameters[:2], np.array([1e-2, 0.0])
    )
    bars = ScaleBars(np.array([0]), np.array([9]), np.array([1.0]), np.array([1.0]))
    variance = np.tile(np.diag([1.0, 1.0, 1.0, np.inf, np.inf, 1.0]), (2, 1, 1))
    exterior = ExteriorObservations(np.arange(2), truth.position[:2], np.zeros((2, 3)), variance)
    network = network.with_given(exterior, given, bars)
    a = adjust(
        network, truth, datum=Datum("control"), reject="none", options=AdjustmentOptions(max_iterations=3)
    )
    found = precision.count_observations(a)
    assert found.image == 2 * len(network.image_points) and found.control == 12
    assert (found.exterior, found.interior, found.scale_bars, found.further) == (8, 1, 1, 0)
    assert found.total == found.image + 12 + 8 + 1 + 1 == a.observations and found.constraints == 0
    rejected = np.arange(len(a.rejected)) < 4
    assert precision.count_observations(replace(a, rejected=rejected)).image == found.image - 8
    free = adjust(network.with_given(ExteriorObservations()), truth, datum=Datum("free"), reject="none")
    found = precision.count_observations(free)
    assert (found.control, found.exterior, found.constraints) == (0, 0, 6)  # a bar gives the scale


def test_the_largest_residuals_are_listed_largest_first(a: Adjustment) -> None:
    w, rejected = np.full(a.standardised.shape, 0.5), np.zeros(len(a.rejected), dtype=bool)
    w[3], w[5], w[8], w[2] = (-3.0, 1.0), (2.0, -4.0), (9.0, 9.0), (np.nan, np.nan)
    rejected[8] = True
    residuals = np.arange(2.0 * len(w)).reshape(-1, 2)
    changed = replace(a, standardised=w, rejected=rejected, residuals=residuals)
    rows = precision.largest_residuals(changed, 2)
    seen = a.network.image_points
    assert [row[:2] for row in rows] == [
        (a.network.images[seen.image[k]], a.network.points[seen.point[k]]) for k in (5, 3)
    ]
    assert [row[2:5] for row in rows] == [(10.0, 11.0, -4.0), (6.0, 7.0, -3.0)]
    assert [row[5] for row in rows] == [changed.tau[5, 1], changed.tau[3, 0]]
    every = precision.largest_residuals(changed, 10**6)
    assert len(every) == len(w) - 1
    assert precision.largest_residuals(replace(a, standardised=np.zeros((0, 2)))) == ()


def test_means_are_of_what_is_known() -> None:
    values = np.array([[3.0, np.nan], [4.0, np.inf], [0.0, 5.0]])
    np.testing.assert_allclose(precision.root_mean_squares(values), np.sqrt([25 / 3, 25.0, 50 / 4]))
    np.testing.assert_array_equal(precision.largest(values), [4.0, 5.0, 5.0])
    unknown = np.full((2, 2), np.nan)
    assert np.isnan(precision.root_mean_squares(unknown)).all() and np.isnan(precision.largest(unknown)).all()
    assert np.isnan(precision.largest(np.zeros((0, 3)))).all()
    np.testing.assert_array_equal(
        precision.largest(np.array([[np.nan, -2.0], [np.nan, -3.0]])), [np.nan, -2, -2]
    )


def test_fixed_coordinates_have_no_precision() -> None:
    covariance = np.stack([np.diag([4.0, 0.0, 9.0]), np.diag([np.nan, 1.0, 16.0])])
    np.testing.assert_array_equal(precision.adjusted_sigmas(covariance), [[2, np.nan, 3], [np.nan, 1, 4]])
    rms, largest = precision.point_sigma(covariance)
    assert rms == pytest.approx(np.sqrt((4 + 0 + 9 + 1 + 16) / 5)) and largest == 4.0
    assert all(np.isnan(precision.point_sigma(np.full((2, 3, 3), np.nan))))


def test_precision_is_of_the_adjusted_unknowns(a: Adjustment) -> None:
    covariance = a.covariance
    points = covariance.points.copy()
    points[3] = 0.0
    found = precision.precision_of(replace(a, covariance=replace(covariance, points=points)))
    assert found.fixed_points == 1 and not found.points[3].any()
    sigma = np.sqrt(np.einsum("nii->ni", np.delete(points, 3, axis=0)))
    np.testing.assert_allclose(found.rms[:3], np.sqrt((sigma**2).mean(axis=0)))
    np.testing.assert_allclose(found.largest, [*sigma.max(axis=0), sigma.max()])
    of_poses = np.sqrt(np.einsum("nii->ni", covariance.exterior))
    np.testing.assert_allclose(found.exterior, of_poses)
    np.testing.assert_allclose(found.centres[3], np.sqrt((of_poses[:, :3] ** 2).mean()))
    np.testing.assert_allclose(found.angles[3], np.sqrt((of_poses[:, 3:] ** 2).mean()))


def test_the_precision_of_angles_is_stated_in_degrees() -> None:
    network, truth = make_network(seed_of("degrees"), images=6, points=30)
    found = precision.precision_of(sfm.adjust(network, truth, reject="none"))
    np.testing.assert_allclose(found.exterior_deg[:, 3:], np.degrees(found.exterior[:, 3:]))
    np.testing.assert_allclose(found.exterior_deg[:, :3], found.exterior[:, :3])
