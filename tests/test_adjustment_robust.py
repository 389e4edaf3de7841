"""Gross errors: found, good observations kept, false alarms as often as alpha says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import make_network, seed_of

from sfm.adjustment.datum import Datum
from sfm.adjustment.reliability import tau_critical
from sfm.adjustment.solve import adjust
from sfm.conventions import BoolArray
from sfm.network import Estimate, Network

FREE = Datum("free")


def spoiled(rng: np.random.Generator, part: float, sigmas: float) -> tuple[Network, Estimate, BoolArray]:
    """A network with gross errors of a given size in random directions in part of its image points."""
    network, truth = make_network(rng, images=10, points=40, noise_px=0.1)
    k = network.image_points
    bad = rng.random(len(k)) < part
    angle = rng.uniform(0, 2 * np.pi, len(k))
    error = 0.1 * sigmas * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return replace(network, image_points=replace(k, xy=k.xy + error * bad[:, None])), truth, bad


@pytest.mark.parametrize("sigmas", [10.0, 200.0])
def test_data_snooping_finds_gross_errors_and_keeps_the_rest(sigmas: float) -> None:
    network, truth, bad = spoiled(seed_of(f"snoop {sigmas}"), 0.05, sigmas)
    a = adjust(network, truth, datum=FREE)
    assert a.converged
    assert np.nanmean(a.redundancy_numbers) > 0.6
    assert (a.rejected & bad).sum() >= 0.99 * bad.sum()
    # 2 coordinates tested at 0.001, known good ones: binomial mean 0.8, so 5 would be a chance of 1e-3
    assert (a.rejected & ~bad).sum() <= 5
    assert a.sigma0 == pytest.approx(1, abs=4 / np.sqrt(2 * a.redundancy))


def test_a_good_network_keeps_nearly_all() -> None:
    network, truth, _ = spoiled(seed_of("good"), 0.0, 0.0)
    a = adjust(network, truth, datum=FREE, alpha=0.01)
    expected = 2 * 0.01 * len(network.image_points)
    assert abs(a.rejected.sum() - expected) < 4 * np.sqrt(expected) + 2


def test_huber_limits_the_harm_of_gross_errors() -> None:
    network, truth, bad = spoiled(seed_of("huber"), 0.05, 100.0)
    plain = adjust(network, truth, datum=FREE, reject="none")
    robust = adjust(network, truth, datum=FREE, reject="huber")
    good = ~bad
    assert (plain.residuals[good] ** 2).mean() > 4 * (robust.residuals[good] ** 2).mean()


def test_tau_is_bounded_by_the_root_of_the_redundancy() -> None:
    assert tau_critical(0.001, 10_000) == pytest.approx(3.2905, abs=2e-3)  # normal for large redundancy
    assert tau_critical(1e-12, 5) < np.sqrt(5)
    assert tau_critical(0.05, 1) == np.inf


def test_a_point_behind_its_camera_at_the_start_comes_back() -> None:
    network, truth = make_network(seed_of("behind"), images=8, points=25)
    points = truth.points.copy()
    points[7] = truth.position[2] * 1.05
    a = adjust(network, replace(truth, points=points), datum=FREE, reject="none")
    reference = adjust(network, truth, datum=FREE, reject="none")
    assert a.converged
    assert not a.rejected.any()
    assert a.sigma0 == pytest.approx(reference.sigma0, rel=1e-9)
