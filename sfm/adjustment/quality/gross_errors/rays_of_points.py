"""Several wrong rays of one object point, taken out one after another from one adjustment.

A ray that leaves moves the residuals of the other rays of its point much, and those of all else by its
leverage on a photograph only. With the cameras fixed the cofactors of the residuals of a point's rays are
I - B V^-1 B', and residuals and cofactors after a ray has left follow from those before, without another
adjustment.

Source: Cook and Weisberg (1982), Residuals and Influence in Regression, sec. 2.2.3, for the residuals when
observations are left out; Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.
"""

from __future__ import annotations

import numpy as np

from sfm.adjustment.engine.collinearity import Observations, State, residuals
from sfm.adjustment.quality.reliability import standardised_residuals, whitening_matrix
from sfm.conventions import BoolArray, FloatArray

MIN_RAYS = 3  # of a point, of which residuals tell the wrong one
# Over the image points of a photograph: share by which the photograph may change a standardised residual,
# about three times its six unknowns over two coordinates each
INFLUENCE = 8.0
MIN_REDUNDANCY = 1e-6  # of a ray in the direction that the others check less, over the other


def further_rays(
    observations: Observations,
    state: State,
    v: FloatArray,
    complement: FloatArray,
    limiting: FloatArray,
    used: BoolArray,
    out: BoolArray,
    *,
    least: FloatArray,
) -> BoolArray:
    """Return the rays of points that lose one to take out with it, as if one left after another, (k,).

    A point ends with a ray that is its worst and may not leave, or not plainly the worst.

    Args:
        observations: image points, ordered by object point.
        state: the unknowns.
        v: residuals of all image points, px, shape (k, 2).
        complement: whitened cofactors of the residuals, shape (k, 2, 2).
        limiting: cofactors of each object point with the cameras fixed, shape (n, 3, 3).
        used: image points in the adjustment, shape (k,).
        out: those that leave it first, shape (k,).
        least: standardised residual above which image points of each photograph may leave, shape (m,).
    """
    further = np.zeros(len(used), dtype=bool)
    count = np.bincount(observations.image[used], minlength=len(least))
    F, B = whitening_matrix(observations.whitening), _by_points(observations, state, v, limiting)
    for j in np.unique(observations.point[out]).tolist():
        rays = np.arange(observations.start[j], observations.start[j + 1])
        rays = rays[used[rays]]
        Q = -np.einsum("aip,pq,bjq->abij", F[rays] @ B[rays], limiting[j], F[rays] @ B[rays])
        every = np.arange(len(rays))
        Q[every, every] = complement[rays]
        e = np.einsum("kab,kb->ka", F[rays], v[rays])  # whitened, as Q
        leaving = np.flatnonzero(out[rays]).tolist()
        while leaving:
            for a in leaving:
                e, Q = _without(a, e, Q)
            further[rays[leaving]] = True
            left = np.flatnonzero(~further[rays])
            leaving = []
            if len(left) >= MIN_RAYS:
                back = np.linalg.solve(F[rays], e[:, :, None])[:, :, 0]
                w = standardised_residuals(back[left], Q[left, left], observations.whitening[rays[left]])
                size = np.abs(w).max(axis=1)
                second, worst = np.argsort(size)[-2:].tolist()
                i = observations.image[rays[left[worst]]]
                if size[worst] > max(least[i], (1 + INFLUENCE / count[i]) * size[second]):
                    leaving = [int(left[worst])]
    return further & ~out


def _by_points(observations: Observations, state: State, v: FloatArray, limiting: FloatArray) -> FloatArray:
    """Return the derivatives of the image points by their object point, px over unit, (k, 2, 3).

    By differences over the standard deviation of the point, within which image points move in proportion.
    """
    h = np.sqrt(np.maximum(np.trace(limiting, axis1=1, axis2=2), 0.0))
    B = np.zeros((len(v), 2, 3))
    for p in range(3):
        moved = state.points.copy()
        moved[:, p] += h
        step = moved[:, p] - state.points[:, p]
        free = (step != 0)[observations.point]  # a point that is held has no cofactors to multiply
        difference = residuals(observations, state._replace(points=moved)) - v
        B[free, :, p] = difference[free] / step[observations.point[free], None]
    return B


def _without(a: int, e: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return residuals (r, 2) and cofactors (r, r, 2, 2) when ray a has left; its own are 0."""
    gain = Q[:, a] @ np.linalg.pinv(Q[a, a], rcond=MIN_REDUNDANCY, hermitian=True)
    return e - gain @ e[a], Q - gain[:, None] @ Q[a][None]
