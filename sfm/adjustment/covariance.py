"""Marginal covariance of points, exterior and interior orientation from the reduced system.

The cofactor of the reduced unknowns is S^-1; points follow without the inverse of the whole:
Q_pp = L^-T (I + Y' S^-1 Y) L^-1 and Q_cp = -S^-1 Y L^-1. Any datum follows by S-transformation,
Q <- S Q S' with S = I - H (B'H)^-1 B', block by block. The limiting precision, cameras fixed, is V^-1.

Source: Foerstner and Wrobel (2016), sec. 15.2.5 and 4.5; limiting precision: Fraser (1987),
Photogramm. Eng. Remote Sens. 53(5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from sfm.adjustment.collinearity import collinearity, scratch
from sfm.adjustment.iterate import Optimum
from sfm.adjustment.parameters import Unknowns, angle_jacobian
from sfm.adjustment.result import Covariance
from sfm.conventions import FloatArray

ZERO = 1e-9  # variance over its limiting value below which a coordinate is one that the datum fixes


@dataclass(frozen=True)
class Cofactors:
    """Cofactor matrices (covariance for sigma0 = 1) in the datum of the adjustment, and what makes more."""

    reduced: FloatArray  # of the reduced unknowns, any datum, (reduced, reduced)
    cross: FloatArray  # of object points (rows) by reduced unknowns, any datum, (3 n, reduced)
    points: FloatArray  # of each object point, any datum, (n, 3, 3)
    limiting: FloatArray  # of each object point with the cameras fixed, (n, 3, 3)
    F_reduced: FloatArray  # (B'H)^-1 B'Q of the reduced unknowns, (d, reduced)
    F_points: FloatArray  # the same of object points, (n, d, 3)
    G: FloatArray  # (B'H)^-1 B'QB (H'B)^-1, (d, d)


def cofactors(optimum: Optimum, layout: Unknowns) -> Cofactors:
    """Return the cofactors of all unknowns at an optimum.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
    """
    b = optimum.normals.blocks
    n = len(b.L)
    Qcc = optimum.factor.inverse()
    free = layout.reduced_free().astype(float)
    Qcc *= free[:, None] * free
    Li = np.asarray(np.linalg.inv(b.L))
    Z = b.Yt @ Qcc
    cross = -_points_product(Li, Z)
    core = b.Yt.reshape(n, 3, -1) @ np.swapaxes(Z.reshape(n, 3, -1), 1, 2)
    limiting = np.swapaxes(Li, 1, 2) @ Li
    points = np.swapaxes(Li, 1, 2) @ (np.eye(3) + core) @ Li
    first = layout.kept_start
    for s, j in enumerate(layout.kept):
        own = slice(first + 3 * s, first + 3 * s + 3)
        cross[3 * j : 3 * j + 3] = Qcc[own]
        points[j] = Qcc[own, own]
        # a point that lost all its rays to the test has no precision by rays; it is held as others are
        limiting[j] = np.linalg.inv(b.V[j]) if np.linalg.matrix_rank(b.V[j]) == 3 else 0.0
    mask = layout.point_free.astype(float)
    points *= mask[:, :, None] * mask[:, None, :]
    limiting *= mask[:, :, None] * mask[:, None, :]
    cross *= mask.reshape(-1, 1)
    F_c, F_p, G = _datum_terms(optimum, layout, Qcc, cross, limiting)
    return Cofactors(Qcc, cross, points, limiting, F_c, F_p, G)


def marginal_covariance(
    optimum: Optimum, layout: Unknowns, cofactors: Cofactors, variance: float
) -> Covariance:
    """Return the covariance of points, exterior and interior orientation in the datum of the adjustment.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
        cofactors: of the same.
        variance: sigma0^2 a posteriori.
    """
    H, P = optimum.motions.reduced, optimum.motions.points
    F, G = cofactors.F_reduced, cofactors.G
    FP = cofactors.F_points
    half = P @ FP
    points = cofactors.points - half - np.swapaxes(half, 1, 2) + P @ G @ np.swapaxes(P, 1, 2)
    fixed = np.diagonal(points, axis1=1, axis2=2) <= ZERO * np.diagonal(cofactors.limiting, axis1=1, axis2=2)
    points[fixed] = 0.0
    np.swapaxes(points, 1, 2)[fixed] = 0.0
    m = len(layout.exterior_free)
    T = np.zeros((m, 6, 6))
    T[:, :3, :3] = np.eye(3)
    T[:, 3:, 3:] = angle_jacobian(optimum.state.M)
    exterior = np.empty((m, 6, 6))
    for i in range(m):
        own = slice(6 * i, 6 * i + 6)
        exterior[i] = _in_datum(cofactors.reduced[own, own], H[own], F[:, own], G)
    exterior = T @ exterior @ np.swapaxes(T, 1, 2)
    interior = [
        variance * _in_datum(cofactors.reduced[np.ix_(own, own)], H[own], F[:, own], G)
        for own in layout.interior_column
    ]
    return Covariance(variance * points, variance * exterior, tuple(interior), variance * cofactors.limiting)


def hat_complement(
    optimum: Optimum, layout: Unknowns, cofactors: Cofactors, weight: FloatArray
) -> FloatArray:
    """Return I - A Q A' of every image point in whitened coordinates, independent of the datum.

    For an image point without weight it is I + A Q A', the cofactor of its predicted residual.

    Args:
        optimum, layout, cofactors: of one adjustment.
        weight: factor on the weight of each image point, shape (k,).

    Returns:
        Cofactors of the whitened residuals, shape (k, 2, 2); NaN behind the camera.
    """
    return _complement(
        layout.obs,
        optimum.state,
        weight,
        cofactors.reduced,
        cofactors.cross,
        cofactors.points,
    )


def without_held(covariance: Covariance, layout: Unknowns) -> Covariance:
    """Return the covariance with NaN for photographs and points that took no part."""
    idle_point, idle_image = ~layout.point_on, ~layout.image_on
    points, limiting = covariance.points.copy(), covariance.points_limiting.copy()
    exterior = covariance.exterior.copy()
    points[idle_point] = limiting[idle_point] = np.nan
    exterior[idle_image] = np.nan
    return replace(covariance, points=points, exterior=exterior, points_limiting=limiting)


def _in_datum(Q: FloatArray, H: FloatArray, F: FloatArray, G: FloatArray) -> FloatArray:
    half = H @ F
    return np.asarray(Q - half - half.T + H @ G @ H.T)


def _datum_terms(
    optimum: Optimum, layout: Unknowns, Qcc: FloatArray, cross: FloatArray, limiting: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (B'H)^-1 B'Q and (B'H)^-1 B'QB (H'B)^-1; kept points appear in B of the points only."""
    motions, b = optimum.motions, optimum.normals.blocks
    n, d = len(b.L), motions.defect
    B = motions.constraints
    on_kept = np.zeros((layout.reduced, d))
    on_kept[layout.kept_start :] = B[layout.kept].reshape(3 * len(layout.kept), d)
    on_reduced = motions.on_reduced + on_kept
    eliminated = np.array(B)
    eliminated[layout.kept] = 0.0
    flat = eliminated.reshape(3 * n, d)
    BQ_c = on_reduced.T @ Qcc + flat.T @ cross
    # Q_pp B_p = V^-1 B_p - L^-T Y' (Q_cp B_p), with Q_cp of all points together
    through = -(b.Yt @ BQ_c.T).reshape(n, 3, d)
    Li = np.linalg.inv(b.L)
    BQ_p = np.swapaxes(limiting @ eliminated + np.swapaxes(Li, 1, 2) @ through, 1, 2)
    for s, j in enumerate(layout.kept):
        own = slice(layout.kept_start + 3 * s, layout.kept_start + 3 * s + 3)
        BQ_p[j] = BQ_c[:, own]
    BQ_p = BQ_p * layout.point_free[:, None, :]
    BQB = np.einsum("jda,jae->de", BQ_p, eliminated) + BQ_c @ on_reduced
    inverse = motions.inverse
    return inverse @ BQ_c, inverse @ BQ_p, inverse @ BQB @ inverse.T


