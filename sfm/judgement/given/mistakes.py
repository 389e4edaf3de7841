"""Common mistakes in given values: each that a kind lists is corrected on trial, and names are assigned anew.

A list of coordinates shifted by one row, or with two names exchanged, is the same figure of points with other
names. Similar triangles in both figures give the similarity between them, and with it the assignment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import permutations
from math import lgamma
from typing import TypeVar

import numpy as np

from sfm.model.conventions import FloatArray, IntArray
from sfm.model.observations.kind import Kind
from sfm.model.similarity import Similarity, fit_similarities

MIN_POINTS = 4  # three points have a similar triangle by chance too easily: two degrees of freedom
MAX_POINTS = 40  # 59,280 ordered triangles; with more points, only the agreed similarity is used
TRIANGLES = 20  # with half of the points correct, 14 of 15 lists of triangles include a correct one
MAX_SIMILAR = 60  # similar triangles that are tried; a cube has 24, and 24 mirrored ones
MAX_ASSIGNMENTS = 8  # assignments that are judged: the likeliest and its rivals

T = TypeVar("T")
K = TypeVar("K", bound=Kind)


def explanations(
    kinds: Sequence[K], judge: Callable[[list[K]], T | None], corrected: Sequence[Mapping[str, K]] = ()
) -> dict[str, T]:
    """Return what observations are judged to be after the correction of each mistake that explains them.

    Args:
        kinds: observations with the same mistake.
        judge: judges corrected observations; None or False if the correction explains nothing.
        corrected: corrected observations of each kind by the name of the mistake; `Kind.mistakes` if empty.
    """
    corrected, explaining = corrected or [kind.mistakes() for kind in kinds], dict[str, T]()
    for mistake in dict.fromkeys(mistake for mistakes in corrected for mistake in mistakes):
        judged = judge([by.get(mistake, kind) for by, kind in zip(corrected, kinds, strict=True)])
        if judged:
            explaining[mistake] = judged
    return explaining


def assignments(
    free: FloatArray, given: FloatArray, variance: tuple[FloatArray, FloatArray], agreed: Similarity | None
) -> Iterator[tuple[int, ...]]:
    """Yield other assignments of given coordinates to points of the free network, likeliest first.

    The cost of an assignment is that of its distances, as errors of unknown size, plus that of its choice.

    Args:
        free: points of the free network, (n, 3).
        given: given coordinates, (n, 3); incomplete points keep their names.
        variance: variance of a coordinate of the free points in their frame, and of the given points, (n,)
            each.
        agreed: similarity on which more than half of the points agree with their names, if any. Three
            points may agree by chance, so other similarities are tried as well.
    """
    from scipy.optimize import linear_sum_assignment  # takes half a second; rarely needed
    from scipy.spatial.distance import cdist

    at = np.flatnonzero(np.isfinite(given).all(axis=1))
    if len(at) < MIN_POINTS:
        return
    X, Y = free[at], given[at]
    of_x, of_y = variance[0][at], variance[1][at]
    placings = [] if agreed is None else [agreed]
    if len(at) <= MAX_POINTS:
        placings += _placings(X, Y)
    if not placings:
        return
    placed = np.concatenate([placing.apply(X) for placing in placings])
    distance2 = cdist(placed, Y, "sqeuclidean").reshape(len(placings), len(X), len(Y))
    scale2 = np.array([placing.scale**2 for placing in placings])[:, None, None]
    expected = np.maximum(3 * (scale2 * of_x[:, None] + of_y), np.finfo(float).tiny)
    misfit = 3 * np.log(np.maximum(distance2 / expected, 1.0))
    costs: dict[tuple[int, ...], float] = {}
    for of_placing in misfit:
        other = linear_sum_assignment(of_placing)[1]
        order = np.arange(len(free))
        order[at] = at[other]
        key = tuple(order.tolist())
        cost = float(of_placing[np.arange(len(at)), other].sum()) + cost_of_choice(key)
        costs[key] = min(cost, costs.get(key, np.inf))
    costs.pop(tuple(range(len(free))), None)
    yield from sorted(costs, key=lambda order: costs[order])[:MAX_ASSIGNMENTS]


def cost_of_choice(order: tuple[int, ...]) -> float:
    """Return 2 ln of n! / (n - m)!, the number of ordered choices of m coordinates, if m names are moved.

    About one in e of these choices moves all m.

    Args:
        order: index of the point whose coordinates each point gets, (n,).
    """
    n, moved = len(order), len(find_renamed(order))
    return 2 * (lgamma(n + 1) - lgamma(n - moved + 1))


def find_renamed(order: tuple[int, ...]) -> tuple[int, ...]:
    """Return the points that get the coordinates of another point."""
    return tuple(k for k, other in enumerate(order) if other != k)


def _placings(X: FloatArray, Y: FloatArray) -> list[Similarity]:
    """Return similarities from triangles of X to similar triangles of Y, with corners in any order."""
    rng, n = np.random.default_rng(len(X)), len(X)
    of_y: IntArray = np.array(list(permutations(range(n), 3)))
    shape = _shape(Y[of_y])
    placings = []
    for _ in range(TRIANGLES):
        corners = rng.choice(n, 3, replace=False)
        apart = np.abs(shape - _shape(X[corners])).sum(axis=1)
        nearest = np.argpartition(apart, min(MAX_SIMILAR, len(apart)) - 1)[:MAX_SIMILAR]
        fitted = fit_similarities(np.broadcast_to(X[corners], (len(nearest), 3, 3)), Y[of_y[nearest]])
        placings += [similarity for similarity in fitted if similarity is not None]
    return placings


def _shape(corners: FloatArray) -> FloatArray:
    """Return the logarithms of two ratios of the sides of triangles, (..., 2)."""
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=-2), axis=-1)
    sides = np.log(np.maximum(sides, np.finfo(float).tiny))
    return np.asarray(sides[..., :2] - sides[..., 2:])
