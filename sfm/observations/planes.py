"""Points on one plane, as targets on a surface plate; the plane is found from them."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sfm.conventions import FloatArray
from sfm.observations.groups import Fit, Group
from sfm.observations.kind import Values

ROUNDS = 20  # of the plane, which offsets shift and turn; each leaves a fraction of the last


class Planes(Group):
    """Distances of points from a plane fitted to them."""

    name: ClassVar[str] = "planes"
    single: ClassVar[str] = "plane"
    components: ClassVar[tuple[str, ...]] = ("offset",)
    least: ClassVar[int] = 4
    needs_scale: ClassVar[bool] = True

    def met(self, values: Values) -> FloatArray:
        """Return the points at their offsets from the plane."""
        points, fit = values.points.copy(), self.fit(values.points[self.point])
        every = np.arange(len(self.point))
        points[self.point] -= fit.difference * fit.Jx[every, 0, every]
        return points

    def fit(self, X: FloatArray) -> Fit:
        """Return n (X - c) - offset of the best plane; H by its height and two tilts."""
        w, start = self.weights, _normal(X, self.weights)
        sides = [self._side(X, start), self._side(X, -start)]  # which one offsets are counted to is not known
        misfit = [float(w @ ((X - c) @ normal - self.value[:, 0]) ** 2) for normal, c in sides]
        normal, c = sides[int(np.argmin(misfit))]
        away = X - c
        u = np.linalg.svd(normal[None])[2][1:]
        H = np.stack([-np.ones(len(X)), *(away @ axis for axis in u)], axis=1)[:, None]
        Jx = np.zeros((len(X), 1, len(X), 3))
        Jx[np.arange(len(X)), 0, np.arange(len(X))] = normal
        return Fit((away @ normal)[:, None] - self.value, Jx, H)

    def _side(self, X: FloatArray, normal: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the normal of the best plane on a side, and a point on it."""
        w = self.weights
        for _ in range(ROUNDS):
            shifted = X - self.value * normal
            normal = _normal(shifted, w, near=normal)
        return normal, ((X - self.value * normal) * w[:, None]).sum(axis=0) / w.sum()


def _normal(X: FloatArray, w: FloatArray, near: FloatArray | None = None) -> FloatArray:
    """Return the normal of the plane of weighted least squares, (3,)."""
    away = X - (X * w[:, None]).sum(axis=0) / w.sum()
    normal = np.linalg.svd(away * np.sqrt(w)[:, None], full_matrices=False)[2][2]
    return np.asarray(normal if near is None or normal @ near > 0 else -normal)
