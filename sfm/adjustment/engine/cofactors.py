"""Marginal covariance of points, exterior and interior orientation from the reduced system.

The cofactor matrix of the reduced unknowns is S^-1. Points follow without the inverse of the full system:
Q_pp = L^-T (I + Y' S^-1 Y) L^-1 and Q_cp = -S^-1 Y L^-1. Any datum follows by S-transformation,
Q <- S Q S' with S = I - H (B'H)^-1 B', block by block. The limiting precision, with fixed cameras, is V^-1.

Source: Foerstner and Wrobel (2016), sec. 15.2.5 and 4.5; limiting precision: Fraser (1987),
Photogramm. Eng. Remote Sens. 53(5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import leading
from sfm.adjustment.engine.collinearity import Observations, State, Workspace, collinearity, new_workspace
from sfm.adjustment.engine.iterate import Optimum
from sfm.adjustment.engine.normals import solve_lower, solve_transposed
from sfm.adjustment.engine.solvers.protocol import Inverse
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.adjustment.result import Covariance
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.observations.pose import exterior_jacobian
from sfm.runtime.compiling import kernel

# Ratio of a variance to its limiting value below which the datum fixes the coordinate. Survey observations
# of a point may be that much better than its rays; there, it is the ratio to the variance in any datum.
MAX_FIXED_VARIANCE, MAX_ROUNDING = 1e-9, 1e-13
NO_DATUM_TERMS = np.zeros((0, 0)), np.zeros((0, 0, 3)), np.zeros((0, 0))


@dataclass(frozen=True)
class Cofactors:
    """Cofactor matrices (covariance for sigma0 = 1) in any datum, and the terms of the S-transformation."""

    exterior: FloatArray  # X0 and w of each pose, any datum, (poses, 6, 6)
    border: FloatArray  # interior unknowns, mounts and kept points, any datum, (i + 3 s, i + 3 s)
    mixed: FloatArray  # poses x border unknowns, any datum, (6 poses, i + 3 s)
    points: FloatArray  # each object point, any datum, (n, 3, 3)
    limiting: FloatArray  # each object point with the cameras held fixed, (n, 3, 3)
    cross: FloatArray  # object point x pose of each image point, any datum, (k, 3, 6)
    cross_border: FloatArray  # each object point x border, any datum, (n, 3, i + 3 s)
    F_reduced: FloatArray  # (B'H)^-1 B'Q of the reduced unknowns, (d, reduced)
    F_points: FloatArray  # likewise of object points, (n, d, 3)
    G: FloatArray  # (B'H)^-1 B'QB (H'B)^-1, (d, d)

    @property
    def has_cross(self) -> bool:
        """Whether cofactors between points and photographs were computed."""
        return len(self.cross) > 0


def cofactors(optimum: Optimum, layout: Unknowns, *, cross: bool = True, datum: bool = True) -> Cofactors:
    """Return the cofactors at an optimum.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
        cross: whether to compute cofactors between points and photographs; they are empty otherwise.
        datum: whether to compute the terms of the S-transformation; they are empty otherwise.
    """
    equations, L = optimum.equations, optimum.equations.lower
    q = optimum.factor.inverse(equations, cross=cross)
    first = layout.pose_free.size
    Li = solve_lower(L, np.broadcast_to(np.eye(3), L.shape))
    limiting = np.asarray(np.swapaxes(Li, 1, 2) @ Li)
    points = limiting + solve_transposed(L, np.swapaxes(solve_transposed(L, q.core), 1, 2))
    for s, (j, V) in enumerate(zip(layout.kept, equations.normals_of(layout.kept), strict=True)):
        at = slice(layout.kept_start - first + 3 * s, layout.kept_start - first + 3 * s + 3)
        points[j] = q.border[at, at]
        # a kept point may have lost all its rays to the test; its limiting precision is then undefined
        limiting[j] = np.linalg.inv(V) if np.linalg.matrix_rank(V) == 3 else 0.0
    mask = layout.point_free.astype(float)
    points *= mask[:, :, None] * mask[:, None, :]
    limiting *= mask[:, :, None] * mask[:, None, :]
    rays, inner = _cross(layout, q, L, mask)
    F_c, F_p, G = _datum_terms(optimum, layout, limiting) if datum else NO_DATUM_TERMS
    return Cofactors(q.exterior, q.border, q.mixed, points, limiting, rays, inner, F_c, F_p, G)


def marginal_covariance(
    optimum: Optimum, layout: Unknowns, cofactors: Cofactors, variance: float
) -> Covariance:
    """Return the covariance of points, exterior and interior orientation in the datum of the adjustment.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
        cofactors: cofactors at the optimum.
        variance: a posteriori sigma0^2.
    """
    H, P = optimum.motions.reduced, optimum.motions.points
    F, G = cofactors.F_reduced, cofactors.G
    points = _in_datum(cofactors.points, P, cofactors.F_points, G)
    fixed = np.diagonal(points, axis1=1, axis2=2) <= largest_fixed(optimum, layout, cofactors)
    points[fixed] = 0.0
    np.swapaxes(points, 1, 2)[fixed] = 0.0
    first = layout.pose_free.size
    columns, J = layout.photograph_terms(optimum.state, np.arange(len(optimum.state.M)))
    T = exterior_jacobian(optimum.state.M) @ J
    exterior = _in_datum(_of_photographs(cofactors, columns), H[columns], np.moveaxis(F[:, columns], 1, 0), G)
    with np.errstate(over="ignore", invalid="ignore"):  # undetermined photographs overflow
        exterior = T @ exterior @ np.swapaxes(T, 1, 2)
    interior = []
    for of_camera in layout.interior_column:
        Q = cofactors.border[np.ix_(of_camera - first, of_camera - first)]
        interior.append(variance * _in_datum(Q[None], H[of_camera][None], F[:, of_camera][None], G)[0])
    columns, J = layout.rig_terms(optimum.state)
    at = np.maximum(columns - first, 0)  # where a mount is fixed, J is 0
    rigs = np.zeros((len(at), len(at)))
    if cofactors.border.size and len(at):
        shared = _in_datum(cofactors.border[np.ix_(at, at)][None], H[columns][None], F[:, columns][None], G)
        rigs = J @ shared[0] @ J.T
    return Covariance(
        variance * points,
        variance * exterior,
        tuple(interior),
        variance * cofactors.limiting,
        variance * rigs,
    )


def largest_fixed(optimum: Optimum, layout: Unknowns, cofactors: Cofactors) -> FloatArray:
    """Return the variance up to which a coordinate is one that the datum fixes, for sigma0 = 1, (n, 3).

    It is 0 where the observations fix position, attitude and scale.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
        cofactors: cofactors at the optimum.
    """
    if not len(optimum.motions.inverse):
        return np.zeros((len(cofactors.points), 3))
    largest = MAX_FIXED_VARIANCE * np.diagonal(cofactors.limiting, axis1=1, axis2=2)
    kept = np.diagonal(cofactors.points[layout.kept], axis1=1, axis2=2)
    largest[layout.kept] = MAX_ROUNDING * np.maximum(kept, 0.0)
    return largest


def hat_complement(
    optimum: Optimum, layout: Unknowns, cofactors: Cofactors, weight: FloatArray
) -> FloatArray:
    """Return I - A Q A' of every image point in whitened coordinates, independent of the datum.

    For an image point without weight the result is I + A Q A', the cofactor of its predicted residual.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
        cofactors: cofactors at the optimum, including those between points and photographs.
        weight: factor on the weight of each image point, shape (k,).

    Returns:
        Cofactors of the whitened residuals, shape (k, 2, 2); NaN behind the camera.
    """
    Q, workspace, out = cofactors, new_workspace(), np.empty((len(weight), 2, 2))
    # the same memory layout for all networks, so that one compiled form serves all
    mixed = np.ascontiguousarray(Q.mixed).reshape(len(Q.exterior), 6, -1)
    border, points = np.ascontiguousarray(Q.border), np.ascontiguousarray(Q.points)
    count = 3 + workspace.A.shape[1]
    _complement(
        layout.observations, optimum.state, weight, Q.exterior, mixed, border, points, Q.cross,
        Q.cross_border, workspace, np.empty((2, count)), np.empty((count, count)), out,
    )  # fmt: skip
    return out


def without_held(covariance: Covariance, layout: Unknowns, optimum: Optimum) -> Covariance:
    """Return the covariance with everything undetermined marked.

    NaN marks photographs and points that took no part or have open directions. An interior parameter that a
    null vector leaves open gets an infinite variance and no covariances, because no datum fixes it.

    Args:
        covariance: covariance of all photographs and points.
        layout: order of the unknowns.
        optimum: undamped normal equations, in which directions that the rays leave open were held.
    """
    idle_point = ~layout.point_on | (optimum.equations.held > 0)
    idle_image = ~layout.image_on
    points, limiting = covariance.points.copy(), covariance.points_limiting.copy()
    exterior = covariance.exterior.copy()
    points[idle_point] = limiting[idle_point] = np.nan
    exterior[idle_image] = np.nan
    opened = np.asarray(leading(optimum.factor.further).any(axis=1))
    interior = []
    for columns, Q in zip(layout.interior_column, covariance.interior, strict=True):
        without, rows = Q.copy(), np.flatnonzero(opened[columns])
        without[rows] = without[:, rows] = np.nan
        without[rows, rows] = np.inf
        interior.append(without)
    rigs = covariance.rigs.copy()
    lost = np.flatnonzero(opened[layout.rig_terms(optimum.state)[0]] & rigs.any(axis=1))
    rigs[lost] = rigs[:, lost] = np.nan
    rigs[lost, lost] = np.inf
    return replace(
        covariance,
        points=points,
        exterior=exterior,
        interior=tuple(interior),
        points_limiting=limiting,
        rigs=rigs,
    )


def _of_photographs(cofactors: Cofactors, columns: IntArray) -> FloatArray:
    """Return the cofactors of the unknowns of each photograph, its pose and its mount, (m, u, u)."""
    pose = columns[:, 0] // 6
    poses_alone = cofactors.exterior[pose]
    if columns.shape[1] == 6:
        return poses_alone
    poses = len(cofactors.exterior)
    at = np.maximum(columns[:, 6:] - 6 * poses, 0)  # where a mount is fixed, J is 0
    if not cofactors.border.size:
        return np.pad(poses_alone, ((0, 0), (0, 6), (0, 6)))
    mixed = cofactors.mixed.reshape(poses, 6, -1)[pose[:, None], :, at].swapaxes(1, 2)
    mounts = cofactors.border[at[:, :, None], at[:, None]]
    return np.block([[poses_alone, mixed], [np.swapaxes(mixed, 1, 2), mounts]])


def _in_datum(Q: FloatArray, H: FloatArray, F: FloatArray, G: FloatArray) -> FloatArray:
    """Return Q - H F - (H F)' + H G H' of many blocks at once."""
    half = H @ F
    return np.asarray(Q - half - np.swapaxes(half, 1, 2) + H @ G @ np.swapaxes(H, 1, 2))


def _datum_terms(
    optimum: Optimum, layout: Unknowns, limiting: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (B'H)^-1 B'Q of reduced unknowns and points, and (B'H)^-1 B'QB (H'B)^-1.

    In B of the motions, kept points appear among the points only.
    """
    motions, equations, L = optimum.motions, optimum.equations, optimum.equations.lower
    d = len(motions.inverse)
    B = motions.constraints
    on_reduced = motions.on_reduced.copy()
    on_reduced[layout.kept_start :] += B[layout.kept].reshape(3 * len(layout.kept), d)
    eliminated = np.array(B)
    eliminated[layout.kept] = 0.0
    # B'Q_c = (B_c - Y L^-1 B_p)' S^-1
    through = equations.times_points(solve_lower(L, eliminated))
    free = layout.reduced_free()[:, None]
    QB_c = optimum.factor.solve((on_reduced - through) * free) * free
    # Q_pp B_p = V^-1 B_p - L^-T Y' (Q_cp B_p), with Q_cp of all points together
    QB_p = limiting @ eliminated - solve_transposed(L, equations.times_reduced(QB_c))
    QB_p[layout.kept] = QB_c[layout.kept_start :].reshape(len(layout.kept), 3, d)
    QB_p *= layout.point_free[:, :, None]
    BQB = np.einsum("jad,jae->de", QB_p, eliminated) + QB_c.T @ on_reduced
    inverse = motions.inverse
    return inverse @ QB_c.T, inverse @ np.swapaxes(QB_p, 1, 2), inverse @ BQB @ inverse.T


