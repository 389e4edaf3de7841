"""Starting pair: the pair of photographs from which a network grows, with the correct one of its solutions.

Pairs with many common points are oriented relatively. Each of their solutions becomes a model. The other
photographs are resected on it, and the model that fits most image points is the start. If there is no third
photograph to distinguish the two solutions of a plane, other knowledge decides.

Rays that intersect at wide angles withstand unknown distortion. Photographs along the optical axis have few
of them. There, false planes that fit within the wide tolerance have wide angles. If the rays of the best pair
favour another solution, pairs with angles that are large for the precision of their rays are tried too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from sfm.model.conventions import FloatArray, IntArray
from sfm.model.display import counted, listed
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, rows_of
from sfm.model.similarity import fit_similarity
from sfm.orientation.image_rays import PLANAR_POINTS, image_tangents
from sfm.orientation.intersection import RayLimits, intersect
from sfm.orientation.relative import RelativeOrientation, model_points, relative_orientations
from sfm.orientation.resection.ransac import resect_robust
from sfm.runtime.progress import report_step

MAX_TIED = 1_000_000  # largest number of pairs with equal counts of common points to select from
MAX_PAIRS = 60  # pairs with solutions that are tried on the other photographs
BARREN_PAIRS = 20  # unsuccessful pairs, with most points fitting no orientation, after which the search ends
PAIR_TRIALS = 500  # samples of five points in a pair; if 45 % of its points fit, it succeeds with 99.99 %
AS_A_PLANE = 0.1  # tangents; largest displacement of points from a plane by the relief of a flat object
PAIR_POINTS = 1000  # common points of a pair that take part in its orientation
MIN_MEDIAN_ANGLE_DEG = 5.0  # smallest median ray angle of a useful starting pair
MIN_ANGLE_OF_TWO_DEG = 3.0  # the same in a survey of two photographs, which has no other pair
MIN_PARALLAX = 10.0  # median ray angle in standard deviations; below it a depth is known to a tenth at best
TWOFOLD = 2.0  # ratio of two misfits above which the smaller one is correct
SCREEN_TRIALS = 200  # triples per photograph in the comparison of solutions
SCREEN_POINTS = 30  # points per photograph in the comparison
SCREEN_PHOTOGRAPHS = 40  # photographs per solution in the comparison


@dataclass(frozen=True)
class Start:
    """First photographs and points of a network, NaN for all others."""

    pair: tuple[int, int] | None  # starting pair
    kind: str  # spatial | planar | control | given
    position: FloatArray  # (m, 3)
    rotation: FloatArray  # (m, 3, 3)
    points: FloatArray  # (n, 3)
    twofold: bool = False  # ambiguous: points in a plane, another start fits as well, no third photograph


Judge = Callable[[Start], float]


@dataclass(frozen=True)
class _Model:
    """One solution of one pair, with the points that it determines."""

    pair: tuple[int, int]
    solution: RelativeOrientation
    favoured: bool  # whether it has the kind that the conjugate rays favour
    points: IntArray  # common points of the pair, (k,)
    xyz: FloatArray  # in the frame of the first photograph, NaN where they do not fit, (k, 3)
    angle: float  # median angle of the rays, rad

    @property
    def shows_depths(self) -> bool:
        """Whether the rays favour it and intersect at large angles for the precision that they show."""
        return self.favoured and self.angle >= MIN_PARALLAX * self.solution.rms

    def start(self, network: Network) -> Start:
        """Return the model as the start of a network."""
        m, n, (i, j) = len(network.images), len(network.points), self.pair
        position, rotation, xyz = np.full((m, 3), np.nan), np.full((m, 3, 3), np.nan), np.full((n, 3), np.nan)
        position[i], rotation[i] = 0.0, np.eye(3)
        position[j], rotation[j] = self.solution.base, self.solution.rotation
        xyz[self.points] = self.xyz
        return Start(self.pair, self.solution.kind, position, rotation, xyz)


@dataclass(frozen=True)
class _Candidate:
    """One solution of one pair."""

    start: Start
    score: float  # see _support
    resected: int  # photographs other than the pair that fit it
    favoured: bool  # whether it has the kind that the conjugate rays favour


def best_start(
    network: Network,
    tangents: FloatArray,
    tolerance: FloatArray,
    *,
    seed: int = 0,
    judge: Judge | None = None,
) -> Start:
    """Return the pair solution on which most image points of all other photographs can be resected.

    Args:
        network: the measurements.
        tangents: tangents of all image points, shape (k, 2).
        tolerance: largest residual in each photograph, tangents, shape (m,).
        seed: seed of the random samples.
        judge: misfit of a start with other knowledge, used if no third photograph decides between the two
            solutions of a plane; the clearly smaller misfit (TWOFOLD) decides.

    Raises:
        GeometryError: no two photographs have four points in common, or no geometry fits them.

    Source: the two solutions of a plane (Ma et al. 2004, sec. 5.3.3) cannot be distinguished in a pair, but
    the false plane does not fit a third photograph. All solutions of all promising pairs are compared by
    their truncated squares over the photographs that share most points with them.
    """
    of_photograph = _sorted_rows(network, tangents)
    pairs = _promising_pairs(network, of_photograph)
    if not pairs:
        raise GeometryError(
            f"orientation: no two of the {len(network.images)} photographs have {PLANAR_POINTS} points in "
            f"common: {_list_common(network, of_photograph)}"
        )
    m = len(network.images)
    least_angle = np.radians(MIN_MEDIAN_ANGLE_DEG if m > 2 else MIN_ANGLE_OF_TWO_DEG)
    of_pairs = _models_of_pairs(network, tangents, tolerance, of_photograph, pairs, seed)

    def best_candidates(candidates: list[_Candidate], of_pairs: list[list[_Model]]) -> list[_Candidate]:
        """Return the candidates of the pair with the best score, among those before and those of pairs."""
        for models in of_pairs:
            of_pair = []
            for model in models:
                start = model.start(network)
                score, resected = _support(network, tangents, tolerance, of_photograph, start, seed)
                of_pair.append(_Candidate(start, score, resected, model.favoured))
            if of_pair and (not candidates or _best_of(of_pair).score > _best_of(candidates).score):
                candidates = of_pair
        return candidates

    wide = [[model for model in models if model.angle >= least_angle] for models in of_pairs]
    candidates = best_candidates([], wide)
    if m > 2 and not (candidates and _best_of(candidates).favoured):
        narrow = [
            [model for model in models if model.angle < least_angle and model.shows_depths]
            for models in of_pairs
        ]
        candidates = best_candidates(candidates, narrow)
    if not candidates:
        widest = np.degrees(max((model.angle for models in of_pairs for model in models), default=0.0))
        needed = f"{np.degrees(least_angle):g} are needed"
        seen = f": {widest:.1f} degrees at most (median), {needed}" if widest > 0 else ""
        raise GeometryError(
            f"orientation: no pair of photographs has a base, or rays that intersect well{seen}"
        )
    return _choose(candidates, judge)


def _models_of_pairs(
    network: Network,
    tangents: FloatArray,
    tolerance: FloatArray,
    of_photograph: list[IntArray],
    pairs: Sequence[tuple[int, int]],
    seed: int,
) -> list[list[_Model]]:
    """Return the solutions of each pair; ends after BARREN_PAIRS if most points fit in none of them."""
    of_pairs: list[list[_Model]] = []
    fits = False
    for tried, (i, j) in enumerate(pairs):
        if tried == BARREN_PAIRS and not fits:
            break
        report_step("starting pairs tried", tried, len(pairs))
        points, first, second = _common(network, tangents, of_photograph[i], of_photograph[j])
        limit = float(max(tolerance[i], tolerance[j]))
        try:
            solutions = relative_orientations(
                first, second, tolerance=limit, seed=seed, max_trials=PAIR_TRIALS
            )
        except GeometryError:
            continue
        fits = fits or any(solution.inliers.mean() > 0.5 for solution in solutions)
        of_pairs.append(_models((i, j), points, first, second, solutions))
    return of_pairs


def pair_solutions(network: Network, estimate: Estimate, *, tolerance_px: float) -> tuple[Estimate, ...]:
    """Return all solutions of two photographs, whatever their fit, transformed to the points of an estimate.

    Only solutions with a useful base are returned. A plane seen at moderate angles has another solution at a
    grazing angle with an almost vanishing base, which can fit the errors better than the true solution.
    Planes also serve as starts for flat objects with relief. A telephoto lens shows large relief and little
    perspective, and coplanarity alone may end in another minimum.

    Args:
        network: network of two photographs and points that both see.
        estimate: one solution, which gives cameras and frame; similar solutions are included.
        tolerance_px: largest residual of a fitting pair of image points, px.

    Source: Ma et al. (2004), An Invitation to 3-D Vision, sec. 5.3.3 (the two solutions of a plane).
    """
    tangents = image_tangents(network.image_points, network.camera, estimate.cameras)
    of_photograph = _sorted_rows(network, tangents)
    points, first, second = _common(network, tangents, of_photograph[0], of_photograph[1])
    tolerance = tolerance_px / min(camera.c_px for camera in estimate.cameras)
    solutions: list[RelativeOrientation] = []
    for within in (tolerance, AS_A_PLANE):
        with suppress(GeometryError):
            solutions += relative_orientations(first, second, tolerance=within, max_trials=PAIR_TRIALS)
    placed = []
    for model in _models((0, 1), points, first, second, solutions):
        start = model.start(network)
        if model.angle < np.radians(MIN_ANGLE_OF_TWO_DEG) or not np.isfinite(start.points).all():
            continue
        with suppress(GeometryError):  # points on a line do not determine it
            placing = fit_similarity(start.points, estimate.points)
            pair = replace(estimate, position=start.position, rotation=start.rotation, points=start.points)
            placed.append(placing.apply_estimate(pair))
    return tuple(placed)


def _choose(candidates: list[_Candidate], judge: Judge | None) -> Start:
    """Return the start with the best score; the judge decides between two without another photograph."""
    best = _best_of(candidates)
    if best.resected:
        return best.start
    rivals = [candidate for candidate in candidates if candidate.favoured]
    if len(rivals) < 2 or rivals[0].start.kind != "planar":
        return _best_of(rivals or [best]).start
    if judge is None:
        return replace(_best_of(rivals).start, twofold=True)
    misfit = [judge(candidate.start) for candidate in rivals]
    least, other = np.sort(misfit)[:2]
    chosen = rivals[int(np.argmin(misfit))].start
    return replace(chosen, twofold=not TWOFOLD * least < other)


def _best_of(candidates: list[_Candidate]) -> _Candidate:
    return max(candidates, key=lambda candidate: candidate.score)


def _sorted_rows(network: Network, tangents: FloatArray) -> list[IntArray]:
    """Return the rows of the usable image points of each photograph."""
    seen = network.image_points
    usable = np.flatnonzero(np.isfinite(tangents).all(axis=1))
    return [usable[rows] for rows in rows_of(seen.image[usable], len(network.images))]


def _list_common(network: Network, of_photograph: list[IntArray]) -> str:
    """Return in words, for each photograph, the other photograph with which it shares most points."""
    usable = np.zeros(len(network.image_points), dtype=bool)
    usable[np.concatenate(of_photograph)] = True
    most, partner = np.zeros(len(of_photograph), dtype=np.int64), np.zeros(len(of_photograph), dtype=np.int64)
    for first, second, count in network.common_points(usable):
        for photograph, other in ((first, second), (second, first)):
            order = np.lexsort(
                (-other, count, photograph)
            )  # the last entry of each photograph is its largest
            last = order[np.flatnonzero(np.diff(photograph[order], append=-1))]
            better = last[count[last] > most[photograph[last]]]
            most[photograph[better]], partner[photograph[better]] = count[better], other[better]
    words = []
    for i, name in enumerate(network.images):
        if not len(of_photograph[i]):
            words.append(f"{name}: no points")
        elif not most[i]:
            words.append(
                f"{name}: none of its {counted(len(of_photograph[i]), 'point')} is in another photograph"
            )
        else:
            shared = counted(int(most[i]), "point")
            words.append(f"{name}: {shared} in common with {network.images[partner[i]]}")
    return listed(words, most=10, separator="; ")


def _promising_pairs(network: Network, of_photograph: list[IntArray]) -> list[tuple[int, int]]:
    """Return pairs with at least four common points, most points first, spread over the photographs."""
    m = len(of_photograph)
    usable = np.zeros(len(network.image_points), dtype=bool)
    usable[np.concatenate(of_photograph)] = True
    pairs = np.zeros(1, dtype=np.int64)  # number of pairs by their number of common points
    for _, _, count in network.common_points(usable):
        now = np.bincount(count, minlength=len(pairs))
        now[: len(pairs)] += pairs
        pairs = now
    pairs[:PLANAR_POINTS] = 0
    fewest = int(np.flatnonzero(np.cumsum(pairs[::-1])[::-1] >= min(MAX_PAIRS, pairs.sum()))[-1])
    kept, passed = [], 0
    every = 1 + int(pairs[fewest]) // MAX_TIED  # stride over pairs with equal numbers of common points
    for first, second, count in network.common_points(usable):
        number = passed + np.cumsum(count == fewest)
        take = (count > fewest) | ((count == fewest) & (number % every == 0))
        take &= count >= PLANAR_POINTS
        passed = int(number[-1]) if len(number) else passed
        kept.append(np.stack([first[take], second[take], count[take]]))
    first, second, count = np.concatenate(kept, axis=1)
    # equal counts in the order of j - i, so that a cut keeps pairs from the whole survey
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
    """Return the points that two photographs have in common, and their tangents in both."""
    seen = network.image_points
    points, rows_a, rows_b = np.intersect1d(seen.point[a], seen.point[b], return_indices=True)
    if len(points) > PAIR_POINTS:
        spread = np.linspace(0, len(points) - 1, PAIR_POINTS).astype(np.int64)
        points, rows_a, rows_b = points[spread], rows_a[spread], rows_b[spread]
    return points, tangents[a[rows_a]], tangents[b[rows_b]]


def _models(
    pair: tuple[int, int],
    points: IntArray,
    first: FloatArray,
    second: FloatArray,
    solutions: Sequence[RelativeOrientation],
) -> list[_Model]:
    """Return the solutions of a pair with a base and enough rays that intersect, with their points."""
    models = []
    for solution in solutions:
        if solution.kind == "infinite":
            continue
        xyz = model_points(first, second, solution)
        usable = np.isfinite(xyz).all(axis=1)
        if usable.sum() < PLANAR_POINTS:
            continue
        to_first, to_second = xyz[usable], xyz[usable] - solution.base
        cosine = np.sum(to_first * to_second, axis=1) / (
            np.linalg.norm(to_first, axis=1) * np.linalg.norm(to_second, axis=1)
        )
        angle = float(np.arccos(np.clip(np.median(cosine), -1, 1)))
        models.append(_Model(pair, solution, solution.kind == solutions[0].kind, points, xyz, angle))
    return models


def _support(
    network: Network,
    tangents: FloatArray,
    tolerance: FloatArray,
    of_photograph: list[IntArray],
    start: Start,
    seed: int,
) -> tuple[float, int]:
    """Return the score of a start, and the number of photographs that can be resected on it.

    An image point adds 1 minus its squared residual in tolerances. The photographs that share most points
    with the model are resected on it. Then the points are intersected again from all of them, which separates
    a true plane from a distorted one.
    """
    seen = network.image_points
    determined = np.asarray(np.isfinite(start.points).all(axis=1))
    rows = [measured[determined[seen.point[measured]]][:SCREEN_POINTS] for measured in of_photograph]
    sharing = sorted(range(len(of_photograph)), key=lambda i: (-len(rows[i]), i))
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
    usable = np.concatenate(rows)
    oriented = np.asarray(np.isfinite(position).all(axis=1))
    usable = usable[oriented[seen.image[usable]]]
    again = intersect(
        tangents[usable],
        seen.image[usable],
        seen.point[usable],
        position,
        rotation,
        n_points=len(network.points),
        limits=RayLimits(tolerance=float(tolerance.max())),
    )
    squares = np.sum(again.residuals**2, axis=1) / tolerance[seen.image[usable]] ** 2
    score = float(np.sum(1 - np.minimum(squares[np.isfinite(squares)], 1.0)))
    return score, int(oriented.sum()) - len(start.pair or ())
