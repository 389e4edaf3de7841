"""The pair of photographs that a network starts from, and which of its solutions is the true one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.conventions import FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.network import Network, rows_of
from sfm.orientation.homography import PLANAR_POINTS
from sfm.orientation.intersection import intersect
from sfm.orientation.relative import RelativeOrientation, model_points, relative_orientations
from sfm.orientation.resection.ransac import resect_robust

MAX_PAIRS = 60  # pairs whose solutions are tried on the other photographs
MIN_MEDIAN_ANGLE_DEG = 5.0  # median ray angle of a pair that is worth starting from
SCREEN_TRIALS = 200  # triples per photograph while solutions are compared
SCREEN_POINTS = 30  # points per photograph, and photographs per solution, that take part in it
SCREEN_PHOTOGRAPHS = 40


@dataclass(frozen=True)
class Start:
    """First photographs and points of a network, NaN for all others."""

    pair: tuple[int, int] | None  # photographs it started from
    kind: str  # spatial | planar | control | given
    position: FloatArray  # (m, 3)
    rotation: FloatArray  # (m, 3, 3)
    points: FloatArray  # (n, 3)


def best_start(network: Network, tangents: FloatArray, tolerance: FloatArray, *, seed: int = 0) -> Start:
    """Return the pair solution on which most image points of all other photographs can be resected.

    Args:
        network: measured facts.
        tangents: of all image points, shape (k, 2).
        tolerance: largest residual in each photograph, tangents, shape (m,).
        seed: of the random samples.

    Raises:
        GeometryError: no two photographs have four points in common, or none of their geometries holds.

    Source: the two solutions of a plane (Ma et al. 2004, sec. 5.3.3) cannot be told apart in a pair; in
    a third photograph the false plane does not fit. All solutions of all promising pairs are tried and
    compared by the truncated squares over the photographs that share most points with them.
    """
    own = _sorted_rows(network, tangents)
    pairs = _promising_pairs(network, own)
    if not pairs:
        raise GeometryError(
            f"orientation: no two of the {len(network.images)} photographs have {PLANAR_POINTS} points in "
            "common"
        )
    best: tuple[float, Start] | None = None
    for i, j in pairs:
        points, first, second = _common(network, tangents, own[i], own[j])
        limit = float(max(tolerance[i], tolerance[j]))
        try:
            solutions = relative_orientations(first, second, tolerance=limit, seed=seed)
        except GeometryError:
            continue
        for solution in solutions:
            if solution.kind == "infinite":
                continue
            candidate = _model(network, (i, j), points, first, second, solution)
            if candidate is None:
                continue
            score = _support(network, tangents, tolerance, own, candidate, seed)
            if best is None or score > best[0]:
                best = (score, candidate)
    if best is None:
        raise GeometryError("orientation: no pair of photographs has a base, or rays that intersect well")
    return best[1]


def _sorted_rows(network: Network, tangents: FloatArray) -> list[IntArray]:
    """Rows of the usable image points of each photograph."""
    seen = network.image_points
    usable = np.flatnonzero(np.isfinite(tangents).all(axis=1))
    return [usable[rows] for rows in rows_of(seen.image[usable], len(network.images))]


def _promising_pairs(network: Network, own: list[IntArray]) -> list[tuple[int, int]]:
    """Pairs with at least four common points, those with most first, spread over the photographs."""
    m = len(own)
    usable = np.zeros(len(network.image_points), dtype=bool)
    usable[np.concatenate(own)] = True
    first, second, count = network.common_points(usable)
    enough = count >= PLANAR_POINTS
    first, second, count = first[enough], second[enough], count[enough]
    # equal counts in the order of j - i, so that a cut takes pairs from all over the survey
    order = np.lexsort((second, first, (second - first) % max(2, m // 3), -count))
    if len(order) > MAX_PAIRS:
        sure = int((count > count[order[MAX_PAIRS - 1]]).sum())
        tied = int((count == count[order[MAX_PAIRS - 1]]).sum())
        step = tied / (MAX_PAIRS - sure)
        order = order[[*range(sure), *(sure + int(k * step) for k in range(MAX_PAIRS - sure))]]
    return list(zip(first[order].tolist(), second[order].tolist(), strict=True))


def _common(
    network: Network, tangents: FloatArray, a: IntArray, b: IntArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Points that two photographs have in common, and their tangents in both."""
    seen = network.image_points
    points, rows_a, rows_b = np.intersect1d(seen.point[a], seen.point[b], return_indices=True)
    return points, tangents[a[rows_a]], tangents[b[rows_b]]


def _model(
    network: Network,
    pair: tuple[int, int],
    points: IntArray,
    first: FloatArray,
    second: FloatArray,
    solution: RelativeOrientation,
) -> Start | None:
    """Pair and its model points as a start; None if too few rays intersect, or at too small angles."""
    xyz = model_points(first, second, solution)
    usable = np.isfinite(xyz).all(axis=1)
    if usable.sum() < PLANAR_POINTS:
        return None
    to_first, to_second = xyz[usable], xyz[usable] - solution.base
    cosine = np.sum(to_first * to_second, axis=1) / (
        np.linalg.norm(to_first, axis=1) * np.linalg.norm(to_second, axis=1)
    )
    if np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < MIN_MEDIAN_ANGLE_DEG:
        return None
    m, n = len(network.images), len(network.points)
    position, rotation, model = np.full((m, 3), np.nan), np.full((m, 3, 3), np.nan), np.full((n, 3), np.nan)
    position[pair[0]], rotation[pair[0]] = 0.0, np.eye(3)
    position[pair[1]], rotation[pair[1]] = solution.base, solution.rotation
    model[points] = xyz
    return Start(pair, solution.kind, position, rotation, model)


def _support(
    network: Network,
    tangents: FloatArray,
    tolerance: FloatArray,
    own: list[IntArray],
    start: Start,
    seed: int,
) -> float:
    """Number of image points that fit a start, each counted 1 - squared residual in tolerances.

    The photographs that share most points with the model are resected on it, then the points are
    intersected again from all of them, which tells a true plane from a bent one.
    """
    seen = network.image_points
    determined = np.asarray(np.isfinite(start.points).all(axis=1))
    rows = [one[determined[seen.point[one]]][:SCREEN_POINTS] for one in own]
    sharing = sorted(range(len(own)), key=lambda i: (-len(rows[i]), i))
    position, rotation = start.position.copy(), start.rotation.copy()
    for i in [i for i in sharing if i not in (start.pair or ())][:SCREEN_PHOTOGRAPHS]:
        result = resect_robust(
            tangents[rows[i]],
            start.points[seen.point[rows[i]]],
            tolerance=tolerance[i],
            seed=seed,
            max_trials=SCREEN_TRIALS,
        )
        if result.found:
            position[i], rotation[i] = result.position, result.rotation
    some = np.concatenate(rows)
    oriented = np.asarray(np.isfinite(position).all(axis=1))
    some = some[oriented[seen.image[some]]]
    again = intersect(
        tangents[some],
        seen.image[some],
        seen.point[some],
        position,
        rotation,
        n_points=len(network.points),
        tolerance=float(tolerance.max()),
    )
    squares = np.sum(again.residuals**2, axis=1) / tolerance[seen.image[some]] ** 2
    return float(np.sum(1 - np.minimum(squares[np.isfinite(squares)], 1.0)))
