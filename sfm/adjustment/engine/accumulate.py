"""Kernels that sum the normal equations of all image points, photograph by photograph, then point by point.

With the derivatives A = (X0, w | interior) and B = (X, Y, Z) of an image point, weighted, and its residual r,
a photograph adds (A r)'(A r) of all its image points in one product, and each image point W' = B'A, V = B'B
and B'r to its object point. No Jacobian of more than one photograph is stored.

Source: Brown (1976), Photogramm. Eng. Remote Sens. 42(8); Foerstner and Wrobel (2016), sec. 15.2.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sfm.adjustment.engine.collinearity import collinearity
from sfm.kernels.options import kernel

SINGULAR_PIVOT = 1e-13  # share of a point's own normal equation left below which its rays are parallel
STIFF = 1e10  # factor on the pivot that holds such a direction of a point
RESIDUAL = 6  # column of the residual among A: X0, w, residual, interior


@njit(cache=True, error_model="numpy", nogil=True)
def add_photographs(obs, state, weight, exterior_free, t, s, b):  # type: ignore[no-untyped-def]
    """Fill the blocks U, C, g, Y of some photographs and add to the sums over photographs.

    Args:
        obs: image points.
        state: values of all parameters.
        weight: factor on the weight of each image point, (k,).
        exterior_free: (m, 6).
        t: space for one image point.
        s: which photographs, and the sums that they add to.
        b: blocks.

    Returns:
        Their v'Pv, infinite with a point behind the camera.
    """
    s.D[:] = 0.0
    s.gi[:] = 0.0
    s.Z[:] = 0.0
    vPv = 0.0
    for i in range(s.first, s.end):
        a = obs.camera[i]
        rays = _derivatives(i, obs, state, weight, t, s.A, b)
        A = s.A[: 2 * abs(rays)]
        N = np.dot(A.T, A)
        vPv += N[RESIDUAL, RESIDUAL] if rays >= 0 else np.inf
        _add_photograph(i, a, obs.free_count[a], N, exterior_free, s, b)
        _add_to_points(i, obs, weight, exterior_free, s, b)
    return vPv


@kernel
def _derivatives(i, obs, state, weight, t, A, b):  # type: ignore[no-untyped-def]
    """Fill two rows of A and B for each image point of photograph i that takes part.

    Returns how many these are, made negative where one is behind the camera.
    """
    a = obs.camera[i]
    rays, in_front = 0, True
    for h in range(b.first[i], b.first[i + 1]):
        o = b.order[h]
        if weight[o] > 0.0:
            if not collinearity(o, obs, state, weight[o], t):
                in_front = False
            x, y = A[2 * rays], A[2 * rays + 1]
            for p in range(6):
                x[p], y[p] = t.A[0, p], t.A[1, p]
            x[RESIDUAL], y[RESIDUAL] = t.r[0], t.r[1]
            for q in range(obs.free_count[a]):
                own = 6 + obs.free_index[a, q]
                x[RESIDUAL + 1 + q], y[RESIDUAL + 1 + q] = t.A[0, own], t.A[1, own]
            rays += 1
    return rays if in_front else -rays


@kernel
def _add_photograph(i, a, f, N, exterior_free, sums, b):  # type: ignore[no-untyped-def]
    """Share out the sum (A r)'(A r) of photograph i; fixed unknowns keep their place with derivatives 0."""
    for p in range(6):
        on = 1.0 if exterior_free[i, p] else 0.0
        for q in range(6):
            b.U[i, p, q] = N[p, q] * on if exterior_free[i, q] else 0.0
        b.g[i, p] = N[p, RESIDUAL] * on
        for q in range(f):
            b.C[i, p, q] = N[p, RESIDUAL + 1 + q] * on
        if not exterior_free[i, p]:
            b.U[i, p, p] = 1.0
    for p in range(f):
        sums.gi[a, p] += N[RESIDUAL + 1 + p, RESIDUAL]
        for q in range(f):
            sums.D[a, p, q] += N[RESIDUAL + 1 + p, RESIDUAL + 1 + q]


