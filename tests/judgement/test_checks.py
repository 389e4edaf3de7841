"""Agreement and precision of an adjustment: its sigma0, residuals and standard deviations, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement import checks
from sfm.judgement.checks import Sigma0
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


def test_a_check_coordinate_is_tested_by_both_standard_deviations() -> None:
    one = checks.compare_coordinate("P", 1, 10.0, 3.0, 11.0, 4.0, 1.0)
    assert (one.coordinate, one.use, one.difference) == ("Y", "check", 1.0)
    assert one.test == pytest.approx(1 / 5)
    assert np.isnan(checks.compare_coordinate("P", 0, 10.0, 0.0, 11.0, 0.0, 1.0).test)
