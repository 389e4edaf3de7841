"""Agreement and precision of an adjustment: its sigma0, residuals and standard deviations, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.judgement import checks
from sfm.judgement.checks import Sigma0
from sfm.model.network import ExteriorObservations, InteriorObservations, ScaleBars
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def a() -> Adjustment:
    network, truth = make_network(seed_of("checks"), images=6, points=14, free=("c",))
    return adjust(network, truth, datum=Datum("free"), reject="none")


@pytest.mark.parametrize(
    ("px", "ratio", "differs"),
    [(0.0507, 1.0, True), (0.0504, 1.0, False), (0.0496, 1.0, False), (0.0493, 1.0, True), (0.05, 2.0, True)],
)
def test_sigma0_of_image_points_is_stated_apart_where_it_differs_by_a_per_cent(
    px: float, ratio: float, differs: bool
) -> None:
    sigma0 = Sigma0(px, ratio, 0.05, pixel_mm=0.004)
    assert sigma0.differs == differs
    assert sigma0.image_points_px == pytest.approx(ratio * 0.05) and sigma0.mm == pytest.approx(px * 0.004)


def test_sigma0_of_image_points_is_that_of_all_where_nothing_checks_them(a: Adjustment) -> None:
    found = checks.sigma0_of(a)
    assert found.px == a.sigma0_px and found.stated_px == a.stated_px
    assert found.ratio == pytest.approx(a.sigma0, rel=1e-6) and found.pixel_mm == 0.005
    unknown = replace(a, redundancy_numbers=np.full_like(a.redundancy_numbers, np.nan))
    assert checks.sigma0_of(unknown).ratio == pytest.approx(a.sigma0_px / a.stated_px)
    none = replace(a, rejected=np.ones_like(a.rejected))
    assert np.isnan(checks.sigma0_of(none).pixel_mm)


def test_the_longest_residual_is_in_standard_deviations(a: Adjustment) -> None:
    """Of 0.1 px, as their median is below what normal residuals of 0.1 px have."""
    v = np.full(a.residuals.shape, 0.05)
    v[7], v[9], v[11] = (0.3, -0.4), (0.0, 0.6), (0.7, 0.0)
    rejected = np.arange(len(v)) == 11
    one = checks.longest_residual(replace(a, residuals=v, rejected=rejected))
    seen = a.network.image_points
    assert (one.image, one.point) == (a.network.images[seen.image[9]], a.network.points[seen.point[9]])
    assert (one.length_px, one.over_sigma, one.weight) == (pytest.approx(0.6), pytest.approx(6.0), 1.0)
    weights = np.where(np.arange(len(v)) == 9, 0.5, 1.0)
    one = checks.longest_residual(replace(a, residuals=v, rejected=rejected, weights=weights))
    assert (one.length_px, one.over_sigma) == (pytest.approx(0.5), pytest.approx(5.0))
    one = checks.longest_residual(replace(a, residuals=v, rejected=np.ones(len(v), dtype=bool)))
    assert (one.image, one.length_px, one.over_sigma, one.weight) == ("", 0.0, 0.0, 1.0)


def test_a_cautious_standard_deviation_hides_no_outlier(a: Adjustment) -> None:
    """Residuals of four times the stated standard deviation: one of ten times is 2.5 times as long."""
    v = seed_of("four times").normal(0, 0.4, a.residuals.shape)
    v[9] = (10.0, 0.0)
    many = replace(a, residuals=v)
    assert checks.longest_residual(many).over_sigma == pytest.approx(25.0, rel=0.15)
    length = np.linalg.norm(v, axis=1)
    assert checks.longest_residual(many).over_sigma == pytest.approx(
        10.0 / (np.median(length) / np.sqrt(2 * np.log(2))), rel=1e-4
    )


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
    found = checks.count_observations(a)
    assert found.image == 2 * len(network.image_points) and found.control == 12
    assert (found.exterior, found.interior, found.scale_bars, found.further) == (8, 1, 1, 0)
    assert found.total == found.image + 12 + 8 + 1 + 1 == a.observations and found.constraints == 0
    rejected = np.arange(len(a.rejected)) < 4
    assert checks.count_observations(replace(a, rejected=rejected)).image == found.image - 8
    free = adjust(network.with_given(ExteriorObservations()), truth, datum=Datum("free"), reject="none")
    found = checks.count_observations(free)
    assert (found.control, found.exterior, found.constraints) == (0, 0, 6)  # a bar gives the scale


def test_the_largest_residuals_are_listed_largest_first(a: Adjustment) -> None:
    w, rejected = np.full(a.standardised.shape, 0.5), np.zeros(len(a.rejected), dtype=bool)
    w[3], w[5], w[8], w[2] = (-3.0, 1.0), (2.0, -4.0), (9.0, 9.0), (np.nan, np.nan)
    rejected[8] = True
    residuals = np.arange(2.0 * len(w)).reshape(-1, 2)
    changed = replace(a, standardised=w, rejected=rejected, residuals=residuals)
    rows = checks.largest_residuals(changed, 2)
    seen = a.network.image_points
    assert [row[:2] for row in rows] == [
        (a.network.images[seen.image[k]], a.network.points[seen.point[k]]) for k in (5, 3)
    ]
    assert [row[2:5] for row in rows] == [(10.0, 11.0, -4.0), (6.0, 7.0, -3.0)]
    assert [row[5] for row in rows] == [changed.tau[5, 1], changed.tau[3, 0]]
    every = checks.largest_residuals(changed, 10**6)
    assert len(every) == len(w) - 1
    assert checks.largest_residuals(replace(a, standardised=np.zeros((0, 2)))) == ()


def test_means_are_of_what_is_known() -> None:
    values = np.array([[3.0, np.nan], [4.0, np.inf], [0.0, 5.0]])
    np.testing.assert_allclose(checks.root_mean_squares(values), np.sqrt([25 / 3, 25.0, 50 / 4]))
    np.testing.assert_array_equal(checks.largest(values), [4.0, 5.0, 5.0])
    unknown = np.full((2, 2), np.nan)
    assert np.isnan(checks.root_mean_squares(unknown)).all() and np.isnan(checks.largest(unknown)).all()
    assert np.isnan(checks.largest(np.zeros((0, 3)))).all()
    np.testing.assert_array_equal(
        checks.largest(np.array([[np.nan, -2.0], [np.nan, -3.0]])), [np.nan, -2, -2]
    )


def test_residuals_of_groups_are_per_coordinate() -> None:
    v = np.array([[3.0, 4.0], [0.0, 1.0], [np.nan, 2.0], [6.0, 8.0]])
    found = checks.rms_of_groups(np.array([1, 1, 1, 3]), v, 5)
    np.testing.assert_allclose(found, [np.nan, np.sqrt(26 / 4), np.nan, np.sqrt(50.0), np.nan])


def test_fixed_coordinates_have_no_precision() -> None:
    covariance = np.stack([np.diag([4.0, 0.0, 9.0]), np.diag([np.nan, 1.0, 16.0])])
    np.testing.assert_array_equal(checks.adjusted_sigmas(covariance), [[2, np.nan, 3], [np.nan, 1, 4]])
    rms, largest = checks.point_sigma(covariance)
    assert rms == pytest.approx(np.sqrt((4 + 0 + 9 + 1 + 16) / 5)) and largest == 4.0
    assert all(np.isnan(checks.point_sigma(np.full((2, 3, 3), np.nan))))


def test_precision_is_of_the_adjusted_unknowns(a: Adjustment) -> None:
    covariance = a.covariance
    points = covariance.points.copy()
    points[3] = 0.0
    found = checks.precision_of(replace(a, covariance=replace(covariance, points=points)))
    assert found.fixed_points == 1 and not found.points[3].any()
    sigma = np.sqrt(np.einsum("nii->ni", np.delete(points, 3, axis=0)))
    np.testing.assert_allclose(found.rms[:3], np.sqrt((sigma**2).mean(axis=0)))
    np.testing.assert_allclose(found.largest, [*sigma.max(axis=0), sigma.max()])
    of_poses = np.sqrt(np.einsum("nii->ni", covariance.exterior))
    np.testing.assert_allclose(found.exterior, of_poses)
    np.testing.assert_allclose(found.centres[3], np.sqrt((of_poses[:, :3] ** 2).mean()))
    np.testing.assert_allclose(found.angles[3], np.sqrt((of_poses[:, 3:] ** 2).mean()))


def test_a_check_coordinate_is_tested_by_both_standard_deviations() -> None:
    one = checks.compare_coordinate("P", 1, 10.0, 3.0, 11.0, 4.0, 1.0)
    assert (one.coordinate, one.use, one.difference) == ("Y", "check", 1.0)
    assert one.test == pytest.approx(1 / 5)
    assert np.isnan(checks.compare_coordinate("P", 0, 10.0, 0.0, 11.0, 0.0, 1.0).test)