@kernel
def _add_to_points(i, obs, weight, exterior_free, sums, b):  # type: ignore[no-untyped-def]
    """Add B'B, B'r, W' of the image points of photograph i; B = -A of the projection centre."""
    a = obs.camera[i]
    f = obs.free_count[a]
    first = 6 * len(obs.camera)
    row = 0
    for h in range(b.first[i], b.first[i + 1]):
        o = b.order[h]
        j = obs.point[o]
        if weight[o] > 0.0:
            x, y = sums.A[row], sums.A[row + 1]
            row += 2
            x0, x1, x2, y0, y1, y2 = x[0], x[1], x[2], y[0], y[1], y[2]
            V, gp, Y, Z = sums.V[j], sums.gp[j], b.Y[o], sums.Z[j]
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
                c = obs.free_column[a, q] - first
                u, v = x[RESIDUAL + 1 + q], y[RESIDUAL + 1 + q]
                Z[0, c] -= x0 * u + y0 * v
                Z[1, c] -= x1 * u + y1 * v
                Z[2, c] -= x2 * u + y2 * v
            for q in range(6):
                if not exterior_free[i, q]:
                    Y[0, q] = Y[1, q] = Y[2, q] = 0.0
        else:
            for p in range(3):
                for q in range(6):
                    b.Y[o, p, q] = 0.0


@kernel
def eliminate_points(obs, point_free, slot, kept_start, stretch, b):  # type: ignore[no-untyped-def]
    """Factor V = L L' of each object point and turn W' into Y' = L^-1 W'; kept points go to K instead.

    Args:
        obs: image points.
        point_free: free coordinates, (n, 3).
        slot: place of each object point among the kept ones, -1 for the others, (n,).
        kept_start: column of the first kept point.
        stretch: factor on the diagonal of V (Marquardt), 1 for the truth.
        b: blocks.
    """
    b.Yy[:] = 0.0
    for j in range(len(slot)):
        b.V[j, 0, 1], b.V[j, 0, 2], b.V[j, 1, 2] = b.V[j, 1, 0], b.V[j, 2, 0], b.V[j, 2, 1]
        for p in range(3):
            if not point_free[j, p]:
                for q in range(3):
                    b.V[j, p, q] = b.V[j, q, p] = 0.0
                b.V[j, p, p] = 1.0
                b.gp[j, p] = 0.0
                for q in range(b.Z.shape[2]):
                    b.Z[j, p, q] = 0.0
                for o in range(obs.start[j], obs.start[j + 1]):
                    for q in range(6):
                        b.Y[o, p, q] = 0.0
        if slot[j] >= 0:
            _keep(j, 3 * slot[j], obs, kept_start, b)
            continue
        b.held[j] = _factor(j, b.V, stretch, b.L)
        b.y[j, 0] = b.gp[j, 0] / b.L[j, 0, 0]
        b.y[j, 1] = (b.gp[j, 1] - b.L[j, 1, 0] * b.y[j, 0]) / b.L[j, 1, 1]
        b.y[j, 2] = (b.gp[j, 2] - b.L[j, 2, 0] * b.y[j, 0] - b.L[j, 2, 1] * b.y[j, 1]) / b.L[j, 2, 2]
        for o in range(obs.start[j], obs.start[j + 1]):
            _forward(j, b.L, b.y, b.Y[o], b.Yy, 6 * obs.image[o])
        _forward(j, b.L, b.y, b.Z[j], b.Yy, 6 * len(obs.camera))


@njit(cache=True, inline="always", error_model="numpy")
def _keep(j, row, obs, kept_start, b):  # type: ignore[no-untyped-def]
    """Move W' of a kept point to its rows K of the reduced system."""
    first = 6 * len(obs.camera)
    b.held[j] = 0
    for p in range(3):
        for c in range(b.K.shape[1]):
            b.K[row + p, c] = 0.0
        for o in range(obs.start[j], obs.start[j + 1]):
            for q in range(6):
                b.K[row + p, 6 * obs.image[o] + q] += b.Y[o, p, q]
                b.Y[o, p, q] = 0.0
        for c in range(b.Z.shape[2]):
            b.K[row + p, first + c] = b.Z[j, p, c]
            b.Z[j, p, c] = 0.0
        for q in range(3):
            b.K[row + p, kept_start + row + q] = b.V[j, p, q]
            b.L[j, p, q] = 1.0 if p == q else 0.0
        b.y[j, p] = 0.0


@njit(cache=True, inline="always", error_model="numpy")
def _factor(j, V, stretch, L):  # type: ignore[no-untyped-def]
    """Cholesky factor of V with its diagonal times stretch; holds directions that the rays leave open."""
    held = 0
    for p in range(3):
        pivot = V[j, p, p] * stretch
        for q in range(p):
            pivot -= L[j, p, q] * L[j, p, q]
        if pivot > SINGULAR_PIVOT * V[j, p, p]:
            L[j, p, p] = np.sqrt(pivot)
        else:
            held = 1
            L[j, p, p] = STIFF * np.sqrt(V[j, p, p]) if V[j, p, p] > 0.0 else STIFF
        for s in range(p + 1, 3):
            total = V[j, s, p]
            for q in range(p):
                total -= L[j, s, q] * L[j, p, q]
            L[j, s, p] = total / L[j, p, p]
            L[j, p, s] = 0.0
    return held


