"""Evidence for and against an object point in all photographs.

This is the compiled part of `correspondence`. It forms hypotheses from pairs of targets and intersects their
rays. It searches for targets around a projected point, and computes how many equally good points chance would
give.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sfm.matching.epipolar import epipolar_distance
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled
from sfm.runtime.small_algebra import solve_three

# If the orientation is wrong by the tolerance, a point from two rays is this many tolerances off in a third
# photograph. The search narrows to one tolerance as more rays join.
SEARCH = (2.5, 1.5, 1.0, 1.0)
# Residuals below this fraction of the tolerance count as equal, so that chance agreement is not taken for
# proof.
FLOOR = 0.1
# Radius, in standard deviations of a coordinate, that contains 95 % of a normal distribution in the plane.
RADIUS_95 = 2.45
# Natural logarithm of the number of chance points below which a point is certain (1 in 10^9).
CERTAIN = -20.0
GAUSS_NEWTON_STEPS = 3


class Scene(NamedTuple):
    """All targets of all photographs in one list, in images free of distortion, with a search raster."""

    first: IntArray  # index of the first target of each photograph, (m + 1,)
    uv: FloatArray  # tangents u = -U/W, v = -V/W, (N, 2)
    kind: IntArray  # only equal kinds match, (N,)
    size: FloatArray  # diameter / c, 0 = unknown, (N,)
    ratio: float  # largest ratio of the sizes of one target on the object
    tolerance: float  # largest residual, px
    oriented: BoolArray  # (m,)
    c: FloatArray  # principal distance, px, (m,)
    position: FloatArray  # X0, (m, 3)
    M: FloatArray  # object to image axes, (m, 3, 3)
    window: FloatArray  # range of tangents certainly inside the photograph: u0, v0, u1, v1, (m, 4)
    area: FloatArray  # area over which the targets of the photograph spread, px^2, (m,)
    corner: FloatArray  # corner of the raster, tangents, (m, 2)
    cell: FloatArray  # width of its cells, at least the widest search, tangents, (m,)
    columns: IntArray  # number of its columns and rows, (m, 2)
    cells: IntArray  # index of its first cell in `start`, (m,)
    start: IntArray  # first entry of each cell in `member`
    member: IntArray  # targets in the order of their cells, (N,)


@compiled
def list_seeds(seeds: IntArray, scene: Scene, pairs: IntArray, E: FloatArray, used: BoolArray) -> int:
    """Fill `seeds` with pairs of unused targets on each other's epipolar lines; return their number.

    With an empty array, the pairs are only counted.
    """
    n = 0
    for k in range(len(pairs)):
        i, j = pairs[k]
        band = SEARCH[0] * scene.tolerance / scene.c[j]
        for a in range(scene.first[i], scene.first[i + 1]):
            if used[a]:
                continue
            for b in range(scene.first[j], scene.first[j + 1]):
                if used[b] or scene.kind[a] != scene.kind[b]:
                    continue
                p, q = scene.uv[a], scene.uv[b]
                if epipolar_distance(E[k], p[0], p[1], q[0], q[1]) < band:
                    if n < len(seeds):
                        seeds[n, 0], seeds[n, 1] = a, b
                    n += 1
    return n


@compiled
def grow(
    scene: Scene,
    seeds: IntArray,
    photograph: IntArray,
    used: BoolArray,
    density: FloatArray,
    log_tests: float,
    min_rays: int,
    cos_angle: float,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Extend each pair to all photographs and return the best point of every target.

    Args:
        scene: targets and orientation.
        seeds: pairs of targets, (s, 2).
        photograph: photograph of each target, (N,).
        used: targets that no longer take part, (N,).
        density: unused targets per px^2 in each photograph, (m,).
        log_tests: natural logarithm of the number of hypotheses tested.
        min_rays: fewest rays of a point.
        cos_angle: cosine of the smallest angle between the two rays of a pair.

    Returns:
        For the best point of each target: its target in each photograph or -1, (N, m); its position, (N, 3);
        natural logarithm of the number of equally good points that chance would give, inf if none, (N,).
    """
    m = len(scene.c)
    best = np.full((len(used), m), -1, dtype=np.int64)
    points = np.full((len(used), 3), np.nan)
    score = np.full(len(used), np.inf)
    track, residual = np.empty(m, dtype=np.int64), np.empty(m)
    X = np.empty(3)
    for s in range(len(seeds)):
        a, b = seeds[s]
        i, j = photograph[a], photograph[b]
        if best[a, j] == b and best[b, i] == a:
            continue  # already in one point
        if score[a] < CERTAIN and score[b] < CERTAIN:
            continue  # both are settled; if their points are rejected, the next round tries again
        if not meet(scene, a, b, i, j, cos_angle, X):
            continue
        size = object_size(scene, a, i, X)
        if not similar(size, object_size(scene, b, j, X), scene.ratio):
            continue
        rays = 0
        for search in SEARCH:
            rays = gather(scene, X, scene.kind[a], size, used, search * scene.tolerance, track, residual)
            if rays < min_rays or not intersect(scene, track, X):
                rays = 0
                break
        if rays == 0:
            continue
        rays = prune(scene, X, track, residual)
        if rays < min_rays:
            continue
        value = log_false_alarms(scene, X, track, residual, rays, density, log_tests)
        for k in range(m):
            if track[k] >= 0 and value < score[track[k]]:
                score[track[k]] = value
                best[track[k]] = track
                points[track[k]] = X
    return best, points, score


