"""Null vectors that no motion of the whole network explains, brought into its datum.

Two networks without a common point, a photograph with a single point, a principal distance that looks like
another height: the normal equations leave more open than the datum knows of. Where such a null vector moves
object points that carry the datum, the datum fixes it as it fixes the motions, by an inner constraint on
these points, so that two networks have a free datum each. Where it moves none, it is fixed by an inner
constraint on the scaled reduced unknowns. So the result does not depend on how a solver has held them.

A point without an accepted ray, or with parallel ones, carries no datum; the directions that are open stay
where they are, whatever the rest does.

Source: Baarda (1973), S-transformations and criterion matrices; Foerstner and Wrobel (2016), sec. 4.5.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.adjustment.datum import ResolvedDatum
from sfm.adjustment.engine.motions import Motions, carriers
from sfm.adjustment.engine.normals import Equations, solve_transposed, times_reduced
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.conventions import BoolArray, FloatArray, IntArray

MIN_CARRIERS = 3  # points that fix position, attitude and scale
# Share of the largest component of a null vector from which it leaves a parameter open.
MIN_LEADING_SHARE = 0.1
# |A dx| of the points that carry the datum from which a null vector of length 1 moves them.
MIN_DATUM_EFFECT = 1e-6


def on_sound_points(datum: ResolvedDatum, held: IntArray) -> ResolvedDatum:
    """Return a datum without the object points of which directions are held, if enough others carry it.

    Args:
        datum: kind and points.
        held: how many directions of each object point are held, (n,).
    """
    if not held.any():
        return datum
    sound = held == 0 if datum.points is None else datum.points & (held == 0)
    return datum._replace(points=sound) if sound.sum() >= MIN_CARRIERS else datum


def leading(vectors: FloatArray) -> BoolArray:
    """Return the unknowns that each null vector leaves open, (reduced, e), of scaled ones (reduced, e)."""
    size = np.abs(vectors)
    return np.asarray(size >= MIN_LEADING_SHARE * size.max(axis=0, keepdims=True, initial=0.0))


def with_further(
    motions: Motions, further: FloatArray, equations: Equations, layout: Unknowns, datum: ResolvedDatum
) -> Motions:
    """Return the motions with further null vectors and the constraints on them.

    Args:
        motions: null vectors that the datum explains.
        further: those it does not explain, scaled, orthonormal, (reduced, e).
        equations: normal equations that have them.
        layout: order of the unknowns.
        datum: kind and sound points; but for a minimal one all constraints on points are inner ones.
    """
    if further.shape[1] == 0 and not equations.blocks.held.any():
        return motions
    blocks, scale = equations.blocks, equations.parts.scale[:, None]
    on = carriers(layout, datum)
    loose = (blocks.held > 0) & ~on
    if loose.any():
        points = motions.points.copy()
        points[loose] = _moved_points(motions.reduced, equations, layout)[loose]
        motions = replace(motions, points=points)
    if further.shape[1] == 0:
        return motions
    N = scale * further * layout.reduced_free()[:, None]
    N, moved = motions.transform(N, _moved_points(N, equations, layout))
    whitened = np.swapaxes(blocks.L[on], 1, 2) @ moved[on]
    _, singular, Vt = np.linalg.svd(np.linalg.qr(whitened.reshape(3 * len(whitened), N.shape[1]), mode="r"))
    carried = int((singular > MIN_DATUM_EFFECT).sum())
    N, moved = N @ Vt.T, moved @ Vt.T
    on_points, on_reduced = np.zeros_like(moved), np.zeros_like(N)
    on_points[on, :, :carried] = moved[on, :, :carried]
    on_reduced[:, carried:] = N[:, carried:] / scale**2
    on_points[..., :carried] /= np.sqrt((on_points[..., :carried] ** 2).sum(axis=(0, 1)))
    # N meets the constraints on the motions: B'H of all together is block triangular
    inverse = np.linalg.inv(_product(on_points, on_reduced, moved, N))
    across = _product(on_points, on_reduced, motions.points, motions.reduced)
    d, e = len(motions.inverse), len(inverse)
    whole = np.zeros((d + e, d + e))
    whole[:d, :d], whole[d:, d:] = motions.inverse, inverse
    whole[d:, :d] = -inverse @ across @ motions.inverse
    return replace(
        motions,
        reduced=np.hstack([motions.reduced, N]),
        points=np.concatenate([motions.points, moved], axis=2),
        constraints=np.concatenate([motions.constraints, on_points], axis=2),
        on_reduced=np.hstack([motions.on_reduced, on_reduced]),
        inverse=whole,
        further=e,
    )


def _moved_points(N: FloatArray, equations: Equations, layout: Unknowns) -> FloatArray:
    """Return what null vectors of the reduced unknowns do to the object points, (n, 3, e)."""
    moved = np.empty((*layout.point_free.shape, N.shape[1]))
    times_reduced(layout.observations, equations.blocks, np.ascontiguousarray(N), moved)
    moved = -solve_transposed(equations.blocks.L, moved)
    moved[layout.kept] = N[layout.kept_start :].reshape(len(layout.kept), 3, N.shape[1])
    return moved * layout.point_free[:, :, None]


def _product(
    on_points: FloatArray, on_reduced: FloatArray, points: FloatArray, reduced: FloatArray
) -> FloatArray:
    """Return B'H of constraints and null vectors."""
    return np.asarray(np.einsum("npd,npe->de", on_points, points) + on_reduced.T @ reduced)