@njit(cache=True, inline="always", error_model="numpy")
def _forward(j, L, y, W, Yy, column):  # type: ignore[no-untyped-def]
    """Replace some columns of the three rows W' of point j by L^-1 W' and add their part of Y y."""
    i0, i1, i2 = 1.0 / L[j, 0, 0], 1.0 / L[j, 1, 1], 1.0 / L[j, 2, 2]
    l10, l20, l21 = L[j, 1, 0], L[j, 2, 0], L[j, 2, 1]
    for q in range(W.shape[1]):
        w0 = W[0, q] * i0
        w1 = (W[1, q] - l10 * w0) * i1
        w2 = (W[2, q] - l20 * w0 - l21 * w1) * i2
        W[0, q], W[1, q], W[2, q] = w0, w1, w2
        Yy[column + q] += w0 * y[j, 0] + w1 * y[j, 1] + w2 * y[j, 2]


@kernel
def step_points(obs, point_free, b, dx, dX):  # type: ignore[no-untyped-def]
    """Fill the step of the object points dX = -L^-T (y + Y'dx), dx of the reduced unknowns; 0 where fixed."""
    first = 6 * len(obs.camera)
    for j in range(len(dX)):
        h0, h1, h2 = b.y[j, 0], b.y[j, 1], b.y[j, 2]
        for q in range(b.Z.shape[2]):
            d = dx[first + q]
            h0 += b.Z[j, 0, q] * d
            h1 += b.Z[j, 1, q] * d
            h2 += b.Z[j, 2, q] * d
        for o in range(obs.start[j], obs.start[j + 1]):
            Y, column = b.Y[o], 6 * obs.image[o]
            for q in range(6):
                d = dx[column + q]
                h0 += Y[0, q] * d
                h1 += Y[1, q] * d
                h2 += Y[2, q] * d
        L = b.L[j]
        z = -h2 / L[2, 2]
        y = (-h1 - L[2, 1] * z) / L[1, 1]
        x = (-h0 - L[1, 0] * y - L[2, 0] * z) / L[0, 0]
        dX[j, 0] = x if point_free[j, 0] else 0.0
        dX[j, 1] = y if point_free[j, 1] else 0.0
        dX[j, 2] = z if point_free[j, 2] else 0.0


@kernel
def gather_interior(obs, b, border, corner, g):  # type: ignore[no-untyped-def]
    """Write the blocks of photographs and cameras into border, corner and right side."""
    first = 6 * len(obs.camera)
    for i in range(len(obs.camera)):
        a = obs.camera[i]
        for p in range(6):
            g[6 * i + p] = b.g[i, p]
            for q in range(obs.free_count[a]):
                border[6 * i + p, obs.free_column[a, q] - first] = b.C[i, p, q]
    for a in range(len(obs.free_count)):
        for p in range(obs.free_count[a]):
            row = obs.free_column[a, p] - first
            g[first + row] += b.gi[a, p]
            for q in range(obs.free_count[a]):
                corner[row, obs.free_column[a, q] - first] += b.D[a, p, q]


@kernel
def times_reduced(obs, b, x, out):  # type: ignore[no-untyped-def]
    """Fill out with Y' x: x of the reduced unknowns, (reduced, d), out of the object points, (n, 3, d)."""
    first = 6 * len(obs.camera)
    out[:] = 0.0
    for j in range(len(out)):
        for p in range(3):
            for q in range(b.Z.shape[2]):
                z = b.Z[j, p, q]
                for e in range(x.shape[1]):
                    out[j, p, e] += z * x[first + q, e]
        for o in range(obs.start[j], obs.start[j + 1]):
            column = 6 * obs.image[o]
            for p in range(3):
                for q in range(6):
                    y = b.Y[o, p, q]
                    for e in range(x.shape[1]):
                        out[j, p, e] += y * x[column + q, e]


@kernel
def times_points(obs, b, h, out):  # type: ignore[no-untyped-def]
    """Add Y h to out: h of the object points, (n, 3, d), out of the reduced unknowns, (reduced, d)."""
    first = 6 * len(obs.camera)
    for j in range(len(h)):
        for p in range(3):
            for q in range(b.Z.shape[2]):
                z = b.Z[j, p, q]
                for e in range(h.shape[2]):
                    out[first + q, e] += z * h[j, p, e]
        for o in range(obs.start[j], obs.start[j + 1]):
            column = 6 * obs.image[o]
            for p in range(3):
                for q in range(6):
                    y = b.Y[o, p, q]
                    for e in range(h.shape[2]):
                        out[column + q, e] += y * h[j, p, e]
