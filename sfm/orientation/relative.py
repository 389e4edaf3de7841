"""Relative orientation of two photographs from conjugate rays: spatial, planar and infinite scenes.

Photograph 1 is the frame: X0 = 0, R = I, image axes of photograph 1. Photograph 2 has the base b
(length 1, as scale is not determined) and R, from image axes 2 to image axes 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit

from sfm.conventions import BoolArray, FloatArray, skew
from sfm.errors import GeometryError
from sfm.orientation.intersection import intersect
from sfm.orientation.resection.least_squares import solve_scaled, turn

SPATIAL_POINTS = 6  # five points give up to ten solutions, the sixth tells them apart
PLANAR_POINTS = 4
UNKNOWNS = 5
MAX_STEPS = 30
CONVERGED = 1e-12
HALVINGS = 8
PLANAR_SHARE = 0.8  # share of the points on one homography from which on a scene may be planar
RANSAC_CONFIDENCE = 0.9999
RANSAC_TRIALS = 2000
NO_BASE = 1e-9  # (sigma1 - sigma3) of a homography of unit sigma2 below which it is a rotation
_IMAGE_FROM_VISION = np.diag([1.0, -1.0, -1.0])  # cv2: y down, looking along +z


@dataclass(frozen=True)
class RelativeOrientation:
    """Photograph 2 in the frame of photograph 1."""

    kind: str  # spatial | planar | infinite (no base: the same standpoint, or all points far away)
    base: FloatArray  # unit vector from projection centre 1 to 2; NaN if infinite, (3,)
    rotation: FloatArray  # R, image axes 2 to image axes 1, (3, 3)
    normal: FloatArray  # unit normal of the plane, towards photograph 1 away; NaN if spatial, (3,)
    inliers: BoolArray  # point pairs that fit, (n,)
    residuals: FloatArray  # distance from coplanarity of each pair, tangents, (n,)
    sigma0: float  # a posteriori standard deviation of an image coordinate, tangents
    redundancy: int  # fitting pairs - 5
    covariance: FloatArray  # of two small turns of b (across it) and w in R exp([w]x), rad, (5, 5)

    @property
    def rms(self) -> float:
        """Root mean square residual of the fitting pairs, tangents."""
        return float(np.sqrt(np.mean(self.residuals[self.inliers] ** 2)))


def relative_orientations(
    first: FloatArray, second: FloatArray, *, tolerance: float, seed: int = 0
) -> tuple[RelativeOrientation, ...]:
    """Return the relative orientations that conjugate rays allow, from nothing but the rays.

    Args:
        first, second: tangents u = -U/W, v = -V/W of conjugate rays of photographs 1 and 2, (n, 2) each.
        tolerance: largest residual of a fitting pair, tangents.
        seed: of the random samples.

    Returns:
        Spatial scene: one orientation, refined by coplanarity. Planar scene: both solutions of the
        homography (they fit equally well; more photographs decide), after the spatial one if there are
        points enough to have one. Rays that a rotation alone explains: one orientation of kind infinite.

    Raises:
        GeometryError: fewer than four pairs, or none that fit one geometry.

    Source: Nister (2004), IEEE PAMI 26(6), five-point start (cv2.findEssentialMat); Ma, Soatto, Kosecka,
    Sastry (2004), An Invitation to 3-D Vision, alg. 5.2 for the plane.
    """
    uv1, uv2 = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    n = len(uv1)
    if n < PLANAR_POINTS:
        raise GeometryError(f"relative orientation: {n} common points, at least {PLANAR_POINTS} are needed")
    found: list[RelativeOrientation] = []
    H, on_plane = fit_homography(uv1, uv2, tolerance=tolerance, seed=seed)
    if on_plane.sum() >= max(PLANAR_POINTS, PLANAR_SHARE * n):
        planar = decompose_homography(H, uv1[on_plane], uv2[on_plane])
        found = [_evaluate(kind, b, R, normal, uv1, uv2, on_plane) for kind, b, R, normal in planar]
        if found[0].kind == "infinite":
            return tuple(found)
    if n >= SPATIAL_POINTS:
        spatial = _spatial(uv1, uv2, tolerance, seed)
        if spatial is not None:
            found.insert(0, spatial)
    if not found:
        raise GeometryError(f"relative orientation: the {n} common points fit no plane and no spatial scene")
    return tuple(found)


def refine_coplanarity(
    first: FloatArray, second: FloatArray, base: FloatArray, rotation: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return base, rotation, residuals and cofactors by least squares on the coplanarity condition.

    Args:
        first, second: tangents of conjugate rays, shape (n, 2) each, n >= 5.
        base, rotation: start values, shapes (3,) and (3, 3).

    Returns:
        Base (unit), rotation, distances from coplanarity in tangents (n,), and Qxx (5, 5) of two small
        turns of b about axes across it and of w in R exp([w]x).

    Raises:
        GeometryError: the pairs do not determine the orientation.

    Source: b . (r1 x R r2) = 0, each equation divided by the norm of its gradient with respect to the
    image coordinates (Foerstner, Wrobel 2016, sec. 13.3.5); Gauss-Newton with five unknowns.
    """
    b, R = np.array(base, dtype=float), np.array(rotation, dtype=float)
    uv1 = np.ascontiguousarray(first, dtype=float)
    uv2 = np.ascontiguousarray(second, dtype=float)
    residuals, N = np.empty(len(uv1)), np.empty((UNKNOWNS, UNKNOWNS))
    if not _adjust_coplanarity(uv1, uv2, b, R, residuals, N):
        raise GeometryError(f"relative orientation: the {len(uv1)} pairs do not determine five parameters")
    return b, R, residuals, _inverse(N)


