"""Limits of the search for other solutions: each test fails where one of them is twice or half as large."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.quality import other_solutions as searched
from sfm.camera import camera_from_values


def stub(images: int = 8, share: float = 0.0, **parts: object) -> Any:
    """Return as much of an adjustment as the limits are asked of: c is known to a share of it."""
    camera = camera_from_values("A", "brown", (2000, 1500), (0.005, 0.005), c_mm=20.0, free=("c",))
    network = SimpleNamespace(images=("",) * images, camera=np.zeros(images, dtype=int), points=(1, 2, 3))
    estimate = SimpleNamespace(cameras=(camera,), points=np.eye(3))
    known = SimpleNamespace(points=np.tile(np.eye(3), (3, 1, 1)))
    return SimpleNamespace(
        network=network,
        estimate=estimate,
        covariance=known,
        interior_sigma=lambda _: np.array([20.0 * share]),
        **parts,
    )


@pytest.mark.parametrize(
    ("images", "share", "weak"), [(4, 0.0, True), (6, 0.0, False), (6, 4e-4, False), (6, 7e-4, True)]
)
def test_few_photographs_or_an_unsure_c_make_a_network_weak(images: int, share: float, weak: bool) -> None:
    assert searched._weak(stub(images, share)) == weak


@pytest.mark.parametrize(("count", "asked"), [(3000, True), (5000, False)])
def test_networks_of_many_image_points_are_not_searched(
    count: int, asked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    a, weak = stub(converged=True, redundancy=10), []
    a.network.image_points = range(count)
    monkeypatch.setattr(searched, "_weak", lambda _: weak.append(True))
    assert searched.other_solutions(a) == () and bool(weak) == asked


@pytest.mark.parametrize(("redundancy", "vPv", "allowed"), [(1, 0.01, 17.92), (90, 90.0, 11.50)])
def test_stated_weights_count_as_ten_observations(redundancy: int, vPv: float, allowed: float) -> None:
    """F of 1 and 11, and of 1 and 100, degrees of freedom at 0.001 is 19.69 and 11.50 (tables)."""
    found = searched._allowed(stub(redundancy=redundancy, vPv=vPv))
    assert found == pytest.approx(allowed, rel=1e-3)


@pytest.mark.parametrize(("sigmas", "other"), [(0.7, False), (1.5, True)])
def test_solutions_are_others_from_one_standard_deviation_on(
    sigmas: float, other: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    a = stub(redundancy=20, vPv=20.0)
    monkeypatch.setattr(searched, "_apart", lambda *_: sigmas)
    assert bool(searched.solution_before(a, a, ())) == other


@pytest.mark.parametrize(("height", "length"), [(2500.0, 3), (3500.0, 2)])
def test_a_barrier_of_three_thousand_ends_the_search(
    height: float, length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    heights = iter([1.0, height, 1e6, 1e6])
    monkeypatch.setattr(searched, "scaled", lambda estimate, _: estimate)
    search: Any = SimpleNamespace(
        adjusted=lambda start, held: SimpleNamespace(estimate=start, vPv=next(heights))
    )
    assert len(searched._Search._along(search, stub().estimate, 1.3, 6, 1.0)) == length


def test_c_is_followed_from_a_fifth_to_the_fivefold() -> None:
    assert 4 < searched.STEP**searched.STEPS < 6
    assert searched.STEPS == 6 and searched.MAX_ITERATIONS == 60 and searched.NEAR == 1e-3


def test_the_principal_distance_of_other_solutions_is_of_the_first_free_camera() -> None:
    free = stub().estimate.cameras[0]
    held = replace(free, name="B", free=np.zeros_like(free.free))
    assert searched._principal_distance((held, free)) == ("A", 20.0, "mm")
    assert searched._principal_distance((held,)) == ("B", 20.0, "mm")
