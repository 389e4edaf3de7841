"""Normal equations of all image points, reduced to orientations and kept points by the Schur complement.

With N = (U W; W' V), V block diagonal with one L L' per object point, and Y = W L^-T, the reduced
normal equations are (U - Y Y') dx = -(g - Y y), y = L^-1 g_points. One pass over the image points,
point by point, fills U and the rows of Y'; no Jacobian is stored. Y Y' is one symmetric product.

Source: Brown (1958, 1976); Mikhail, Bethel and McGlone (2001), sec. 5.8; Foerstner and Wrobel (2016),
sec. 15.2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg.blas import dsyrk

from sfm.adjustment.collinearity import State, collinearity, scratch
from sfm.adjustment.parameters import Unknowns
from sfm.adjustment.weighted import Weighted, point_terms, weighted_terms
from sfm.conventions import FloatArray, IntArray
from sfm.distortion.models import MAX_PARAMETERS
from sfm.errors import GeometryError

SINGULAR_PIVOT = 1e-13  # share of a point's own normal equation left below which its rays are parallel
LARGEST_BYTES = 6e9  # of Y'; larger networks would swap
STIFF = 1e10  # factor on the pivot that holds such a direction of a point


class Blocks(NamedTuple):
    """Parts of the normal equations that one pass over the image points fills."""

    U: FloatArray  # X0, w of each photograph by themselves and all its interior parameters, upper
    # triangle, (m, 6, 6 + MAX_PARAMETERS)
    D: FloatArray  # all interior parameters of each camera, upper triangle, (a, MAX_PARAMETERS, same)
    g: FloatArray  # right side of X0, w, (m, 6)
    gi: FloatArray  # right side of interior parameters, (a, MAX_PARAMETERS)
    V: FloatArray  # object points before elimination, (n, 3, 3)
    gp: FloatArray  # right side of object points, (n, 3)
    L: FloatArray  # Cholesky factors of V; unit matrix for kept points, (n, 3, 3)
    y: FloatArray  # L^-1 gp; 0 for kept points, (n, 3)
    Yt: FloatArray  # rows of Y', 0 for kept points, (3 n, reduced)
    K: FloatArray  # kept points by all reduced unknowns, (3 s, reduced)
    held: IntArray  # 1 where a direction of a point had to be held, (n,)


class Normals(NamedTuple):
    """Reduced normal equations S dx = -g and what is needed to get the object points back."""

    S: FloatArray  # upper triangle filled, column-major, (reduced, reduced)
    g: FloatArray  # (reduced,)
    diagonal: FloatArray  # of the normal equations before reduction, (reduced,)
    blocks: Blocks
    vPv: float  # weighted sum of squares at the state; infinite if a point is behind a camera


def normal_equations(
    layout: Unknowns,
    weighted: Weighted,
    state: State,
    weight: FloatArray,
    *,
    damping: float = 0.0,
    space: Blocks | None = None,
) -> Normals:
    """Return the reduced normal equations at a state.

    Args:
        layout: order of the unknowns.
        weighted: observed unknowns.
        state: values of all parameters.
        weight: factor on the weight of each image point, 0 = takes no part, shape (k,).
        damping: share of its diagonal added to the whole normal matrix (Marquardt); 0 for the truth.
        space: blocks to be used again.
    """
    blocks = new_blocks(layout) if space is None else space
    Np, gp = point_terms(weighted, state)
    terms = weighted_terms(weighted, layout, state)
    slot = np.full(len(state.points), -1, dtype=np.int64)
    slot[layout.kept] = np.arange(len(layout.kept))
    vPv = _accumulate(
        layout.obs,
        state,
        weight,
        Np,
        gp,
        layout.point_free,
        slot,
        layout.kept_start,
        1 + damping,
        blocks,
    )
    for e, i in enumerate(weighted.image):
        blocks.U[i, :, :6] += terms.exterior[e]
        blocks.g[i] += terms.exterior_g[e]
    S = np.zeros((layout.reduced, layout.reduced), order="F")
    g = np.zeros(layout.reduced)
    _assemble(layout.obs, layout.kept_start, blocks, S, g)
    np.add.at(S, (weighted.column, weighted.column), weighted.interior_weight)
    np.add.at(g, weighted.column, terms.interior_g)
    S[layout.kept_start :, layout.kept_start :] += terms.kept
    g[layout.kept_start :] += terms.kept_g + blocks.gp[layout.kept].ravel()
    fixed = np.flatnonzero(~layout.reduced_free())
    if len(fixed):
        S[fixed] = S[:, fixed] = 0.0
        S[fixed, fixed] = 1.0
        g[fixed] = 0.0
        blocks.Yt[:, fixed] = 0.0
    diagonal = S.diagonal().copy()
    np.einsum("aa->a", S)[:] *= 1 + damping
    S = dsyrk(-1.0, blocks.Yt.T, beta=1.0, c=S, overwrite_c=1)
    g -= blocks.y.ravel() @ blocks.Yt
    return Normals(S, g, diagonal, blocks, vPv + terms.vPv)


def point_step(normals: Normals, reduced_step: FloatArray, layout: Unknowns) -> FloatArray:
    """Return the step of all object points that belongs to a step of the reduced unknowns, (n, 3)."""
    b = normals.blocks
    n = len(b.y)
    h = -(b.y + (b.Yt @ reduced_step).reshape(n, 3))
    dX = _solve_transposed(b.L, h)
    dX[layout.kept] = reduced_step[layout.kept_start :].reshape(-1, 3)
    return np.where(layout.point_free, dX, 0.0)


def new_blocks(layout: Unknowns) -> Blocks:
    """Return space for the blocks of a network.

    Raises:
        GeometryError: the dense system would not fit in memory.
    """
    m, n, a = len(layout.exterior_free), len(layout.point_free), len(layout.interior_free)
    q = MAX_PARAMETERS
    size = 8 * 3 * n * layout.reduced
    if size > LARGEST_BYTES:
        raise GeometryError(
            f"adjustment: {m} photographs and {n} points need {size / 1e9:.0f} GB in one dense system, "
            f"at most {LARGEST_BYTES / 1e9:.0f} GB are taken"
        )
    return Blocks(
        U=np.empty((m, 6, 6 + q)),
        D=np.empty((a, q, q)),
        g=np.empty((m, 6)),
        gi=np.empty((a, q)),
        V=np.empty((n, 3, 3)),
        gp=np.empty((n, 3)),
        L=np.empty((n, 3, 3)),
        y=np.empty((n, 3)),
        Yt=np.zeros((3 * n, layout.reduced)),
        K=np.zeros((3 * len(layout.kept), layout.reduced)),
        held=np.zeros(n, dtype=np.int64),
    )


@njit(cache=True, error_model="numpy")
def _accumulate(obs, state, weight, Np, gp0, point_free, slot, kept_start, stretch, b):  # type: ignore[no-untyped-def]
    """Fill the blocks in one pass, point by point; return v'Pv, infinite with points behind cameras."""
    t = scratch()
    first_interior = 6 * len(obs.camera)
    b.U[:] = 0.0
    b.D[:] = 0.0
    b.g[:] = 0.0
    b.gi[:] = 0.0
    E = np.zeros((3, t.Jp.shape[1]))
    vPv = 0.0
    for j in range(len(state.points)):
        row = 3 * slot[j] if slot[j] >= 0 else 3 * j
        rows = b.K if slot[j] >= 0 else b.Yt
        for p in range(3):
            for q in range(first_interior, rows.shape[1]):
                rows[row + p, q] = 0.0
            for q in range(3):
                b.V[j, p, q] = Np[j, p, q]
            b.gp[j, p] = gp0[j, p]
        last_image, last_camera = -1, -1
        for o in range(obs.start[j], obs.start[j + 1]):
            i = obs.image[o]
            if i != last_image:
                for p in range(3):
                    for q in range(6 * i, 6 * i + 6):
                        rows[row + p, q] = 0.0
                last_image = i
            if weight[o] > 0.0:
                a = obs.camera[i]
                if a != last_camera:
                    _add_interior(E, last_camera, obs, rows, row)
                    last_camera = a
                if not collinearity(o, obs, state, weight[o], t):
                    vPv = np.inf
                vPv += t.r[0] * t.r[0] + t.r[1] * t.r[1]
                _add_image_point(i, a, obs.interior[a], j, t, b, rows, row, E)
        _add_interior(E, last_camera, obs, rows, row)
        for p in range(3):
            for q in range(p):
                b.V[j, p, q] = b.V[j, q, p]
        for p in range(3):
            if not point_free[j, p]:
                for q in range(3):
                    b.V[j, p, q] = b.V[j, q, p] = 0.0
                b.V[j, p, p] = 1.0
                b.gp[j, p] = 0.0
                for q in range(rows.shape[1]):
                    rows[row + p, q] = 0.0
        if slot[j] >= 0:
            for p in range(3):
                for q in range(3):
                    rows[row + p, kept_start + row + q] = b.V[j, p, q]
                    b.L[j, p, q] = 1.0 if p == q else 0.0
                b.y[j, p] = 0.0
            b.held[j] = 0
        else:
            b.held[j] = _factor(j, b.V, stretch, b.L)
            _forward(j, b.L, b.gp, b.y)
            last_image = -1
            for o in range(obs.start[j], obs.start[j + 1]):
                i = obs.image[o]
                if i != last_image:
                    _forward_columns(j, b.L, rows, row, 6 * i, 6 * i + 6)
                    last_image = i
            _forward_columns(j, b.L, rows, row, first_interior, kept_start)
    return vPv


