"""Kernels that sum the normal equations of all image points, photograph by photograph, then point by point.

An image point has weighted derivatives A = (X0, w | interior) and B = (X, Y, Z) and a residual r. A
photograph adds (A r)'(A r) of all its image points in one product. Each image point adds W' = B'A, V = B'B
and B'r to its object point. The Jacobian of only one photograph is stored at a time.

Source: Brown (1976), Photogramm. Eng. Remote Sens. 42(8); Foerstner and Wrobel (2016), sec. 15.2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfm.adjustment.engine.collinearity import Observations, State, Workspace, collinearity
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled, inlined, kernel

SINGULAR_PIVOT = 1e-13  # ratio of a pivot of a point to its diagonal term below which its rays are parallel
STIFFENING = 1e10  # factor on the pivot that holds such a direction of a point
RESIDUAL = 6  # column of the residual in A: X0, w, residual, interior


class Blocks(NamedTuple):
    """Blocks of the normal equations that one pass over the image points fills; f = free ones per camera."""

    U: FloatArray  # X0, w of each pose, (poses, 6, 6)
    C: FloatArray  # X0, w of the pose of each photograph x free parameters of its camera, (m, 6, f)
    D: FloatArray  # free parameters of each camera, (a, f, f)
    g: FloatArray  # right-hand side of X0, w of each pose, (poses, 6)
    gi: FloatArray  # right-hand side of the free parameters of each camera, (a, f)
    V: FloatArray  # object points before elimination, (n, 3, 3)
    gp: FloatArray  # right-hand side of object points, (n, 3)
    L: FloatArray  # Cholesky factors of V; unit matrix for kept points, (n, 3, 3)
    y: FloatArray  # L^-1 gp; 0 for kept points, (n, 3)
    Y: FloatArray  # Y' of each image point, for X0, w of its pose; 0 for kept points, (k, 3, 6)
    Y_interior: FloatArray  # Y' of each object point, for all interior unknowns; 0 for kept points, (n, 3, i)
    Yy: FloatArray  # Y y, which is subtracted from the right-hand side, (reduced,)
    K: FloatArray  # kept points x all reduced unknowns, (3 s, reduced)
    held: IntArray  # number of directions of each point that had to be held, (n,)
    order: IntArray  # image points, photograph by photograph, (k,)
    first: IntArray  # index in `order` of the first image point of each photograph, and the end, (m + 1,)


class Sums(NamedTuple):
    """Sums over some photographs, as in `Blocks`, and work space for one photograph."""

    first: int  # first photograph
    end: int  # photograph after the last
    U: FloatArray  # U of each photograph; without rigs, the U of the blocks, (m, 6, 6)
    g: FloatArray  # likewise, (m, 6)
    D: FloatArray
    gi: FloatArray
    V: FloatArray
    gp: FloatArray
    Y_interior: FloatArray
    A: FloatArray  # derivatives and residuals of the image points of one photograph


@compiled
def add_photographs(
    observations: Observations,
    state: State,
    weight: FloatArray,
    pose_free: BoolArray,
    workspace: Workspace,
    sums: Sums,
    blocks: Blocks,
) -> float:
    """Fill U, g, C and Y of some photographs and add to the sums over photographs.

    Args:
        observations: image points.
        state: values of all parameters.
        weight: factor on the weight of each image point, (k,).
        pose_free: which unknowns of each pose are free, (poses, 6).
        workspace: work space for one image point.
        sums: the range of photographs, and the sums that they add to.
        blocks: the blocks to fill.

    Returns:
        v'Pv of these photographs, infinite if a point is behind the camera.
    """
    sums.D[:] = 0.0
    sums.gi[:] = 0.0
    sums.Y_interior[:] = 0.0
    vPv = 0.0
    for i in range(sums.first, sums.end):
        a = observations.camera[i]
        rays = _derivatives(i, observations, state, weight, workspace, sums.A, blocks)
        A = sums.A[: 2 * abs(rays)]
        N = np.dot(A.T, A)
        vPv += N[RESIDUAL, RESIDUAL] if rays >= 0 else np.inf
        _add_photograph(i, a, observations.free_count[a], observations.pose_of[i], N, pose_free, sums, blocks)
        _add_to_points(i, observations, weight, pose_free, sums, blocks)
    return vPv


@kernel
def _derivatives(
    i: int,
    observations: Observations,
    state: State,
    weight: FloatArray,
    workspace: Workspace,
    A: FloatArray,
    blocks: Blocks,
) -> int:
    """Fill two rows of A for each image point of photograph i that takes part.

    Return the number of these image points, negative if one is behind the camera.
    """
    a = observations.camera[i]
    rays, in_front = 0, True
    for h in range(blocks.first[i], blocks.first[i + 1]):
        o = blocks.order[h]
        if weight[o] > 0.0:
            if not collinearity(o, observations, state, weight[o], workspace):
                in_front = False
            x, y = A[2 * rays], A[2 * rays + 1]
            for p in range(6):
                x[p], y[p] = workspace.A[0, p], workspace.A[1, p]
            x[RESIDUAL], y[RESIDUAL] = workspace.r[0], workspace.r[1]
            for q in range(observations.free_count[a]):
                column = 6 + observations.free_index[a, q]
                x[RESIDUAL + 1 + q], y[RESIDUAL + 1 + q] = workspace.A[0, column], workspace.A[1, column]
            rays += 1
    return rays if in_front else -rays


@kernel
def _add_photograph(
    i: int, a: int, f: int, pose: int, N: FloatArray, pose_free: BoolArray, sums: Sums, blocks: Blocks
) -> None:
    """Distribute the sum (A r)'(A r) of photograph i; fixed unknowns keep their rows, with derivatives 0."""
    for p in range(6):
        on = 1.0 if pose_free[pose, p] else 0.0
        for q in range(6):
            sums.U[i, p, q] = N[p, q] * on if pose_free[pose, q] else 0.0
        sums.g[i, p] = N[p, RESIDUAL] * on
        for q in range(f):
            blocks.C[i, p, q] = N[p, RESIDUAL + 1 + q] * on
        if not pose_free[pose, p]:
            sums.U[i, p, p] = 1.0
    for p in range(f):
        sums.gi[a, p] += N[RESIDUAL + 1 + p, RESIDUAL]
        for q in range(f):
            sums.D[a, p, q] += N[RESIDUAL + 1 + p, RESIDUAL + 1 + q]