@compiled
def meet(
    scene: Scene,
    target: int,
    other_target: int,
    image: int,
    other_image: int,
    cos_angle: float,
    X: FloatArray,
) -> bool:
    """Fill X with the midpoint of the shortest line between two rays; False if the rays are unsuitable."""
    di, dj = np.empty(3), np.empty(3)
    for k in range(3):
        di[k] = (
            scene.M[image, 0, k] * scene.uv[target, 0]
            + scene.M[image, 1, k] * scene.uv[target, 1]
            - scene.M[image, 2, k]
        )
        dj[k] = (
            scene.M[other_image, 0, k] * scene.uv[other_target, 0]
            + scene.M[other_image, 1, k] * scene.uv[other_target, 1]
            - scene.M[other_image, 2, k]
        )
    di /= np.sqrt(di[0] ** 2 + di[1] ** 2 + di[2] ** 2)
    dj /= np.sqrt(dj[0] ** 2 + dj[1] ** 2 + dj[2] ** 2)
    cosine = di[0] * dj[0] + di[1] * dj[1] + di[2] * dj[2]
    if cosine > cos_angle:
        return False
    ei = ej = 0.0
    for k in range(3):
        base = scene.position[other_image, k] - scene.position[image, k]
        ei += di[k] * base
        ej += dj[k] * base
    below = 1.0 - cosine * cosine
    if below < 1e-12:
        return False
    along_i = (ei - cosine * ej) / below
    along_j = (cosine * ei - ej) / below
    if along_i <= 0 or along_j <= 0:
        return False
    for k in range(3):
        X[k] = 0.5 * (
            scene.position[image, k] + along_i * di[k] + scene.position[other_image, k] + along_j * dj[k]
        )
    return True


@compiled
def tangents(scene: Scene, image: int, X: FloatArray) -> tuple[float, float, float]:
    """Return u, v and the depth -W of a point in a photograph."""
    x = X[0] - scene.position[image, 0]
    y = X[1] - scene.position[image, 1]
    z = X[2] - scene.position[image, 2]
    M = scene.M[image]
    depth = -(M[2, 0] * x + M[2, 1] * y + M[2, 2] * z)
    U = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z
    V = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z
    return U / depth, V / depth, depth


@compiled
def object_size(scene: Scene, target: int, image: int, X: FloatArray) -> float:
    """Return the diameter of a target on the object, 0 if unknown."""
    size: float = scene.size[target] * tangents(scene, image, X)[2]
    return size


@compiled
def similar(size: float, other: float, ratio: float) -> bool:
    """Return whether two sizes agree; an unknown size (0) agrees with any."""
    return size == 0.0 or other == 0.0 or (size < ratio * other and other < ratio * size)


@compiled
def gather(
    scene: Scene,
    X: FloatArray,
    kind: int,
    size: float,
    used: BoolArray,
    radius_px: float,
    track: IntArray,
    residual: FloatArray,
) -> int:
    """Fill `track` with the nearest unused target around the point in each photograph; count them."""
    rays = 0
    for i in range(len(scene.c)):
        track[i] = -1
        if not scene.oriented[i]:
            continue
        u, v, depth = tangents(scene, i, X)
        if depth <= 0:
            continue
        column = int(np.floor((u - scene.corner[i, 0]) / scene.cell[i]))
        row = int(np.floor((v - scene.corner[i, 1]) / scene.cell[i]))
        nearest = (radius_px / scene.c[i]) ** 2
        for r in range(max(row - 1, 0), min(row + 2, scene.columns[i, 1])):
            for s in range(max(column - 1, 0), min(column + 2, scene.columns[i, 0])):
                at = scene.cells[i] + r * scene.columns[i, 0] + s
                for k in range(scene.start[at], scene.start[at + 1]):
                    a = scene.member[k]
                    if used[a] or scene.kind[a] != kind:
                        continue
                    d = (scene.uv[a, 0] - u) ** 2 + (scene.uv[a, 1] - v) ** 2
                    if d < nearest and similar(size, scene.size[a] * depth, scene.ratio):
                        nearest = d
                        track[i] = a
        if track[i] >= 0:
            rays += 1
            residual[i] = math.sqrt(nearest) * scene.c[i]
    return rays


