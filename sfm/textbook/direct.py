"""Two other ways to adjust a network: direct orientation onto control, and separate adjustment.

Direct orientation adjusts photographs (usually a pair) onto control points in one adjustment, without a model
in between. Each photograph starts from a resection on its control points.

Separate adjustment alternates between object points and orientations instead of solving for all unknowns
together. Each round first adjusts every object point with the orientations held (3 x 3 systems). Then it
adjusts all orientations with the points held, in one system of the exterior orientations and the interior
parameters. It ends at the same optimum as the simultaneous adjustment, but converges only linearly. It gives
no covariance between points and orientations, so its precision of a point would be the limiting precision.

Source: document 000 of the project's sources, sec. 2.4; block coordinate descent in Nocedal and Wright,
Numerical Optimization (2006), sec. 9.3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sfm.adjustment.engine.accumulate import Blocks
from sfm.adjustment.engine.collinearity import sum_of_squares
from sfm.adjustment.engine.normals import new_space, normal_equations
from sfm.adjustment.engine.observed import observed_of
from sfm.adjustment.engine.unknowns import Unknowns, estimate_of, start_weights, step, unknowns_of
from sfm.model.arguments import check_indices, checked_arguments
from sfm.model.conventions import BoolArray, FloatArray, IntArray, rotation_from_vector, skew
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, rows_of
from sfm.orientation.intersection import intersect
from sfm.orientation.resection.least_squares import resect_least_squares
from sfm.orientation.resection.ransac import resect_robust

TOLERANCE = 1e-13  # relative decrease of v'Pv per round at which the rounds stop
MIN_STEP_SHARE = 2.0**-12  # smallest fraction of a step that is tried
MAX_STEPS = 30
MAX_LAST_STEP = 1e-12
START_TOLERANCE = 0.1  # tangents: tolerated error of a start


@dataclass(frozen=True)
class DirectOrientation:
    """Photographs oriented to control in one adjustment, without a model in between."""

    positions: FloatArray  # projection centres, unit of the control points, (m, 3)
    rotations: FloatArray  # R, image to object axes, (m, 3, 3)
    points: FloatArray  # control points as given, others adjusted, unit of the control points, (n, 3)
    residuals: FloatArray  # v = computed - measured, tangents, (k, 2)
    sigma0: float  # a posteriori standard deviation of an image coordinate, tangents
    redundancy: int  # 2 k - 6 m - 3 new points
    covariance: FloatArray  # covariance of X0 and w in R exp([w]x) of all photographs, (6 m, 6 m)
    converged: bool  # whether the last step was negligible


@checked_arguments(tangents="k 2", image="k", point="k", control="n 3")
def orient_direct(
    tangents: FloatArray, image: IntArray, point: IntArray, control: FloatArray
) -> DirectOrientation:
    """Orient photographs (usually two) to control points, with the conjugate rays of new points.

    Args:
        tangents: u = -U/W, v = -V/W of each ray, free of distortion, shape (k, 2).
        image: photograph index of each ray, shape (k,).
        point: point index of each ray, shape (k,).
        control: coordinates of the control points, NaN for all other points, shape (n, 3), any unit.

    Raises:
        GeometryError: a photograph has fewer than four control points (its start needs them), a new point has
            fewer than two rays, or the rays do not determine the solution.

    Source: document 004, "direct orientation": the collinearity equations of both photographs, solved by
    Gauss-Newton. Control points are fixed, and the new points are unknowns that are eliminated.
    """
    uv = np.ascontiguousarray(tangents, dtype=float)
    known = np.asarray(np.isfinite(control).all(axis=1))
    m = int(image.max(initial=-1)) + 1
    if not m:
        raise GeometryError(
            "direct orientation: no rays, at least four control points per photograph are needed"
        )
    check_indices("orient_direct: image", image, m)
    check_indices("orient_direct: point", point, len(control))
    positions, rotations = _resect_photographs(uv, image, point, control, known, m)
    start = intersect(uv, image, point, positions, rotations, n_points=len(control)).points
    points = np.where(known[:, None], control, start)
    missing = np.flatnonzero(
        ~np.isfinite(points).all(axis=1) & (np.bincount(point, minlength=len(points)) > 0)
    )
    if len(missing):
        raise GeometryError(
            f"direct orientation: point {missing[0]} is neither control nor seen by two photographs"
        )
    converged = False
    for _ in range(MAX_STEPS):
        v, A, B = _linearise(uv, image, point, positions, rotations, points)
        N, n_vector, solve_points = _eliminate_new_points(v, A, B, image, point, known, m)
        try:
            dx = np.asarray(np.linalg.solve(N, n_vector), dtype=float)
        except np.linalg.LinAlgError:
            raise GeometryError("direct orientation: control does not determine the photographs") from None
        points = points + solve_points(dx)
        step = dx.reshape(m, 6)
        distance = np.linalg.norm(points[point] - positions[image], axis=1).mean()
        positions = positions + step[:, :3]
        rotations = rotations @ rotation_from_vector(step[:, 3:])
        if np.abs(step[:, :3]).max() < MAX_LAST_STEP * distance and np.abs(step[:, 3:]).max() < MAX_LAST_STEP:
            converged = True
            break
    v, A, B = _linearise(uv, image, point, positions, rotations, points)
    N, _, _ = _eliminate_new_points(v, A, B, image, point, known, m)
    new = np.unique(point[~known[point]])
    redundancy = 2 * len(uv) - 6 * m - 3 * len(new)
    sigma0 = float(np.sqrt(np.sum(v**2) / redundancy)) if redundancy > 0 else np.nan
    covariance = sigma0**2 * np.linalg.inv(N)
    return DirectOrientation(
        positions, rotations, points, v, sigma0, redundancy, np.asarray(covariance), converged
    )


def _resect_photographs(
    uv: FloatArray, image: IntArray, point: IntArray, control: FloatArray, known: BoolArray, m: int
) -> tuple[FloatArray, FloatArray]:
    """Return start positions and rotations of all photographs, resected on their control points."""
    positions, rotations = np.empty((m, 3)), np.empty((m, 3, 3))
    for i, rows in enumerate(rows_of(image, m)):
        used = rows[known[point[rows]]]
        result = resect_robust(uv[used], control[point[used]], tolerance=START_TOLERANCE)
        if not result.found:
            raise GeometryError(f"direct orientation: photograph {i}: {result.reason}")
        adjusted = resect_least_squares(uv[used], control[point[used]], result.position, result.rotation)
        positions[i], rotations[i] = adjusted.position, adjusted.rotation
    return positions, rotations


def _linearise(
    uv: FloatArray,
    image: IntArray,
    point: IntArray,
    positions: FloatArray,
    rotations: FloatArray,
    points: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (k, 2), and their derivatives by photograph (k, 2, 6) and point (k, 2, 3)."""
    R = rotations[image]
    UVW = np.einsum("kji,kj->ki", R, points[point] - positions[image])
    W = UVW[:, 2:]
    u = -UVW[:, :2] / W
    # d (u, v) / d (U, V, W)
    D = np.zeros((len(uv), 2, 3))
    D[:, 0, 0] = D[:, 1, 1] = -1 / W[:, 0]
    D[:, :, 2] = -u / W
    B = D @ np.swapaxes(R, 1, 2)
    A = np.concatenate([-B, D @ skew(UVW)], axis=2)
    return u - uv, A, B


