"""Networks: reducing keeps what belongs together."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from sfm.network import ExteriorObservations, ImagePoints, Network, ObjectPoints, ScaleBars
from sfm.reduced_network import reduce_network
from tests.synthetic import make_network, seed_of


def test_reduced_network_keeps_measurements_of_what_is_left() -> None:
    network, truth = make_network(seed_of("reduce"), images=6, points=20, visibility=0.7)
    network = replace(
        network,
        control=ObjectPoints(np.array([2, 5, 7]), truth.points[[2, 5, 7]], np.zeros((3, 3, 3))),
        scale_bars=ScaleBars(np.array([1, 2]), np.array([3, 9]), np.array([1.0, 2.0]), np.array([0.1, 0.2])),
        exterior=ExteriorObservations(
            np.array([0, 4]), truth.position[[0, 4]], np.zeros((2, 3)), np.tile(np.eye(6), (2, 1, 1))
        ),
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
        monkeypatch.setattr("sfm.network.MAX_PAIRS_AT_ONCE", most)
        found = list(network.common_points(usable))
        assert len(found) >= parts
        joined = [np.concatenate(part).tolist() for part in zip(*found, strict=True)]
        assert list(zip(*joined, strict=True)) == true


def test_photographs_that_all_see_the_same_points_are_paired_in_bounded_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """2,000 photographs of 10 points: 2 million pairs, of which 200,000 are counted at a time."""
    monkeypatch.setattr("sfm.network.MAX_PAIRS_AT_ONCE", 200_000)
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
