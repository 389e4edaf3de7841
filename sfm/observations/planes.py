"""Points on one plane, as targets on a surface plate; the plane is found from them."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sfm.conventions import FloatArray
from sfm.observations.groups import Fit, Group
from sfm.observations.kind import Values


class Planes(Group):
    """Distances of points from a plane of their own."""

    name: ClassVar[str] = "planes"
    single: ClassVar[str] = "plane"
    components: ClassVar[tuple[str, ...]] = ("offset",)
    least: ClassVar[int] = 4
    needs_scale: ClassVar[bool] = True

    def met(self, values: Values) -> FloatArray:
        """Return the points at their offsets from the plane."""
        points, fit = values.points.copy(), self.fit(values.points[self.point])
        own = np.arange(len(self.point))
        points[self.point] -= fit.difference * fit.Jx[own, 0, own]
        return points

    def fit(self, X: FloatArray) -> Fit:
        """Return n (X - c) - offset of the best plane; H by its height and two tilts."""
        w = self.weights
        normal = _normal(X, w)
        for _ in range(2):  # offsets shift the plane of least squares a little
            c = ((X - self.value * normal) * w[:, None]).sum(axis=0) / w.sum()
            normal = _normal(X - self.value * normal, w, near=normal)
        away = X - c
        u = np.linalg.svd(normal[None])[2][1:]
        H = np.stack([-np.ones(len(X)), *(away @ axis for axis in u)], axis=1)[:, None]
        Jx = np.zeros((len(X), 1, len(X), 3))
        Jx[np.arange(len(X)), 0, np.arange(len(X))] = normal
        return Fit((away @ normal)[:, None] - self.value, Jx, H)


def _normal(X: FloatArray, w: FloatArray, near: FloatArray | None = None) -> FloatArray:
    """Return the normal of the plane of weighted least squares, (3,)."""
    away = X - (X * w[:, None]).sum(axis=0) / w.sum()
    normal = np.linalg.svd(away * np.sqrt(w)[:, None], full_matrices=False)[2][2]
    return np.asarray(normal if near is None or normal @ near > 0 else -normal)
