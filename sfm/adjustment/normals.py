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
from sfm.camera import MAX_PARAMETERS
from sfm.conventions import FloatArray, IntArray

SINGULAR_PIVOT = 1e-13  # share of a point's own normal equation left below which its rays are parallel
STIFF = 1e10  # factor on the pivot that holds such a direction of a point


class Blocks(NamedTuple):
    """Parts of the normal equations that one pass over the image points fills."""

    U: FloatArray  # X0, w of each photograph, (m, 6, 6)
    C: FloatArray  # X0, w of each photograph by its interior parameters, (m, 6, MAX_PARAMETERS)
    D: FloatArray  # interior parameters of each camera, (a, MAX_PARAMETERS, MAX_PARAMETERS)
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
        layout.obs, state, weight, layout.interior_start, Np, gp, slot, layout.kept_start, 1 + damping, blocks
    )
    for e, i in enumerate(weighted.image):
        blocks.U[i] += terms.exterior[e]
        blocks.g[i] += terms.exterior_g[e]
    S = np.zeros((layout.reduced, layout.reduced), order="F")
    g = np.zeros(layout.reduced)
    _assemble(
        layout.obs.camera, layout.obs.free_count, layout.interior_start, layout.kept_start, blocks, S, g
    )
    S[weighted.column, weighted.column] += weighted.interior_weight
    np.add.at(g, weighted.column, terms.interior_g)
    S[layout.kept_start :, layout.kept_start :] += terms.kept
    g[layout.kept_start :] += terms.kept_g + blocks.gp[layout.kept].ravel()
    fixed = np.flatnonzero(~layout.reduced_free())
    S[fixed, fixed] = 1.0
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
    """Return space for the blocks of a network."""
    m, n, a = len(layout.exterior_free), len(layout.point_free), len(layout.interior_free)
    q = MAX_PARAMETERS
    return Blocks(
        U=np.empty((m, 6, 6)),
        C=np.empty((m, 6, q)),
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


@njit(cache=True)
def _accumulate(obs, state, weight, interior_start, Np, gp0, slot, kept_start, stretch, b):  # type: ignore[no-untyped-def]
    """Fill the blocks in one pass, point by point; return v'Pv, infinite with points behind cameras."""
    t = scratch()
    b.U[:] = 0.0
    b.C[:] = 0.0
    b.D[:] = 0.0
    b.g[:] = 0.0
    b.gi[:] = 0.0
    vPv = 0.0
    for j in range(len(state.points)):
        V = b.V[j]
        gp = b.gp[j]
        V[:] = Np[j]
        gp[:] = gp0[j]
        kept = slot[j] >= 0
        rows = b.K[3 * slot[j] : 3 * slot[j] + 3] if kept else b.Yt[3 * j : 3 * j + 3]
        _clear(obs, interior_start, j, rows)
        if kept:
            rows[:, kept_start:] = 0.0
        for o in range(obs.start[j], obs.start[j + 1]):
            if weight[o] == 0.0:
                continue
            if not collinearity(o, obs, state, weight[o], t):
                vPv = np.inf
                continue
            vPv += t.r[0] * t.r[0] + t.r[1] * t.r[1]
            i = obs.image[o]
            a = obs.camera[i]
            _add_image_point(i, a, obs.free_count[a], interior_start[a], t, b, V, gp, rows)
        for p in range(3):
            if obs.point_free[j, p] == 0.0:
                V[p, :] = 0.0
                V[:, p] = 0.0
                V[p, p] = 1.0
                gp[p] = 0.0
        if kept:
            for p in range(3):
                for q in range(3):
                    rows[p, kept_start + 3 * slot[j] + q] = V[p, q]
            b.L[j] = np.eye(3)
            b.y[j] = 0.0
            b.held[j] = 0
        else:
            b.held[j] = _factor(V, stretch, b.L[j])
            _forward(b.L[j], gp, b.y[j])
            last = -1
            for o in range(obs.start[j], obs.start[j + 1]):
                if obs.image[o] != last:
                    _forward_columns(b.L[j], rows, 6 * obs.image[o], 6)
                last = obs.image[o]
            last = -1
            for o in range(obs.start[j], obs.start[j + 1]):
                a = obs.camera[obs.image[o]]
                if a != last and _first_of_camera(obs, o, j):
                    _forward_columns(b.L[j], rows, interior_start[a], obs.free_count[a])
                last = a
    return vPv


@njit(cache=True)
def _add_image_point(i, a, f, first, t, b, V, gp, rows):  # type: ignore[no-untyped-def]
    """Add one weighted image point to the blocks; rows are those of its object point in W'."""
    U, C, D = b.U[i], b.C[i], b.D[a]
    A, Ai, B, r = t.A, t.Ai, t.B, t.r
    for p in range(6):
        for q in range(p, 6):
            U[p, q] += A[0, p] * A[0, q] + A[1, p] * A[1, q]
        for q in range(f):
            C[p, q] += A[0, p] * Ai[0, q] + A[1, p] * Ai[1, q]
        b.g[i, p] += A[0, p] * r[0] + A[1, p] * r[1]
    for p in range(f):
        for q in range(p, f):
            D[p, q] += Ai[0, p] * Ai[0, q] + Ai[1, p] * Ai[1, q]
        b.gi[a, p] += Ai[0, p] * r[0] + Ai[1, p] * r[1]
    for p in range(3):
        for q in range(3):
            V[p, q] += B[0, p] * B[0, q] + B[1, p] * B[1, q]
        for q in range(6):
            rows[p, 6 * i + q] += B[0, p] * A[0, q] + B[1, p] * A[1, q]
        for q in range(f):
            rows[p, first + q] += B[0, p] * Ai[0, q] + B[1, p] * Ai[1, q]
        gp[p] += B[0, p] * r[0] + B[1, p] * r[1]


@njit(cache=True)
def _clear(obs, interior_start, j, rows):  # type: ignore[no-untyped-def]
    """Set to 0 the entries of the rows of point j that its image points will fill."""
    for o in range(obs.start[j], obs.start[j + 1]):
        i = obs.image[o]
        a = obs.camera[i]
        for p in range(3):
            rows[p, 6 * i : 6 * i + 6] = 0.0
            rows[p, interior_start[a] : interior_start[a] + obs.free_count[a]] = 0.0


@njit(cache=True)
def _first_of_camera(obs, o, j):  # type: ignore[no-untyped-def]
    """Whether image point o is the first of point j taken with its camera."""
    a = obs.camera[obs.image[o]]
    earlier = obs.start[j]
    while obs.camera[obs.image[earlier]] != a:
        earlier += 1
    return earlier == o


@njit(cache=True)
def _factor(V, stretch, L):  # type: ignore[no-untyped-def]
    """Cholesky factor of V with its diagonal times stretch; holds directions that the rays leave open."""
    held = 0
    L[:] = 0.0
    for p in range(3):
        pivot = V[p, p] * stretch
        for q in range(p):
            pivot -= L[p, q] * L[p, q]
        if pivot > SINGULAR_PIVOT * V[p, p]:
            L[p, p] = np.sqrt(pivot)
        else:
            held = 1
            L[p, p] = STIFF * np.sqrt(V[p, p]) if V[p, p] > 0.0 else STIFF
        for s in range(p + 1, 3):
            total = V[s, p]
            for q in range(p):
                total -= L[s, q] * L[p, q]
            L[s, p] = total / L[p, p]
    return held


@njit(cache=True)
def _forward(L, g, y):  # type: ignore[no-untyped-def]
    """y = L^-1 g."""
    y[0] = g[0] / L[0, 0]
    y[1] = (g[1] - L[1, 0] * y[0]) / L[1, 1]
    y[2] = (g[2] - L[2, 0] * y[0] - L[2, 1] * y[1]) / L[2, 2]


@njit(cache=True)
def _forward_columns(L, rows, first, count):  # type: ignore[no-untyped-def]
    """Replace columns of the three rows W' by L^-1 W'."""
    for q in range(first, first + count):
        rows[0, q] = rows[0, q] / L[0, 0]
        rows[1, q] = (rows[1, q] - L[1, 0] * rows[0, q]) / L[1, 1]
        rows[2, q] = (rows[2, q] - L[2, 0] * rows[0, q] - L[2, 1] * rows[1, q]) / L[2, 2]


@njit(cache=True)
def _solve_transposed(L, h):  # type: ignore[no-untyped-def]
    """Return L^-T h for every point, (n, 3)."""
    x = np.empty_like(h)
    for j in range(len(h)):
        x[j, 2] = h[j, 2] / L[j, 2, 2]
        x[j, 1] = (h[j, 1] - L[j, 2, 1] * x[j, 2]) / L[j, 1, 1]
        x[j, 0] = (h[j, 0] - L[j, 1, 0] * x[j, 1] - L[j, 2, 0] * x[j, 2]) / L[j, 0, 0]
    return x


@njit(cache=True)
def _assemble(camera, free_count, interior_start, kept_start, b, S, g):  # type: ignore[no-untyped-def]
    """Write the blocks into the upper triangle of S and into g."""
    for i in range(len(camera)):
        a = camera[i]
        for p in range(6):
            g[6 * i + p] = b.g[i, p]
            for q in range(p, 6):
                S[6 * i + p, 6 * i + q] = b.U[i, p, q]
            for q in range(free_count[a]):
                S[6 * i + p, interior_start[a] + q] = b.C[i, p, q]
    for a in range(len(free_count)):
        for p in range(free_count[a]):
            g[interior_start[a] + p] = b.gi[a, p]
            for q in range(p, free_count[a]):
                S[interior_start[a] + p, interior_start[a] + q] = b.D[a, p, q]
    for p in range(len(b.K)):
        for q in range(kept_start + p + 1):
            S[q, kept_start + p] = b.K[p, q]