def fit_homography(
    first: FloatArray, second: FloatArray, *, tolerance: float, seed: int = 0
) -> tuple[FloatArray, BoolArray]:
    """Return H with r2 ~ H r1 for rays r = (u, v, -1), and the pairs that fit it.

    Args:
        first, second: tangents of conjugate rays, shape (n, 2) each, n >= 4.
        tolerance: largest residual in photograph 2, tangents.
        seed: of the random samples.
    """
    n = len(first)
    used = np.ones(n, dtype=bool)
    if n > PLANAR_POINTS:
        cv2.setRNGSeed(seed)
        _, mask = cv2.findHomography(first, second, cv2.RANSAC, tolerance, maxIters=RANSAC_TRIALS)
        if mask is None or mask.sum() < PLANAR_POINTS:
            return np.eye(3), np.zeros(n, dtype=bool)
        used = mask.ravel().astype(bool)
    H = _direct_homography(first[used], second[used])
    r1, r2 = _rays(first), _rays(second)
    mapped = r1 @ H.T
    if np.sum(mapped[used] * r2[used]) < 0:
        H, mapped = -H, -mapped
    with np.errstate(divide="ignore", invalid="ignore"):
        residuals = np.linalg.norm(-mapped[:, :2] / mapped[:, 2:] - second, axis=1)
    return H, (mapped[:, 2] < 0) & (residuals <= tolerance)


def decompose_homography(
    H: FloatArray, first: FloatArray, second: FloatArray
) -> list[tuple[str, FloatArray, FloatArray, FloatArray]]:
    """Return (kind, base, rotation, normal) of the one or two camera pairs that a homography stands for.

    Args:
        H: r2 ~ H r1 for rays r = (u, v, -1), its sign such that depths are positive, shape (3, 3).
        first, second: tangents of conjugate rays on the plane, shape (n, 2) each.

    Returns:
        Both solutions that have the plane in front of photograph 1; one of kind infinite for a rotation.

    Source: Ma et al. (2004), alg. 5.2: H = R' + t n', from the eigenvectors of H'H.
    """
    _, s, Vt = np.linalg.svd(H)
    H = H / s[1]
    s1, s3 = s[0] / s[1], s[2] / s[1]
    nan = np.full(3, np.nan)
    if s1 - s3 < NO_BASE:
        U, _, Wt = np.linalg.svd(H)
        return [("infinite", nan, (U @ Wt).T, nan)]
    v1, v2, v3 = Vt
    p, q = np.sqrt(max(1 - s3**2, 0.0)), np.sqrt(max(s1**2 - 1, 0.0))
    solutions = []
    for sign in (1.0, -1.0):
        u = (p * v1 + sign * q * v3) / np.sqrt(s1**2 - s3**2)
        normal = np.cross(v2, u)
        R21 = np.stack([H @ v2, H @ u, np.cross(H @ v2, H @ u)], axis=1) @ np.stack([v2, u, normal])
        t = (H - R21) @ normal
        if np.sum(_rays(first) @ normal) < 0:
            normal, t = -normal, -t
        base = -R21.T @ t
        solutions.append(("planar", base / np.linalg.norm(base), R21.T, normal))
    if abs(solutions[0][3] @ solutions[1][3]) > 1 - NO_BASE:
        return solutions[:1]
    return solutions


def model_points(first: FloatArray, second: FloatArray, pair: RelativeOrientation) -> FloatArray:
    """Return the points that the fitting pairs intersect in, frame of photograph 1, NaN elsewhere, (n, 3)."""
    n = len(first)
    image, point = np.repeat([0, 1], n), np.tile(np.arange(n), 2)
    positions = np.stack([np.zeros(3), pair.base])
    rotations = np.stack([np.eye(3), pair.rotation])
    points = intersect(np.concatenate([first, second]), image, point, positions, rotations, n_points=n).points
    return np.where(pair.inliers[:, None], points, np.nan)