@kernel
def _add_to_points(
    i: int,
    observations: Observations,
    weight: FloatArray,
    pose_free: BoolArray,
    sums: Sums,
    blocks: Blocks,
) -> None:
    """Add B'B, B'r and W' of the image points of photograph i; B is -A of the projection centre."""
    a = observations.camera[i]
    f = observations.free_count[a]
    first = 6 * observations.poses
    row = 0
    for h in range(blocks.first[i], blocks.first[i + 1]):
        o = blocks.order[h]
        j = observations.point[o]
        if weight[o] > 0.0:
            x, y = sums.A[row], sums.A[row + 1]
            row += 2
            x0, x1, x2, y0, y1, y2 = x[0], x[1], x[2], y[0], y[1], y[2]
            V, gp, Y, Yi = sums.V[j], sums.gp[j], blocks.Y[o], sums.Y_interior[j]
            for q in range(6):
                Y[0, q] = -(x0 * x[q] + y0 * y[q])
                Y[1, q] = -(x1 * x[q] + y1 * y[q])
                Y[2, q] = -(x2 * x[q] + y2 * y[q])
            V[0, 0] += x0 * x0 + y0 * y0
            V[1, 0] += x1 * x0 + y1 * y0
            V[1, 1] += x1 * x1 + y1 * y1
            V[2, 0] += x2 * x0 + y2 * y0
            V[2, 1] += x2 * x1 + y2 * y1
            V[2, 2] += x2 * x2 + y2 * y2
            r0, r1 = x[RESIDUAL], y[RESIDUAL]
            gp[0] -= x0 * r0 + y0 * r1
            gp[1] -= x1 * r0 + y1 * r1
            gp[2] -= x2 * r0 + y2 * r1
            for q in range(f):
                c = observations.free_column[a, q] - first
                u, v = x[RESIDUAL + 1 + q], y[RESIDUAL + 1 + q]
                Yi[0, c] -= x0 * u + y0 * v
                Yi[1, c] -= x1 * u + y1 * v
                Yi[2, c] -= x2 * u + y2 * v
            for q in range(6):
                if not pose_free[observations.pose_of[i], q]:
                    Y[0, q] = Y[1, q] = Y[2, q] = 0.0
        else:
            for p in range(3):
                for q in range(6):
                    blocks.Y[o, p, q] = 0.0


