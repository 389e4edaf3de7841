"""Separate adjustment: the optimum of the simultaneous one, slowly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.errors import GeometryError
from sfm.network import ObjectPoints, ScaleBars
from sfm.textbook.direct import adjust_separately
from tests.synthetic import make_network, perturb, seed_of


@pytest.mark.parametrize("free", [(), ("c", "x0", "y0", "K1")])
@pytest.mark.parametrize("control", [False, True])
def test_rounds_end_at_the_simultaneous_optimum(free: tuple[str, ...], control: bool) -> None:
    rng = seed_of(f"separate {free} {control}")
    network, truth = make_network(rng, images=6, points=20, free=free)
    if control:
        network = replace(network, control=ObjectPoints(np.arange(8), truth.points[:8], np.zeros((8, 3, 3))))
    start = perturb(truth, rng, position=1e-3, angle_deg=0.1, points=1e-3)
    both = adjust(network, start, datum=Datum("control" if control else "free"), reject="none")
    turn = adjust_separately(network, start)
    assert turn.rounds > 5 * both.iterations
    assert turn.vPv == pytest.approx(both.vPv, rel=1e-6)
    if control:
        sigma = np.sqrt(np.diagonal(both.covariance.points, axis1=1, axis2=2))
        error = np.abs(turn.estimate.points - both.estimate.points)
        assert (error <= 0.1 * sigma + 1e-12).all()


def test_scale_bars_are_refused() -> None:
    network, truth = make_network(seed_of("bars"), images=4, points=10)
    bars = ScaleBars(np.array([0]), np.array([1]), np.array([1.0]), np.array([1e-3]))
    with pytest.raises(GeometryError, match="expected image points and fixed control only"):
        adjust_separately(replace(network, scale_bars=bars), truth)
