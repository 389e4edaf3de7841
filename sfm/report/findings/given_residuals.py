"""Residuals of what was given with a standard deviation: control, bars, interior and exterior orientation.

Each is judged by Baarda's w, its residual over the standard deviation of that residual, sigma sqrt(r) with
the standard deviation stated for it and its redundancy number r. A value with r = 0 is met exactly whatever
it is, so that it is not checked.

Source: Baarda (1968), A testing procedure for use in geodetic networks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.engine.observed_unknowns import inverse_of_observed
from sfm.adjustment.quality.reliability import UNCONTROLLED, standardised_of_given
from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, angles_from_rotation
from sfm.report.findings.precision import root_mean_square
from sfm.result import SurveyResult


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


@dataclass(frozen=True)
class GivenResiduals:
    """Residuals of given values of one kind; d = 3 coordinates or angles of a point or photograph, else 1."""

    kind: str  # what the names stand for
    coordinates: tuple[str, ...]  # names of the coordinates or angles, (d,)
    names: tuple[str, ...]  # control point, both ends of a bar, parameter and camera, or photograph, (n,)
    units: tuple[str, ...]  # (n,)
    given: FloatArray  # (n, d)
    difference: FloatArray  # adjusted minus given, (n, d)
    sigma: FloatArray  # given standard deviation; NaN where not observed, 0 where fixed, (n, d)
    r: FloatArray  # redundancy number; NaN where fixed or not observed, (n, d)
    w: FloatArray  # difference over sigma sqrt(r); NaN where not checked, (n, d)

    def observed(self) -> GivenResiduals | None:
        """Return those of which something was observed; None without any."""
        rows = np.flatnonzero(np.isfinite(self.sigma).any(axis=1))
        names, units = (tuple(words[k] for k in rows) for words in (self.names, self.units))
        values = (x[rows] for x in (self.given, self.difference, self.sigma, self.r, self.w))
        return GivenResiduals(self.kind, self.coordinates, names, units, *values) if len(rows) else None

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
                self.units[k],
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
    """Given values that took part beside the photographs; None for kinds without any."""

    control: GivenResiduals | None
    bars: GivenResiduals | None
    interior: GivenResiduals | None
    position: GivenResiduals | None  # projection centres
    rotation: GivenResiduals | None  # angles, deg

    @property
    def kinds(self) -> tuple[GivenResiduals, ...]:
        """All kinds that there are."""
        kinds = (self.control, self.bars, self.interior, self.position, self.rotation)
        return tuple(kind for kind in kinds if kind is not None)

    @property
    def single_values(self) -> tuple[tuple[str, GivenValue], ...]:
        """Kind and value of each scale bar and each observed parameter of interior orientation."""
        kinds = (("scale bar", self.bars), ("interior", self.interior))
        return tuple((name, one) for name, kind in kinds if kind is not None for one in kind.values)

    @property
    def exterior(self) -> tuple[GivenResiduals, ...]:
        """Projection centres and angles, of the photographs of which something was observed."""
        kinds = (kind.observed() for kind in (self.position, self.rotation) if kind is not None)
        return tuple(kind for kind in kinds if kind is not None)


def control_residuals(a: Adjustment, unit: str) -> GivenResiduals | None:
    """Return by how much control differs from its given coordinates; None where control took no part."""
    control = a.network.control
    if a.datum != "control" or not len(control):
        return None
    variance = np.einsum("nii->ni", control.covariance)
    difference = a.estimate.points[control.point] - control.xyz
    weight, _ = inverse_of_observed(control.covariance)
    w, r = standardised_of_given(difference, weight, a.cofactors.points[control.point])
    return GivenResiduals(
        kind="control point",
        coordinates=("X", "Y", "Z"),
        names=tuple(a.network.points[j] for j in control.point),
        units=(unit,) * len(control),
        given=np.where(np.isfinite(variance), control.xyz, np.nan),
        difference=np.where(np.isfinite(variance), difference, np.nan),
        sigma=np.where(np.isfinite(variance), np.sqrt(variance), np.nan),
        r=r,
        w=w,
    )


def bar_residuals(a: Adjustment, unit: str) -> GivenResiduals | None:
    """Return by how much scale bars differ from their given lengths; None without scale bars."""
    bars = a.network.scale_bars
    if not len(bars):
        return None
    X, r = a.estimate.points, a.bar_redundancy
    difference = np.linalg.norm(X[bars.end] - X[bars.start], axis=1) - bars.length
    checked = r > UNCONTROLLED
    w = np.where(checked, difference / (bars.sigma * np.sqrt(np.where(checked, r, 1.0))), np.nan)
    return GivenResiduals(
        kind="scale bar",
        coordinates=("length",),
        names=tuple(
            f"{a.network.points[i]} - {a.network.points[j]}"
            for i, j in zip(bars.start, bars.end, strict=True)
        ),
        units=(unit,) * len(bars),
        given=bars.length[:, None],
        difference=difference[:, None],
        sigma=bars.sigma[:, None],
        r=r[:, None],
        w=w[:, None],
    )


def interior_residuals(result: SurveyResult) -> GivenResiduals | None:
    """Return by how much weighted interior orientation differs from its given values; None without."""
    adjustment, found = result.adjustment, result.adjustment.network.interior
    names, units, parts = [], [], []
    for a in np.unique(found.camera):
        camera, Q = adjustment.estimate.cameras[a], adjustment.cofactors.interior[a]
        column = {int(s): k for k, s in enumerate(np.flatnonzero(camera.free))}
        rows = [
            int(q)
            for q in np.flatnonzero(found.camera == a)
            if found.parameter[q] in column and 0 < found.sigma[q] < np.inf
        ]
        if not rows:
            continue
        own = found.parameter[rows]
        names += [f"{camera.names[s]} of camera {camera.owner_of(s)}" for s in own]
        units += [camera.units[s] for s in own]
        at = [column[int(s)] for s in own]
        cofactor = Q[np.ix_(at, at)] if len(Q) else np.full((len(at),) * 2, np.nan)
        given, difference = found.value[rows], camera.parameters[own] - found.value[rows]
        weight = found.weight_of(np.array(rows))
        w, r = standardised_of_given(difference[None], weight[None], cofactor[None])
        parts.append(np.stack([given, difference, found.sigma[rows], r[0], w[0]]))
    if not parts:
        return None
    given, difference, sigma, r, w = np.hstack(parts)[:, :, None]
    kind, words = "interior orientation", (tuple(names), tuple(units))
    return GivenResiduals(kind, ("value",), *words, given, difference, sigma, r, w)


def exterior_residuals(result: SurveyResult) -> tuple[GivenResiduals, GivenResiduals] | None:
    """Return by how much projection centres and angles (deg) differ from those observed; None without."""
    a, seen = result.adjustment, result.adjustment.network.exterior
    if not len(seen):
        return None
    variance = np.einsum("eii->ei", seen.covariance)
    position, rotation = a.estimate.position[seen.image], a.estimate.rotation[seen.image]
    angles = (angles_from_rotation(rotation) - seen.angles + np.pi) % (2 * np.pi) - np.pi
    v = np.where(np.isfinite(variance), np.hstack([position - seen.position, angles]), 0.0)
    weight, _ = inverse_of_observed(seen.covariance)
    w, r = standardised_of_given(v, weight, a.cofactors.exterior[seen.image])
    given = np.where(np.isfinite(variance), np.hstack([seen.position, seen.angles]), np.nan)
    sigma = np.sqrt(np.where(np.isfinite(variance), variance, np.nan))
    v = np.where(np.isfinite(variance), v, np.nan)
    names = tuple(a.network.images[i] for i in seen.image)

    def part(kind: str, coordinates: str, rows: slice, unit: str, factor: float) -> GivenResiduals:
        values, differences, sigmas = (factor * x[:, rows] for x in (given, v, sigma))
        units, axes = (unit,) * len(names), tuple(coordinates.split())
        return GivenResiduals(kind, axes, names, units, values, differences, sigmas, r[:, rows], w[:, rows])

    return (
        part("projection centre", "X0 Y0 Z0", slice(0, 3), result.length_unit, 1.0),
        part("rotation", "omega phi kappa", slice(3, 6), "deg", float(np.degrees(1.0))),
    )


def given_of(result: SurveyResult) -> Given:
    """Return everything that was given with a standard deviation and took part."""
    position, rotation = exterior_residuals(result) or (None, None)
    a, unit = result.adjustment, result.length_unit
    return Given(
        control_residuals(a, unit), bar_residuals(a, unit), interior_residuals(result), position, rotation
    )