@kernel
def sum_poses(observations: Observations, pose_free: BoolArray, sums: Sums, blocks: Blocks) -> None:
    """Sum U and g of the photographs of each pose; fixed unknowns keep their rows.

    Args:
        observations: image points.
        pose_free: which unknowns of each pose are free, (poses, 6).
        sums: U and g of each photograph.
        blocks: receive the sums.
    """
    blocks.U[:] = 0.0
    blocks.g[:] = 0.0
    for i in range(len(observations.pose_of)):
        pose = observations.pose_of[i]
        for p in range(6):
            blocks.g[pose, p] += sums.g[i, p]
            for q in range(6):
                blocks.U[pose, p, q] += sums.U[i, p, q]
    for pose in range(observations.poses):
        for p in range(6):
            if not pose_free[pose, p]:
                blocks.U[pose, p, p] = 1.0


@kernel
def eliminate_points(
    observations: Observations,
    point_free: BoolArray,
    slot: IntArray,
    kept_start: int,
    stretch: float,
    blocks: Blocks,
) -> None:
    """Factor V = L L' of each object point and turn W' into Y' = L^-1 W'; kept points go to K instead.

    Args:
        observations: image points.
        point_free: free coordinates, (n, 3).
        slot: index of each object point among the kept points, -1 for the others, (n,).
        kept_start: column of the first kept point.
        stretch: factor on the diagonal of V (Marquardt), 1 without damping.
        blocks: the blocks to fill.
    """
    blocks.Yy[:] = 0.0
    for j in range(len(slot)):
        V, L, y, gp = blocks.V[j], blocks.L[j], blocks.y[j], blocks.gp[j]
        V[0, 1], V[0, 2], V[1, 2] = V[1, 0], V[2, 0], V[2, 1]
        for p in range(3):
            if not point_free[j, p]:
                for q in range(3):
                    V[p, q] = V[q, p] = 0.0
                V[p, p] = 1.0
                gp[p] = 0.0
                for q in range(blocks.Y_interior.shape[2]):
                    blocks.Y_interior[j, p, q] = 0.0
                for o in range(observations.start[j], observations.start[j + 1]):
                    for q in range(6):
                        blocks.Y[o, p, q] = 0.0
        if slot[j] >= 0:
            _keep(j, 3 * slot[j], observations, kept_start, blocks)
            continue
        blocks.held[j] = _factor(j, blocks.V, stretch, blocks.L)
        y[0] = gp[0] / L[0, 0]
        y[1] = (gp[1] - L[1, 0] * y[0]) / L[1, 1]
        y[2] = (gp[2] - L[2, 0] * y[0] - L[2, 1] * y[1]) / L[2, 2]
        for o in range(observations.start[j], observations.start[j + 1]):
            _forward(j, blocks.L, blocks.y, blocks.Y[o], blocks.Yy, 6 * observations.pose[o])
        _forward(j, blocks.L, blocks.y, blocks.Y_interior[j], blocks.Yy, 6 * observations.poses)


