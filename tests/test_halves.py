"""`benchmarks.halves`: differences of halves against what is predicted, over several draws."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import halves
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from tests.synthetic import make_network, observed_anew, seed_of


@pytest.fixture(scope="module")
def whole() -> Adjustment:
    """Return a network of independent errors of 0.1 px, as stated, and its adjustment."""
    network, truth = make_network(seed_of("halves"), images=6, points=120, planar=True, noise_px=0.0)
    noisy = observed_anew(network, truth, 0.1, seed_of("noise of halves"))
    return adjust(noisy, truth, reject="none", options=AdjustmentOptions(redundancy_numbers=False))


@pytest.mark.parametrize("way", halves.WAYS)
def test_draws_are_different_halves_of_all_points(whole: Adjustment, way: str) -> None:
    drawn = list(halves._halves(whole.estimate.points, whole.estimate.position, way, 5))
    assert len({half.tobytes() for half in drawn}) > 2
    assert all(0.3 < half.mean() < 0.7 for half in drawn)


def test_halves_of_independent_errors_differ_as_predicted(whole: Adjustment) -> None:
    points, found, predicted, ratio, sigma = halves._of_centres(whole, None, "random", 12)
    assert points == 120 and sigma < 0.15
    assert ratio == pytest.approx(1.0, abs=3 * sigma)
    assert found / predicted == pytest.approx(ratio, rel=0.1)


def test_the_same_halves_once_more_say_nothing_more(
    whole: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sigma of a ratio knows what draws have in common."""
    half = np.arange(len(whole.network.points)) % 2 == 0
    monkeypatch.setattr(halves, "_halves", lambda *_: iter([half, half, half, half]))
    often = halves._of_centres(whole, None, "random", 4)
    monkeypatch.setattr(halves, "_halves", lambda *_: iter([half]))
    assert often == pytest.approx(halves._of_centres(whole, None, "random", 1))
