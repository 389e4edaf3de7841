"""Intersection: object points from the rays of several photographs, linear, robust and by least squares.

The point nearest to all rays is the start. If rays contradict one another, the start is the two-ray point
that most rays support. Gauss-Newton on the image residuals then gives the least-squares solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm.model.arguments import check_indices, checked_arguments, checked_fields
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled
from sfm.runtime.small_algebra import solve_scaled

MAX_STEPS = 20
CONVERGED = 1e-13  # last step, relative to the distance of the point
MAX_PAIRS = 400  # pairs of rays that are tried for one point


@dataclass(frozen=True)
class Intersection:
    """Object points from their rays; NaN where rays do not determine a point."""

    points: FloatArray  # object points, object unit, (n, 3)
    cofactors: FloatArray  # Qxx of each point for rays of weight 1, object unit^2, (n, 3, 3)
    covariance: FloatArray  # sigma0^2 Qxx with the common sigma0 of all points, (n, 3, 3)
    residuals: FloatArray  # v = computed - measured of every ray, tangents, NaN behind the camera, (k, 2)
    used: BoolArray  # rays that took part, (k,)
    rays: IntArray  # number of rays that took part at each point, (n,)
    angle: FloatArray  # largest angle between two of the rays that took part, rad, (n,)
    sigma0: float  # a posteriori standard deviation of unit weight; tangents if weights are not given
    redundancy: int  # 2 (rays used) - 3 (points)


@checked_fields
@dataclass(frozen=True)
class RayLimits:
    """What the rays of an intersected point must reach."""

    tolerance: float = np.inf
    """largest residual vector of a ray that takes part, tangents. With a finite tolerance the point is the
    one that most rays support."""
    min_angle_deg: float = 0.0  # smallest ray angle of a determined point, deg


@checked_arguments(tangents="k 2", image="k", point="k", positions="m 3", rotations="m 3 3", weights="k 2 2")
def intersect(
    tangents: FloatArray,
    image: IntArray,
    point: IntArray,
    positions: FloatArray,
    rotations: FloatArray,
    *,
    n_points: int | None = None,
    weights: FloatArray | None = None,
    limits: RayLimits = RayLimits(),
) -> Intersection:
    """Return the object points determined by many rays, each by least squares on its image residuals.

    Args:
        tangents: u = -U/W, v = -V/W of each measured ray, shape (k, 2).
        image: index of the photograph of each ray, shape (k,).
        point: index of the object point of each ray, shape (k,).
        positions: projection centres X0, shape (m, 3), object unit; rays of photographs with NaN are left
            out.
        rotations: R of the photographs, image to object axes, shape (m, 3, 3).
        n_points: number of object points; the largest index + 1 if not given.
        weights: weight matrix of each ray, shape (k, 2, 2); unit matrices if not given.
        limits: what the rays of a point must reach.

    Returns:
        Points with covariance; a point needs two rays and lies in front of all photographs that see it.

    Raises:
        GeometryError: an index of a photograph or point is out of range.

    Source: Foerstner, Wrobel (2016), sec. 13.4: the point nearest to the rays, then Gauss-Newton on the
    collinearity equations. The two-ray candidates are tested against all other rays as in RANSAC.
    """
    uv = np.ascontiguousarray(tangents, dtype=float).reshape(-1, 2)
    n = int(np.max(point, initial=-1)) + 1 if n_points is None else n_points
    check_indices("intersect: image", image, len(positions))
    check_indices("intersect: point", point, n)
    P = np.broadcast_to(np.eye(2), (len(uv), 2, 2)) if weights is None else weights
    oriented = np.asarray(np.isfinite(positions).all(axis=1))
    usable = oriented[image] & np.isfinite(uv).all(axis=1)
    order = np.argsort(point[usable], kind="stable")
    ray = np.flatnonzero(usable)[order]
    start = np.searchsorted(point[ray], np.arange(n + 1))
    xyz, Q = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    count, angle = np.zeros(n, dtype=np.int64), np.full(n, np.nan)
    residuals, used = np.full((len(uv), 2), np.nan), np.zeros(len(uv), dtype=np.bool_)
    rays = _Rays(
        uv,
        np.ascontiguousarray(image, dtype=np.int64),
        np.ascontiguousarray(positions, dtype=float),
        np.ascontiguousarray(rotations, dtype=float),
        np.array(P, dtype=float, order="C"),  # writable, because the kernels are compiled for that
    )
    tolerance, cos_limit = limits.tolerance, float(np.cos(np.radians(limits.min_angle_deg)))
    cost = _intersect_all(
        rays, ray, start, tolerance * tolerance, cos_limit, xyz, Q, count, angle, residuals, used
    )
    redundancy = int(2 * used.sum() - 3 * np.isfinite(xyz).all(axis=1).sum())
    sigma0 = float(np.sqrt(cost / redundancy)) if redundancy > 0 else np.nan
    return Intersection(xyz, Q, sigma0**2 * Q, residuals, used, count, angle, sigma0, redundancy)


class _Rays(NamedTuple):
    """All measured rays, with their photographs."""

    tangents: FloatArray  # u = -U/W, v = -V/W, (k, 2)
    image: IntArray  # index of the photograph, (k,)
    positions: FloatArray  # projection centres X0, object unit, (m, 3)
    rotations: FloatArray  # R, image to object axes, (m, 3, 3)
    weights: FloatArray  # weight matrices, (k, 2, 2)


@compiled
def _intersect_all(
    rays: _Rays,
    ray: IntArray,
    start: IntArray,
    limit: float,
    cos_limit: float,
    xyz: FloatArray,
    Q: FloatArray,
    number: IntArray,
    angle: FloatArray,
    residuals: FloatArray,
    used: BoolArray,
) -> float:
    """Intersect point by point, and return the sum of v'Pv over all points.

    The rays of point j are `ray[start[j]:start[j + 1]]`; a ray fits up to the squared residual `limit`.
    """
    direction = np.empty((len(ray), 3))  # of the rays of one point, which may be all
    X, best_X = np.empty(3), np.empty(3)
    N, b, dx = np.empty((3, 3)), np.empty(3), np.empty(3)
    total = 0.0
    for j in range(len(xyz)):
        of_point = ray[start[j] : start[j + 1]]
        m = len(of_point)
        if m < 2:
            continue
        for i in range(m):
            _direction(rays, of_point[i], direction[i])
            used[of_point[i]] = True
        nearest = _nearest_to_rays(rays, of_point, direction, used, N, b, X)
        if np.isinf(limit) or m == 2:
            if not nearest:
                _drop(of_point, used)
                continue
        elif not nearest or _sum_of_squares(rays, of_point, X) > limit:
            score = _best_pair(rays, of_point, direction, limit, used, N, b, X, best_X)
            if np.isinf(score):
                continue
            X[:] = best_X
        ok = False
        for _ in range(3):
            if not np.isinf(limit):
                count = 0
                for i in range(m):
                    k = of_point[i]
                    used[k] = _square(rays, k, X) <= limit
                    count += used[k]
                if count < 2:
                    ok = False
                    break
            best_X[:] = X
            ok = _least_squares(rays, of_point, used, X, N, b, dx)
            if not ok:
                X[:] = best_X
                break
        count, smallest = 0, 1.0
        if ok:
            ok, count, smallest = _select(rays, of_point, direction, X, limit, used)
        if not ok or count < 2 or smallest > cos_limit:
            _drop(of_point, used)
            continue
        for i in range(m):
            k = of_point[i]
            _residual(rays, k, X, residuals[k])
            if used[k]:
                ru, rv = residuals[k, 0], residuals[k, 1]
                P = rays.weights[k]
                total += P[0, 0] * ru * ru + 2.0 * P[0, 1] * ru * rv + P[1, 1] * rv * rv
        xyz[j] = X
        Q[j] = np.linalg.inv(N)
        number[j] = count
        angle[j] = np.arccos(max(-1.0, smallest))
    return total


@compiled
def _drop(of_point: IntArray, used: BoolArray) -> None:
    """Mark rays as not taking part."""
    for i in range(len(of_point)):
        used[of_point[i]] = False


@compiled
def _select(
    rays: _Rays, of_point: IntArray, direction: FloatArray, X: FloatArray, limit: float, used: BoolArray
) -> tuple[bool, int, float]:
    """Keep the used rays that fit a point; return whether it is in front of all, their number and spread.

    The spread is the cosine of the largest angle between two of them.
    """
    in_front, count, smallest = True, 0, 1.0
    for i in range(len(of_point)):
        k = of_point[i]
        square = _square(rays, k, X)
        if np.isinf(square) and used[k]:
            in_front = False
        used[k] = used[k] and square <= limit
        if not used[k]:
            continue
        count += 1
        for h in range(i):
            if used[of_point[h]]:
                c = 0.0
                for d in range(3):
                    c += direction[i, d] * direction[h, d]
                smallest = min(smallest, c)
    return in_front, count, smallest


@compiled
def _direction(rays: _Rays, ray: int, out: FloatArray) -> None:
    """Fill the unit vector of a ray in object axes."""
    uv, R = rays.tangents[ray], rays.rotations[rays.image[ray]]
    norm = np.sqrt(uv[0] * uv[0] + uv[1] * uv[1] + 1.0)
    for d in range(3):
        out[d] = (R[d, 0] * uv[0] + R[d, 1] * uv[1] - R[d, 2]) / norm


@compiled
def _nearest_to_rays(
    rays: _Rays,
    of_point: IntArray,
    direction: FloatArray,
    used: BoolArray,
    N: FloatArray,
    b: FloatArray,
    X: FloatArray,
) -> bool:
    """Fill the point with the least sum of squared distances from the rays in use; False if there is none."""
    N[:] = 0.0
    b[:] = 0.0
    for i in range(len(of_point)):
        if not used[of_point[i]]:
            continue
        C = rays.positions[rays.image[of_point[i]]]
        along = direction[i, 0] * C[0] + direction[i, 1] * C[1] + direction[i, 2] * C[2]
        for a in range(3):
            for c in range(3):
                N[a, c] -= direction[i, a] * direction[i, c]
            N[a, a] += 1.0
            b[a] += C[a] - along * direction[i, a]
    return solve_scaled(N, b, X)


@compiled
def _best_pair(
    rays: _Rays,
    of_point: IntArray,
    direction: FloatArray,
    limit: float,
    used: BoolArray,
    N: FloatArray,
    b: FloatArray,
    X: FloatArray,
    best_X: FloatArray,
) -> float:
    """Fill the two-ray point with the least truncated squares over all rays; return their sum (inf: none)."""
    m = len(of_point)
    best = np.inf
    stride = max(1, (m * (m - 1) // 2) // MAX_PAIRS)
    pair = -1
    for i in range(m):
        for h in range(i):
            pair += 1
            if pair % stride:
                continue
            _drop(of_point, used)
            used[of_point[i]] = used[of_point[h]] = True
            if not _nearest_to_rays(rays, of_point, direction, used, N, b, X):
                continue
            score = 0.0
            fits = 0
            for k in of_point:
                square = _square(rays, k, X)
                fits += square <= limit
                score += min(square, limit)
                if score >= best:
                    break
            if score < best and fits >= 2:
                best = score
                best_X[:] = X
    _drop(of_point, used)
    return best


@compiled
def _sum_of_squares(rays: _Rays, of_point: IntArray, X: FloatArray) -> float:
    """Return the sum of the squared image residuals of rays.

    If this sum is below the limit of a single ray, the least-squares point of all rays has the smallest
    truncated squares of all points, because rejecting one ray costs the limit.
    """
    total = 0.0
    for k in of_point:
        total += _square(rays, k, X)
    return total


@compiled
def _square(rays: _Rays, ray: int, X: FloatArray) -> float:
    """Return the squared image residual of a ray, infinite for a point behind the camera."""
    uv, C, R = rays.tangents[ray], rays.positions[rays.image[ray]], rays.rotations[rays.image[ray]]
    dx, dy, dz = X[0] - C[0], X[1] - C[1], X[2] - C[2]
    W = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
    if not W < 0.0:
        return np.inf
    ru: float = (R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz) / W + uv[0]
    rv: float = (R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz) / W + uv[1]
    return ru * ru + rv * rv


@compiled
def _residual(rays: _Rays, ray: int, X: FloatArray, residual: FloatArray) -> None:
    """Fill the image residual of a ray, (2,); unchanged for a point behind the camera."""
    uv, C, R = rays.tangents[ray], rays.positions[rays.image[ray]], rays.rotations[rays.image[ray]]
    dx, dy, dz = X[0] - C[0], X[1] - C[1], X[2] - C[2]
    W = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
    if W < 0.0:
        residual[0] = -(R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz) / W - uv[0]
        residual[1] = -(R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz) / W - uv[1]


@compiled
def _least_squares(
    rays: _Rays,
    of_point: IntArray,
    used: BoolArray,
    X: FloatArray,
    N: FloatArray,
    b: FloatArray,
    dx: FloatArray,
) -> bool:
    """Refine X by Gauss-Newton on the image residuals of the rays in use, and fill N; False if it fails."""
    A = np.empty((2, 3))
    for _ in range(MAX_STEPS):
        N[:] = 0.0
        b[:] = 0.0
        distance = 0.0
        for i in range(len(of_point)):
            k = of_point[i]
            if not used[k]:
                continue
            C, R = rays.positions[rays.image[k]], rays.rotations[rays.image[k]]
            uv, P = rays.tangents[k], rays.weights[k]
            x, y, z = X[0] - C[0], X[1] - C[1], X[2] - C[2]
            W = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
            if not W < 0.0:
                return False
            u = -(R[0, 0] * x + R[1, 0] * y + R[2, 0] * z) / W
            v = -(R[0, 1] * x + R[1, 1] * y + R[2, 1] * z) / W
            ru, rv = u - uv[0], v - uv[1]
            distance = max(distance, abs(W))
            for d in range(3):
                A[0, d] = -(R[d, 0] + u * R[d, 2]) / W
                A[1, d] = -(R[d, 1] + v * R[d, 2]) / W
            for a in range(3):
                pa = P[0, 0] * A[0, a] + P[0, 1] * A[1, a]
                qa = P[0, 1] * A[0, a] + P[1, 1] * A[1, a]
                b[a] -= pa * ru + qa * rv
                for c in range(3):
                    N[a, c] += pa * A[0, c] + qa * A[1, c]
        if not solve_scaled(N, b, dx):
            return False
        for d in range(3):
            X[d] += dx[d]
        if abs(dx[0]) + abs(dx[1]) + abs(dx[2]) < CONVERGED * distance:
            return True
    return True
