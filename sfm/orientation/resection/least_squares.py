"""Space resection by least squares: the collinearity equations, with history and dispersion matrix."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import BoolArray, FloatArray, rotation_from_angles
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.kernels.compiling import compiled
from sfm.kernels.small_algebra import solve_scaled, turn

UNKNOWNS = 6
MAX_STEPS = 50
HALVINGS = 8
CONVERGED = 1e-12  # step relative to the distance of the points and to 1 rad


@dataclass(frozen=True)
class Resection:
    """Exterior orientation of one photograph by least squares over its points."""

    position: FloatArray  # projection centre X0, object unit, (3,)
    rotation: FloatArray  # R, image to object axes, (3, 3)
    residuals: FloatArray  # v = computed - measured, tangents, (n, 2)
    sigma0: float  # a posteriori standard deviation of unit weight; NaN without redundancy
    redundancy: int  # 2 n - 6
    cofactors: FloatArray  # Qxx of X0, Y0, Z0 (object unit) and omega, phi, kappa (rad), (6, 6)
    covariance: FloatArray  # sigma0^2 Qxx; NaN without redundancy, (6, 6)
    history: FloatArray  # X0, Y0, Z0, omega, phi, kappa before the first and after every step, (s + 1, 6)
    converged: bool  # whether the last step was negligible

    @property
    def rms(self) -> float:
        """Root mean square residual per coordinate, tangents."""
        return float(np.sqrt(np.mean(self.residuals**2)))


@checked_arguments(tangents="n 2", points="n 3", position="3", rotation="3 3", weights="n 2 2")
def resect_least_squares(
    tangents: FloatArray,
    points: FloatArray,
    position: FloatArray,
    rotation: FloatArray,
    *,
    weights: FloatArray | None = None,
    max_steps: int = MAX_STEPS,
) -> Resection:
    """Return the exterior orientation that minimises the weighted squares of the image residuals.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, free of distortion, shape (n, 2).
        points: object points, shape (n, 3), object unit.
        position: approximate projection centre X0, shape (3,), object unit.
        rotation: approximate R, image to object axes, shape (3, 3).
        weights: weight matrix of each image point, shape (n, 2, 2); unit matrices if not given, so that
            sigma0 is a tangent (times c: mm on the image).
        max_steps: largest number of Gauss-Newton steps.

    Raises:
        GeometryError: fewer than three points, points that do not determine the orientation, or start
            values from which points lie behind the camera.

    Source: Kraus (2007), sec. 4.2.1; Gauss-Newton, a step halved while it raises the sum of squares.
    """
    n = len(points)
    if n < 3:
        raise GeometryError(f"resection: {counted(n, 'point')}, least squares needs at least 3")
    P = np.broadcast_to(np.eye(2), (n, 2, 2)) if weights is None else weights
    uv = np.ascontiguousarray(tangents, dtype=float)
    xyz = np.ascontiguousarray(points, dtype=float)
    X0, R = np.array(position, dtype=float), np.array(rotation, dtype=float)
    history = np.empty((max_steps + 1, UNKNOWNS))
    N, residuals = np.empty((UNKNOWNS, UNKNOWNS)), np.empty((n, 2))
    used = np.ones(n, dtype=np.bool_)
    P = np.ascontiguousarray(P, dtype=float)
    cost, steps, state = adjust_pose(uv, xyz, P, used, X0, R, max_steps, history, N, residuals)
    if state == BEHIND:
        raise GeometryError("resection: points lie behind the camera at the start values")
    if state == RANK:
        raise GeometryError(
            f"resection: the {counted(n, 'point')} do not determine position and rotation (collinear or "
            "coincident)"
        )
    redundancy = 2 * n - UNKNOWNS
    cofactors = cofactors_in_angles(np.asarray(np.linalg.inv(N), dtype=float), R)
    sigma0 = float(np.sqrt(cost / redundancy)) if redundancy > 0 else np.nan
    return Resection(
        X0,
        R,
        residuals,
        sigma0,
        redundancy,
        cofactors,
        sigma0**2 * cofactors,
        history[: steps + 1],
        state == DONE,
    )


def cofactors_in_angles(cofactors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return cofactors of X0 and (omega, phi, kappa) from those of X0 and a small rotation in image axes.

    Args:
        cofactors: of X0 and of w in R exp([w]x), shape (6, 6).
        rotation: R, shape (3, 3).

    Returns:
        Shape (6, 6). At phi = +-90 deg omega and kappa are not separable and the pseudo-inverse is used.
    """
    J = np.eye(6)
    J[3:, 3:] = np.linalg.pinv(_rotation_from_angle_rates(rotation))
    return J @ cofactors @ J.T


def _rotation_from_angle_rates(rotation: FloatArray) -> FloatArray:
    """Return d w / d (omega, phi, kappa), w the rotation in image axes: columns Rz'Ry'ex, Rz'ey, ez."""
    phi = np.arcsin(np.clip(rotation[0, 2], -1.0, 1.0))
    kappa = np.arctan2(-rotation[0, 1], rotation[0, 0])
    Rz = rotation_from_angles(0.0, 0.0, kappa)
    Ry = rotation_from_angles(0.0, phi, 0.0)
    return np.stack([(Ry @ Rz)[0], Rz[1], np.array([0.0, 0.0, 1.0])], axis=1)