def _spatial(uv1: FloatArray, uv2: FloatArray, tolerance: float, seed: int) -> RelativeOrientation | None:
    """Five-point start and refinement by coplanarity; None if fewer than six pairs fit."""
    down = np.array([1.0, -1.0])
    cv2.setRNGSeed(seed)
    E, mask = cv2.findEssentialMat(
        uv1 * down,
        uv2 * down,
        np.eye(3),
        method=cv2.RANSAC,
        prob=RANSAC_CONFIDENCE,
        threshold=tolerance,
        maxIters=RANSAC_TRIALS,
    )
    if E is None or E.shape != (3, 3) or mask.sum() < SPATIAL_POINTS:
        return None
    used = mask.ravel().astype(bool)
    D = _IMAGE_FROM_VISION
    _, R, t, front = cv2.recoverPose(E, uv1[used] * down, uv2[used] * down, np.eye(3), distanceThresh=1e9)[:4]
    if (front > 0).sum() < SPATIAL_POINTS:
        return None
    rotation = (D @ np.asarray(R, dtype=np.float64) @ D).T
    base = -rotation @ D @ np.asarray(t, dtype=np.float64).ravel()
    nan = np.full(3, np.nan)
    best = _evaluate("spatial", base / np.linalg.norm(base), rotation, nan, uv1, uv2, used)
    for _ in range(5):
        try:
            b, R2, _, _ = refine_coplanarity(uv1[used], uv2[used], best.base, best.rotation)
        except GeometryError:
            return best
        best = _evaluate("spatial", b, R2, nan, uv1, uv2, used)
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
    """Residuals, sigma0 and covariance of an orientation over its fitting pairs."""
    n = int(inliers.sum())
    redundancy = n - UNKNOWNS
    empty = RelativeOrientation(
        kind, base, rotation, normal, inliers, np.zeros(len(uv1)), np.nan, redundancy, np.full((5, 5), np.nan)
    )
    if kind == "infinite":
        return empty
    all1, all2 = np.ascontiguousarray(uv1), np.ascontiguousarray(uv2)
    residuals, N, b = np.empty(len(uv1)), np.empty((5, 5)), np.empty(5)
    _coplanarity_normals(all1, all2, base, rotation, residuals, N, b)
    if redundancy <= 0 or kind == "planar":
        return replace(empty, residuals=residuals)
    own = np.empty(n)
    cost = _coplanarity_normals(all1[inliers], all2[inliers], base, rotation, own, N, b)
    sigma0 = float(np.sqrt(cost / redundancy))
    covariance = sigma0**2 * _inverse(N)
    return replace(empty, residuals=residuals, sigma0=sigma0, covariance=covariance)


def _direct_homography(first: FloatArray, second: FloatArray) -> FloatArray:
    """Direct linear solution with conditioned coordinates (Hartley, Zisserman 2004, alg. 4.2)."""
    T1, T2 = _conditioner(first), _conditioner(second)
    r1, r2 = _rays(first) @ T1.T, _rays(second) @ T2.T
    rows = np.einsum("nij,nk->nijk", skew(r2), r1).reshape(-1, 9)
    h = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    return np.linalg.inv(T2) @ h @ T1


def _inverse(N: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(N), dtype=float)


def _conditioner(uv: FloatArray) -> FloatArray:
    centre = uv.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum((uv - centre) ** 2, axis=1)) / 2)
    return np.array([[1, 0, centre[0]], [0, 1, centre[1]], [0, 0, spread]]) / spread


def _rays(uv: FloatArray) -> FloatArray:
    return np.concatenate([uv, -np.ones((len(uv), 1))], axis=1)


@njit(cache=True)
def _adjust_coplanarity(uv1, uv2, base, R, residuals, N):  # type: ignore[no-untyped-def]
    """Gauss-Newton in place with halved steps; False if singular."""
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


@njit(cache=True)
def _across(base, p, q):  # type: ignore[no-untyped-def]
    """Two unit vectors across the base."""
    k = 0
    for d in range(1, 3):
        if abs(base[d]) < abs(base[k]):
            k = d
    p[:] = -base[k] * base
    p[k] += 1.0
    p /= np.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2)
    q[0] = base[1] * p[2] - base[2] * p[1]
    q[1] = base[2] * p[0] - base[0] * p[2]
    q[2] = base[0] * p[1] - base[1] * p[0]


@njit(cache=True)
def _turn_base(base, s, t, out):  # type: ignore[no-untyped-def]
    p, q = np.empty(3), np.empty(3)
    _across(base, p, q)
    out[:] = base + s * p + t * q
    out /= np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)


@njit(cache=True)
def _coplanarity_normals(uv1, uv2, base, R, residuals, N, b5):  # type: ignore[no-untyped-def]
    """Normal equations of (two turns of b, w); each equation divided by its gradient; returns v'v."""
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
        _cross(r2, base, g)
        _cross(base, r1, h)
        _cross(r1, r2, a)
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


@njit(cache=True)
def _cross(a, b, out):  # type: ignore[no-untyped-def]
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
