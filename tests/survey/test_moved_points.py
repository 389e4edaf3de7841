"""Points that moved between photographs: named and left out, or seen in two parts of the photographs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sfm
from sfm.adjustment.quality.consistency import consistency_of
from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import project
from sfm.model.conventions import BoolArray, FloatArray, rotation_from_vector
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.remarks.remark import of_kind
from sfm.model.similarity import fit_similarity
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of

NOISE_PX = 0.05


def moved_from(network: Network, truth: Estimate, first: int, points: FloatArray) -> Network:
    """Return the network with the points at other places from a photograph on."""
    seen = network.image_points
    xy = seen.xy.copy()
    for i in range(first, len(network.images)):
        rows, camera = seen.image == i, truth.cameras[network.camera[i]]
        pose = truth.position[i], truth.rotation[i]
        before, after = (project(camera, *pose, X[seen.point[rows]]) for X in (truth.points, points))
        xy[rows] += after - before
    return replace(network, image_points=replace(seen, xy=xy))


def turned(X: FloatArray, part: BoolArray, by: float, rng: np.random.Generator) -> FloatArray:
    """Return points of which a part is turned about its middle, the farthest one by this distance."""
    axis, middle = rng.standard_normal(3), X[part].mean(axis=0)
    axis /= np.linalg.norm(axis)
    away = X[part] - middle
    angle = by / np.linalg.norm(np.cross(away, axis), axis=1).max()
    moved = X.copy()
    moved[part] = middle + away @ rotation_from_vector(axis * angle).T
    return moved


def observed_exactly(network: Network, truth: Estimate) -> ImagePoints:
    """Return the image points of a network without noise."""
    seen = network.image_points
    xy = seen.xy.copy()
    for i in range(len(network.images)):
        rows, camera = seen.image == i, truth.cameras[network.camera[i]]
        xy[rows] = project(camera, truth.position[i], truth.rotation[i], truth.points[seen.point[rows]])
    return replace(seen, xy=xy)


def run(network: Network, truth: Estimate, **settings: object) -> SurveyResult:
    return sfm.run_survey(survey_of(network, truth, **settings))


@pytest.mark.parametrize(
    ("images", "by", "level"), [(12, 0.7e-3, "fair"), (20, 0.7e-3, "fair"), (12, 0.0, "good")]
)
def test_half_of_the_points_turned_between_halves_of_the_photographs(
    images: int, by: float, level: str
) -> None:
    """By 0.7 mm of 1 m: the points settle between the two states, and no residual is large."""
    rng = seed_of(f"half turned {images}")
    network, truth = make_network(rng, images=images, points=60, noise_px=NOISE_PX)
    X = turned(truth.points, rng.random(60) < 0.5, by, rng)
    result = run(moved_from(network, truth, images // 2, X), truth)
    found = of_kind(result.verdict.remarks, "photographs_differ")
    bodies = of_kind(result.verdict.remarks, "points_moved")  # found where the rays show which points moved
    assert result.verdict.level == ("bad" if bodies else level)
    assert len(found) + len(bodies) == (by > 0)
    for one in found:
        assert one.names("next") == (network.images[images // 2],) and 1.2 < one.number("times") < 4
    (tested,) = of_kind(result.verdict.tests, "parts_tested")
    assert tested.number("parts") == min(images - 3, 15) and tested.number("different") == (by > 0)


@pytest.mark.parametrize(("start", "warned"), [(10, True), (5, True), (2, False)])
def test_photographs_that_differ_count_by_the_shift_of_the_result(start: int, warned: bool) -> None:
    """Of a change after 2 of 20 photographs little remains in the result, whose points are those after it."""
    rng = seed_of("half turned 20")
    network, truth = make_network(rng, images=20, points=60, noise_px=NOISE_PX)
    X = turned(truth.points, rng.random(60) < 0.5, 0.7e-3, rng)
    exact = replace(network, image_points=observed_exactly(network, truth))
    a, b = (sfm.adjust(moved_from(one, truth, start, X), truth, reject="none") for one in (network, exact))
    sigma = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
    places = b.estimate.points
    shift = min(
        float(np.abs((fit_similarity(places, state).apply(places) - state) / sigma).max())
        for state in (truth.points, X)
    )
    change = consistency_of(a).change
    assert change is not None and change.shift == pytest.approx(shift, rel=0.25)
    assert a.verdict is not None
    assert bool(of_kind(a.verdict.remarks, "photographs_differ")) == warned


@pytest.mark.parametrize(
    ("start", "count", "by", "level"),
    [
        (6, 3, 4e-4, "fair"),
        (6, 3, 0.0, "good"),
        (3, 15, 4e-4, "fair"),  # 30 % of the points, 8 % of the image points
        (9, 15, 4e-4, "fair"),
        (6, 15, 4e-4, "bad"),  # 15 % of the image points: a person decides
    ],
)
def test_points_that_moved_far_keep_one_state(start: int, count: int, by: float, level: str) -> None:
    rng = seed_of("three points moved")
    network, truth = make_network(rng, images=12, points=50, noise_px=NOISE_PX, free=("c",))
    X = truth.points.copy()
    X[:count] += by * np.array([1.0, -1.0, 0.5]) * rng.choice([-1.0, 1.0], (count, 3))
    result = run(moved_from(network, truth, start, X), truth, adjust={"reject": "tau"})
    a, names = result.adjustment, network.points
    moved = of_kind(result.verdict.remarks, "points_moved")
    assert result.verdict.level == level
    assert a.network.points == names
    named = {name for one in moved for name in one.names("points")}
    assert named <= set(names[:count]) and len(named) >= 0.7 * count * (by > 0)  # others are only rejected
    state = "after" if start < 6 else "before"
    kept = {one.names("state") for one in moved if one.number("wrong") == 0}
    assert kept <= {(state,), ()} and ((state,) in kept) == (level == "fair")
    assert (result.unused_image_points > 0) == (level == "fair")
    if level != "bad":
        true = X if start < 6 else truth.points
        error = fit_similarity(true, a.estimate.points).apply(true) - a.estimate.points
        sigma = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
        assert np.abs(error / sigma).max() < 5


def test_points_that_moved_twice_are_in_no_single_state() -> None:
    """Of one move they keep a state; the image points of the other move still contradict it."""
    rng = seed_of("twice moved")
    network, truth = make_network(rng, images=12, points=50, noise_px=NOISE_PX, free=("c",))
    X = truth.points.copy()
    X[:3] += 6e-4 * rng.choice([-1.0, 1.0], (3, 3))
    Y = X.copy()
    Y[:3] += 6e-4 * rng.choice([-1.0, 1.0], (3, 3))
    once = moved_from(network, truth, 4, X)
    seen = once.image_points
    xy = seen.xy.copy()
    for i in range(9, 12):
        rows, camera = seen.image == i, truth.cameras[network.camera[i]]
        from_xy, to_xy = (
            project(camera, truth.position[i], truth.rotation[i], places[seen.point[rows]])
            for places in (X, Y)
        )
        xy[rows] += to_xy - from_xy
    twice = run(replace(once, image_points=replace(seen, xy=xy)), truth, adjust={"reject": "tau"})
    a = twice.adjustment
    sigma = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
    kept = [network.points.index(name) for name in a.network.points]
    true = X[kept]  # of the middle of the sequence
    error = np.abs((fit_similarity(true[3:], a.estimate.points[3:]).apply(true) - a.estimate.points) / sigma)
    assert twice.verdict.level == "bad" or error.max() < 5
