"""Robust space resection from many points, some of them wrong: P3P in RANSAC, then least squares."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, replace
from functools import cached_property
from math import comb

import numpy as np
from scipy.special import bdtrc

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.orientation.resection.fischler_bolles import MAX_SOLUTIONS, WORK, rays_from_tangents, solve_triple
from sfm.orientation.resection.least_squares import (
    DONE,
    LIMIT,
    UNKNOWNS,
    adjust_pose,
    cofactors_in_angles,
    pose_normals,
)
from sfm.runtime.compiling import compiled

SAMPLE = 3  # points in a trial
MARGIN_SD = 3  # standard deviations of the number of trials, added to its expectation
MAX_TRIALS = 20_000
LOCAL, FINAL = 0, 1
# Gauss-Newton steps of the local and of the final improvement; an array, because `adjust_pose` would be
# compiled for each plain number
STEPS = np.array([4, 30])
ROUNDS = 10  # rounds of least squares and new selection of the fitting points
CHANCE = 0.5  # largest expected number of poses that random points support
FEW_POINTS = 8  # number of points up to which every triple is tried and every candidate improved
_NOWHERE = np.full(3, np.nan)


@dataclass(frozen=True)
class RobustResection:
    """Exterior orientation from points, some of which do not fit; NaN with a reason if there is none."""

    position: FloatArray  # projection centre X0, object unit, (3,)
    rotation: FloatArray  # R, image to object axes, (3, 3)
    inliers: BoolArray  # points that fit, (n,)
    residuals: FloatArray  # v = computed - measured of all points, tangents, NaN behind the camera, (n, 2)
    rms: float  # root mean square residual per coordinate of the fitting points, tangents
    sigma0: float  # a posteriori standard deviation of a coordinate, tangents; NaN without redundancy
    sigma: float  # standard deviation of a coordinate for the covariance, tangents
    normal_matrix: FloatArray  # N of X0 and a small rotation in image axes, for unit weights, (6, 6)
    trials: int  # number of triples tried
    reason: str  # why there is no orientation; empty if there is one
    needed: int  # number of points that must fit

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of X0 (object unit) and omega, phi, kappa (rad), (6, 6)."""
        if not self.found:
            return np.full((6, 6), np.nan)
        return self.sigma**2 * cofactors_in_angles(
            np.asarray(np.linalg.inv(self.normal_matrix), dtype=float), self.rotation
        )

    @property
    def found(self) -> bool:
        """Whether there is an orientation."""
        return not self.reason


@checked_arguments(tangents="n 2", points="n 3")
def resect_robust(
    tangents: FloatArray,
    points: FloatArray,
    *,
    tolerance: float,
    seed: int = 0,
    min_inliers: int = 4,
    max_trials: int = MAX_TRIALS,
    sigma: float | None = None,
    field: float = np.inf,
) -> RobustResection:
    """Return the exterior orientation that most of the points support.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, shape (n, 2).
        points: object points, shape (n, 3), object unit.
        tolerance: largest residual vector of a fitting point, tangents.
        seed: seed for the choice of triples; the same seed gives the same result.
        min_inliers: smallest number of fitting points, at least 4 (three always fit).
        max_trials: largest number of triples.
        sigma: a priori standard deviation of a coordinate for the covariance, tangents; the a posteriori one
            if not given.
        field: area of the photograph, squared tangents; if given, more points must fit than by chance
            (`fewest_fitting`).

    Returns:
        The orientation with the smallest truncated sum of squared residuals, refined by least squares over
        the fitting points; or the reason why there is none.

    Source: Fischler, Bolles (1981), secs. II-IV: trials until E(k) + 3 SD(k) for the share w of fitting
    points found so far. The truncated squares are those of Torr, Zisserman (2000), CVIU 78 (MSAC); the
    improvement of every new best candidate by least squares is that of Chum et al. (2003), LO-RANSAC.
    """
    n = len(points)
    needed = fewest_fitting(n, tolerance, field, minimum=min_inliers)
    uv = np.ascontiguousarray(tangents, dtype=float).reshape(-1, 2)
    xyz = np.ascontiguousarray(points, dtype=float).reshape(-1, 3)
    if n < max(min_inliers, SAMPLE + 1):
        return _failure(n, needed, f"{counted(n, 'point')}, resection needs {needed}")
    weights = np.zeros((n, 2, 2))
    weights[:, 0, 0] = weights[:, 1, 1] = 1.0
    X0, R, used, residuals, N = (
        np.empty(3),
        np.empty((3, 3)),
        np.zeros(n, dtype=np.bool_),
        np.empty((n, 2)),
        np.empty((6, 6)),
    )
    trials = _search(
        uv, rays_from_tangents(uv), xyz, weights, tolerance, max_trials, seed, X0, R, used, residuals, N
    )
    count = int(used.sum())
    if trials < 0:
        return _failure(
            n,
            needed,
            f"no orientation fits any triple of its {counted(n, 'point')} (collinear or coincident)",
        )
    if count < needed:
        return replace(
            _failure(
                n, needed, f"only {count} of {n} points fit within the tolerance, resection needs {needed}"
            ),
            inliers=used,
            trials=trials,
        )
    fitting = residuals[used]
    square = float(np.sum(fitting**2))
    redundancy = 2 * count - UNKNOWNS
    sigma0 = np.sqrt(square / redundancy)
    rms, a_priori = float(np.sqrt(square / (2 * count))), sigma0 if sigma is None else sigma
    return RobustResection(X0, R, used, residuals, rms, float(sigma0), float(a_priori), N, trials, "", needed)