@inlined
def _keep(j: int, row: int, observations: Observations, kept_start: int, blocks: Blocks) -> None:
    """Move W' of a kept point to its rows K of the reduced system."""
    first = 6 * observations.poses
    blocks.held[j] = 0
    for p in range(3):
        for c in range(blocks.K.shape[1]):
            blocks.K[row + p, c] = 0.0
        for o in range(observations.start[j], observations.start[j + 1]):
            for q in range(6):
                blocks.K[row + p, 6 * observations.pose[o] + q] += blocks.Y[o, p, q]
                blocks.Y[o, p, q] = 0.0
        for c in range(blocks.Y_interior.shape[2]):
            blocks.K[row + p, first + c] = blocks.Y_interior[j, p, c]
            blocks.Y_interior[j, p, c] = 0.0
        for q in range(3):
            blocks.K[row + p, kept_start + row + q] = blocks.V[j, p, q]
            blocks.L[j, p, q] = 1.0 if p == q else 0.0
        blocks.y[j, p] = 0.0


@inlined
def _factor(j: int, V: FloatArray, stretch: float, L: FloatArray) -> int:
    """Factor V with its diagonal times `stretch`; return the number of open directions, which are held."""
    held = 0
    for p in range(3):
        pivot = V[j, p, p] * stretch
        for q in range(p):
            pivot -= L[j, p, q] * L[j, p, q]
        if pivot > SINGULAR_PIVOT * V[j, p, p]:
            L[j, p, p] = np.sqrt(pivot)
        else:
            held += 1
            L[j, p, p] = STIFFENING * np.sqrt(V[j, p, p]) if V[j, p, p] > 0.0 else STIFFENING
        for s in range(p + 1, 3):
            total = V[j, s, p]
            for q in range(p):
                total -= L[j, s, q] * L[j, p, q]
            L[j, s, p] = total / L[j, p, p]
            L[j, p, s] = 0.0
    return held


@inlined
def _forward(j: int, L: FloatArray, y: FloatArray, W: FloatArray, Yy: FloatArray, column: int) -> None:
    """Replace columns of the three rows W' of point j by L^-1 W', and add their part of Y y."""
    i0, i1, i2 = 1.0 / L[j, 0, 0], 1.0 / L[j, 1, 1], 1.0 / L[j, 2, 2]
    l10, l20, l21 = L[j, 1, 0], L[j, 2, 0], L[j, 2, 1]
    for q in range(W.shape[1]):
        w0 = W[0, q] * i0
        w1 = (W[1, q] - l10 * w0) * i1
        w2 = (W[2, q] - l20 * w0 - l21 * w1) * i2
        W[0, q], W[1, q], W[2, q] = w0, w1, w2
        Yy[column + q] += w0 * y[j, 0] + w1 * y[j, 1] + w2 * y[j, 2]


@kernel
def gather_interior(
    observations: Observations, blocks: Blocks, border: FloatArray, corner: FloatArray, g: FloatArray
) -> None:
    """Write the blocks of photographs and cameras into the border, the corner and the right-hand side.

    Args:
        observations: image points.
        blocks: filled blocks.
        border: poses x interior unknowns, (6 poses, i).
        corner: interior unknowns, (i, i).
        g: right-hand side, (reduced,).
    """
    first = 6 * observations.poses
    for i in range(observations.poses):
        for p in range(6):
            g[6 * i + p] = blocks.g[i, p]
    for i in range(len(observations.camera)):
        a, row = observations.camera[i], 6 * observations.pose_of[i]
        for p in range(6):
            for q in range(observations.free_count[a]):
                border[row + p, observations.free_column[a, q] - first] += blocks.C[i, p, q]
    for a in range(len(observations.free_count)):
        for p in range(observations.free_count[a]):
            row = observations.free_column[a, p] - first
            g[first + row] += blocks.gi[a, p]
            for q in range(observations.free_count[a]):
                corner[row, observations.free_column[a, q] - first] += blocks.D[a, p, q]
