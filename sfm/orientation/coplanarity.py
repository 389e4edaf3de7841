"""The coplanarity condition of conjugate rays, adjusted with five unknowns."""

from __future__ import annotations

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import FloatArray
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.kernels.options import compiled
from sfm.kernels.small_algebra import cross, solve_scaled, turn

UNKNOWNS = 5
MAX_STEPS = 30
CONVERGED = 1e-12  # sum of the five steps, rad
HALVINGS = 8


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
        turns of b about axes across it and of w in R exp([w]x).

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
    """Return how far conjugate rays are from coplanarity, and the normal matrix of the five parameters.

    Args:
        first: tangents u = -U/W, v = -V/W of rays of photograph 1, shape (n, 2).
        second: the conjugate rays of photograph 2, shape (n, 2).
        base: unit vector from projection centre 1 to 2 in image axes 1, shape (3,).
        rotation: R, image axes 2 to image axes 1, shape (3, 3).

    Returns:
        Distances in tangents, (n,); normal matrix of two turns of b and of w in R exp([w]x), (5, 5).

    Source: as `refine_coplanarity`.
    """
    residuals, N, b = np.empty(len(first)), np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    uv1, uv2 = np.ascontiguousarray(first, dtype=float), np.ascontiguousarray(second, dtype=float)
    _coplanarity_normals(uv1, uv2, base, np.ascontiguousarray(rotation), residuals, N, b)
    return residuals, N


def turned_pair(base: FloatArray, rotation: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return base and rotation after a step of the five unknowns: two turns of b, and w in R exp([w]x)."""
    new_base, new_rotation = np.empty(3), np.empty((3, 3))
    _turn_base(base, step[0], step[1], new_base)
    turn(np.ascontiguousarray(rotation), step[2], step[3], step[4], new_rotation)
    return new_base, new_rotation


@compiled
def _adjust_coplanarity(
    uv1: FloatArray, uv2: FloatArray, base: FloatArray, R: FloatArray, residuals: FloatArray, N: FloatArray
) -> bool:
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


@compiled
def _across(base: FloatArray, p: FloatArray, q: FloatArray) -> None:
    """Fill two unit vectors at right angles to the base."""
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
    """Fill the base turned by two small angles across it."""
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
    """Fill the normal equations of (two turns of b, w), each divided by its gradient; return v'v."""
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
