"""Relative orientation of two photographs: closed form, and adjustment by the coplanarity condition.

Photograph 1 defines the frame: X0 = 0, R = I, with its image axes. Photograph 2 has the base b, of length 1
because scale is not determined, and R from image axes 2 to image axes 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.special import fdtri

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import VISION_AXES, BoolArray, FloatArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.orientation.image_rays import (
    PLANAR_POINTS,
    decompose_homography,
    fit_homography,
    transfer_residuals,
)
from sfm.orientation.intersection import intersect
from sfm.orientation.resection.least_squares import rotation_from_position
from sfm.runtime.compiling import compiled
from sfm.runtime.small_algebra import cross, solve_scaled, turn

UNKNOWNS = 5
MAX_STEPS = 30
CONVERGED = 1e-12  # sum of the five steps, rad
HALVINGS = 8
SPATIAL_POINTS = 6  # five points give up to ten solutions, and the sixth decides between them
PLANAR_SHARE = 0.8  # share of the pairs that must fit one homography for a planar solution
INFINITE_SHARE = 0.1  # residuals of a pure rotation over the tolerance, below which no base is sought
BASE_EXPLAINS = 5.0  # ratio of sigma0 without and with a base; neglected distortion does not reach it
NARROW = 0.1  # share of the tolerance used to find a small base
CONFIDENCE = 0.999  # confidence of the tests whether a simpler scene explains the rays as well
RANSAC_CONFIDENCE = 0.9999
RANSAC_TRIALS = 2000
ROUNDS = 5  # rounds of adjustment and new selection of the fitting pairs
_NAN = np.full(3, np.nan)


@dataclass(frozen=True)
class RelativeOrientation:
    """Photograph 2 in the frame of photograph 1."""

    kind: str  # spatial | planar | infinite (no base: the same station, or all points far away)
    base: FloatArray  # unit vector from projection centre 1 to 2; NaN if infinite, (3,)
    rotation: FloatArray  # R, image axes 2 to image axes 1, (3, 3)
    normal: FloatArray  # unit normal of the plane, away from photograph 1; NaN if not planar, (3,)
    inliers: BoolArray  # point pairs that fit, (n,)
    residuals: FloatArray  # distance of each pair from coplanarity, tangents, (n,)
    sigma0: float  # a posteriori standard deviation of an image coordinate, tangents
    redundancy: int  # number of fitting pairs - 5
    normal_matrix: FloatArray  # N of two small rotations of b (across it) and w in R exp([w]x), (5, 5)

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of two small rotations of b (across it) and w in R exp([w]x), rad^2, (5, 5)."""
        if not np.isfinite(self.normal_matrix).all():
            return np.full((5, 5), np.nan)
        return np.asarray(self.sigma0**2 * np.linalg.pinv(self.normal_matrix, hermitian=True))

    @property
    def rms(self) -> float:
        """Root mean square residual of the fitting pairs, tangents."""
        return float(np.sqrt(np.mean(self.residuals[self.inliers] ** 2)))