@njit(cache=True, inline="always", error_model="numpy")
def _add_image_point(i, a, f, j, t, b, rows, row, E):  # type: ignore[no-untyped-def]
    """Add one weighted image point to the blocks; rows holds W' of its object point, E its interior part.

    With A = (-B, R, I) every product with B serves the point and, turned in sign, the projection centre.
    """
    for p in range(3):
        B0, B1 = t.B[0, p], t.B[1, p]
        R0, R1 = t.A[0, 3 + p], t.A[1, 3 + p]
        for q in range(p, 3):
            BB = B0 * t.B[0, q] + B1 * t.B[1, q]
            b.V[j, p, q] += BB
            b.U[i, p, q] += BB
            rows[row + p, 6 * i + q] -= BB
            if q > p:
                rows[row + q, 6 * i + p] -= BB
            b.U[i, 3 + p, 3 + q] += R0 * t.A[0, 3 + q] + R1 * t.A[1, 3 + q]
        for q in range(3):
            BR = B0 * t.A[0, 3 + q] + B1 * t.A[1, 3 + q]
            b.U[i, p, 3 + q] -= BR
            rows[row + p, 6 * i + 3 + q] += BR
        Br = B0 * t.r[0] + B1 * t.r[1]
        b.gp[j, p] += Br
        b.g[i, p] -= Br
        b.g[i, 3 + p] += R0 * t.r[0] + R1 * t.r[1]
        for q in range(f):
            BI = B0 * t.A[0, 6 + q] + B1 * t.A[1, 6 + q]
            E[p, q] += BI
            b.U[i, p, 6 + q] -= BI
            b.U[i, 3 + p, 6 + q] += R0 * t.A[0, 6 + q] + R1 * t.A[1, 6 + q]
    for p in range(f):
        x, y = t.A[0, 6 + p], t.A[1, 6 + p]
        for q in range(p, f):
            b.D[a, p, q] += x * t.A[0, 6 + q] + y * t.A[1, 6 + q]
        b.gi[a, p] += x * t.r[0] + y * t.r[1]


