"""Elements of the inverse of the reduced normal matrix that marginal covariances are made of.

Of S^-1 only the blocks of single photographs, the border of interior unknowns and kept points, and between
photographs that share a point are needed: Y'S^-1 Y of an object point sums over pairs of its rays. The
full matrix gives them pair by pair of rays, or by products or triangular products of the rows Y', some points
at a time; the banded one by the elements of its inverse within the band,

    S^-1 = (Z + X Q X'   -X Q; -Q X'   Q)    Z = A^-1, X = A^-1 C, Q = (D - C' A^-1 C)^-1.

Source: Foerstner and Wrobel (2016), sec. 15.2.5; Golub and Plemmons (1980), Linear Algebra Appl. 34.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.linalg import cho_solve
from scipy.linalg.lapack import dlauum

from sfm.adjustment.engine.accumulate import times_reduced
from sfm.adjustment.engine.normals import Blocks, Equations
from sfm.adjustment.engine.solvers.banded import BandFactor
from sfm.adjustment.engine.solvers.banded_inverse import band_inverse
from sfm.adjustment.engine.solvers.dense import HALVED, Factor, rows_of
from sfm.adjustment.engine.solvers.pairs import times_inverse
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.conventions import FloatArray
from sfm.kernels.options import kernel
from sfm.kernels.threads import at_once

TRIANGLE_PARTS = 4  # stretches of columns of a triangular matrix; 5/8 of the work of a full one


@dataclass(frozen=True)
class Inverse:
    """Elements of S^-1, in the units of the unknowns, 0 where they are fixed."""

    exterior: FloatArray  # of X0, w of each photograph, (m, 6, 6)
    mixed: FloatArray  # of exterior by border unknowns, (6 m, i + 3 s)
    border: FloatArray  # of interior unknowns and kept points, (i + 3 s, i + 3 s)
    core: FloatArray  # Y'S^-1 Y of each object point, (n, 3, 3)
    YQ: FloatArray  # Y'S^-1 of the object point by the photograph of each image point, (k, 3, 6)
    YQ_border: FloatArray  # Y'S^-1 of each object point by the border, (n, 3, i + 3 s)


def inverse_of(
    equations: Equations, factor: Factor | BandFactor, layout: Unknowns, *, cross: bool
) -> Inverse:
    """Return the elements of the inverse of the reduced normal matrix.

    Args:
        equations: undamped normal equations.
        factor: of their reduced matrix.
        layout: order of the unknowns.
        cross: whether Y'S^-1 is wanted; empty otherwise.
    """
    if isinstance(factor, BandFactor):
        return _of_band(equations.blocks, factor, layout, cross)
    return _of_full(equations.blocks, factor, layout, cross)


def _of_full(b: Blocks, factor: Factor, layout: Unknowns, cross: bool) -> Inverse:
    m, n = len(b.U), len(b.y)
    W = factor.inverse_root()
    free = layout.reduced_free()
    if not free.all():
        W *= free[:, None]
    Q, _ = dlauum(W)
    _mirror(Q)
    first = 6 * m
    wanted = cross or factor.pairs is not None
    core = np.empty((n, 3, 3))
    YQ = np.empty((len(b.Y) if wanted else 0, 3, 6))
    YQ_border = np.empty((n if wanted else 0, 3, layout.reduced - first))
    if factor.pairs is not None:
        times_inverse(factor.pairs, layout.observations, b.Y, Q.T, b.Z, YQ)
        times_reduced(layout.observations, b, np.ascontiguousarray(Q[:, first:]), YQ_border)
        _core(layout.observations, YQ, b.Y, YQ_border, b.Z, core)
    else:
        half = n // 2 if layout.reduced**2 >= HALVED else n

        def products(begin: int, end: int) -> None:
            for start, rows in rows_of(b, layout, np.ones(layout.reduced), np.float64, begin, end):
                own = slice(start, start + len(rows) // 3)
                if cross:
                    rowsQ = rows @ Q
                    _pick(layout.observations, rowsQ, start, YQ, YQ_border)
                    _core_of_rows(rowsQ, rows, core[own])
                else:
                    white = _times_triangle(rows, W)
                    _core_of_rows(white, white, core[own])

        at_once(lambda: products(0, half), lambda: products(half, n))
    if not cross:
        YQ, YQ_border = YQ[:0], YQ_border[:0]
    block = np.arange(first).reshape(m, 6)
    return Inverse(
        Q[block[:, :, None], block[:, None, :]], Q[:first, first:], Q[first:, first:], core, YQ, YQ_border
    )


def _times_triangle(rows: FloatArray, W: FloatArray) -> FloatArray:
    """Return rows W, W upper triangular, some columns at a time to leave out most of the zeros."""
    product = np.empty_like(rows)
    width = -(-W.shape[0] // TRIANGLE_PARTS)
    for start in range(0, W.shape[0], width):
        end = min(start + width, W.shape[0])
        np.matmul(rows[:, :end], W[:end, start:end], out=product[:, start:end])
    return product


def _core_of_rows(left: FloatArray, right: FloatArray, core: FloatArray) -> None:
    shape = (-1, 3, left.shape[1])
    np.matmul(left.reshape(shape), np.swapaxes(right.reshape(shape), 1, 2), out=core)


def _of_band(b: Blocks, factor: BandFactor, layout: Unknowns, cross: bool) -> Inverse:
    m, n = len(b.U), len(b.y)
    first, border = 6 * m, len(factor.corner)
    free = layout.reduced_free().astype(float)
    s, sb = (factor.scale * free)[factor.rows], (factor.scale * free)[first:]
    Z = band_inverse(factor.L)
    _scale_inverse(Z, s)
    X = factor.X * s[:, None] / factor.scale[first:]
    Q = cho_solve((factor.corner, False), np.eye(border)) if border else np.zeros((0, 0))
    Q = Q * sb[:, None] * sb
    place = np.empty(m, dtype=np.int64)
    place[factor.rows[::6] // 6] = np.arange(m)
    mixed = np.empty((first, border))
    XQ = X @ Q
    mixed[factor.rows] = -XQ
    exterior = np.empty((m, 6, 6))
    core, YQ, YQ_border = np.zeros((n, 3, 3)), np.empty((len(b.Y), 3, 6)), np.empty((n, 3, border))
    _diagonal_blocks(Z, place, X, XQ, exterior)
    space = np.empty((3, border))
    _sum_pairs(layout.observations, place, factor.points, b.Y, b.Z, Z, X, Q, space, core, YQ, YQ_border)
    if not cross:
        YQ, YQ_border = YQ[:0], YQ_border[:0]
    return Inverse(exterior, mixed, Q, core, YQ, YQ_border)


@njit(cache=True)
def _mirror(Q):  # type: ignore[no-untyped-def]
    """Copy the upper triangle to the lower one."""
    for q in range(len(Q)):
        for p in range(q):
            Q[q, p] = Q[p, q]


@njit(cache=True, error_model="numpy", nogil=True)
def _pick(observations, products, start, YQ, YQ_border):  # type: ignore[no-untyped-def]
    """Take the columns of the photographs that see each point, and those of the border."""
    first = 6 * len(observations.camera)
    for h in range(len(products) // 3):
        j = start + h
        for p in range(3):
            for o in range(observations.start[j], observations.start[j + 1]):
                for q in range(6):
                    YQ[o, p, q] = products[3 * h + p, 6 * observations.image[o] + q]
            for q in range(YQ_border.shape[2]):
                YQ_border[j, p, q] = products[3 * h + p, first + q]


@kernel
def _core(observations, YQ, Y, YQ_border, Z, core):  # type: ignore[no-untyped-def]
    """Fill Y'Q Y of each object point."""
    for j in range(len(core)):
        for p in range(3):
            for q in range(3):
                total = 0.0
                for c in range(Z.shape[2]):
                    total += YQ_border[j, p, c] * Z[j, q, c]
                core[j, p, q] = total
        for o in range(observations.start[j], observations.start[j + 1]):
            for p in range(3):
                for q in range(3):
                    for r in range(6):
                        core[j, p, q] += YQ[o, p, r] * Y[o, q, r]


