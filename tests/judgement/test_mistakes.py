"""Mistakes in lists of coordinates: which names are tried, how many, and in which order."""

from __future__ import annotations

from itertools import product
from math import log

import numpy as np
import pytest

from sfm.judgement.given import mistakes
from sfm.judgement.given.mistakes import assignments, cost_of_choice, explanations, find_renamed
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.similarity import Similarity
from tests.synthetic import seed_of

FRAME = Similarity(2.5, rotation_from_vector(np.array([0.3, -0.2, 1.1])), np.array([5.0, -2.0, 1.0]))
CUBE = np.array(list(product((0.0, 1.0), repeat=3)))


def found(free: FloatArray, given: FloatArray, agreed: Similarity | None = None) -> list[tuple[int, ...]]:
    """Return the assignments of coordinates of 1 mm to points of a free network of 0.1 mm."""
    variance = np.full(len(free), 1e-8), np.full(len(free), 1e-6)
    return list(assignments(free, given, variance, agreed))


def test_of_a_cube_all_turned_and_mirrored_triangles_are_tried() -> None:
    """48 orders of its corners are congruent; of so many per triangle hardly more are fitted."""
    placings = mistakes._placings(CUBE, FRAME.apply(CUBE))
    exact = [
        one
        for one in placings
        if all(np.abs(FRAME.apply(CUBE) - p).max(axis=1).min() < 1e-9 for p in one.apply(CUBE))
    ]
    turned = {tuple(np.round(one.rotation, 6).ravel().tolist()) for one in exact}
    assert len(turned) == 24
    assert 20 * 48 <= len(placings) < 20 * 100


@pytest.mark.parametrize("n", [8, 30])
def test_half_of_the_points_right_place_the_others(n: int) -> None:
    """The chance that no list of triangles is of right points only is 1 in 15, and one was tried for each."""
    placed = 0
    for k in range(12 if n == 8 else 3):
        rng = seed_of(f"half right {n} {k}")
        X = rng.uniform(-1, 1, (n, 3))
        given = FRAME.apply(X)
        given[n // 2 :] = FRAME.apply(rng.uniform(-1, 1, (n - n // 2, 3)))
        right = [np.linalg.norm(one.apply(X) - given, axis=1) < 1e-6 for one in mistakes._placings(X, given)]
        placed += any(one.sum() >= n // 2 for one in right)
    assert placed >= (9 if n == 8 else 2)


def test_assignments_that_are_judged_are_few() -> None:
    """Of a cube 23 others are exact, and none is better than another; a pyramid needs four."""
    several = found(CUBE, FRAME.apply(CUBE))
    assert 4 < len(several) < 16 and len(set(several)) == len(several)
    assert tuple(range(8)) not in several
    for order in several:  # each is a turn of the cube
        np.testing.assert_allclose(
            np.linalg.norm(CUBE[list(order)][:, None] - CUBE[list(order)], axis=2),
            np.linalg.norm(CUBE[:, None] - CUBE, axis=2),
        )


@pytest.mark.parametrize(("apart", "exchanged"), [(4.6e-3, False), (5.4e-3, True)])
def test_names_are_exchanged_beyond_the_expected_distance(apart: float, exchanged: bool) -> None:
    """Three times the variance of a coordinate, 2.5^2 of the free network and that of the given point."""
    X = seed_of("expected distance").uniform(-1, 1, (50, 3))
    X[7] = X[3] + apart / 2.5 * np.array([0.6, 0.0, 0.8])
    order = np.arange(50)
    order[[3, 7]] = 7, 3
    variance = np.full(50, 1e-6), np.full(50, 2e-6)
    several = list(assignments(X, FRAME.apply(X)[order], variance, FRAME))
    assert several == ([tuple(order.tolist())] if exchanged else [])


def test_the_likelier_assignment_is_the_first() -> None:
    """An exchange of two costs less than one of all, if both place the points as well."""
    rng = seed_of("likelier")
    half = rng.uniform(-1, 1, (5, 3))
    half[:, 0] = np.abs(half[:, 0]) + 0.2
    X = np.concatenate([half, half * (-1, -1, 1)])  # turned by half a circle
    order = np.arange(10)
    order[[0, 1]] = 1, 0
    several = found(X, FRAME.apply(X)[order])
    assert several[0] == tuple(order.tolist())
    assert cost_of_choice(several[0]) < cost_of_choice(several[1])


def test_the_cost_of_a_choice_is_that_of_its_ordered_names() -> None:
    assert find_renamed((0, 2, 1, 3, 4)) == (1, 2)
    assert cost_of_choice((0, 2, 1, 3, 4)) == pytest.approx(2 * log(5 * 4))
    assert cost_of_choice((1, 2, 3, 4, 0)) == pytest.approx(2 * log(120))
    assert cost_of_choice((0, 1, 2)) == 0 and cost_of_choice(()) == 0


def test_incomplete_points_keep_their_names() -> None:
    X = seed_of("incomplete").uniform(-1, 1, (7, 3))
    given = FRAME.apply(X)[[1, 0, 2, 3, 4, 5, 6]]
    given[5, 2] = np.nan
    assert found(X, given)[0] == (1, 0, 2, 3, 4, 5, 6)
    given[3:5, 0] = np.nan  # four that remain
    assert found(X, given)[0] == (1, 0, 2, 3, 4, 5, 6)
    given[6, 0] = np.nan
    assert found(X, given) == []


def test_a_mistake_is_corrected_in_all_that_have_it() -> None:
    """Those of a kind that does not have it stay; what explains nothing is left out."""
    seen: list[list[str]] = []

    def judge(kinds: list[str]) -> str | None:
        seen.append(kinds)
        return "fits" if "a in feet" in kinds else None

    corrected = [{"unit": "a in feet", "sign": "a turned"}, {"sign": "b turned"}]
    assert explanations(["a", "b"], judge, corrected) == {"unit": "fits"}  # type: ignore[type-var]
    assert seen == [["a in feet", "b"], ["a turned", "b turned"]]
