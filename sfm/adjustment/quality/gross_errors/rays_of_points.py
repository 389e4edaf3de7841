"""Several wrong rays of one object point, taken out one after another from one adjustment.

A ray that leaves moves the residuals of the other rays of its point much, and those of all else by its
leverage on a photograph only. With the cameras fixed the cofactors of the residuals of a point's rays are
I - B V^-1 B', and residuals and cofactors after a ray has left follow from those before, without another
adjustment.

Source: Cook and Weisberg (1982), Residuals and Influence in Regression, sec. 2.2.3, for the residuals when
observations are left out; Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.
"""

from __future__ import annotations

from dataclasses import dataclass

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
    sound = used & np.isfinite(v).all(axis=1) & np.isfinite(complement).all(axis=(1, 2))
    for j in np.unique(observations.point[out]).tolist():
        rows = np.arange(observations.start[j], observations.start[j + 1])
        rows = rows[sound[rows]]
        e = np.einsum("kab,kb->ka", F[rows], v[rows])
        rays = _Rays(e, complement[rows], F[rows] @ B[rows], limiting[j])
        left = np.ones(len(rows), dtype=bool)
        leaving = np.flatnonzero(out[rows]).tolist()
        while leaving:
            for a in leaving:
                rays = rays.without(a)
            left[leaving] = False
            rest = np.flatnonzero(left)
            leaving = []
            if len(rest) >= MIN_RAYS:
                back = np.asarray(np.linalg.solve(F[rows[rest]], rays.e[rest, :, None])[:, :, 0], dtype=float)
                w = standardised_residuals(back, rays.Q[rest], observations.whitening[rows[rest]])
                size = np.abs(w).max(axis=1)
                second, worst = np.argsort(size)[-2:].tolist()
                i = observations.image[rows[rest[worst]]]
                if size[worst] > max(least[i], (1 + INFLUENCE / count[i]) * size[second]):
                    leaving = [int(rest[worst])]
        further[rows[~left]] = True
    return further & ~out


@dataclass(frozen=True)
class _Rays:
    """Rays of one point, whitened."""

    e: FloatArray  # residuals, (r, 2)
    Q: FloatArray  # their cofactors, (r, 2, 2)
    B: FloatArray  # derivatives by the point, (r, 2, 3)
    C: FloatArray  # cofactors of the point, (3, 3): -B C B' are those of two residuals

    def without(self, a: int) -> _Rays:
        """Return what is left when one of them leaves; its own place means nothing afterwards."""
        with_a = -self.B @ self.C @ self.B[a].T
        weight = np.linalg.pinv(self.Q[a], rcond=MIN_REDUNDANCY, hermitian=True)
        gain = with_a @ weight
        to_point = self.C @ self.B[a].T
        return _Rays(
            self.e - gain @ self.e[a],
            self.Q - gain @ np.swapaxes(with_a, 1, 2),
            self.B,
            self.C + to_point @ weight @ to_point.T,
        )


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
