"""Coverage of photographs and weak points of a network, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.report.network_geometry import Geometry, geometry_of, hull_area, rms_of_groups
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


def test_residuals_of_groups_are_per_coordinate() -> None:
    v = np.array([[3.0, 4.0], [0.0, 1.0], [np.nan, 2.0], [6.0, 8.0]])
    found = rms_of_groups(np.array([1, 1, 1, 3]), v, 5)
    np.testing.assert_allclose(found, [np.nan, np.sqrt(26 / 4), np.nan, np.sqrt(50.0), np.nan])