def fewest_fitting(n: int, tolerance: float, field: float, *, minimum: int = SAMPLE + 1) -> int:
    """Return how many of n points must fit for the fit to be significant.

    Args:
        n: number of points.
        tolerance: largest residual of a fitting point, tangents.
        field: area of the photograph, squared tangents.
        minimum: lower limit of the result, which is also at least four.

    Source: Moisan, Stival (2004), Int. J. Comput. Vision 57(3): among all poses of all triples, the expected
    number of poses that fit this many points at random positions must be less than CHANCE.
    """
    needed = max(minimum, SAMPLE + 1)
    chance = min(1.0, np.pi * tolerance**2 / field)
    tests = MAX_SOLUTIONS * comb(n, SAMPLE)
    if needed >= n:
        return needed

    def enough(fitting: int) -> bool:
        return bool(tests * bdtrc(fitting - SAMPLE - 1, n - SAMPLE, chance) <= CHANCE)

    return bisect_left(range(n), True, lo=needed, key=enough)


@checked_arguments()
def expected_trials(w: float, n: int) -> tuple[float, float]:
    """Return expectation E(k) and standard deviation SD(k) of the trials until a sample is free of errors.

    Args:
        w: probability that a point is correct.
        n: number of points in a sample.

    Raises:
        GeometryError: the probability or the number is out of range.

    Source: Fischler, Bolles (1981), sec. II.B: E(k) = w^-n, SD(k) = sqrt(1 - w^n) w^-n.
    """
    if not (0 < w <= 1 and n > 0):
        raise GeometryError(f"expected_trials: w is {w:g} and n is {n}, expected 0 < w <= 1 and n >= 1")
    good = w**n
    return 1.0 / good, float(np.sqrt(1.0 - good)) / good


def _failure(n: int, needed: int, reason: str) -> RobustResection:
    nan = np.full((n, 2), np.nan)
    return RobustResection(
        _NOWHERE.copy(), np.full((3, 3), np.nan), np.zeros(n, dtype=bool), nan, np.nan, np.nan, np.nan,
        np.full((6, 6), np.nan), 0, reason, needed,
    )  # fmt: skip


