"""Points on one plumb line: Z is up, and the place of the line is found from them.

Points on one straight line, as along a wire or an edge; the line is found from them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Self

import numpy as np

from sfm.conventions import FloatArray, IntArray
from sfm.observations.groups import Fit, Group
from sfm.observations.kind import Values


class Lines(Group):
    """Offsets of points across a straight line through them, in two directions; observed is none."""

    name: ClassVar[str] = "lines"
    single: ClassVar[str] = "line"
    components: ClassVar[tuple[str, ...]] = ("across", "aside")
    least: ClassVar[int] = 3
    needs_scale: ClassVar[bool] = True
    turns: ClassVar[bool] = True  # whether the direction is found from the points, too

    def fit(self, X: FloatArray) -> Fit:
        """Return the offsets from the best line; H by its place and, where it is free, its direction."""
        w = self.weights.reshape(-1, 2)[:, 0]
        along, axes = self.axes(X, w)
        length = (X - (X * w[:, None]).sum(axis=0) / w.sum()) @ along
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
        """Return them as they are: no offset is observed."""
        return self

    def displaced(self, values: Values, rng: np.random.Generator) -> FloatArray:
        """Return the points at offsets from the line that have the standard deviation stated."""
        points = self.met(values)
        if len(self):
            _, axes = self.axes(points[self.point], self.weights.reshape(-1, 2)[:, 0])
            points = points.copy()
            points[self.point] += self.draw_errors(rng).reshape(-1, 2) @ axes
        return points

    @classmethod
    def axes(cls, X: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the direction of the line of least squares, (3,), and two axes across it, (2, 3)."""
        away = X - (X * w[:, None]).sum(axis=0) / w.sum()
        found = np.linalg.svd(away * np.sqrt(w)[:, None], full_matrices=False)[2]
        return found[0], found[1:]

    @classmethod
    def columns(cls) -> tuple[str, ...]:
        """Return the column of standard deviations: no offset is observed."""
        return ("sigma",)

    @classmethod
    def of_group(
        cls, group: str, points: IntArray, value: FloatArray, sigma: FloatArray, number: Mapping[str, int]
    ) -> Self:
        """Return the points of a line, of one standard deviation each."""
        return cls(group, points[:, 0], np.zeros((len(points), 2)), np.repeat(sigma, 2, axis=1))


class PlumbLines(Lines):
    """Offsets of points in X and Y from a plumb line through them; observed is none."""

    name: ClassVar[str] = "plumb lines"
    single: ClassVar[str] = "plumb line"
    components: ClassVar[tuple[str, ...]] = ("X", "Y")
    least: ClassVar[int] = 2
    turns: ClassVar[bool] = False

    @classmethod
    def axes(cls, X: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return Z, and X and Y."""
        return np.eye(3)[2], np.eye(3)[:2]
