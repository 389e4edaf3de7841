"""What rejected image points have in common: limits and counts, on a small network."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.consistency import intersect_rays
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement.hypotheses import rejections
from sfm.judgement.hypotheses.rejections import SecondPlace, explain_rejections
from sfm.model.camera import project
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.distributions import chi2_isf
from sfm.model.network import ImagePoints
from sfm.model.remarks.remark import Remark, kinds_of
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def clean() -> Adjustment:
    network, truth = make_network(seed_of("rejections"), images=8, points=14, free=())
    return adjust(network, truth, datum=Datum("free"), reject="none")


def at(a: Adjustment, row: int, X: FloatArray) -> FloatArray:
    """Return where the photograph of an image point shows a place."""
    i, estimate = int(a.network.image_points.image[row]), a.estimate
    camera = estimate.cameras[a.network.camera[i]]
    return np.asarray(project(camera, estimate.position[i], estimate.rotation[i], X[None])[0])


def row_of(a: Adjustment, point: int, image: int) -> int:
    seen = a.network.image_points
    return int(np.flatnonzero((seen.point == point) & (seen.image == image))[0])


def with_rejected(a: Adjustment, xy: dict[int, FloatArray]) -> Adjustment:
    """Return an adjustment in which some image points were measured elsewhere and rejected."""
    seen = a.network.image_points
    moved, residuals = seen.xy.copy(), a.residuals.copy()
    for row, one in xy.items():
        residuals[row] += moved[row] - one
        moved[row] = one
    rejected = np.isin(np.arange(len(seen)), list(xy))
    network = replace(a.network, image_points=replace(seen, xy=moved))
    return replace(a, network=network, rejected=rejected, residuals=residuals)


def test_nothing_is_explained_where_nothing_was_rejected_or_known(clean: Adjustment) -> None:
    assert explain_rejections(clean) == ()
    rows = [row_of(clean, 3, i) for i in (5, 6, 7)]
    X = clean.estimate.points[3] + (0.1, 0.0, 0.05)
    a = with_rejected(clean, {row: at(clean, row, X) for row in rows})
    assert kinds_of(explain_rejections(a)) == ("points_moved",)
    assert explain_rejections(replace(a, sigma0=0.0)) == ()
    assert explain_rejections(replace(a, undetermined=("X of point 3",))) == ()


def test_an_image_point_is_another_one_within_the_error_of_a_prediction(clean: Adjustment) -> None:
    tolerance = np.sqrt(2 * chi2_isf(0.01, 2)) * clean.sigma0_px
    rows = [row_of(clean, 3, i) for i in (1, 2, 3)]
    where = {}
    for row, factor in zip(rows, (0.8, 0.95, 1.1), strict=True):
        where[row] = at(clean, row, clean.estimate.points[9])
        where[row][1] += factor * tolerance
    a = with_rejected(clean, where)
    assert rejections._other_points(a) == dict.fromkeys(rows[:2], 9)


@pytest.mark.parametrize("model", ["brown", "opencv", "opencv_fisheye"])
def test_a_point_is_found_wherever_in_the_photograph_and_around_it(model: str) -> None:
    """Up to the tolerance in every direction, also at the corners, where lenses distort most."""
    network, truth = make_network(seed_of(model), images=6, points=80, free=(), model=model)
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    seen = a.network.image_points
    tolerance = np.sqrt(2 * chi2_isf(0.01, 2)) * a.sigma0_px
    first = np.flatnonzero(seen.image == 0)
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, 24, endpoint=False)):
        row, other = first[k % len(first)], seen.point[first[(k + 7) % len(first)]]
        xy = at(a, row, a.estimate.points[other])
        direction = np.array([np.cos(angle), np.sin(angle)])
        near, far = (
            rejections._other_points(with_rejected(a, {row: xy + factor * tolerance * direction}))
            for factor in (0.99, 1.01)
        )
        assert near == {row: other} and far != near


@pytest.mark.parametrize("chord", [1e-4, 0.02, 0.4, 2.0, np.nan, np.inf])
def test_points_in_a_direction_are_those_of_the_plain_way(chord: float) -> None:
    """Also of places among the points, and at one of them, and with points that are nowhere."""
    random = np.random.default_rng(seed_of("groups"))
    points = random.normal(scale=(50.0, 30.0, 2.0), size=(3000, 3))
    points[::97] = np.nan
    groups = rejections._Groups.of(points)
    found = 0
    for place in (*random.normal(scale=40.0, size=(20, 3)), points[5], np.array([0.0, 0.0, 900.0])):
        direction = points[random.integers(1, 97)] - place
        direction /= np.linalg.norm(direction)
        outward = points - place
        with np.errstate(invalid="ignore"):
            outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        plain = np.linalg.norm(outward - direction, axis=1) <= chord
        expected = np.flatnonzero(plain) if np.isfinite(chord) else np.arange(len(points))
        assert np.array_equal(groups.within(place, direction, chord), expected)
        found += len(expected)
    assert found > 0
    assert len(rejections._Groups.of(points[:0]).within(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.1)) == 0


def test_a_point_is_not_taken_for_itself(clean: Adjustment) -> None:
    row = row_of(clean, 3, 1)
    a = with_rejected(clean, {row: at(clean, row, clean.estimate.points[3])})
    assert rejections._other_points(a) == {}


def stub(point: list[int], image: list[int], rejected: list[bool] | None = None) -> Any:
    k = len(point)
    seen = ImagePoints(np.array(image), np.array(point), np.zeros((k, 2)), np.tile(np.eye(2), (k, 1, 1)))
    names = tuple("ABCDEFGH")
    network = SimpleNamespace(image_points=seen, images=names, points=tuple(f"p{j}" for j in range(9)))
    out: BoolArray = np.zeros(k, dtype=bool) if rejected is None else np.array(rejected)
    return SimpleNamespace(network=network, rejected=out)


def test_names_are_exchanged_in_two_photographs_at_least() -> None:
    """In both photographs each of the two points must lie where the other one is."""
    twice = stub([1, 2, 1, 2, 1], [0, 0, 4, 4, 3])
    found = {0: 2, 1: 1, 2: 2, 3: 1, 4: 2}
    assert rejections._exchanged(twice, found) == ({(1, 2): [0, 3, 4]}, [])
    del found[3]
    pairs, rest = rejections._exchanged(twice, found)
    assert pairs == {} and sorted(rest) == [0, 1, 2, 4]


def test_exchanged_names_are_reported_once_and_others_as_misnamed(clean: Adjustment) -> None:
    X = clean.estimate.points
    where = {}
    for i in (2, 5):
        where[row_of(clean, 3, i)] = at(clean, row_of(clean, 3, i), X[9])
        where[row_of(clean, 9, i)] = at(clean, row_of(clean, 9, i), X[3])
    for i in (0, 1, 4):  # where point 6 is
        where[row_of(clean, 12, i)] = at(clean, row_of(clean, 12, i), X[6])
    exchanged, misnamed = explain_rejections(with_rejected(clean, where))
    assert (exchanged.kind, misnamed.kind) == ("names_exchanged", "image_points_misnamed")
    assert (exchanged.names("first"), exchanged.names("second")) == (("4",), ("10",))
    assert exchanged.names("photographs") == ("image 3", "image 6")
    assert misnamed.number("count") == 3
    assert misnamed.names("photographs") == ("image 1", "image 2", "image 5")


def second_places(clean: Adjustment, images: tuple[int, ...], by: FloatArray) -> list[SecondPlace]:
    rows = [row_of(clean, 3, i) for i in images]
    X = clean.estimate.points[3] + by
    return rejections._second_places(with_rejected(clean, {row: at(clean, row, X) for row in rows}), set())


def test_a_second_place_is_where_three_rays_meet(clean: Adjustment) -> None:
    by = np.array([0.03, -0.02, 0.06])
    (one,) = second_places(clean, (6, 1, 3), by)
    assert one.point == 3 and one.images.tolist() == [1, 3, 6]
    assert one.distance == pytest.approx(0.07, rel=0.02)
    assert second_places(clean, (1, 3), by) == []
    assert second_places(clean, (1, 3, 4, 5, 6, 7), by)[0].images.tolist() == [1, 3, 4, 5, 6, 7]
    assert second_places(clean, (1, 2, 3, 4, 5, 6, 7), by) == []  # one ray has no place


def test_the_distance_is_judged_by_both_covariances_and_the_rays_rejected(clean: Adjustment) -> None:
    axis = np.array([0.6, 0.0, 0.8])
    rows = np.array([row_of(clean, 3, i) for i in (5, 6, 7)])
    kept = np.array([row_of(clean, 3, i) for i in (0, 1, 2, 3, 4)])
    a = with_rejected(clean, {row: at(clean, row, clean.estimate.points[3]) for row in rows.tolist()})
    (_, Q, _), (first, Q0, _) = intersect_rays(a, rows), intersect_rays(a, kept)
    limit = np.sqrt(chi2_isf(0.01 / 3, 3))
    unit = axis / np.sqrt(axis @ np.linalg.inv(Q + Q0) @ axis)
    shift = first - clean.estimate.points[3]
    assert second_places(clean, (5, 6, 7), shift + 0.93 * limit * unit) == []
    (one,) = second_places(clean, (5, 6, 7), shift + 1.07 * limit * unit)
    assert one.over_sigma == pytest.approx(1.07 * limit, rel=0.02)


def test_rays_that_do_not_meet_have_no_second_place(clean: Adjustment) -> None:
    rows = [row_of(clean, 3, i) for i in (1, 3, 6)]
    X = clean.estimate.points[3] + (0.03, -0.02, 0.06)

    def beside(px: float) -> Adjustment:
        where = {row: at(clean, row, X) for row in rows}
        where[rows[0]] += (px, 0.0)
        where[rows[1]] += (0.0, px)
        return with_rejected(clean, where)

    assert intersect_rays(beside(0.0), np.array(rows))[2] < 1e-3
    misfit = intersect_rays(beside(1.0), np.array(rows))[2]
    limit = np.sqrt(chi2_isf(0.01, 3) / misfit)  # 6 coordinates less 3
    assert len(rejections._second_places(beside(0.93 * limit), set())) == 1
    assert rejections._second_places(beside(1.07 * limit), set()) == []


def place(point: int, images: list[int], distance: float = 1.0, over: float = 9.0) -> SecondPlace:
    return SecondPlace(point, distance, over, np.array(images))


def remarks_of(places: list[SecondPlace], kept: dict[int, list[int]]) -> list[Remark]:
    point = [j for j, images in kept.items() for _ in images]
    image = [i for images in kept.values() for i in images]
    return rejections._of_places(stub(point, image), places, "mm")


def test_points_that_moved_at_one_place_of_the_sequence_are_one_remark() -> None:
    found = remarks_of(
        [
            place(1, [4, 5, 6], 2.0, 7.0),
            place(2, [5, 6], 3.0, 6.0),
            place(3, [4, 7]),
            place(4, [0, 1, 2], 4.0, 5.0),
        ],
        {1: [0, 1, 2], 2: [0, 3], 3: [0, 6], 4: [3, 4]},
    )
    assert [one.kind for one in found] == ["points_moved", "points_moved", "points_moved", "two_places"]
    assert [one.names("points") for one in found[:3]] == [("p4",), ("p1",), ("p2",)]
    assert [one.names("from") for one in found[:3]] == [("D",), ("E",), ("F",)]
    assert [one.number("distance") for one in found[:3]] == [4.0, 2.0, 3.0]
    assert [one.number("shift") for one in found[:3]] == [5.0, 7.0, 6.0]
    assert {one.severity for one in found} == {"warning"}  # the result does not depend on rejected ones
    alone = found[3]
    assert alone.names("point") == ("p3",) and alone.names("photographs") == ("E", "H")
    assert (alone.number("distance"), alone.number("sigmas")) == (1.0, 9.0)
    assert alone.numbers["distance"].unit == found[0].numbers["distance"].unit == "mm"


def test_points_that_moved_together_have_the_largest_distance() -> None:
    (one,) = remarks_of([place(1, [4, 5], 2.0, 7.0), place(2, [4, 6], 3.0, 6.0)], {1: [0, 3], 2: [1, 2]})
    assert one.names("points") == ("p1", "p2") and one.names("from") == ("E",)
    assert (one.number("distance"), one.number("shift")) == (3.0, 7.0)