def _eliminate_new_points(
    v: FloatArray, A: FloatArray, B: FloatArray, image: IntArray, point: IntArray, known: BoolArray, m: int
) -> tuple[FloatArray, FloatArray, Callable[[FloatArray], FloatArray]]:
    """Return the normal equations without the new points, and the function that solves for these points."""
    k = len(v)
    wide = np.zeros((k, 2, 6 * m))
    columns = 6 * image[:, None] + np.arange(6)
    for axis in (0, 1):
        wide[np.arange(k)[:, None], axis, columns] = A[:, axis]
    N = np.einsum("kia,kib->ab", wide, wide)
    n_vector = -np.einsum("kia,ki->a", wide, v)
    parts = []
    for j in np.unique(point[~known[point]]):
        of_point = point == j
        C = np.einsum("kia,kib->ab", wide[of_point], B[of_point])
        inverse = np.linalg.inv(np.einsum("kia,kib->ab", B[of_point], B[of_point]))
        b = -np.einsum("kia,ki->a", B[of_point], v[of_point])
        N = N - C @ inverse @ C.T
        n_vector = n_vector - C @ inverse @ b
        parts.append((j, C, inverse, b))

    def solve_points(dx: FloatArray) -> FloatArray:
        step = np.zeros((len(known), 3))
        for j, C, inverse, b in parts:
            step[j] = inverse @ (b - C.T @ dx)
        return step

    return N, n_vector, solve_points