@njit(cache=True, error_model="numpy")
def _scale_inverse(Z, scale):  # type: ignore[no-untyped-def]
    for c in range(len(Z)):
        for d in range(min(Z.shape[1], len(Z) - c)):
            Z[c, d] *= scale[c] * scale[c + d]


@njit(cache=True, error_model="numpy")
def _diagonal_blocks(Z, place, X, XQ, exterior):  # type: ignore[no-untyped-def]
    """Fill Z + X Q X' of each photograph by itself."""
    for i in range(len(place)):
        c = 6 * place[i]
        for p in range(6):
            for q in range(6):
                total = Z[c + min(p, q), abs(p - q)]
                for s in range(X.shape[1]):
                    total += XQ[c + p, s] * X[c + q, s]
                exterior[i, p, q] = total


@kernel
def _sum_pairs(observations, place, points, Y, Zp, Z, X, Q, uQ, core, YQ, YQ_border):  # type: ignore[no-untyped-def]
    """Fill Y'S^-1 and Y'S^-1 Y of each object point; Zp are the rows Y' of the interior unknowns."""
    inner = Zp.shape[2]
    for j in points:
        for p in range(3):  # u Q with u = Y'X - Zp
            for c in range(len(Q)):
                YQ_border[j, p, c] = -Zp[j, p, c] if c < inner else 0.0
        for t in range(observations.start[j], observations.start[j + 1]):
            column = 6 * place[observations.image[t]]
            for p in range(3):
                for q in range(6):
                    for c in range(len(Q)):
                        YQ_border[j, p, c] += Y[t, p, q] * X[column + q, c]
        for p in range(3):
            for c in range(len(Q)):
                total = 0.0
                for s in range(len(Q)):
                    total += YQ_border[j, p, s] * Q[s, c]
                uQ[p, c] = total
        for s in range(observations.start[j], observations.start[j + 1]):
            row = 6 * place[observations.image[s]]
            for p in range(3):
                for q in range(6):
                    total = 0.0
                    for c in range(len(Q)):
                        total += uQ[p, c] * X[row + q, c]
                    YQ[s, p, q] = total
            for t in range(observations.start[j], observations.start[j + 1]):
                column = 6 * place[observations.image[t]]
                for r in range(6):
                    t0, t1, t2 = Y[t, 0, r], Y[t, 1, r], Y[t, 2, r]
                    for q in range(6):
                        if row + q >= column + r:
                            z = Z[column + r, row + q - column - r]
                        else:
                            z = Z[row + q, column + r - row - q]
                        YQ[s, 0, q] += t0 * z
                        YQ[s, 1, q] += t1 * z
                        YQ[s, 2, q] += t2 * z
            for p in range(3):
                for q in range(3):
                    for r in range(6):
                        core[j, p, q] += YQ[s, p, r] * Y[s, q, r]
        for p in range(3):
            for c in range(len(Q)):
                YQ_border[j, p, c] = -uQ[p, c]
            for q in range(3):
                for c in range(inner):
                    core[j, p, q] -= uQ[p, c] * Zp[j, q, c]
