"""A result as files hold it: a network with its solution and standard deviations, whoever computed it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.display import html_table, text_table
from sfm.network import Estimate, Network
from sfm.point_table import Point, PointTable

NO_SCALE = "network units"
"""unit of lengths in a network whose scale is undefined"""
CONTROL_COVARIANCE = "control covariance"  # kind of a row of given.csv
MEASURED = "measured"
"""what targets.csv says of a target in the place of a reason for its rejection"""


@dataclass(frozen=True)
class SeenTargets:
    """What was measured, and what was rejected, in the photographs of a result."""

    image: IntArray  # index of the photograph in the network of the result, (k,)
    xy: FloatArray  # centres, px, (k, 2)
    ellipse: (
        FloatArray  # semi-axes, larger first, px, and angle from x towards y, rad; NaN if rejected, (k, 3)
    )
    reason: tuple[str, ...]  # why it was not measured, in words; empty where it was, (k,)

    @property
    def measured(self) -> BoolArray:
        """Which were measured, (k,)."""
        return np.array([not words for words in self.reason], dtype=bool)


@dataclass(frozen=True, repr=False, eq=False)
class StoredResult:
    """One result to go on with or to compare: Kolinear's own, COLMAP's or another program's.

    Example:
        >>> import sfm
        >>> sfm.StoredResult("bench", result.network, result.estimate).points["1"].xyz.shape
        (3,)
    """

    name: str  # what people call it
    network: Network
    estimate: Estimate
    point_covariance: FloatArray | None = None  # marginal, object unit^2, (n, 3, 3)
    position_covariance: FloatArray | None = None  # of projection centres, object unit^2, (m, 3, 3)
    interior_sigma: tuple[FloatArray, ...] | None = None  # of each parameter, NaN where fixed
    redundancy: int | None = None  # of the adjustment, for the degrees of freedom of tests
    unit: str = ""  # of lengths, as people call it; empty where nobody knows
    covariance: FloatArray | None = None  # of all coordinates of points together, object unit^2, (3k, 3k)
    datum: str = ""  # free | minimal | control; empty where nobody knows
    points_named: bool = True  # whether names of points identify them, or are mere numbers
    images_named: bool = True  # likewise of photographs
    covariance_points: IntArray | None = (
        None  # of which k points `covariance` is, all n where not given, (k,)
    )

    @property
    def has_scale(self) -> bool:
        """Whether lengths are in a known unit, from scale bars or control."""
        return self.unit not in ("", NO_SCALE)

    def covariance_rows(self, points: IntArray) -> IntArray:
        """Return the row of points among those that `covariance` is of, -1 where it is not of them.

        Args:
            points: indices, (k,).
        """
        if self.covariance_points is None:
            return points
        row = np.full(len(self.network.points), -1, dtype=np.int64)
        row[self.covariance_points] = np.arange(len(self.covariance_points))
        return np.asarray(row[points])

    @property
    def points(self) -> PointTable:
        """The object points by name."""
        n = len(self.network.points)
        covariance = self.point_covariance
        if covariance is None:
            covariance = np.full((n, 3, 3), np.nan)
        return PointTable(
            self.network.points, self.estimate.points, covariance, self.network.rays(), self.unit
        )

    def point(self, name: str | int) -> Point:
        """Return an object point by its name, which of a coded target is its number.

        Raises:
            UnknownNameError: there is none of that name.
        """
        found: Point = self.points[str(name)]
        return found

    def _rows(self) -> list[tuple[str, str]]:
        known = self.point_covariance is not None
        return [
            ("photographs", str(len(self.network.images))),
            ("points", f"{len(self.network.points)}{', with' if known else ', without'} standard deviations"),
            ("image points", str(len(self.network.image_points))),
            ("cameras", ", ".join(f"{c.name} ({c.model})" for c in self.estimate.cameras)),
        ]

    def __repr__(self) -> str:
        return text_table(f"Result {self.name}", ("", ""), self._rows())

    def _repr_html_(self) -> str:
        return html_table(f"Result {self.name}", ("", ""), self._rows())
