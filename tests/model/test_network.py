"""Networks: reducing keeps what belongs together; what cannot be adjusted is refused."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import sfm
from sfm.adjustment.solve import adjust
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import GeometryError, KolinearError
from sfm.model.estimate import Estimate
from sfm.model.network import ExteriorObservations, ImagePoints, Network, ObjectPoints, ScaleBars, sum_rows
from sfm.model.observations import HeightDifferences
from sfm.model.reduced_network import reduce_network, select_determined
from tests.synthetic import make_network, seed_of


def test_reduced_network_keeps_measurements_of_what_is_left() -> None:
    network, truth = make_network(seed_of("reduce"), images=6, points=20, visibility=0.7)
    network = network.with_given(
        ObjectPoints(np.array([2, 5, 7]), truth.points[[2, 5, 7]], np.zeros((3, 3, 3))),
        ExteriorObservations(
            np.array([0, 4]), truth.position[[0, 4]], np.zeros((2, 3)), np.tile(np.eye(6), (2, 1, 1))
        ),
        ScaleBars(np.array([1, 2]), np.array([3, 9]), np.array([1.0, 2.0]), np.array([0.1, 0.2])),
    )
    images, points = np.ones(6, dtype=bool), np.ones(20, dtype=bool)
    images[0] = points[2] = points[3] = False
    keep = np.ones(len(network.image_points), dtype=bool)
    keep[-1] = False
    small, estimate = reduce_network(network, truth, images, points, keep)

    assert small.images == network.images[1:]
    assert [small.points[j] for j in small.control.point] == ["6", "8"]
    assert len(small.scale_bars) == 0
    assert list(small.exterior.image) == [3]
    assert np.array_equal(estimate.points, truth.points[points])
    old = {
        (network.images[i], network.points[j]): tuple(xy)
        for i, j, xy in zip(
            network.image_points.image[keep],
            network.image_points.point[keep],
            network.image_points.xy[keep],
            strict=True,
        )
        if images[i] and points[j]
    }
    new = {
        (small.images[i], small.points[j]): tuple(xy)
        for i, j, xy in zip(
            small.image_points.image, small.image_points.point, small.image_points.xy, strict=True
        )
    }
    assert new == old


@pytest.mark.parametrize(("min_points", "said"), [(13, "13"), (np.array([14, 13, 14]), "13 or 14")])
def test_reason_states_the_points_that_photographs_need(min_points: int | IntArray, said: str) -> None:
    network, truth = make_network(seed_of("needed points"), images=3, points=12)
    every = np.ones(len(network.image_points), dtype=bool)
    rays = np.ones(12, dtype=np.int64)
    with pytest.raises(GeometryError, match=rf"^0 of 3 photographs see .* \(at least {said}\)"):
        select_determined(network, truth, every, rays, min_points)


def test_rays_count_the_photographs_of_a_point() -> None:
    network, _ = make_network(seed_of("rays"), images=5, points=12)
    assert network.rays().sum() == len(network.image_points)
    assert network.rays().max() <= 5


def test_undetermined_parts_of_an_estimate_are_nan() -> None:
    _, truth = make_network(seed_of("nan"), images=4, points=10)
    position, points = truth.position.copy(), truth.points.copy()
    position[1], points[3] = np.nan, np.nan
    estimate = replace(truth, position=position, points=points)
    assert list(np.flatnonzero(~estimate.oriented)) == [1]
    assert list(np.flatnonzero(~estimate.determined)) == [3]


def test_pairs_of_photographs_that_share_points_are_counted_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    network, _ = make_network(seed_of("pairs"), images=7, points=30, visibility=0.4)
    seen = network.image_points
    usable = seed_of("usable").random(len(seen)) < 0.7
    sees = [set(seen.point[usable & (seen.image == i)].tolist()) for i in range(7)]
    true = [(i, j, len(sees[i] & sees[j])) for i in range(7) for j in range(i + 1, 7) if sees[i] & sees[j]]
    for most, parts in ((10**6, 1), (8, 3)):
        monkeypatch.setattr("sfm.model.network.MAX_PAIRS_AT_ONCE", most)
        found = list(network.common_points(usable))
        assert len(found) >= parts
        joined = [np.concatenate(part).tolist() for part in zip(*found, strict=True)]
        assert list(zip(*joined, strict=True)) == true


def test_photographs_that_all_see_the_same_points_are_paired_in_bounded_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """2,000 photographs of 10 points: 2 million pairs, of which 200,000 are counted at a time."""
    monkeypatch.setattr("sfm.model.network.MAX_PAIRS_AT_ONCE", 200_000)
    m, n = 2_000, 10
    image, point = np.repeat(np.arange(m), n), np.tile(np.arange(n), m)
    seen = ImagePoints(image, point, np.zeros((m * n, 2)), np.tile(np.eye(2), (m * n, 1, 1)))
    names = tuple(str(k) for k in range(m))
    network = Network(names, np.zeros(m, dtype=np.int64), names[:n], seen)
    tracemalloc.start()
    pairs = sum(int((count == n).sum()) for _, _, count in network.common_points(np.ones(m * n, dtype=bool)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert pairs == m * (m - 1) // 2
    assert peak < 24e6  # 78 MB with all at once


Spoil = Callable[[Network, Estimate], tuple[Network, Estimate]]


def seen(network: Network, **changes: Any) -> Network:
    return replace(network, image_points=replace(network.image_points, **changes))


def with_value(array: np.ndarray, row: int, value: Any) -> np.ndarray:
    changed = np.array(array)
    changed[row] = value
    return changed


SPOILED: tuple[tuple[Spoil, str], ...] = (
    (
        lambda n, e: (seen(n, xy=with_value(n.image_points.xy, 3, np.nan)), e),
        r"image image 1, point 4: image coordinates nan nan px",
    ),
    (
        lambda n, e: (seen(n, covariance=with_value(n.image_points.covariance, 3, 0.0)), e),
        r"image image 1, point 4: covariance 0 0 0 0 px\^2, expected a symmetric positive definite matrix",
    ),
    (lambda n, e: (seen(n, covariance=n.image_points.covariance[:, 0]), e), r"of shape \(\d+, 2\), expected"),
    (lambda n, e: (seen(n, image=with_value(n.image_points.image, 0, 99)), e), "index 99 of a photograph"),
    (lambda n, e: (seen(n, point=with_value(n.image_points.point, 0, -1)), e), "index -1 of a object point"),
    (
        lambda n, e: (seen(n, image=n.image_points.image.astype(float)), e),
        "indices of a photograph of type float64, expected whole numbers",
    ),
    (
        lambda n, e: (
            n.with_given(ObjectPoints(np.arange(3), e.points[:3], np.zeros((3, 3)))),
            e,
        ),
        r"covariances of the control of shape \(3, 3\), expected \(3, 3, 3\)",
    ),
    (lambda n, e: (replace(n, camera=n.camera + 5), e), "index 5 of a camera, expected 0 to 0"),
    (lambda n, e: (n, replace(e, points=e.points[:-1])), r"object points of shape \(19, 3\), expected"),
    (lambda n, e: (n.with_control(["1"], [[0, 0, np.nan]], 0.1), e), "control point 1: expected finite"),
    (lambda n, e: (n.with_control(["1", "1"], np.zeros((2, 3))), e), "control point 1: duplicate"),
    (lambda n, e: (n.with_control(["1"], np.zeros((1, 2))), e), r"coordinates \(1, 2\)"),
    (lambda n, e: (n.with_scale_bar("1", "1", 1.0, 0.1), e), "scale bar 1 - 1: length 1"),
    (lambda n, e: (n.with_scale_bar("1", "2", np.nan, 0.1), e), "scale bar 1 - 2: length nan"),
    (lambda n, e: (e, n), "network is a Estimate, expected Network"),  # type: ignore
)


@pytest.mark.parametrize("k", range(len(SPOILED)))
def test_what_no_adjustment_can_use_is_named(k: int) -> None:
    spoil, message = SPOILED[k]
    network, truth = make_network(seed_of("check"), images=5, points=20)
    with pytest.raises(GeometryError, match=message):
        sfm.adjust(*spoil(network, truth))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"options": sfm.AdjustmentOptions(sigma_px=0.0)}, "sigma_px = 0.0, expected a number more than 0"),
        ({"options": sfm.AdjustmentOptions(sigma_px=float("nan"))}, "sigma_px = nan"),
        ({"options": sfm.AdjustmentOptions(alpha=2.0)}, "alpha = 2.0, expected a number between 0 and 1"),
        (
            {"options": sfm.AdjustmentOptions(image_sigma_factor=np.ones(3))},
            r"image_sigma_factor of shape \(3,\), expected",
        ),
        ({"options": sfm.AdjustmentOptions(image_sigma_factor=0.0)}, "image_sigma_factor of shape"),
        ({"datum": "middle"}, "datum: kind 'middle', expected one of"),
    ],
)
def test_options_that_cannot_be_are_named(options: dict[str, Any], message: str) -> None:
    network, truth = make_network(seed_of("check"), images=5, points=20)
    with pytest.raises(GeometryError, match=message):
        sfm.adjust(network, truth, **options)


def test_short_ways_of_saying_it_work() -> None:
    network, truth = make_network(seed_of("check"), images=5, points=20)
    a = sfm.adjust(network, truth, datum="free", reject="none")
    assert a.datum == "free" and sfm.change_datum(a, "minimal").datum == "minimal"
    assert sfm.Solution("a", network, truth).point(7).name == "7"
    with pytest.raises(KolinearError, match=r"unknown point '77', expected one of 7"):
        sfm.Solution("a", network, truth).point(77)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sfm.find_targets("a.jpg"), "photograph is 'a.jpg', expected an array"),  # type: ignore
        (lambda: sfm.find_targets(np.zeros((0, 5), np.uint8)), r"shape \(0, 5\)"),
        (lambda: sfm.find_targets(np.zeros((50, 50), np.uint8), codes=14), "codes is 14, expected text"),  # type: ignore
        (
            lambda: sfm.find_targets(np.zeros((50, 50), np.uint8), min_diameter_px=-1),
            "diameters from -1 to inf",
        ),
        (
            lambda: sfm.fit_similarity(np.zeros((3, 2)), np.zeros((3, 2))),
            r"source is an array of shape \(3, 2\), expected",
        ),
        (lambda: sfm.fit_similarity(np.full((3, 3), np.nan), np.zeros((3, 3))), "NaN or infinity"),
        (lambda: sfm.run_survey("nowhere.toml"), r"nowhere\.toml"),
    ],
)
def test_other_functions_refuse_in_one_line(call: Callable[[], object], message: str) -> None:
    with pytest.raises(KolinearError, match=message):
        call()


def control_of(r: float) -> FloatArray:
    """Return a covariance of sigmas 1, 2 and 0.5 with correlations of one size, one negative."""
    return np.array([[1, r, r], [r, 1, -r], [r, -r, 1]]) * np.outer([1, 2, 0.5], [1, 2, 0.5])


def test_control_that_no_measurement_can_have_is_refused() -> None:
    network, truth = make_network(seed_of("control"), images=4, points=12)
    names, xyz = network.points[:4], truth.points[:4]
    for sigma in (-1.0, np.nan, [1.0, -1.0, 1.0]):
        with pytest.raises(GeometryError, match="control: sigma"):
            network.with_control(names, xyz, sigma)
    with pytest.raises(GeometryError, match="expected finite"):
        network.with_control(names, np.full((4, 3), np.nan), 1.0)
    partly = network.with_control(names, xyz, [0.0, 1.0, np.inf])
    assert np.array_equal(partly.control.covariance[0], np.diag([0.0, 1.0, np.inf]))
    for covariance, good in (
        (control_of(0.3), True),
        (control_of(0.6), False),  # every pair is possible, the three together are not
        (np.diag([0.0, 1.0, np.inf]), True),
        (np.diag([0.0, 1.0, np.inf]) + 0.1 * (1 - np.eye(3)), False),
        (np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), False),
    ):
        held = ObjectPoints(np.arange(4), xyz, np.tile(covariance, (4, 1, 1)))
        if good:
            a = sfm.adjust(network.with_given(held), truth, datum=sfm.Datum("control"))
            assert len(a.network.control) == 4
        else:
            with pytest.raises(GeometryError, match="positive definite"):
                sfm.adjust(network.with_given(held), truth)


@pytest.mark.parametrize("mixed", [[1.0, 0, 0], [0.6, 0.6, -0.6], [np.nan, 0, 0]])
def test_known_points_with_impossible_covariances_are_refused(mixed: list[float]) -> None:
    xyz, sigma = np.eye(3), np.ones((3, 3))
    with pytest.raises(KolinearError, match="control point b: "):
        sfm.KnownPoints(("a", "b", "c"), xyz, sigma, np.array([[0.0, 0, 0], mixed, [0, 0, 0]]))
    with pytest.raises(KolinearError, match="control point a: "):
        sfm.KnownPoints(("a", "b", "c"), xyz, -sigma)


def test_observations_of_ones_own_are_added_and_checked() -> None:
    network, truth = make_network(seed_of("own observations"), images=5, points=12)
    ends = np.array([0, 3, 5]), np.array([1, 4, 11])
    exact = truth.points[ends[1], 2:] - truth.points[ends[0], 2:]
    levelled = HeightDifferences(*ends, exact, np.full((3, 1), 1e-5))
    found = adjust(network.with_observations(levelled), truth)
    assert len(found.network.further) == 1 and found.expected_defect == 4
    solved = found.estimate.points
    np.testing.assert_allclose(solved[ends[1], 2:] - solved[ends[0], 2:], exact, atol=5e-5)
    wrong = (
        (replace(levelled, end=np.array([1, 4, 12])), "point 12, expected 0 to 11"),
        (replace(levelled, sigma=np.array([[1e-5], [0.0], [1e-5]])), "standard deviations above 0"),
        (replace(levelled, value=np.array([[np.nan], [0.0], [0.0]])), "finite values"),
        (network.scale_bars, "scale bars: not with_observations"),
    )
    for kind, message in wrong:
        with pytest.raises(GeometryError, match=message):
            network.with_observations(kind)


def test_a_point_with_one_ray_has_no_coordinates_in_a_result() -> None:
    """Its start value stayed among the results, with a standard deviation that is not known."""
    network, truth = make_network(seed_of("one ray"), images=5, points=15, visibility=1.0)
    seen = network.image_points
    kept = np.ones(len(seen), dtype=bool)
    kept[np.flatnonzero(seen.point == 3)[1:]] = False
    network = replace(network, image_points=seen.select(kept))
    found = adjust(network, truth)
    assert np.flatnonzero(~found.estimate.determined).tolist() == [3]
    assert found.undetermined == ("point 4: 1 ray, 2 are needed",)
    np.testing.assert_array_equal(found.estimate.points[:3], adjust(network, truth).estimate.points[:3])
    control = ObjectPoints(np.arange(4), truth.points[:4], np.tile(1e-8 * np.eye(3), (4, 1, 1)))
    known = adjust(network.with_given(control), truth, datum="control")  # known otherwise
    assert known.estimate.determined.all()


@pytest.mark.parametrize("shape", [(), (3,), (3, 6)])
def test_rows_are_summed_by_their_index(shape: tuple[int, ...]) -> None:
    rng = seed_of("sums")
    index, values = rng.integers(0, 7, 50), rng.standard_normal((50, *shape))
    expected = np.zeros((9, *shape))
    np.add.at(expected, index, values)
    np.testing.assert_array_equal(sum_rows(index, values, 9), expected)
    assert not sum_rows(index[:0], values[:0], 4).any()


def test_a_network_has_one_set_of_each_kind_of_given_values_before_all_others() -> None:
    network, truth = make_network(seed_of("check"), images=5, points=20)
    control = ObjectPoints(np.arange(3), truth.points[:3], np.zeros((3, 3, 3)))
    bars = ScaleBars(np.array([0]), np.array([1]), np.array([1.5]), np.array([1e-3]))
    levels = HeightDifferences(np.array([0]), np.array([1]), np.array([[0.1]]), np.array([[1e-3]]))
    mixed = replace(network, observations=(levels, bars, control))
    assert [kind.name for kind in mixed.observations] == [
        "control points",
        "scale bars",
        "height differences",
    ]
    assert mixed.control is control and mixed.scale_bars is bars and mixed.further == (levels,)
    without = mixed.with_given(ObjectPoints())
    assert not len(without.control) and without.scale_bars is bars and without.further == (levels,)
    assert mixed.with_given(control.select(np.arange(2)), further=()).observations[1:] == (bars,)
    for observations in ((control, control), (bars, levels, bars)):
        with pytest.raises(GeometryError, match="2 sets, expected one"):
            replace(network, observations=observations)
    with pytest.raises(GeometryError, match="height differences: not with_given, expected further"):
        network.with_given(levels)


def test_a_set_of_a_derived_kind_is_the_set_of_its_kind() -> None:
    class Surveyed(ObjectPoints):
        """Control with a name of its own."""

    network, truth = make_network(seed_of("check"), images=5, points=20)
    control = ObjectPoints(np.arange(3), truth.points[:3], np.zeros((3, 3, 3)))
    surveyed = Surveyed(np.arange(2), truth.points[:2], np.zeros((2, 3, 3)))
    assert network.with_given(control).with_given(surveyed).observations == (surveyed,)
