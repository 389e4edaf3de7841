"""Points on a plane, at one height, on a line or on a plumb line; the shape is fitted to the points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Self

import numpy as np

from sfm.model.conventions import FloatArray, IntArray
from sfm.model.observations.kind import Fit, Group, Values

ROUNDS = 20  # iterations of a plane, which offsets shift and tilt; each reduces the error to a fraction


class Planes(Group):
    """Distances of points from a plane fitted to them."""

    name: ClassVar[str] = "planes"
    single: ClassVar[str] = "plane"
    components: ClassVar[tuple[str, ...]] = ("offset",)
    least: ClassVar[int] = 4
    needs_scale: ClassVar[bool] = True

    def met(self, values: Values) -> FloatArray:
        """Return the points at their observed offsets from the plane."""
        points, fit = values.points.copy(), self.fit(values.points[self.point])
        every = np.arange(len(self.point))
        points[self.point] -= fit.difference * fit.Jx[every, 0, every]
        return points

    def fit(self, X: FloatArray) -> Fit:
        """Return n (X - c) - offset for the best plane, with derivatives H by its height and two tilts."""
        w, start = self.weights, _normal(X, self.weights)
        sides = [self._side(X, start), self._side(X, -start)]  # the positive side of offsets is unknown
        misfit = [float(w @ ((X - c) @ normal - self.value[:, 0]) ** 2) for normal, c in sides]
        normal, c = sides[int(np.argmin(misfit))]
        away = X - c
        u = np.linalg.svd(normal[None])[2][1:]
        H = np.stack([-np.ones(len(X)), *(away @ axis for axis in u)], axis=1)[:, None]
        Jx = np.zeros((len(X), 1, len(X), 3))
        Jx[np.arange(len(X)), 0, np.arange(len(X))] = normal
        return Fit((away @ normal)[:, None] - self.value, Jx, H)

    def _side(self, X: FloatArray, normal: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the normal of the best plane with offsets to one side, and a point on the plane."""
        w = self.weights
        for _ in range(ROUNDS):
            shifted = X - self.value * normal
            normal = _normal(shifted, w, near=normal)
        return normal, ((X - self.value * normal) * w[:, None]).sum(axis=0) / w.sum()


def _normal(X: FloatArray, w: FloatArray, near: FloatArray | None = None) -> FloatArray:
    """Return the normal of the plane by weighted least squares, (3,)."""
    away = X - (X * w[:, None]).sum(axis=0) / w.sum()
    normal = np.linalg.svd(away * np.sqrt(w)[:, None], full_matrices=False)[2][2]
    return np.asarray(normal if near is None or normal @ near > 0 else -normal)


class LevelGroups(Group):
    """Heights of points above a level of the group."""

    name: ClassVar[str] = "points at one height"
    single: ClassVar[str] = "level"
    components: ClassVar[tuple[str, ...]] = ("height",)
    least: ClassVar[int] = 2
    needs_scale: ClassVar[bool] = True

    def met(self, values: Values) -> FloatArray:
        """Return the points at the observed heights."""
        points = values.points.copy()
        points[self.point, 2] -= self.fit(values.points[self.point]).difference[:, 0]
        return points

    def fit(self, X: FloatArray) -> Fit:
        """Return Z minus its weighted mean, minus the observed height."""
        w, at = self.weights, X[:, 2] - self.value[:, 0]
        Jx = np.zeros((len(X), 1, len(X), 3))
        Jx[np.arange(len(X)), 0, np.arange(len(X)), 2] = 1.0
        return Fit((at - (w * at).sum() / w.sum())[:, None], Jx, -np.ones((len(X), 1, 1)))


class Lines(Group):
    """Offsets of points across a straight line through them, in two directions; observed offsets are 0."""

    name: ClassVar[str] = "lines"
    single: ClassVar[str] = "line"
    components: ClassVar[tuple[str, ...]] = ("across", "aside")
    least: ClassVar[int] = 3
    needs_scale: ClassVar[bool] = True
    turns: ClassVar[bool] = True  # whether the direction is also fitted to the points

    def fit(self, X: FloatArray) -> Fit:
        """Return the offsets from the best line, with derivatives H by its position and free direction."""
        w = self.weights.reshape(-1, 2)[:, 0]
        along, axes = self.axes(X, w)
        length = (X - X.mean(axis=0)) @ along  # from any origin, because the position is free
        at = X @ axes.T
        at = at - (at * w[:, None]).sum(axis=0) / w.sum()
        H = np.zeros((len(X), 2, 4 if self.turns else 2))
        H[:, 0, 0] = H[:, 1, 1] = -1.0
        if self.turns:
            H[:, 0, 2] = H[:, 1, 3] = -length
        Jx = np.zeros((len(X), 2, len(X), 3))
        Jx[np.arange(len(X)), :, np.arange(len(X))] = axes
        return Fit(at, Jx, H)

    def met(self, values: Values) -> FloatArray:
        """Return the points without their offsets from the line."""
        X, points = values.points[self.point], values.points.copy()
        _, axes = self.axes(X, self.weights.reshape(-1, 2)[:, 0])
        points[self.point] -= self.fit(X).difference @ axes
        return points

    def simulated(self, values: Values, rng: np.random.Generator | None = None) -> Self:
        """Return the line unchanged, because no offsets are observed."""
        return self

    def displaced(self, values: Values, rng: np.random.Generator) -> FloatArray:
        """Return the points at random offsets from the line with the stated standard deviation."""
        points = self.met(values)
        if len(self):
            _, axes = self.axes(points[self.point], self.weights.reshape(-1, 2)[:, 0])
            points = points.copy()
            points[self.point] += self.draw_errors(rng).reshape(-1, 2) @ axes
        return points

    @classmethod
    def axes(cls, X: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the direction of the least-squares line, (3,), and two axes across it, (2, 3)."""
        away = X - (X * w[:, None]).sum(axis=0) / w.sum()
        directions = np.linalg.svd(away * np.sqrt(w)[:, None], full_matrices=False)[2]
        return directions[0], directions[1:]

    @classmethod
    def columns(cls) -> tuple[str, ...]:
        """Return the column of standard deviations; there are no observed offsets."""
        return ("sigma",)

    @classmethod
    def of_group(
        cls, group: str, points: IntArray, value: FloatArray, sigma: FloatArray, number: Mapping[str, int]
    ) -> Self:
        """Return the points of a line, with one standard deviation for each point."""
        return cls(group, points[:, 0], np.zeros((len(points), 2)), np.repeat(sigma, 2, axis=1))


class PlumbLines(Lines):
    """Offsets of points in X and Y from a plumb line through them; the observed offsets are 0."""

    name: ClassVar[str] = "plumb lines"
    single: ClassVar[str] = "plumb line"
    components: ClassVar[tuple[str, ...]] = ("X", "Y")
    least: ClassVar[int] = 2
    turns: ClassVar[bool] = False

    @classmethod
    def axes(cls, X: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the Z axis, and the X and Y axes."""
        return np.eye(3)[2], np.eye(3)[:2]
