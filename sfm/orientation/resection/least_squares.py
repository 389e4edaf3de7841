"""Space resection by least squares, and criteria that distinguish the correct orientation from others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import BoolArray, FloatArray, rotation_from_angles
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.runtime.compiling import compiled
from sfm.runtime.small_algebra import solve_scaled, turn

COINCIDENT = 1e-9  # largest distance of coincident points, relative to their extent
COLLINEAR = 1e-7  # largest ratio of the second singular value to the first for collinear points
MIN_TO_CHOOSE = 4  # every solution fits three points
UNKNOWNS = 6
MAX_STEPS = 50
HALVINGS = 8
CONVERGED = 1e-12  # last step, relative to the distance of the points and to 1 rad


@dataclass(frozen=True)
class Resection:
    """Exterior orientation of one photograph by least squares."""

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
        weights: weight matrix of each image point, shape (n, 2, 2). Unit matrices if not given; then sigma0
            is a tangent (times c: mm on the image).
        max_steps: largest number of Gauss-Newton steps.

    Raises:
        GeometryError: fewer than three points, points that do not determine the orientation, or points
            behind the camera at the start values.

    Source: Kraus (2007), sec. 4.2.1; Gauss-Newton, with steps halved while they raise the sum of squares.
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
        cofactors: cofactors of X0 and of w in R exp([w]x), shape (6, 6).
        rotation: R, shape (3, 3).

    Returns:
        Cofactors, shape (6, 6). At phi = +-90 deg, where omega and kappa are not separable, the
        pseudo-inverse is used.
    """
    J = np.eye(6)
    # d w / d (omega, phi, kappa), w the rotation in image axes, has the columns Rz'Ry'ex, Rz'ey, ez
    phi = np.arcsin(np.clip(rotation[0, 2], -1.0, 1.0))
    kappa = np.arctan2(-rotation[0, 1], rotation[0, 0])
    Rz = rotation_from_angles(0.0, 0.0, kappa)
    Ry = rotation_from_angles(0.0, phi, 0.0)
    rates = np.stack([(Ry @ Rz)[0], Rz[1], np.array([0.0, 0.0, 1.0])], axis=1)
    J[3:, 3:] = np.linalg.pinv(rates)
    return J @ cofactors @ J.T


DONE, LIMIT, BEHIND, RANK = 0, 1, 2, 3  # results of the adjustment of one pose


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
    """Adjust X0 and R in place; fill history, N (of X0 and w) and residuals; return v'Pv, steps, state.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, (n, 2).
        points: object points, (n, 3).
        weights: weight matrices of the image points, (n, 2, 2).
        used: points that take part, (n,).
        X0: projection centre, (3,).
        R: rotation, image to object axes, (3, 3).
        max_steps: largest number of steps.
        history: receives position and angles, (steps + 1, 6) or (0, 6).
        N: receives the normal matrix, (6, 6).
        residuals: receives the residuals, (n, 2).
    """
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
    """Fill the normal equations of X0 and w in R exp([w]x); return v'Pv and the mean distance.

    v'Pv is infinite if a point is behind the camera.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, (n, 2).
        points: object points, (n, 3).
        weights: weight matrices of the image points, (n, 2, 2).
        used: points that take part, (n,).
        X0: projection centre, (3,).
        R: rotation, image to object axes, (3, 3).
        N: receives the normal matrix, (6, 6).
        n_vector: receives the right-hand side, (6,).
        residuals: receives the residuals, (n, 2).
    """
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


@dataclass(frozen=True)
class ResectionSolution:
    """An exterior orientation with its residuals at the image points."""

    position: FloatArray  # projection centre X0, object unit, (3,)
    rotation: FloatArray  # R, image to object axes, (3, 3)
    residuals: FloatArray  # v = computed - measured, tangents; NaN for points behind the camera, (n, 2)

    @property
    def rms(self) -> float:
        """Root mean square residual per coordinate, tangents; inf if a point is behind the camera."""
        if not np.isfinite(self.residuals).all():
            return np.inf
        return float(np.sqrt(np.mean(self.residuals**2)))


def solution_of(
    position: FloatArray, rotation: FloatArray, tangents: FloatArray, points: FloatArray
) -> ResectionSolution:
    """Return an exterior orientation with its residuals at the given points.

    Args:
        position: projection centre X0, shape (3,), object unit.
        rotation: R, image to object axes, shape (3, 3).
        tangents: u = -U/W, v = -V/W of the measured rays, shape (n, 2).
        points: object points, shape (n, 3), object unit.
    """
    return ResectionSolution(position, rotation, tangents_of(position, rotation, points) - tangents)


@dataclass(frozen=True)
class LineFit:
    """Straight line computed = slope measured + intercept through the image coordinates of a solution."""

    slope: float  # 1 for the true solution
    intercept: float  # 0 for the true solution, tangents
    scatter: float  # root mean square distance from the line, tangents
    departure: float  # root mean square distance from the line of slope 1 through 0, tangents


