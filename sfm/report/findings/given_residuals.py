"""The given values that took part in an adjustment, with their residuals, kind by kind."""

from __future__ import annotations

from dataclasses import dataclass

from sfm.adjustment.result import Adjustment
from sfm.given_residuals import CENTRE, ROTATION, GivenResiduals, given_residuals
from sfm.observations.control import ObjectPoints
from sfm.observations.interior import InteriorObservations
from sfm.observations.scale_bars import ScaleBars


@dataclass(frozen=True)
class Given:
    """Given values that took part beside the photographs, kind by kind."""

    kinds: tuple[GivenResiduals, ...]

    @property
    def control(self) -> GivenResiduals | None:
        """Control points; None without any."""
        return self.of(ObjectPoints.single)

    @property
    def bars(self) -> GivenResiduals | None:
        """Scale bars; None without any."""
        return self.of(ScaleBars.single)

    @property
    def interior(self) -> GivenResiduals | None:
        """Observed parameters of interior orientation; None without any."""
        return self.of(InteriorObservations.single)

    @property
    def further(self) -> tuple[GivenResiduals, ...]:
        """Those that are neither control points, scale bars, interior nor exterior orientation."""
        others = (ObjectPoints.single, ScaleBars.single, InteriorObservations.single, CENTRE, ROTATION)
        return tuple(kind for kind in self.kinds if kind.kind not in others)

    def of(self, kind: str) -> GivenResiduals | None:
        """Return the residuals of a kind, by the name of one of them; None without any."""
        return next((one for one in self.kinds if one.kind == kind), None)

    @property
    def exterior(self) -> tuple[GivenResiduals, ...]:
        """Projection centres and angles, of the photographs of which something was observed."""
        kinds = (kind.observed() for kind in self.kinds if kind.kind in (CENTRE, ROTATION))
        return tuple(kind for kind in kinds if kind is not None)


def given_of(a: Adjustment, length_unit: str) -> Given:
    """Return everything that was given beside the image points and took part.

    Args:
        a: what `adjust` returned.
        length_unit: of its coordinates.
    """
    took_part = {one.index: (one.rows, one.redundancy_numbers, one.standardised) for one in a.observed}
    found: list[GivenResiduals] = []
    for index, part in given_residuals(a.network, a.estimate, length_unit, took_part):
        if part.kind == InteriorObservations.single:
            found += [part.rows(took_part[index][0])] if index in took_part else []
        elif part.kind != ObjectPoints.single or a.datum == "control":
            found.append(part)
    return Given(tuple(found))