@checked_arguments(first="n 2", second="n 2")
def relative_orientations(
    first: FloatArray,
    second: FloatArray,
    *,
    tolerance: float,
    seed: int = 0,
    max_trials: int = RANSAC_TRIALS,
) -> tuple[RelativeOrientation, ...]:
    """Return the relative orientations that fit conjugate rays, from the rays alone.

    Args:
        first: tangents u = -U/W, v = -V/W of rays of photograph 1, shape (n, 2), n >= 4.
        second: the conjugate rays of photograph 2, shape (n, 2).
        tolerance: largest residual of a fitting pair, tangents.
        seed: seed of the random samples.
        max_trials: largest number of samples of five points.

    Returns:
        Orientations; the kind of the first one describes the scene. Infinite: a rotation explains the rays.
        Planar: both solutions of the homography, which fit equally well until more photographs decide, then
        the spatial one if there is one. Spatial: one orientation, adjusted by coplanarity, then the planar
        ones if the points are close enough to a plane for the tolerance.

    Raises:
        GeometryError: fewer than four pairs, or none that fit one geometry.

    Source: Nister (2004), IEEE PAMI 26(6), five-point start (cv2.findEssentialMat); Ma, Soatto, Kosecka,
    Sastry (2004), An Invitation to 3-D Vision, alg. 5.2 for the plane. F tests of the residual variances
    distinguish the kinds.
    """
    uv1 = np.ascontiguousarray(first, dtype=float).reshape(-1, 2)
    uv2 = np.ascontiguousarray(second, dtype=float).reshape(-1, 2)
    n = len(uv1)
    if n < PLANAR_POINTS or len(uv2) != n:
        raise GeometryError(
            f"relative orientation: {counted(n, 'common point')}, at least {PLANAR_POINTS} are needed"
        )
    H, on_plane = fit_homography(uv1, uv2, tolerance=tolerance, seed=seed)
    spatial: RelativeOrientation | None = None
    planar: list[RelativeOrientation] = []
    if on_plane.sum() >= max(PLANAR_POINTS, PLANAR_SHARE * n):
        infinite = _pure_rotation(H, uv1, uv2, on_plane, tolerance)
        if infinite is not None:
            # with a wide tolerance, a false base would fit all pairs of a small base
            spatial = (
                _spatial_orientation(uv1, uv2, NARROW * tolerance, seed, max_trials)
                if n >= SPATIAL_POINTS
                else None
            )
            if spatial is None or not BASE_EXPLAINS * spatial.sigma0 < infinite.sigma0:
                return (infinite,)
        planar = [
            _evaluate("planar", base, R, normal, uv1, uv2, on_plane)
            for base, R, normal in decompose_homography(H, uv1[on_plane])
        ]
    if spatial is None and n >= SPATIAL_POINTS:
        spatial = _spatial_orientation(uv1, uv2, tolerance, seed, max_trials)
    if spatial is not None:
        spatial = _nearest_to_coplanar(spatial, planar, uv1, uv2, tolerance)
    if spatial is None:
        if not planar:
            raise GeometryError(
                f"relative orientation: neither a plane nor a spatial scene fits {counted(n, 'common point')}"
            )
        return tuple(planar)
    if planar and _is_planar(H, uv1, uv2, spatial):
        return (*planar, spatial)
    return (spatial, *planar)


@checked_arguments(first="5 2", second="5 2")
def five_point_orientations(first: FloatArray, second: FloatArray) -> tuple[RelativeOrientation, ...]:
    """Return all spatial orientations that fit five conjugate rays, with the points before both photographs.

    Five pairs have no redundancy: up to ten orientations fit them exactly, and other knowledge decides.

    Args:
        first: tangents u = -U/W, v = -V/W of rays of photograph 1, shape (5, 2).
        second: the conjugate rays of photograph 2, shape (5, 2).

    Source: Nister (2004), IEEE PAMI 26(6) (cv2.findEssentialMat).
    """
    down = np.array([1.0, -1.0])
    uv1, uv2 = np.ascontiguousarray(first, dtype=float), np.ascontiguousarray(second, dtype=float)
    E, _ = cv2.findEssentialMat(uv1 * down, uv2 * down, np.eye(3), method=cv2.RANSAC)
    every = np.ones(len(uv1), dtype=bool)
    orientations = []
    for matrix in np.zeros((0, 3, 3)) if E is None else E.reshape(-1, 3, 3):
        count, R, t, _ = cv2.recoverPose(matrix, uv1 * down, uv2 * down, np.eye(3))[:4]
        if count < len(uv1):
            continue
        D = VISION_AXES
        rotation = (D @ np.asarray(R, dtype=np.float64) @ D).T
        base = -rotation @ D @ np.asarray(t, dtype=np.float64).ravel()
        orientations.append(
            _evaluate("spatial", base / np.linalg.norm(base), rotation, _NAN, uv1, uv2, every)
        )
    return tuple(orientations)


def model_points(first: FloatArray, second: FloatArray, pair: RelativeOrientation) -> FloatArray:
    """Return the intersections of the fitting pairs in the frame of photograph 1, NaN elsewhere, (n, 3).

    Args:
        first: tangents u = -U/W, v = -V/W of rays of photograph 1, shape (n, 2).
        second: the conjugate rays of photograph 2, shape (n, 2).
        pair: relative orientation.
    """
    n = len(first)
    image, point = np.repeat([0, 1], n), np.tile(np.arange(n), 2)
    positions = np.stack([np.zeros(3), pair.base])
    rotations = np.stack([np.eye(3), pair.rotation])
    points = intersect(np.concatenate([first, second]), image, point, positions, rotations, n_points=n).points
    return np.where(pair.inliers[:, None], points, np.nan)