@compiled
def intersect(scene: Scene, track: IntArray, X: FloatArray) -> bool:
    """Move X to the least squares intersection of its rays, in px; False if the rays do not determine it.

    Source: Kraus (2007), sec. 5.2 (spatial intersection by the collinearity equations, Gauss-Newton).
    """
    N, h, step = np.empty((3, 3)), np.empty(3), np.empty(3)
    for _ in range(GAUSS_NEWTON_STEPS):
        N[:] = 0.0
        h[:] = 0.0
        for i in range(len(track)):
            a = track[i]
            if a < 0:
                continue
            u, v, depth = tangents(scene, i, X)
            if depth <= 0:
                return False
            w2 = scene.c[i] ** 2
            du, dv = scene.uv[a, 0] - u, scene.uv[a, 1] - v
            for k in range(3):
                Ju = (scene.M[i, 0, k] + u * scene.M[i, 2, k]) / depth
                Jv = (scene.M[i, 1, k] + v * scene.M[i, 2, k]) / depth
                h[k] += w2 * (Ju * du + Jv * dv)
                for l in range(3):
                    Jul = (scene.M[i, 0, l] + u * scene.M[i, 2, l]) / depth
                    Jvl = (scene.M[i, 1, l] + v * scene.M[i, 2, l]) / depth
                    N[k, l] += w2 * (Ju * Jul + Jv * Jvl)
        if not solve_three(N, h, step):
            return False
        for k in range(3):
            X[k] += step[k]
    return True


@compiled
def prune(scene: Scene, X: FloatArray, track: IntArray, residual: FloatArray) -> int:
    """Recompute the residuals of a point, drop rays beyond the tolerance, and return the number kept."""
    rays = 0
    for i in range(len(track)):
        a = track[i]
        if a < 0:
            continue
        u, v, depth = tangents(scene, i, X)
        residual[i] = scene.c[i] * math.sqrt((scene.uv[a, 0] - u) ** 2 + (scene.uv[a, 1] - v) ** 2)
        if depth <= 0 or residual[i] > scene.tolerance:
            track[i] = -1
        else:
            rays += 1
    return rays


@compiled
def same_target(
    scene: Scene, targets: IntArray, X: FloatArray, other: IntArray, Y: FloatArray, reach_px: float
) -> bool:
    """Return whether two points are one target: never in the same photograph, and mostly close together."""
    near = far = 0
    for i in range(len(scene.c)):
        if not scene.oriented[i]:
            continue
        if targets[i] >= 0 and other[i] >= 0:
            return False
        u, v, depth = tangents(scene, i, X)
        p, q, depth_of_other = tangents(scene, i, Y)
        if depth > 0 and depth_of_other > 0:
            if scene.c[i] * math.hypot(u - p, v - q) < reach_px:
                near += 1
            else:
                far += 1
    return near > far


@compiled
def in_view(scene: Scene, image: int, X: FloatArray) -> bool:
    """Return whether a point falls inside a photograph."""
    if not scene.oriented[image]:
        return False
    u, v, depth = tangents(scene, image, X)
    w = scene.window[image]
    return depth > 0 and w[0] < u < w[2] and w[1] < v < w[3]


@compiled
def log_false_alarms(
    scene: Scene,
    X: FloatArray,
    track: IntArray,
    residual: FloatArray,
    rays: int,
    density: FloatArray,
    log_tests: float,
) -> float:
    """Return the logarithm of the number of points with as good rays and residuals that chance would give.

    tests * binomial(n - 2, k - 2) * p^(k - 2): k of the n photographs that see the position agree. p is the
    probability that a target lies within the radius of the residuals. The hypothesis itself uses two rays.
    """
    n = 0
    squares, log_p = 0.0, 0.0
    for i in range(len(track)):
        if track[i] >= 0:
            n += 1
            squares += residual[i] ** 2
        elif in_view(scene, i, X):
            n += 1
    sigma = max(math.sqrt(squares / (2 * rays - 3)), FLOOR * scene.tolerance)
    radius = min(RADIUS_95 * sigma, scene.tolerance)
    for i in range(len(track)):
        if track[i] >= 0:
            log_p += math.log(min(1.0, density[i] * math.pi * radius**2))
    choices = math.lgamma(n - 1) - math.lgamma(rays - 1) - math.lgamma(n - rays + 1)
    return log_tests + choices + log_p * (rays - 2) / rays
