"""Statistics and geometry of a bundle report, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement.bundle_statistics import Given, given_of, statistics_of, summarise_redundancy
from sfm.model.network import ExteriorObservations, InteriorObservations, ScaleBars
from sfm.model.observation_residuals import CENTRE, ROTATION
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def a() -> Adjustment:
    network, truth = make_network(seed_of("bundle"), images=6, points=14, cameras=2, free=("c",))
    return adjust(network, truth, datum=Datum("free"), reject="none")


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