@dataclass(frozen=True)
class SeparateAdjustment:
    """The state after the last round."""

    estimate: Estimate  # adjusted interior and exterior orientation and points
    vPv: float  # weighted sum of squared residuals of the image points
    rounds: int  # number of rounds computed
    converged: bool  # whether the last round decreased v'Pv by no more than the tolerance


@checked_arguments()
def adjust_separately(
    network: Network, estimate: Estimate, *, max_rounds: int = 2000, tolerance: float = TOLERANCE
) -> SeparateAdjustment:
    """Adjust points and orientations alternately.

    Each round adjusts every object point by itself with the orientations held, then all orientations with the
    points held. It ends at the optimum of `sfm.adjustment.solve.adjust`. But it takes hundreds of rounds
    where `adjust` takes a few steps, and it gives no covariance. Control points, if there are any, are fixed
    and define the datum. Otherwise the start values define it.

    Args:
        network: image points, and control points if any.
        estimate: start values; photographs and points without start values (NaN) are left out.
        max_rounds: largest number of rounds.
        tolerance: relative decrease of v'Pv per round at which the rounds stop.

    Returns:
        Adjusted values, v'Pv, and whether the rounds converged.

    Raises:
        GeometryError: the network has scale bars or other observations that tie points to one another.

    Example:
        >>> adjust_separately(network, start).estimate.points  # doctest: +SKIP

    Source: Nocedal and Wright, Numerical Optimization (2006), sec. 9.3 (block coordinate descent).
    """
    layout, state = unknowns_of(network, estimate, use_control=True)
    observed = observed_of(network, layout, state, use_control=True)
    if observed:
        raise GeometryError(
            "separate adjustment: the network has scale bars or other observations, expected image points "
            "and fixed control only (adjust takes the others)"
        )
    weight = start_weights(layout, state)
    vPv = float(sum_of_squares(layout.observations, state, weight))
    space = new_space(layout)
    for number in range(1, max_rounds + 1):
        before = vPv
        for move in (_point_step, _orientation_step):
            normals = normal_equations(layout, observed, state, weight, space=space)
            reduced, points = move(normals.blocks, layout)
            share = 1.0
            while share >= MIN_STEP_SHARE:  # halved until v'Pv does not increase
                moved = step(layout, state, share * reduced, share * points)
                reached = float(sum_of_squares(layout.observations, moved, weight))
                if reached <= vPv:
                    state, vPv = moved, reached
                    break
                share /= 2
        if before - vPv <= tolerance * before:
            return SeparateAdjustment(estimate_of(state, estimate), vPv, number, True)
    return SeparateAdjustment(estimate_of(state, estimate), vPv, max_rounds, False)


def _point_step(blocks: Blocks, layout: Unknowns) -> tuple[FloatArray, FloatArray]:
    """Return the step of the points with the orientations held, -V^-1 g."""
    dX = -np.linalg.solve(blocks.V, blocks.gp[:, :, None])[:, :, 0]
    return np.zeros(layout.reduced), np.where(layout.point_free, dX, 0.0)


def _orientation_step(blocks: Blocks, layout: Unknowns) -> tuple[FloatArray, FloatArray]:
    """Return the step of exterior and interior orientation with the points held, -U^-1 g."""
    m = len(layout.pose_free)
    U = np.zeros((layout.reduced, layout.reduced))
    g = np.zeros(layout.reduced)
    g[: 6 * m] = blocks.g.ravel()
    for i in range(m):
        U[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = np.triu(blocks.U[i])
        column = layout.interior_column[layout.observations.camera[i]]
        U[6 * i : 6 * i + 6, column] = blocks.C[i, :, : len(column)]
    for a, column in enumerate(layout.interior_column):
        f = len(column)
        U[np.ix_(column, column)] += blocks.D[a, :f, :f]
        g[column] += blocks.gi[a, :f]
    on = layout.reduced_free()
    scale = 1 / np.sqrt(np.diagonal(U)[on])
    factored = cho_factor(U[np.ix_(on, on)] * scale[:, None] * scale, lower=False)
    dx = np.zeros(layout.reduced)
    dx[on] = -scale * cho_solve(factored, scale * g[on])
    return dx, np.zeros(layout.point_free.shape)
