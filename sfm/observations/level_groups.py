"""Points at one height, as along a water level; Z is up, and the height is found from them."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sfm.conventions import FloatArray
from sfm.observations.groups import Fit, Group
from sfm.observations.kind import Values


class LevelGroups(Group):
    """Heights of points above a level of the group."""

    name: ClassVar[str] = "points at one height"
    single: ClassVar[str] = "level"
    components: ClassVar[tuple[str, ...]] = ("height",)
    least: ClassVar[int] = 2
    needs_scale: ClassVar[bool] = True

    def met(self, values: Values) -> FloatArray:
        """Return the points at the heights observed."""
        points = values.points.copy()
        points[self.point, 2] -= self.fit(values.points[self.point]).difference[:, 0]
        return points

    def fit(self, X: FloatArray) -> Fit:
        """Return Z less its weighted mean, less that observed."""
        w, at = self.weights, X[:, 2] - self.value[:, 0]
        Jx = np.zeros((len(X), 1, len(X), 3))
        Jx[np.arange(len(X)), 0, np.arange(len(X)), 2] = 1.0
        return Fit((at - (w * at).sum() / w.sum())[:, None], Jx, -np.ones((len(X), 1, 1)))