@compiled
def _search(
    tangents: FloatArray,
    rays: FloatArray,
    points: FloatArray,
    weights: FloatArray,
    tolerance: float,
    max_trials: int,
    seed: int,
    X0: FloatArray,
    R: FloatArray,
    used: BoolArray,
    residuals: FloatArray,
    N: FloatArray,
) -> int:
    """Fill the best pose, its fitting points, residuals and normal matrix; return trials (-1: no pose)."""
    n = len(points)
    position, rotation = np.empty((MAX_SOLUTIONS, 3)), np.empty((MAX_SOLUTIONS, 3, 3))
    legs, work = np.empty((MAX_SOLUTIONS, 3)), np.empty(WORK)
    ray3, point3, pick = np.empty((3, 3)), np.empty((3, 3)), np.zeros(3, dtype=np.int64)
    try_X0, try_R = np.empty(3), np.empty((3, 3))
    history = np.empty((0, 6))
    n_vector = np.empty(6)
    limit = tolerance * tolerance
    best, best_raw = np.inf, np.inf
    exhaustive = n <= FEW_POINTS
    state = np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(0x2545F4914F6CDD1D)
    wanted = float(max_trials)
    trial = 0
    pick[2] = -1
    while True:
        if exhaustive:
            if not _next_triple(pick, n):
                break
        else:
            if trial >= wanted:
                break
            state = _random_triple(state, n, pick)
        trial += 1
        for k in range(3):
            ray3[k], point3[k] = rays[pick[k]], points[pick[k]]
        for s in range(solve_triple(ray3, point3, position, rotation, legs, work)):
            raw = truncated_squares(tangents, points, position[s], rotation[s], limit, best_raw)
            if raw >= best_raw and not exhaustive:
                continue
            best_raw = min(raw, best_raw)
            try_X0[:], try_R[:] = position[s], rotation[s]
            score = raw
            for _ in range(2):
                if exhaustive and n == SAMPLE + 1:
                    used[:] = True
                elif select(tangents, points, try_X0, try_R, limit, used) < SAMPLE + 1:
                    break
                adjust_pose(
                    tangents, points, weights, used, try_X0, try_R, STEPS[LOCAL], history, N, residuals
                )
                new = truncated_squares(tangents, points, try_X0, try_R, limit, np.inf)
                if new >= score:
                    break
                score = new
            if raw < score or score >= best:
                if raw >= best:
                    continue
                try_X0[:], try_R[:] = position[s], rotation[s]
                score = raw
            best = score
            X0[:], R[:] = try_X0, try_R
            w = max(select(tangents, points, X0, R, limit, used), SAMPLE) / n
            good = w**SAMPLE
            wanted = min(float(max_trials), (1.0 + MARGIN_SD * np.sqrt(1.0 - good)) / good)
    if best == np.inf:
        return -1
    for _ in range(ROUNDS):
        before = select(tangents, points, X0, R, limit, used)
        if before < SAMPLE + 1:
            break
        try_X0[:], try_R[:] = X0, R
        _, _, end = adjust_pose(
            tangents, points, weights, used, try_X0, try_R, STEPS[FINAL], history, N, residuals
        )
        score = truncated_squares(tangents, points, try_X0, try_R, limit, np.inf)
        if (end != DONE and end != LIMIT) or score > best * (1.0 + 1e-12):
            break
        same = abs(score - best) <= 1e-12 * best
        X0[:], R[:] = try_X0, try_R
        best = score
        if same:
            break
    select(tangents, points, X0, R, limit, used)
    pose_normals(tangents, points, weights, used, X0, R, N, n_vector, residuals)
    return trial


@compiled
def truncated_squares(
    tangents: FloatArray, points: FloatArray, X0: FloatArray, R: FloatArray, limit: float, stop: float
) -> float:
    """Return the sum of min(squared residual, limit), infinite as soon as it reaches `stop`.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, (n, 2).
        points: object points, (n, 3).
        X0: projection centre, (3,).
        R: rotation, image to object axes, (3, 3).
        limit: largest squared residual that counts.
        stop: sum at which the computation ends.
    """
    total = 0.0
    for i in range(len(points)):
        dx, dy, dz = points[i, 0] - X0[0], points[i, 1] - X0[1], points[i, 2] - X0[2]
        W = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
        if W < 0.0:
            ru = (R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz) / W + tangents[i, 0]
            rv = (R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz) / W + tangents[i, 1]
            total += min(ru * ru + rv * rv, limit)
        else:
            total += limit
        if total >= stop:
            return np.inf
    return total


@compiled
def select(
    tangents: FloatArray, points: FloatArray, X0: FloatArray, R: FloatArray, limit: float, used: BoolArray
) -> int:
    """Mark the points in front of the camera with squared residuals up to `limit`; return their number.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, (n, 2).
        points: object points, (n, 3).
        X0: projection centre, (3,).
        R: rotation, image to object axes, (3, 3).
        limit: largest squared residual of a fitting point.
        used: receives the marks, (n,).
    """
    count = 0
    for i in range(len(points)):
        dx, dy, dz = points[i, 0] - X0[0], points[i, 1] - X0[1], points[i, 2] - X0[2]
        W = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
        used[i] = False
        if W < 0.0:
            ru = (R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz) / W + tangents[i, 0]
            rv = (R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz) / W + tangents[i, 1]
            used[i] = ru * ru + rv * rv <= limit
        if used[i]:
            count += 1
    return count


@compiled
def _next_triple(pick: IntArray, n: int) -> bool:
    """Step to the next i < j < k in lexical order; pick[2] = -1 starts."""
    if pick[2] < 0:
        pick[0], pick[1], pick[2] = 0, 1, 2
        return True
    for k in (2, 1, 0):
        if pick[k] < n - 3 + k:
            pick[k] += 1
            for j in range(k + 1, 3):
                pick[j] = pick[j - 1] + 1
            return True
    return False


@compiled
def _random_triple(state: np.uint64, n: int, pick: IntArray) -> np.uint64:
    """Draw three different indices; return the new state (splitmix64, Steele et al. 2014)."""
    k = 0
    while k < 3:
        state += np.uint64(0x9E3779B97F4A7C15)
        z = state
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
        index = np.int64(z % np.uint64(n))
        if (k > 0 and index == pick[0]) or (k > 1 and index == pick[1]):
            continue
        pick[k] = index
        k += 1
    return state