DONE, LIMIT, BEHIND, RANK = 0, 1, 2, 3  # how an adjustment of one pose ends


@compiled
def adjust_pose(
    tangents: FloatArray,
    points: FloatArray,
    weights: FloatArray,
    used: BoolArray,
    X0: FloatArray,
    R: FloatArray,
    max_steps: int,
    history: FloatArray,
    N: FloatArray,
    residuals: FloatArray,
) -> tuple[float, int, int]:
    """Adjust X0 and R in place; fill history, N (of X0 and w) and residuals; return v'Pv, steps, state."""
    n_vector, new_n, new_N = np.empty(6), np.empty(6), np.empty((6, 6))
    new_X0, new_R = np.empty(3), np.empty((3, 3))
    dx = np.empty(6)
    cost, distance = pose_normals(tangents, points, weights, used, X0, R, N, n_vector, residuals)
    _note(history[:1], X0, R)
    if not np.isfinite(cost):
        return cost, 0, BEHIND
    steps = 0
    for _ in range(max_steps):
        if not solve_scaled(N, n_vector, dx):
            return cost, steps, RANK
        factor = 1.0
        improved = False
        for _half in range(HALVINGS):
            for d in range(3):
                new_X0[d] = X0[d] + factor * dx[d]
            turn(R, factor * dx[3], factor * dx[4], factor * dx[5], new_R)
            new_cost, new_distance = pose_normals(
                tangents, points, weights, used, new_X0, new_R, new_N, new_n, residuals
            )
            if new_cost <= cost * (1.0 + 1e-9) + 1e-300:
                improved = True
                break
            factor *= 0.5
        if not improved:
            # the last residuals belong to a refused step
            cost, distance = pose_normals(tangents, points, weights, used, X0, R, N, n_vector, residuals)
            return cost, steps, LIMIT
        cost, distance = new_cost, new_distance
        X0[:], R[:], N[:], n_vector[:] = new_X0, new_R, new_N, new_n
        steps += 1
        _note(history[steps : steps + 1], X0, R)
        if (
            factor == 1.0
            and abs(dx[0]) + abs(dx[1]) + abs(dx[2]) < CONVERGED * distance
            and abs(dx[3]) + abs(dx[4]) + abs(dx[5]) < CONVERGED
        ):
            return cost, steps, DONE
    return cost, steps, LIMIT


@compiled
def _note(history: FloatArray, X0: FloatArray, R: FloatArray) -> None:
    """Write position and angles into a row of the history, (1, 6), if there is one, (0, 6)."""
    for row in history:
        for p in range(3):
            row[p] = X0[p]
        row[3] = np.arctan2(-R[1, 2], R[2, 2])
        row[4] = np.arcsin(min(1.0, max(-1.0, R[0, 2])))
        row[5] = np.arctan2(-R[0, 1], R[0, 0])


@compiled
def pose_normals(
    tangents: FloatArray,
    points: FloatArray,
    weights: FloatArray,
    used: BoolArray,
    X0: FloatArray,
    R: FloatArray,
    N: FloatArray,
    n_vector: FloatArray,
    residuals: FloatArray,
) -> tuple[float, float]:
    """Normal equations of X0 and w (R exp([w]x)); returns v'Pv (inf: a point behind) and mean distance."""
    N[:] = 0.0
    n_vector[:] = 0.0
    cost, distance, count = 0.0, 0.0, 0
    A = np.empty((2, 6))
    for i in range(len(points)):
        dx, dy, dz = points[i, 0] - X0[0], points[i, 1] - X0[1], points[i, 2] - X0[2]
        U = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
        V = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
        W = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
        if not W < 0.0:
            residuals[i, 0] = residuals[i, 1] = np.nan
            if used[i]:
                return np.inf, 0.0
            continue
        u, v = -U / W, -V / W
        ru, rv = u - tangents[i, 0], v - tangents[i, 1]
        residuals[i, 0], residuals[i, 1] = ru, rv
        if not used[i]:
            continue
        distance += np.sqrt(dx * dx + dy * dy + dz * dz)
        count += 1
        # du = -(dU + u dW) / W and d(U, V, W) = -M dX0 - w x (U, V, W)
        for d in range(3):
            A[0, d] = (R[d, 0] + u * R[d, 2]) / W
            A[1, d] = (R[d, 1] + v * R[d, 2]) / W
        A[0, 3] = -u * v
        A[0, 4] = 1.0 + u * u
        A[0, 5] = v
        A[1, 3] = -1.0 - v * v
        A[1, 4] = u * v
        A[1, 5] = -u
        p, q, r = weights[i, 0, 0], weights[i, 0, 1], weights[i, 1, 1]
        cost += p * ru * ru + 2.0 * q * ru * rv + r * rv * rv
        for a in range(6):
            pa, qa = p * A[0, a] + q * A[1, a], q * A[0, a] + r * A[1, a]
            n_vector[a] -= pa * ru + qa * rv
            for b in range(a, 6):
                N[a, b] += pa * A[0, b] + qa * A[1, b]
    for a in range(6):
        for b in range(a):
            N[a, b] = N[b, a]
    return cost, distance / max(count, 1)
