"""Residuals of what was given with a standard deviation: control, scale bars, interior and exterior
orientation.

Each is judged by Baarda's w, its residual over the standard deviation of that residual, sigma sqrt(r) with
the standard deviation stated for it and its redundancy number r. A value with r = 0 is met exactly whatever
it is, so that it is not checked.

Source: Baarda (1968), A testing procedure for use in geodetic networks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from sfm.adjustment.engine.observed_unknowns import inverse_of_observed
from sfm.adjustment.quality.reliability import UNCONTROLLED, standardised_of_given
from sfm.conventions import FloatArray, IntArray, angles_from_rotation
from sfm.result import SurveyResult

NOT_CHECKED = "not checked"
EXTERIOR = (("projection centre", ("X0", "Y0", "Z0")), ("rotation", ("omega", "phi", "kappa")))


@dataclass(frozen=True)
class GivenResiduals:
    """Residuals of given values of one kind; d = 3 coordinates or angles of a point or photograph, else 1."""

    names: tuple[str, ...]  # control point, both ends of a bar, parameter and camera, or photograph, (n,)
    units: tuple[str, ...]  # (n,)
    given: FloatArray  # (n, d)
    difference: FloatArray  # adjusted minus given, (n, d)
    sigma: FloatArray  # given standard deviation; NaN where not observed, 0 where fixed, (n, d)
    r: FloatArray  # redundancy number; NaN where fixed or not observed, (n, d)
    w: FloatArray  # difference over sigma sqrt(r); NaN where not checked, (n, d)

    def select(self, rows: IntArray) -> GivenResiduals:
        """Return the residuals that an index names."""
        names, units = (tuple(words[k] for k in rows) for words in (self.names, self.units))
        values = (x[rows] for x in (self.given, self.difference, self.sigma, self.r, self.w))
        return GivenResiduals(names, units, *values)

    def worst(self) -> tuple[int, float] | None:
        """Return the index with the largest |w|, and it; None where nothing is checked."""
        if not np.isfinite(self.w).any():
            return None
        size = np.nanmax(np.abs(self.w), axis=1, initial=0.0)
        return int(np.argmax(size)), float(size.max())


def control_residuals(result: SurveyResult) -> GivenResiduals | None:
    """Return by how much control differs from its given coordinates; None where control took no part."""
    a, control = result.adjustment, result.adjustment.network.control
    if a.datum != "control" or not len(control):
        return None
    variance = np.einsum("nii->ni", control.covariance)
    difference = a.estimate.points[control.point] - control.xyz
    weight, _ = inverse_of_observed(control.covariance)
    w, r = standardised_of_given(difference, weight, a.covariance.points[control.point] / a.sigma0**2)
    return GivenResiduals(
        names=tuple(a.network.points[j] for j in control.point),
        units=(result.length_unit,) * len(control),
        given=control.xyz,
        difference=difference,
        sigma=np.where(np.isfinite(variance), np.sqrt(variance), np.nan),
        r=r,
        w=w,
    )


def bar_residuals(result: SurveyResult) -> GivenResiduals | None:
    """Return by how much scale bars differ from their given lengths; None without scale bars."""
    a, bars = result.adjustment, result.adjustment.network.scale_bars
    if not len(bars):
        return None
    X, r = a.estimate.points, a.bar_redundancy
    difference = np.linalg.norm(X[bars.end] - X[bars.start], axis=1) - bars.length
    checked = r > UNCONTROLLED
    w = np.where(checked, difference / (bars.sigma * np.sqrt(np.where(checked, r, 1.0))), np.nan)
    return GivenResiduals(
        names=tuple(
            f"{a.network.points[i]} - {a.network.points[j]}"
            for i, j in zip(bars.start, bars.end, strict=True)
        ),
        units=(result.length_unit,) * len(bars),
        given=bars.length[:, None],
        difference=difference[:, None],
        sigma=bars.sigma[:, None],
        r=r[:, None],
        w=w[:, None],
    )


def interior_residuals(result: SurveyResult) -> GivenResiduals | None:
    """Return by how much weighted interior orientation differs from its given values; None without."""
    adjustment, found = result.adjustment, result.adjustment.network.interior
    names, units, rows, cofactors = [], [], [], []
    for a, s, given, sigma in zip(found.camera, found.parameter, found.value, found.sigma, strict=True):
        camera, Q = adjustment.estimate.cameras[a], adjustment.covariance.interior[a]
        where = np.flatnonzero(np.flatnonzero(camera.free) == s)
        if not len(where) or not 0 < sigma < np.inf:
            continue
        names.append(f"{camera.names[s]} of camera {camera.group_of(s) or camera.name}")
        units.append(camera.units[s])
        rows.append((given, camera.parameters[s] - given, sigma))
        cofactors.append(Q[where[0], where[0]] / adjustment.sigma0**2 if len(Q) else np.nan)
    if not rows:
        return None
    given, difference, sigma = np.array(rows, dtype=float).T[:, :, None]
    w, r = standardised_of_given(
        difference, 1 / sigma[:, :, None] ** 2, np.array(cofactors, dtype=float)[:, None, None]
    )
    return GivenResiduals(tuple(names), tuple(units), given, difference, sigma, r, w)


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
    w, r = standardised_of_given(v, weight, a.covariance.exterior[seen.image] / a.sigma0**2)
    given = np.where(np.isfinite(variance), np.hstack([seen.position, seen.angles]), np.nan)
    sigma = np.sqrt(np.where(np.isfinite(variance), variance, np.nan))
    v = np.where(np.isfinite(variance), v, np.nan)
    names = tuple(a.network.images[i] for i in seen.image)

    def part(rows: slice, unit: str, factor: float) -> GivenResiduals:
        values, differences, sigmas = (factor * x[:, rows] for x in (given, v, sigma))
        units = (unit,) * len(names)
        return GivenResiduals(names, units, values, differences, sigmas, r[:, rows], w[:, rows])

    return part(slice(0, 3), result.length_unit, 1.0), part(slice(3, 6), "deg", np.degrees(1.0))


def given_rows(result: SurveyResult) -> Iterable[Sequence[object]]:
    """Return kind, name, coordinate, unit, given value, difference, sigma, r and w of every given value."""
    exterior = exterior_residuals(result) or (None, None)
    for kind, found, coordinates in (
        ("control point", control_residuals(result), "XYZ"),
        ("scale bar", bar_residuals(result), ("length",)),
        ("interior orientation", interior_residuals(result), ("value",)),
        *((kind, found, names) for (kind, names), found in zip(EXTERIOR, exterior, strict=True)),
    ):
        if found is None:
            continue
        for k, name in enumerate(found.names):
            for d, coordinate in enumerate(coordinates):
                if np.isnan(found.sigma[k, d]):  # not observed
                    continue
                values = (x[k, d] for x in (found.given, found.difference, found.sigma, found.r, found.w))
                yield (kind, name, coordinate, found.units[k], *values)


def words_of_w(w: float, r: float) -> str:
    """Return w of a given value; that it is not checked where r is 0, nothing where it was not observed."""
    return f"{w:+.2f}" if np.isfinite(w) else "" if np.isnan(r) else NOT_CHECKED
