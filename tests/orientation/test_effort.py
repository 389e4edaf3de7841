"""What hopeless or hostile image points cost: trials, rounds and memory, counted rather than timed."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.datum import Datum, motions_of
from sfm.adjustment.engine.observed import observed_of
from sfm.adjustment.engine.unknowns import unknowns_of
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, ObjectPoints
from sfm.orientation.image_rays import fit_homography
from sfm.orientation.incremental import growth as growing
from sfm.orientation.incremental import starting_pair
from sfm.orientation.incremental.growth import Growth
from sfm.orientation.resection.ransac import fewest_fitting
from tests.synthetic import make_network, seed_of

MIB = 2**20


def _started(network: Network, truth: Estimate) -> Growth:
    return Growth(network, truth, 0, np.full(len(truth.cameras), 50.0), 4)


def test_pairs_that_fit_nothing_are_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = make_network(seed_of("barren"), images=14, points=10)
    start, trials = _started(network, truth), []

    def nothing(*_: Any, max_trials: int, **__: Any) -> Any:
        trials.append(max_trials)
        raise GeometryError("fits nothing")

    monkeypatch.setattr(starting_pair, "relative_orientations", nothing)
    with pytest.raises(GeometryError, match="no pair of photographs"):
        starting_pair.best_start(network, start.tangents(), start.tolerance())
    assert len(trials) == starting_pair.BARREN_PAIRS < starting_pair.MAX_PAIRS < 14 * 13 / 2
    assert set(trials) == {starting_pair.PAIR_TRIALS}


def test_one_pair_that_fits_lets_all_be_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = make_network(seed_of("one fits"), images=14, points=10)
    start, tried = _started(network, truth), 0

    def seldom(*args: Any, real: Any = starting_pair.relative_orientations, **options: Any) -> Any:
        nonlocal tried
        tried += 1
        if tried == starting_pair.BARREN_PAIRS:
            return real(*args, **options)
        raise GeometryError("fits nothing")

    monkeypatch.setattr(starting_pair, "relative_orientations", seldom)
    assert starting_pair.best_start(network, start.tangents(), start.tolerance()).kind == "spatial"
    assert tried == starting_pair.MAX_PAIRS


def test_a_pair_is_oriented_on_a_bounded_number_of_points(monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = make_network(seed_of("many"), images=2, points=3000)
    start, given = _started(network, truth), []

    def counted(first: Any, *_: Any, **__: Any) -> Any:
        given.append(len(first))
        raise GeometryError("fits nothing")

    monkeypatch.setattr(starting_pair, "relative_orientations", counted)
    with pytest.raises(GeometryError):
        starting_pair.best_start(network, start.tangents(), start.tolerance())
    assert given == [starting_pair.PAIR_POINTS]


def test_many_unsupported_photographs_are_let_go_in_few_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = make_network(seed_of("unsupported"), images=120, points=12)
    seen = network.image_points
    wrong = replace(seen, xy=seed_of("anywhere").uniform((0, 0), (1999, 1499), seen.xy.shape))
    growth = _started(replace(network, image_points=wrong), truth)
    growth.tolerance_px = np.array([1.0])
    rounds = 0

    def counted(*args: Any, real: Any = growing.photograph_support) -> Any:
        nonlocal rounds
        rounds += 1
        return real(*args)

    monkeypatch.setattr(growing, "photograph_support", counted)
    assert growth.drop_unsupported() == 120
    assert not growth.estimate.oriented.any() and len(growth.reasons) == 120
    assert rounds < 80


def test_the_fewest_fitting_of_a_million_points_are_found_by_halving(monkeypatch: pytest.MonkeyPatch) -> None:
    from sfm.orientation.resection import ransac

    asked = 0

    def counted(*args: Any, real: Any = ransac.bdtrc) -> Any:
        nonlocal asked
        asked += 1
        return real(*args)

    monkeypatch.setattr(ransac, "bdtrc", counted)
    assert fewest_fitting(1_000_000, 0.1, 1.0) == pytest.approx(34_000, rel=0.1)
    assert asked < 30
    for n in (5, 9, 30, 200):  # one by one, as it is defined
        found = fewest_fitting(n, 0.05, 1.0)
        tests = ransac.MAX_SOLUTIONS * ransac.comb(n, 3)
        chances = [tests * ransac.bdtrc(k - 4, n - 3, np.pi * 0.05**2) for k in range(4, n)]
        assert found == next((k for k, chance in zip(range(4, n), chances, strict=True) if chance <= 0.5), n)


def _peak_mib(work: Any) -> float:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1] / MIB
    finally:
        tracemalloc.stop()


def test_a_homography_takes_memory_in_proportion_to_its_points() -> None:
    uv = seed_of("homography").uniform(-0.4, 0.4, (2000, 2))
    assert _peak_mib(lambda: fit_homography(uv, uv, tolerance=0.01)) < 30  # 3 n squared would be 275 MiB


def test_control_takes_memory_in_proportion_to_its_points() -> None:
    network, truth = make_network(seed_of("control"), images=3, points=1500)
    n = len(network.points)
    control = ObjectPoints(np.arange(n), truth.points, np.tile(np.eye(3) * 1e-6, (n, 1, 1)))
    network = network.with_given(control)
    datum = Datum("control")
    layout, state = unknowns_of(network, truth, use_control=True)
    observed = observed_of(network, layout, state, use_control=True)
    resolved = datum.resolve(network)
    motions_of(layout, observed, state, resolved)
    peak = _peak_mib(lambda: motions_of(layout, observed, state, resolved))
    assert peak < 30  # 3 n squared would be 155 MiB