@checked_arguments(tangents="n 2")
def choose_by_line(
    solutions: tuple[ResectionSolution, ...], tangents: FloatArray
) -> tuple[ResectionSolution, tuple[LineFit, ...]]:
    """Return the solution with computed image coordinates closest to the line computed = measured.

    Args:
        solutions: solutions of a resection from three points, with residuals at all points.
        tangents: measured image points, shape (n, 2), n >= 4.

    Returns:
        The chosen solution, and the lines of all solutions in the given order.

    Raises:
        GeometryError: fewer than four points, points other than those of the solutions, or no solution with
            all points in front of the camera.

    Source: document 001, secs. 4.2.1 and 5.1: the unique solution of the P3P by fitting a line through at
    least four points. The document states the principle without formulas; this is our interpretation.
    """
    if len(tangents) < MIN_TO_CHOOSE:
        raise GeometryError(
            f"line fitting: {counted(len(tangents), 'point')}, at least {MIN_TO_CHOOSE} are needed"
        )
    if any(len(solution.residuals) != len(tangents) for solution in solutions):
        raise GeometryError(
            f"line fitting: {counted(len(tangents), 'image point')}, needed those that the solutions have "
            "residuals of"
        )
    lines = []
    for solution in solutions:
        measured, computed = tangents.ravel(), (tangents + solution.residuals).ravel()
        if not np.isfinite(computed).all():  # a point is behind the camera
            lines.append(LineFit(np.nan, np.nan, np.inf, np.inf))
            continue
        slope, intercept = np.polyfit(measured, computed, 1)
        scatter = np.sqrt(np.mean((computed - slope * measured - intercept) ** 2))
        departure = np.sqrt(np.mean((computed - measured) ** 2))
        lines.append(LineFit(float(slope), float(intercept), float(scatter), float(departure)))
    departures = [line.departure for line in lines]
    if not np.isfinite(departures).any():
        raise GeometryError("line fitting: points lie behind the camera in every solution")
    return solutions[int(np.argmin(departures))], tuple(lines)


@checked_arguments(position="3", rotation="3 3", points="n 3")
def tangents_of(position: FloatArray, rotation: FloatArray, points: FloatArray) -> FloatArray:
    """Return the tangents of object points by the collinearity equations.

    Args:
        position: projection centre X0, shape (3,), object unit.
        rotation: R, image to object axes, shape (3, 3).
        points: object points, shape (n, 3), object unit.

    Returns:
        u = -U/W, v = -V/W, shape (n, 2); NaN behind the camera.

    Source: Kraus (2007), sec. 4.2.1; document 000, eqs. of the central perspective, with c = 1.
    """
    UVW = (np.asarray(points, dtype=float) - position) @ rotation
    W = np.where(UVW[:, 2] < 0, UVW[:, 2], np.nan)
    return np.asarray(-UVW[:, :2] / W[:, None], dtype=float)


def rotation_from_position(tangents: FloatArray, points: FloatArray, position: FloatArray) -> FloatArray:
    """Return R that best rotates the measured rays into the directions from the position to the points.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, shape (n, 2), n >= 2.
        points: object points, shape (n, 3), object unit.
        position: projection centre, shape (3,).

    Source: Wahba's problem (1965) by the singular value decomposition of Markley (1988).
    """
    rays = np.concatenate([tangents, -np.ones((len(tangents), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    directions = points - position
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    U, _, Vt = np.linalg.svd(directions.T @ rays)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def sort_solutions(solutions: list[ResectionSolution]) -> tuple[ResectionSolution, ...]:
    """Return solutions in the order of their residuals, smallest first."""
    return tuple(sorted(solutions, key=lambda solution: solution.rms))


def checked_points(
    method: str, tangents: FloatArray, points: FloatArray, *, needed: int
) -> tuple[FloatArray, FloatArray]:
    """Return image and object points as arrays, or raise the reason why a method cannot use them.

    Args:
        method: name of the method, for the message.
        tangents: image points, shape (n, 2).
        points: object points, shape (n, 3).
        needed: number of points that the method needs.

    Raises:
        GeometryError: too few points, unequal numbers, values that are not finite, coincident points, or
            collinear points.
    """
    uv = np.ascontiguousarray(tangents, dtype=float).reshape(-1, 2)
    xyz = np.ascontiguousarray(points, dtype=float).reshape(-1, 3)
    n = len(xyz)
    if len(uv) != n:
        raise GeometryError(
            f"{method}: {counted(len(uv), 'image point')} and {counted(n, 'object point')}, "
            "one each is needed"
        )
    if n < needed:
        raise GeometryError(f"{method}: {counted(n, 'point')}, at least {needed} are needed")
    if not (np.isfinite(uv).all() and np.isfinite(xyz).all()):
        raise GeometryError(f"{method}: a coordinate is not a finite number")
    first = xyz[:needed]
    spread = np.linalg.norm(xyz - xyz.mean(axis=0), axis=1).max()
    distance = np.linalg.norm(first[:, None] - first[None], axis=2) + np.eye(len(first)) * spread
    if spread == 0 or distance.min() <= COINCIDENT * spread:
        i, j = np.unravel_index(int(np.argmin(distance)), distance.shape)
        raise GeometryError(f"{method}: points {min(i, j) + 1} and {max(i, j) + 1} coincide")
    for name, values in (("object", xyz), ("image", uv)):
        # the points that the method starts from, and all points
        for part in (values[: max(needed, 3)], values):
            s = np.linalg.svd(part - part.mean(axis=0), compute_uv=False)
            if s[1] <= COLLINEAR * s[0]:
                raise GeometryError(f"{method}: the {len(part)} {name} points lie on one line or coincide")
    return uv, xyz


def thickness(points: FloatArray) -> float:
    """Return the extent of object points across their plane over the largest extent; 0 if all coincide."""
    s = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(s[2] / s[0]) if s[0] > 0 else 0.0