@njit(cache=True, inline="always", error_model="numpy")
def _add_interior(E, a, obs, rows, row):  # type: ignore[no-untyped-def]
    """Add the free interior columns of camera a to the rows of a point and clear E."""
    if a >= 0:
        for p in range(3):
            for q in range(obs.free_count[a]):
                rows[row + p, obs.free_column[a, q]] += E[p, obs.free_index[a, q]]
        E[:] = 0.0


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
def _forward(j, L, g, y):  # type: ignore[no-untyped-def]
    """y = L^-1 g."""
    y[j, 0] = g[j, 0] / L[j, 0, 0]
    y[j, 1] = (g[j, 1] - L[j, 1, 0] * y[j, 0]) / L[j, 1, 1]
    y[j, 2] = (g[j, 2] - L[j, 2, 0] * y[j, 0] - L[j, 2, 1] * y[j, 1]) / L[j, 2, 2]


@njit(cache=True, inline="always", error_model="numpy")
def _forward_columns(j, L, rows, row, first, end):  # type: ignore[no-untyped-def]
    """Replace columns of the three rows W' of point j by L^-1 W'."""
    i0, i1, i2 = 1.0 / L[j, 0, 0], 1.0 / L[j, 1, 1], 1.0 / L[j, 2, 2]
    l10, l20, l21 = L[j, 1, 0], L[j, 2, 0], L[j, 2, 1]
    for q in range(first, end):
        y0 = rows[row, q] * i0
        y1 = (rows[row + 1, q] - l10 * y0) * i1
        rows[row, q] = y0
        rows[row + 1, q] = y1
        rows[row + 2, q] = (rows[row + 2, q] - l20 * y0 - l21 * y1) * i2


@njit(cache=True, error_model="numpy")
def _solve_transposed(L, h):  # type: ignore[no-untyped-def]
    """Return L^-T h for every point, (n, 3)."""
    x = np.empty_like(h)
    for j in range(len(h)):
        x[j, 2] = h[j, 2] / L[j, 2, 2]
        x[j, 1] = (h[j, 1] - L[j, 2, 1] * x[j, 2]) / L[j, 1, 1]
        x[j, 0] = (h[j, 0] - L[j, 1, 0] * x[j, 1] - L[j, 2, 0] * x[j, 2]) / L[j, 0, 0]
    return x


@njit(cache=True, error_model="numpy")
def _assemble(obs, kept_start, b, S, g):  # type: ignore[no-untyped-def]
    """Write the blocks into the upper triangle of S and into g."""
    for i in range(len(obs.camera)):
        a = obs.camera[i]
        for p in range(6):
            g[6 * i + p] = b.g[i, p]
            for q in range(p, 6):
                S[6 * i + p, 6 * i + q] = b.U[i, p, q]
            for q in range(obs.free_count[a]):
                S[6 * i + p, obs.free_column[a, q]] = b.U[i, p, 6 + obs.free_index[a, q]]
    for a in range(len(obs.free_count)):
        for p in range(obs.free_count[a]):
            s, row = obs.free_index[a, p], obs.free_column[a, p]
            g[row] += b.gi[a, s]
            for q in range(p, obs.free_count[a]):
                column = obs.free_column[a, q]  # shared parameters stand in the columns of an earlier camera
                S[min(row, column), max(row, column)] += b.D[a, s, obs.free_index[a, q]]
    for p in range(len(b.K)):
        for q in range(kept_start + p + 1):
            S[q, kept_start + p] = b.K[p, q]
