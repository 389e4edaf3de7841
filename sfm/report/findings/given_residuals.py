"""Residuals of what was given with a standard deviation: control, bars, interior and exterior orientation.

Each is judged by Baarda's w, its residual over the standard deviation of that residual, sigma sqrt(r) with
the standard deviation stated for it and its redundancy number r. A value with r = 0 is met exactly whatever
it is, so that it is not checked.

Source: Baarda (1968), A testing procedure for use in geodetic networks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, IntArray
from sfm.network import values_of
from sfm.observations.control import ObjectPoints
from sfm.observations.exterior import ExteriorObservations
from sfm.observations.interior import InteriorObservations
from sfm.observations.scale_bars import ScaleBars
from sfm.report.findings.precision import root_mean_square


@dataclass(frozen=True)
class GivenValue:
    """A given coordinate, angle, length or parameter."""

    name: str
    coordinate: str
    unit: str
    given: float
    difference: float  # adjusted minus given
    sigma: float  # given standard deviation; 0 where fixed
    r: float  # redundancy number; NaN where fixed
    w: float  # NaN where not checked

    def named(self, coordinates: tuple[str, ...]) -> GivenValue:
        """Return it with its coordinate in its name, where there are several."""
        return self if len(coordinates) == 1 else replace(self, name=f"{self.name} {self.coordinate}")


@dataclass(frozen=True)
class GivenResiduals:
    """Residuals of given values of one kind; d = 3 coordinates or angles of a point or photograph, else 1."""

    kind: str  # name of one of them
    coordinates: tuple[str, ...]  # names of the coordinates or angles, (d,)
    names: tuple[str, ...]  # control point, both ends of a bar, parameter and camera, or photograph, (n,)
    units: tuple[tuple[str, ...], ...]  # of each coordinate, (n, d)
    given: FloatArray  # (n, d)
    difference: FloatArray  # adjusted minus given, (n, d)
    sigma: FloatArray  # given standard deviation; NaN where not observed, 0 where fixed, (n, d)
    r: FloatArray  # redundancy number; NaN where fixed or not observed, (n, d)
    w: FloatArray  # difference over sigma sqrt(r); NaN where not checked, (n, d)

    def observed(self) -> GivenResiduals | None:
        """Return those of which something was observed; None without any."""
        rows = np.flatnonzero(np.isfinite(self.sigma).any(axis=1))
        return self.rows(rows) if len(rows) else None

    def rows(self, rows: IntArray) -> GivenResiduals:
        """Return some of them."""
        names, units = tuple(self.names[k] for k in rows), tuple(self.units[k] for k in rows)
        values = (x[rows] for x in (self.given, self.difference, self.sigma, self.r, self.w))
        return GivenResiduals(self.kind, self.coordinates, names, units, *values)

    @property
    def checked(self) -> bool:
        """Whether any has a standard deviation, so that its residual can be judged."""
        return bool(np.isfinite(self.r).any())

    @property
    def rms(self) -> FloatArray:
        """Root mean square difference of each coordinate, (d,)."""
        return np.array([root_mean_square(v) for v in self.difference.T])

    @property
    def values(self) -> tuple[GivenValue, ...]:
        """Every coordinate by itself, those not observed left out."""
        return tuple(
            GivenValue(
                self.names[k],
                self.coordinates[d],
                self.units[k][d],
                *(float(x[k, d]) for x in (self.given, self.difference, self.sigma, self.r, self.w)),
            )
            for k, d in np.argwhere(~np.isnan(self.sigma))
        )

    @property
    def by_w(self) -> tuple[GivenValue, ...]:
        """The coordinates that have a redundancy number, largest |w| first."""
        known = [one for one in self.values if np.isfinite(one.r)]
        return tuple(sorted(known, key=lambda one: -abs(np.nan_to_num(one.w))))

    @property
    def worst(self) -> GivenValue | None:
        """The coordinate with the largest |w|; None where nothing is checked."""
        return next((one for one in self.by_w if np.isfinite(one.w)), None)


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
    def single_values(self) -> tuple[tuple[str, GivenValue], ...]:
        """Kind and value of all but control points and photographs."""
        tables = (ObjectPoints.single, CENTRE, ROTATION)
        shown = [kind for kind in self.kinds if kind.kind not in tables]
        short = {InteriorObservations.single: "interior"}
        return tuple(
            (short.get(kind.kind, kind.kind), one.named(kind.coordinates))
            for kind in shown
            for one in kind.values
        )

    @property
    def exterior(self) -> tuple[GivenResiduals, ...]:
        """Projection centres and angles, of the photographs of which something was observed."""
        kinds = (kind.observed() for kind in self.kinds if kind.kind in (CENTRE, ROTATION))
        return tuple(kind for kind in kinds if kind is not None)


CENTRE, ROTATION = "projection centre", "rotation"


def given_of(a: Adjustment, length_unit: str) -> Given:
    """Return everything that was given beside the image points and took part.

    Args:
        a: what `adjust` returned.
        length_unit: of its coordinates.
    """
    found: list[GivenResiduals] = []
    took_part = {one.index: one for one in a.observed}
    for index, kind in enumerate(a.network.kinds):
        if not len(kind) or (isinstance(kind, ObjectPoints) and a.datum != "control"):
            continue
        variance = np.diagonal(kind.covariances(), axis1=1, axis2=2)
        known = np.isfinite(variance)
        v = kind.linearise(values_of(a.estimate)).difference
        r, w = np.full(v.shape, np.nan), np.full(v.shape, np.nan)
        if index in took_part:
            one = took_part[index]
            r[one.rows], w[one.rows] = one.redundancy_numbers, one.standardised
        units = kind.units(a.estimate, length_unit)
        turned = np.array([[unit == "rad" for unit in row] for row in units])
        factor = np.where(turned, np.degrees(1.0), 1.0)
        part = GivenResiduals(
            kind=kind.single,
            coordinates=kind.labels(a.network),
            names=kind.names(a.network, a.estimate),
            units=tuple(tuple("deg" if unit == "rad" else unit for unit in row) for row in units),
            given=np.where(known, factor * kind.values, np.nan),
            difference=np.where(known, factor * v, np.nan),
            sigma=factor * np.sqrt(np.where(known, variance, np.nan)),
            r=r,
            w=w,
        )
        if isinstance(kind, ExteriorObservations):
            found += _centre_and_rotation(part)
        elif isinstance(kind, InteriorObservations):
            found += [part.rows(took_part[index].rows)] if index in took_part else []
        else:
            found.append(part)
    return Given(tuple(found))


def _centre_and_rotation(part: GivenResiduals) -> list[GivenResiduals]:
    """Return exterior orientation as projection centres and as angles."""
    found = []
    for kind, axes in ((CENTRE, slice(0, 3)), (ROTATION, slice(3, 6))):
        units = tuple(row[axes] for row in part.units)
        given, v, sigma = (x[:, axes] for x in (part.given, part.difference, part.sigma))
        r, w = part.r[:, axes], part.w[:, axes]
        found.append(GivenResiduals(kind, part.coordinates[axes], part.names, units, given, v, sigma, r, w))
    return found
