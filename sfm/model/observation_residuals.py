"""Residuals of values given with a standard deviation in addition to the image points: the rows of given.csv.

Each value is tested by Baarda's w, its residual divided by the standard deviation of the residual. This is
sigma sqrt(r), with the stated standard deviation sigma and the redundancy number r. A value with r = 0 has
no residual whatever it is, so it is not checked.

Source: Baarda (1968), A testing procedure for use in geodetic networks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm.model.conventions import FloatArray, IntArray
from sfm.model.estimate import Estimate, values_of
from sfm.model.network import Network
from sfm.model.observations.pose import ExteriorObservations
from sfm.model.solution import CONTROL_COVARIANCE

CENTRE, ROTATION = "projection centre", "rotation"
Tests = tuple[IntArray, FloatArray, FloatArray]  # rows of a kind, redundancy numbers, w


@dataclass(frozen=True)
class GivenValue:
    """A given coordinate, angle, length or parameter."""

    name: str
    coordinate: str
    unit: str
    given: float
    difference: float  # adjusted minus given
    sigma: float  # stated standard deviation; 0 where fixed
    r: float  # redundancy number; NaN where fixed
    w: float  # NaN where not checked


@dataclass(frozen=True)
class GivenResiduals:
    """Residuals of given values of one kind; d = 3 coordinates or angles of a point or photograph, else 1."""

    kind: str  # name of the kind, in the singular
    coordinates: tuple[str, ...]  # names of the coordinates or angles, (d,)
    names: tuple[str, ...]  # control point, both ends of a bar, parameter and camera, or photograph, (n,)
    units: tuple[tuple[str, ...], ...]  # unit of each coordinate, (n, d)
    given: FloatArray  # (n, d)
    difference: FloatArray  # adjusted minus given, (n, d)
    sigma: FloatArray  # stated standard deviation; NaN where not observed, 0 where fixed, (n, d)
    r: FloatArray  # redundancy number; NaN where fixed or not observed, (n, d)
    w: FloatArray  # difference over sigma sqrt(r); NaN where not checked, (n, d)

    def observed(self) -> GivenResiduals | None:
        """Return the rows with at least one observed value; None if there are none."""
        rows = np.flatnonzero(np.isfinite(self.sigma).any(axis=1))
        return self.rows(rows) if len(rows) else None

    def rows(self, rows: IntArray) -> GivenResiduals:
        """Return the rows of the given indices."""
        names, units = tuple(self.names[k] for k in rows), tuple(self.units[k] for k in rows)
        values = (x[rows] for x in (self.given, self.difference, self.sigma, self.r, self.w))
        return GivenResiduals(self.kind, self.coordinates, names, units, *values)

    def components(self, kind: str, components: slice) -> GivenResiduals:
        """Return some of the coordinates as a separate kind."""
        values = (x[:, components] for x in (self.given, self.difference, self.sigma, self.r, self.w))
        return GivenResiduals(
            kind, self.coordinates[components], self.names, tuple(u[components] for u in self.units), *values
        )

    @property
    def checked(self) -> bool:
        """Whether any value has a standard deviation, so its residual can be tested."""
        return bool(np.isfinite(self.r).any())

    @property
    def rms(self) -> FloatArray:
        """Root mean square difference of each coordinate, (d,)."""
        known = [v[np.isfinite(v)] for v in self.difference.T]
        return np.array([np.sqrt(np.mean(v**2)) if len(v) else np.nan for v in known])

    @property
    def values(self) -> tuple[GivenValue, ...]:
        """All observed coordinates, one by one."""
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
        """The coordinates with a redundancy number, largest |w| first."""
        known = [residual for residual in self.values if np.isfinite(residual.r)]
        return tuple(sorted(known, key=lambda residual: -abs(np.nan_to_num(residual.w))))

    @property
    def worst(self) -> GivenValue | None:
        """The coordinate with the largest |w|; None where nothing is checked."""
        return next((residual for residual in self.by_w if np.isfinite(residual.w)), None)

    @property
    def table_rows(self) -> list[tuple[Any, ...]]:
        """The rows of given.csv, in the order of its columns."""
        return [
            (
                self.kind,
                residual.name,
                residual.coordinate,
                residual.unit,
                residual.given,
                residual.difference,
                residual.sigma,
                residual.r,
                residual.w,
            )
            for residual in self.values
        ]


def given_residuals(
    network: Network, estimate: Estimate, length_unit: str, tests: Mapping[int, Tests] | None = None
) -> Iterator[tuple[int, GivenResiduals]]:
    """Yield the residuals of every kind of given values, with its index in `network.observations`.

    Exterior orientation gives two kinds, projection centres and angles. Without tests r and w are NaN.

    Args:
        network: network with the given values.
        estimate: solution that the values are compared with.
        length_unit: unit of its coordinates.
        tests: tests of the kinds that took part in an adjustment, by the index of the kind.
    """
    for index, kind in enumerate(network.observations):
        if not len(kind):
            continue
        variance = np.diagonal(kind.covariances(), axis1=1, axis2=2)
        known = np.isfinite(variance)
        v = kind.linearise(values_of(estimate)).difference
        r, w = np.full(v.shape, np.nan), np.full(v.shape, np.nan)
        if tests and index in tests:
            rows, r[rows], w[rows] = tests[index][0], *tests[index][1:]
        units = kind.units(estimate, length_unit)
        factor = np.where(np.array([[unit == "rad" for unit in row] for row in units]), np.degrees(1.0), 1.0)
        part = GivenResiduals(
            kind.single,
            kind.labels(network),
            kind.names(network, estimate),
            tuple(tuple("deg" if unit == "rad" else unit for unit in row) for row in units),
            np.where(known, factor * kind.values, np.nan),
            np.where(known, factor * v, np.nan),
            factor * np.sqrt(np.where(known, variance, np.nan)),
            *(r, w),
        )
        if isinstance(kind, ExteriorObservations):
            yield index, part.components(CENTRE, slice(0, 3))
            yield index, part.components(ROTATION, slice(3, 6))
        else:
            yield index, part


def given_rows(kinds: Iterable[GivenResiduals], network: Network, unit: str) -> Iterator[tuple[object, ...]]:
    """Yield the rows of given.csv: all values, and the covariances of correlated control coordinates.

    Args:
        kinds: residuals of each kind of given values.
        network: network with the control points.
        unit: length unit of the control.
    """
    control = False
    for kind in kinds:
        control = control or kind.kind == "control point"
        yield from kind.table_rows
    squared = f"{unit}^2" if unit else ""
    for name, pair, value in network.correlated_control() if control else ():
        yield (CONTROL_COVARIANCE, name, pair, squared, value, None, None, None, None)