def _points_product(Li: FloatArray, Z: FloatArray) -> FloatArray:
    """Return L^-T times the three rows of every point, (3 n, reduced)."""
    n = len(Li)
    return np.asarray((np.swapaxes(Li, 1, 2) @ Z.reshape(n, 3, -1)).reshape(3 * n, -1))


@njit(cache=True)
def _complement(obs, state, weight, Qcc, cross, points):  # type: ignore[no-untyped-def]
    t = scratch()
    out = np.empty((len(obs.image), 2, 2))
    column = np.empty(t.A.shape[1], dtype=np.int64)
    J = np.empty(t.A.shape)
    for o in range(len(obs.image)):
        i, j = obs.image[o], obs.point[o]
        a = obs.camera[i]
        f = obs.free_count[a]
        used = weight[o] > 0.0
        if not collinearity(o, obs, state, weight[o] if used else 1.0, t):
            out[o] = np.nan
            continue
        for p in range(6):
            column[p] = 6 * i + p
            J[0, p], J[1, p] = t.A[0, p], t.A[1, p]
        for p in range(f):
            column[6 + p] = obs.free_column[a, p]
            s = 6 + obs.free_index[a, p]
            J[0, 6 + p], J[1, 6 + p] = t.A[0, s], t.A[1, s]
        h00, h01, h11 = 0.0, 0.0, 0.0
        for p in range(6 + f):
            s0, s1 = 0.0, 0.0
            for q in range(6 + f):
                value = Qcc[column[p], column[q]]
                s0 += value * J[0, q]
                s1 += value * J[1, q]
            h00 += J[0, p] * s0
            h01 += J[0, p] * s1
            h11 += J[1, p] * s1
            for q in range(3):
                value = cross[3 * j + q, column[p]]
                h00 += 2.0 * J[0, p] * value * t.B[0, q]
                h01 += J[0, p] * value * t.B[1, q] + J[1, p] * value * t.B[0, q]
                h11 += 2.0 * J[1, p] * value * t.B[1, q]
        for p in range(3):
            for q in range(3):
                h00 += t.B[0, p] * points[j, p, q] * t.B[0, q]
                h01 += t.B[0, p] * points[j, p, q] * t.B[1, q]
                h11 += t.B[1, p] * points[j, p, q] * t.B[1, q]
        sign = -1.0 if used else 1.0
        out[o, 0, 0] = 1.0 + sign * h00
        out[o, 0, 1] = sign * h01
        out[o, 1, 0] = sign * h01
        out[o, 1, 1] = 1.0 + sign * h11
    return out
