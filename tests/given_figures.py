"""Given points beside a free network that is only its points and their covariance."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from sfm.judgement.given.free_network import Reference
from sfm.judgement.given.points import GivenPoints, PlacedPoints, judge_points
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.estimate import Estimate
from sfm.model.network import ObjectPoints
from sfm.model.similarity import Similarity
from tests.synthetic import make_network, seed_of

CAMERA = make_network(seed_of("given figures"))[1].cameras[0]  # which takes no part


@dataclass(frozen=True)
class Figure:
    """Points with given coordinates, and the same points of a free network."""

    given: FloatArray  # NaN where unknown, (n, 3)
    stated: FloatArray  # covariance of the given coordinates, 0 where fixed, (n, 3, 3)
    free: FloatArray  # (n, 3)
    joint: FloatArray  # covariance of the free points, (3 n, 3 n)
    redundancy: int = 500

    @property
    def reference(self) -> Reference:
        """The free network."""
        estimate = Estimate((CAMERA,), np.zeros((0, 3)), np.zeros((0, 3, 3)), self.free)
        marginal: Any = SimpleNamespace(
            adjustment=SimpleNamespace(estimate=estimate, redundancy=self.redundancy)
        )
        return Reference(marginal, np.arange(0), np.arange(len(self.free)), self.joint)

    @property
    def points(self) -> GivenPoints:
        """The given points as they are judged."""
        covariance = self.stated.copy()
        row, axis = np.nonzero(~np.isfinite(self.given))
        covariance[row, axis, axis] = np.inf
        control = ObjectPoints(np.arange(len(self.given)), self.given, covariance)
        return GivenPoints(control, self.reference)

    def select(self, some: IntArray) -> Figure:
        """Return the points of the given indices."""
        rows = (3 * np.asarray(some)[:, None] + np.arange(3)).ravel()
        joint = self.joint[np.ix_(rows, rows)]
        return Figure(self.given[some], self.stated[some], self.free[some], joint, self.redundancy)


def judge(
    figure: Figure, level: float, *, start: Similarity | None = None, estimated: bool = False
) -> PlacedPoints | None:
    """Return the judged points of a figure."""
    return judge_points(figure.points, level, start=start, estimated=estimated)