def _pure_rotation(
    H: FloatArray, uv1: FloatArray, uv2: FloatArray, used: BoolArray, tolerance: float
) -> RelativeOrientation | None:
    """Return the rotation that explains the rays, None if a homography explains them better."""
    rays1 = np.concatenate([uv1, -np.ones((len(uv1), 1))], axis=1)
    R = rotation_from_position(uv2[used], rays1[used], np.zeros(3))
    off = transfer_residuals(R.T, uv1, uv2)
    if not np.isfinite(off[used]).all():
        return None
    n = int(used.sum())
    square = float(np.sum(off[used] ** 2))
    simple = bool(np.linalg.norm(off[used], axis=1).max() <= INFINITE_SHARE * tolerance)
    if n > PLANAR_POINTS:
        full = float(np.sum(transfer_residuals(H, uv1, uv2)[used] ** 2))
        r_full, extra = 2 * n - 8, 5
        ratio = (square - full) / extra / max(full / r_full, np.finfo(float).tiny)
        simple = simple or ratio <= fdtri(extra, r_full, CONFIDENCE)
        # noise-free rays of one station: both sums are rounding
        simple = simple or square <= (1e-12) ** 2 * n
    if not simple:
        return None
    redundancy = 2 * n - 3
    sigma0 = float(np.sqrt(square / redundancy / 2))  # differences of two photographs
    length = np.linalg.norm(off, axis=1)
    none = np.full((5, 5), np.nan)
    return RelativeOrientation(
        "infinite", _NAN, R, _NAN, length <= tolerance, length, sigma0, redundancy, none
    )


def _is_planar(H: FloatArray, uv1: FloatArray, uv2: FloatArray, spatial: RelativeOrientation) -> bool:
    """Return whether a plane explains the pairs as well as a spatial scene does, by the variance ratio."""
    used = spatial.inliers
    n = int(used.sum())
    if n <= PLANAR_POINTS or spatial.redundancy < 1:
        return False
    off = transfer_residuals(H, uv1, uv2)[used]
    if not np.isfinite(off).all():
        return False
    # a transfer residual contains the errors of both photographs
    variance = float(np.sum(off**2)) / (2 * n - 8) / 2
    ratio = variance / max(spatial.sigma0**2, np.finfo(float).tiny)
    return bool(ratio <= fdtri(2 * n - 8, spatial.redundancy, CONFIDENCE))


def _spatial_orientation(
    uv1: FloatArray, uv2: FloatArray, tolerance: float, seed: int, max_trials: int
) -> RelativeOrientation | None:
    """Return the orientation from a five-point start and coplanarity; None if fewer than six pairs fit."""
    down = np.array([1.0, -1.0])
    cv2.setRNGSeed(seed)
    E, mask = cv2.findEssentialMat(
        uv1 * down,
        uv2 * down,
        np.eye(3),
        method=cv2.RANSAC,
        prob=RANSAC_CONFIDENCE,
        threshold=tolerance,
        maxIters=max_trials,
    )
    if E is None or E.shape != (3, 3) or mask.sum() < SPATIAL_POINTS:
        return None
    used = mask.ravel().astype(bool)
    D = VISION_AXES
    _, R, t, front = cv2.recoverPose(E, uv1[used] * down, uv2[used] * down, np.eye(3), distanceThresh=1e9)[:4]
    if (front > 0).sum() < SPATIAL_POINTS:
        return None
    rotation = (D @ np.asarray(R, dtype=np.float64) @ D).T
    base = -rotation @ D @ np.asarray(t, dtype=np.float64).ravel()
    return _adjust_spatial(base / np.linalg.norm(base), rotation, uv1, uv2, used, tolerance)


def _nearest_to_coplanar(
    spatial: RelativeOrientation,
    planar: list[RelativeOrientation],
    uv1: FloatArray,
    uv2: FloatArray,
    tolerance: float,
) -> RelativeOrientation:
    """Return the orientation with the smallest residuals among the first one and the adjusted planar ones.

    With shallow relief and a wide tolerance, both orientations of a plane fit the rays, and random samples
    select either. An adjustment from the wrong one ends in another minimum, with larger residuals.
    """
    orientations = [spatial]
    orientations += [
        _adjust_spatial(start.base, start.rotation, uv1, uv2, start.inliers, tolerance) for start in planar
    ]
    squares = [
        float(np.sum(np.minimum(orientation.residuals, tolerance) ** 2)) for orientation in orientations
    ]
    return orientations[int(np.argmin(squares))]


def _adjust_spatial(
    base: FloatArray,
    rotation: FloatArray,
    uv1: FloatArray,
    uv2: FloatArray,
    used: BoolArray,
    tolerance: float,
) -> RelativeOrientation:
    """Adjust a spatial orientation by coplanarity, selecting the fitting pairs again until they stay."""
    best = _evaluate("spatial", base, rotation, _NAN, uv1, uv2, used)
    for _ in range(ROUNDS):
        try:
            b, R2, _, _ = refine_coplanarity(uv1[used], uv2[used], best.base, best.rotation)
        except GeometryError:
            return best
        best = _evaluate("spatial", b, R2, _NAN, uv1, uv2, used)
        new = best.residuals <= tolerance
        if new.sum() < SPATIAL_POINTS or np.array_equal(new, used):
            break
        used = new
    return best


