"""Statistics and geometry of a bundle report, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement.bundle_statistics import (
    Geometry,
    Given,
    geometry_of,
    given_of,
    hull_area,
    statistics_of,
    summarise_redundancy,
)
from sfm.model.network import ExteriorObservations, InteriorObservations, ScaleBars
from sfm.model.observation_residuals import CENTRE, ROTATION
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def a() -> Adjustment:
    network, truth = make_network(seed_of("bundle"), images=6, points=14, cameras=2, free=("c",))
    return adjust(network, truth, datum=Datum("free"), reject="none")


def test_points_whose_rays_meet_at_less_than_ten_degrees_are_weak() -> None:
    none = np.zeros(0)
    angle = np.array([14.0, 8.0, np.nan, 40.0, 2.0, 11.0])
    found = Geometry(np.zeros(6, dtype=np.int64), angle, none, none, none, (), none)  # type: ignore[arg-type]
    assert found.weak.tolist() == [4, 1]


def test_coverage_is_of_each_camera(a: Adjustment) -> None:
    """By the hull of its image points in its photographs, and by the farthest from the centre."""
    found, seen = geometry_of(a), a.network.image_points
    assert [one.camera for one in found.coverage] == ["camera 1", "camera 2"]
    size = np.array([2000.0, 1500.0])
    for c, one in enumerate(found.coverage):
        own = a.network.camera[seen.image] == c
        assert one.hull_of_all == pytest.approx(hull_area((seen.xy[own] - 1) / size))
        photographs = np.flatnonzero(a.network.camera == c)
        away = np.linalg.norm(seen.xy - (size - 1) / 2, axis=1) / 1250
        np.testing.assert_allclose(one.radius, [away[seen.image == i].max() for i in photographs])
        np.testing.assert_allclose(
            one.hull, [hull_area(seen.xy[seen.image == i] / size) for i in photographs]
        )
        np.testing.assert_array_equal(one.hull, found.hull[photographs])
    assert found.image_points.tolist() == np.bincount(seen.image).tolist()
    v = a.residuals
    np.testing.assert_allclose(
        found.image_rms_px, [np.sqrt((v[seen.image == i] ** 2).mean()) for i in range(6)]
    )
    assert found.histogram() == tuple(
        (n, int((np.bincount(seen.point) == n).sum())) for n in np.unique(np.bincount(seen.point)).tolist()
    )


def test_a_photograph_without_image_points_covers_nothing(a: Adjustment) -> None:
    out = a.network.image_points.image == 2
    found = geometry_of(replace(a, rejected=out))
    assert found.hull[2] == 0 and found.image_points[2] == 0 and np.isnan(found.image_rms_px[2])
    assert found.coverage[0].radius[1] == 0.0


def test_a_summary_is_of_what_is_known() -> None:
    found = summarise_redundancy(np.array([[3.0, np.nan], [1.0, np.inf]]))
    assert (found.smallest, found.mean, found.median, found.largest) == (1.0, np.inf, 3.0, np.inf)
    found = summarise_redundancy(np.array([4.0, 1.0, 2.0, 1.0]))
    assert (found.smallest, found.mean, found.median, found.largest) == (1.0, 2.0, 1.5, 4.0)
    none = summarise_redundancy(np.full(3, np.nan))
    assert np.isnan([none.smallest, none.mean, none.median, none.largest]).all()


def test_statistics_are_of_all_kinds(a: Adjustment) -> None:
    found = statistics_of(a)
    assert found.known and len(found.global_tests) == 1
    assert found.largest_w == pytest.approx(np.nanmax(np.abs(found.w.statistic)))
    assert found.largest_tau == pytest.approx(np.nanmax(np.abs(found.tau.statistic)))
    assert found.redundancy_of_image_points == pytest.approx(a.redundancy, rel=1e-6)
    assert found.redundancy_sum == pytest.approx(a.redundancy, rel=1e-6)
    assert all(not one.significant for one in found.not_significant)
    assert {one.first for one in found.camera_correlations} <= {
        "c of camera camera 1",
        "c of camera camera 2",
    }
    bars = ScaleBars(np.array([0, 1]), np.array([5, 6]), np.array([1.0, 1.0]), np.array([9.0, 9.0]))
    both = adjust(a.network.with_given(bars), a.estimate, datum=Datum("free"), reject="none")
    assert [one.of for one in statistics_of(both).global_tests] == list(statistics_of(both).kinds.names)
    assert len(statistics_of(both).global_tests) == 2


def test_given_values_are_told_apart_by_kind() -> None:
    network, truth = make_network(seed_of("given kinds"), images=6, points=14, free=("c",))
    bars = ScaleBars(np.array([0]), np.array([5]), np.array([1.0]), np.array([9.0]))
    variance = np.tile(np.diag([1.0] * 3 + [np.inf] * 3), (2, 1, 1))
    exterior = ExteriorObservations(np.arange(2), truth.position[:2], np.zeros((2, 3)), variance)
    interior = InteriorObservations(
        np.array([0]), np.array([0]), truth.cameras[0].parameters[:1], np.array([1.0])
    )
    network = network.with_control(network.points[:6], truth.points[:6], 1e-3)
    network = network.with_given(exterior, interior, bars)
    a = adjust(network, truth, datum=Datum("control"), reject="none")
    given = given_of(a, "m")
    assert given.control is not None and len(given.control.names) == 6
    assert given.bars is not None and given.bars.names == ("1 - 6",)
    assert given.interior is not None and given.further == ()
    assert [one.kind for one in given.exterior] == [CENTRE]  # no angle was observed
    assert given.of(ROTATION) is None or given.of(ROTATION) in given.kinds
    free = network.with_given(ExteriorObservations())
    given = given_of(adjust(free, truth, datum=Datum("free"), reject="none"), "m")
    assert given.control is None and given.bars is not None and given.exterior == ()
    assert Given(()).control is None
