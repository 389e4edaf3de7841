"""Requirements on a network: a standard deviation of points or lengths, or a displacement that is found.

A displacement between two such surveys is found, in its worst direction, if it is as long as the
noncentrality of the test of three coordinates over the standard deviation of the difference.

Source: Baarda (1968), sec. 4 (power of a test); Niemeier (2008), Ausgleichungsrechnung, ch. 9.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.statistics import POWER
from sfm.conventions import BoolArray, FloatArray
from sfm.epochs.displacements import detectable_shift
from sfm.errors import GeometryError
from sfm.planning.planned_object import PlannedObject
from sfm.planning.prediction import Prediction

MIN_RAYS = 3  # of a point: with two it is never seen whose a gross error is
ALPHA = 0.001  # of the test of one point among many


@dataclass(frozen=True)
class WantedPrecision:
    """Each None if it is not asked for; lengths in the object unit."""

    sigma: float | None = None  # of every point, RMS of its coordinates
    length_sigma: float | None = None  # of every length between two points
    displacement: float | None = None  # of any point between two surveys, found with POWER

    def __post_init__(self) -> None:
        for name, value in (
            ("sigma", self.sigma),
            ("sigma of lengths", self.length_sigma),
            ("displacement", self.displacement),
        ):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise GeometryError(f"plan: wanted {name} is {value:g}, needed more than 0")

    @property
    def anything(self) -> bool:
        """Whether something is asked for."""
        return any(x is not None for x in (self.sigma, self.length_sigma, self.displacement))

    def point_variance(self, planned: PlannedObject) -> FloatArray:
        """Return about what variance of a coordinate is enough at each point, object unit^2, (n,).

        Args:
            planned: the object.
        """
        sigma = [math.inf]
        if self.sigma is not None:
            sigma.append(self.sigma)
        if self.length_sigma is not None:
            sigma.append(self.length_sigma / math.sqrt(2))
        if self.displacement is not None:
            sigma.append(self.displacement / displacement_per_sigma())
        return np.full(len(planned.names), min(sigma) ** 2)


def displacement_per_sigma() -> float:
    """Return how long a displacement between two surveys must be to be found, over sigma of one of them."""
    return math.sqrt(2) * detectable_shift(ALPHA, POWER, 3, None)


def found_displacement(prediction: Prediction) -> FloatArray:
    """Return the displacement of each point that would be found between two surveys, object unit, (n,)."""
    return prediction.largest_sigma * displacement_per_sigma()


def short_of(prediction: Prediction, wanted: WantedPrecision, points: BoolArray) -> float:
    """Return the largest of what is predicted over what is wanted; 1 or less where all of it is reached.

    Infinite where a point has fewer than MIN_RAYS, or the network leaves something undetermined.

    Args:
        prediction: of a network.
        wanted: what it must give.
        points: that count, (n,).
    """
    if not points.any():
        raise GeometryError(f"plan: no point can be seen from {MIN_RAYS} stations")
    complete = prediction.determined[points].all() and (prediction.rays[points] >= MIN_RAYS).all()
    short = [0.0 if complete and not prediction.adjustment.undetermined else math.inf]
    if wanted.sigma is not None:
        short.append(float(prediction.sigma[points].max()) / wanted.sigma)
    if wanted.length_sigma is not None and math.isfinite(short[0]):
        short.append(prediction.length_sigma / wanted.length_sigma)
    if wanted.displacement is not None:
        short.append(float(found_displacement(prediction)[points].max()) / wanted.displacement)
    return max(short)
