"""Limits of the search for other solutions: each test fails where one of them is twice or half as large."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality import other_solutions as searched
from sfm.adjustment.solve import adjust
from sfm.model.camera import camera_from_values
from sfm.model.distortion.models import MODELS as CAMERA_MODELS
from tests.synthetic import make_network, seed_of


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
    found = searched._allowed(stub(redundancy=redundancy, vPv=vPv), 0.001)
    assert found == pytest.approx(allowed, rel=1e-3)


@pytest.mark.parametrize(("sigmas", "other"), [(0.7, False), (1.5, True)])
def test_solutions_are_others_from_one_standard_deviation_on(
    sigmas: float, other: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, truth = make_network(seed_of("apart"), images=3, points=20, free=("c",))
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    other_place = searched._Candidate(a.estimate, a.vPv)
    monkeypatch.setattr(searched._Search, "candidates", lambda *_, **__: [other_place])
    monkeypatch.setattr(searched._Place, "distance", lambda *_: sigmas)
    assert bool(searched.other_solutions(a)) == other


def test_uncertain_points_place_a_solution_as_little_as_they_count() -> None:
    rng = seed_of("apart by weights")
    points, sigma = rng.normal(size=(12, 3)), np.full(12, 1e-3)
    sigma[0] = 10.0
    other = points.copy()
    other[0] += 5.0
    first, second = (SimpleNamespace(points=xyz) for xyz in (points, other))
    of_result: Any = None
    apart = searched._Place(of_result, sigma).distance(first, second)
    assert apart == pytest.approx(0.5 * np.sqrt(3 / 36), rel=0.01)


def camera_at(model: str, x: float, y: float, *, free: bool = True) -> Any:
    """Return the estimate of a camera of 2000 x 1500 pixels with its principal point there, px."""
    names = CAMERA_MODELS[model].names
    place = (x - 1000, 750 - y) if model == "brown" else (x - 0.5, y - 0.5)
    camera = camera_from_values(
        *("A", model, (2000, 1500), (1.0, 1.0)),
        c_mm=3000.0,
        free=names[1:3] if free and model == "brown" else names[:4] if free else (),
        values=tuple(zip(("x0", "y0") if model == "brown" else ("cx", "cy"), place, strict=True)),
    )
    assert camera.principal_point_px == pytest.approx([x, y])
    return SimpleNamespace(cameras=(camera,))


@pytest.mark.parametrize("model", ["brown", "opencv"])
def test_a_principal_point_beyond_the_photograph_is_no_other_solution(model: str) -> None:
    centre, cropped = camera_at(model, 1000.0, 750.0), camera_at(model, -300.0, 750.0)
    for x, y in ((-10.0, 750.0), (2010.0, 750.0), (1000.0, -10.0), (1000.0, 1510.0)):
        assert searched._impossible(camera_at(model, x, y), centre)
        assert not searched._impossible(camera_at(model, x, y), cropped)  # so are all of it
        assert not searched._impossible(camera_at(model, x, y, free=False), centre)  # given
    for x, y in ((10.0, 1490.0), (1990.0, 10.0)):
        assert not searched._impossible(camera_at(model, x, y), centre)


@pytest.mark.parametrize(("height", "length"), [(2500.0, 3), (3500.0, 2)])
def test_a_barrier_of_three_thousand_ends_the_search(
    height: float, length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    heights = iter([1.0, height, 1e6, 1e6])
    monkeypatch.setattr(searched, "scale_estimate", lambda estimate, _: estimate)
    search: Any = SimpleNamespace(
        adjusted=lambda start, held: SimpleNamespace(estimate=start, vPv=next(heights))
    )
    start = stub().estimate
    first = search.adjusted(start, held=True)
    assert len(searched._Search._along(search, start, first, 1.3, 6, 1.0)) == length


def test_c_is_followed_from_a_fifth_to_the_fivefold() -> None:
    assert 4 < searched.STEP**searched.STEPS < 6
    assert searched.STEPS == 6 and searched.MAX_ITERATIONS == 60 and searched.FOLLOWING_TOLERANCE == 1e-3


def test_each_c_is_tried_from_the_one_before_and_from_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """The valley that is followed is at 3 and 5; from the start another one is found, at 2."""
    heights = iter([1.0, 3.0, 5.0, 2.0, 7.0, 8.0])
    start = stub().estimate

    def scaled(one: Any, factor: float) -> Any:
        camera = one.cameras[0]
        return SimpleNamespace(cameras=(camera.with_parameters(camera.parameters * factor),))

    monkeypatch.setattr(searched, "scale_estimate", scaled)
    search: Any = SimpleNamespace(adjusted=lambda one, held: searched._Candidate(one, next(heights)))
    track = searched._Search._along(search, start, search.adjusted(start, held=True), 2.0, 3, 1.0)
    assert [one.vPv for one in track] == [1.0, 3.0, 2.0, 7.0]
    assert [one.estimate.cameras[0].parameters[0] for one in track] == [20.0, 40.0, 80.0, 160.0]


def test_other_solutions_are_described_by_the_first_camera_whose_c_is_free() -> None:
    free = stub().estimate.cameras[0]
    held = replace(free, name="B", free=np.zeros_like(free.free))
    for cameras, name in (((held, free), "A"), ((held,), "B")):
        a = stub(share=0.1)
        a.estimate.cameras = cameras
        scaled = tuple(one.with_parameters(one.parameters * 1.5) for one in cameras)
        other: Any = SimpleNamespace(cameras=scaled, points=np.eye(3))
        found = searched._Place(a, np.ones(3)).describe(other, 1.0)
        assert (found.camera, found.c, found.unit) == (name, pytest.approx(30.0), "mm")
        assert found.c_moved == pytest.approx(5.0) and not found.reflected


@pytest.mark.parametrize(("heights", "adjusted"), [([1.0, 9.0, 5.0, 9.0], [5.0]), ([1.0, 9.0, 12.0], [])])
def test_minima_along_c_are_adjusted_and_the_start_is_not(
    heights: list[float], adjusted: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The start is the result, whose minimum is known; a minimum farther along is adjusted with c free."""
    start, again = stub().estimate, []
    monkeypatch.setattr(searched, "_with_free", lambda estimate, _: estimate)

    def along(one: Any, first: Any, factor: float, steps: int, vPv: float) -> list[Any]:
        return [searched._Candidate(one if k == 0 else stub().estimate, h) for k, h in enumerate(heights)]

    def adjust_freely(one: Any, *, held: bool = False) -> Any:
        if not held:
            again.append(one)
        return SimpleNamespace(converged=True, estimate=one, vPv=2.0)

    search: Any = SimpleNamespace(_along=along, adjusted=adjust_freely, datum=SimpleNamespace(kind="control"))
    found = list(searched._Search.candidates(search, start, (), 1.0, 1.5, follow_c=True))
    assert len(again) == 2 * len(adjusted)  # with c larger, and smaller
    assert sorted(one.vPv for one in found) == 2 * [1.0] + 2 * [2.0] * len(adjusted)


def test_no_start_is_adjusted_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search leaves each start in two directions."""
    network, truth = make_network(seed_of("weak"), images=4, points=30)
    a = adjust(network, truth, datum=Datum("free"), reject="tau")
    starts: list[tuple[bytes, ...]] = []

    def counted(self: Any, start: Any, *, real: Any = searched._Search.adjusted, **options: Any) -> Any:
        cameras = tuple(camera.parameters.tobytes() for camera in start.cameras)
        starts.append((*cameras, start.position.tobytes(), start.points.tobytes(), str(options).encode()))
        return real(self, start, **options)

    monkeypatch.setattr(searched._Search, "adjusted", counted)
    searched.other_solutions(a)
    assert len(starts) == len(set(starts)) > searched.STEPS