def _evaluate(
    kind: str,
    base: FloatArray,
    rotation: FloatArray,
    normal: FloatArray,
    uv1: FloatArray,
    uv2: FloatArray,
    inliers: BoolArray,
) -> RelativeOrientation:
    """Return an orientation with residuals, sigma0 and normal equations from its fitting pairs."""
    redundancy = int(inliers.sum()) - UNKNOWNS
    residuals = np.abs(coplanarity_residuals(uv1, uv2, base, rotation)[0])
    sigma0, N = np.nan, np.full((5, 5), np.nan)
    if redundancy > 0:
        v, N = coplanarity_residuals(uv1[inliers], uv2[inliers], base, rotation)
        sigma0 = float(np.sqrt(np.sum(v**2) / redundancy))
    return RelativeOrientation(kind, base, rotation, normal, inliers, residuals, sigma0, redundancy, N)


@checked_arguments(first="n 2", second="n 2", base="3", rotation="3 3")
def refine_coplanarity(
    first: FloatArray, second: FloatArray, base: FloatArray, rotation: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return base, rotation, residuals and cofactors by least squares on the coplanarity condition.

    Args:
        first: tangents u = -U/W, v = -V/W of rays of photograph 1, shape (n, 2), n >= 5.
        second: the conjugate rays of photograph 2, shape (n, 2).
        base: approximate direction from projection centre 1 to 2 in image axes 1, shape (3,).
        rotation: approximate R, image axes 2 to image axes 1, shape (3, 3).

    Returns:
        Base (unit), rotation, distances from coplanarity in tangents (n,), and Qxx (5, 5) of two small
        rotations of b about axes across it and of w in R exp([w]x).

    Raises:
        GeometryError: fewer than five pairs, or pairs that do not determine the orientation.

    Source: b . (r1 x R r2) = 0, each equation divided by the norm of its gradient with respect to the
    image coordinates (Foerstner, Wrobel 2016, sec. 13.3.5); Gauss-Newton with five unknowns.
    """
    n = len(first)
    if n < UNKNOWNS or len(second) != n:
        raise GeometryError(f"relative orientation: {counted(n, 'pair')}, at least {UNKNOWNS} are needed")
    b, R = np.array(base, dtype=float), np.array(rotation, dtype=float, order="C")
    uv1 = np.ascontiguousarray(first, dtype=float)
    uv2 = np.ascontiguousarray(second, dtype=float)
    residuals, N = np.empty(len(uv1)), np.empty((UNKNOWNS, UNKNOWNS))
    if not _adjust_coplanarity(uv1, uv2, b, R, residuals, N):
        raise GeometryError(
            f"relative orientation: the {counted(len(uv1), 'pair')} do not determine five parameters"
        )
    return b, R, residuals, np.asarray(np.linalg.inv(N), dtype=float)


def coplanarity_residuals(
    first: FloatArray, second: FloatArray, base: FloatArray, rotation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the distances of conjugate rays from coplanarity, and the normal matrix of five parameters.

    Args:
        first: tangents u = -U/W, v = -V/W of rays of photograph 1, shape (n, 2).
        second: the conjugate rays of photograph 2, shape (n, 2).
        base: unit vector from projection centre 1 to 2 in image axes 1, shape (3,).
        rotation: R, image axes 2 to image axes 1, shape (3, 3).

    Returns:
        Distances in tangents, (n,); normal matrix of two rotations of b and of w in R exp([w]x), (5, 5).

    Source: as for `refine_coplanarity`.
    """
    residuals, N, b = np.empty(len(first)), np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    uv1, uv2 = np.ascontiguousarray(first, dtype=float), np.ascontiguousarray(second, dtype=float)
    _coplanarity_normals(uv1, uv2, base, np.ascontiguousarray(rotation), residuals, N, b)
    return residuals, N


def turned_pair(base: FloatArray, rotation: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return base and rotation after a step of the five unknowns.

    Args:
        base: unit vector from projection centre 1 to 2, shape (3,).
        rotation: R, image axes 2 to image axes 1, shape (3, 3).
        step: two small rotations of b, and w in R exp([w]x), rad, shape (5,).
    """
    new_base, new_rotation = np.empty(3), np.empty((3, 3))
    _turn_base(base, step[0], step[1], new_base)
    turn(np.ascontiguousarray(rotation), step[2], step[3], step[4], new_rotation)
    return new_base, new_rotation


@compiled
def _adjust_coplanarity(
    uv1: FloatArray, uv2: FloatArray, base: FloatArray, R: FloatArray, residuals: FloatArray, N: FloatArray
) -> bool:
    """Adjust base and R in place by Gauss-Newton with halved steps; False if singular."""
    b5, dx = np.empty(5), np.empty(5)
    new_base, new_R, new_N, new_b = np.empty(3), np.empty((3, 3)), np.empty((5, 5)), np.empty(5)
    cost = _coplanarity_normals(uv1, uv2, base, R, residuals, N, b5)
    for _ in range(MAX_STEPS):
        if not solve_scaled(N, b5, dx):
            return False
        factor = 1.0
        improved = False
        for _half in range(HALVINGS):
            _turn_base(base, factor * dx[0], factor * dx[1], new_base)
            turn(R, factor * dx[2], factor * dx[3], factor * dx[4], new_R)
            new_cost = _coplanarity_normals(uv1, uv2, new_base, new_R, residuals, new_N, new_b)
            if new_cost <= cost * (1.0 + 1e-9) + 1e-300:
                improved = True
                break
            factor *= 0.5
        if not improved:
            _coplanarity_normals(uv1, uv2, base, R, residuals, N, b5)
            return True
        cost = new_cost
        base[:], R[:], N[:], b5[:] = new_base, new_R, new_N, new_b
        if factor == 1.0 and np.abs(dx).sum() < CONVERGED:
            return True
    return True


@compiled
def _across(base: FloatArray, p: FloatArray, q: FloatArray) -> None:
    """Fill two unit vectors perpendicular to the base and to each other."""
    k = 0
    for d in range(1, 3):
        if abs(base[d]) < abs(base[k]):
            k = d
    p[:] = -base[k] * base
    p[k] += 1.0
    p /= np.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2)
    cross(base, p, q)


@compiled
def _turn_base(base: FloatArray, s: float, t: float, out: FloatArray) -> None:
    """Fill the base rotated by two small angles about axes across it."""
    p, q = np.empty(3), np.empty(3)
    _across(base, p, q)
    out[:] = base + s * p + t * q
    out /= np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)


@compiled
def _coplanarity_normals(
    uv1: FloatArray,
    uv2: FloatArray,
    base: FloatArray,
    R: FloatArray,
    residuals: FloatArray,
    N: FloatArray,
    b5: FloatArray,
) -> float:
    """Fill the normal equations for two rotations of b and w, with gradient-normed conditions; return v'v."""
    N[:] = 0.0
    b5[:] = 0.0
    p, q = np.empty(3), np.empty(3)
    _across(base, p, q)
    cost = 0.0
    r1, r2, g, h, a, J = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(5)
    for i in range(len(uv1)):
        r1[0], r1[1], r1[2] = uv1[i, 0], uv1[i, 1], -1.0
        x, y = uv2[i, 0], uv2[i, 1]
        for d in range(3):
            r2[d] = R[d, 0] * x + R[d, 1] * y - R[d, 2]
        # e = b . (r1 x r2) = r1 . (r2 x b) = r2 . (b x r1)
        cross(r2, base, g)
        cross(base, r1, h)
        cross(r1, r2, a)
        e = base[0] * a[0] + base[1] * a[1] + base[2] * a[2]
        # gradient with respect to the image coordinates of both photographs
        gx = R[0, 0] * h[0] + R[1, 0] * h[1] + R[2, 0] * h[2]
        gy = R[0, 1] * h[0] + R[1, 1] * h[1] + R[2, 1] * h[2]
        gz = R[0, 2] * h[0] + R[1, 2] * h[1] + R[2, 2] * h[2]
        norm = np.sqrt(g[0] ** 2 + g[1] ** 2 + gx * gx + gy * gy)
        if norm == 0.0:
            residuals[i] = 0.0
            continue
        v = e / norm
        residuals[i] = v
        cost += v * v
        J[0] = (p[0] * a[0] + p[1] * a[1] + p[2] * a[2]) / norm
        J[1] = (q[0] * a[0] + q[1] * a[1] + q[2] * a[2]) / norm
        # d(R r) = R (w x r): e changes by w . (r x R'h), r = (x, y, -1)
        J[2] = (y * gz + gy) / norm
        J[3] = (-gx - x * gz) / norm
        J[4] = (x * gy - y * gx) / norm
        for m in range(5):
            b5[m] -= J[m] * v
            for k in range(5):
                N[m, k] += J[m] * J[k]
    return cost