def _cross(layout: Unknowns, q: Inverse, L: FloatArray, mask: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Q_pc = -L^-T Y'S^-1 of each image point x its pose, and of each object point x the border."""
    if len(q.YQ) == 0:
        return q.YQ, q.YQ_border
    point, first = layout.observations.point, 6 * len(q.exterior)
    rays = -solve_transposed(L[point], q.YQ) * mask[point][:, :, None]
    inner = -solve_transposed(L, q.YQ_border) * mask[:, :, None]
    mixed = q.mixed.reshape(len(q.exterior), 6, -1)
    for s, j in enumerate(layout.kept):
        at = slice(layout.kept_start - first + 3 * s, layout.kept_start - first + 3 * s + 3)
        seen = slice(layout.observations.start[j], layout.observations.start[j + 1])
        rays[seen] = np.swapaxes(mixed[layout.observations.pose[seen], :, at], 1, 2)
        inner[j] = q.border[at]
    return rays, inner


@kernel
def _complement(
    observations: Observations,
    state: State,
    weight: FloatArray,
    exterior: FloatArray,
    mixed: FloatArray,
    border: FloatArray,
    points: FloatArray,
    cross: FloatArray,
    cross_border: FloatArray,
    workspace: Workspace,
    J: FloatArray,
    Q: FloatArray,
    out: FloatArray,
) -> None:
    """Fill I - J Q J' of each image point; J and Q belong to its pose, X and free camera parameters."""
    first = 6 * observations.poses
    for o in range(len(observations.image)):
        i, j = observations.pose[o], observations.point[o]
        a = observations.camera[observations.image[o]]
        f = observations.free_count[a]
        used = weight[o] > 0.0
        in_front = collinearity(o, observations, state, weight[o] if used else 1.0, workspace)
        for row in range(2):
            for p in range(6):
                J[row, p] = workspace.A[row, p]
            for p in range(3):
                J[row, 6 + p] = workspace.B[row, p]
            for p in range(f):
                J[row, 9 + p] = workspace.A[row, 6 + observations.free_index[a, p]]
        for p in range(6):
            for q in range(6):
                Q[p, q] = exterior[i, p, q]
            for q in range(3):
                Q[p, 6 + q] = cross[o, q, p]
            for q in range(f):
                Q[p, 9 + q] = mixed[i, p, observations.free_column[a, q] - first]
        for p in range(3):
            for q in range(3):
                Q[6 + p, 6 + q] = points[j, p, q]
            for q in range(f):
                Q[6 + p, 9 + q] = cross_border[j, p, observations.free_column[a, q] - first]
        for p in range(f):
            for q in range(p, f):
                Q[9 + p, 9 + q] = border[
                    observations.free_column[a, p] - first, observations.free_column[a, q] - first
                ]
        h00, h01, h11 = 0.0, 0.0, 0.0
        for p in range(9 + f):
            x, y = 0.5 * Q[p, p] * J[0, p], 0.5 * Q[p, p] * J[1, p]
            for q in range(p + 1, 9 + f):
                x += Q[p, q] * J[0, q]
                y += Q[p, q] * J[1, q]
            h00 += 2.0 * J[0, p] * x
            h01 += J[0, p] * y + J[1, p] * x
            h11 += 2.0 * J[1, p] * y
        sign = -1.0 if used else 1.0
        out[o, 0, 0] = 1.0 + sign * h00 if in_front else np.nan
        out[o, 0, 1] = sign * h01 if in_front else np.nan
        out[o, 1, 0] = out[o, 0, 1]
        out[o, 1, 1] = 1.0 + sign * h11 if in_front else np.nan
