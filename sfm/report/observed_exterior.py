"""Observed exterior orientation in the reports: by how much the adjusted one differs, and its test.

The redundancy number of an observed unknown is r = 1 - q / sigma^2, with its cofactor q; w is the residual
over its standard deviation sigma sqrt(r).

Source: Baarda (1968), A testing procedure for use in geodetic networks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from sfm.adjustment.reliability import UNCONTROLLED
from sfm.adjustment.result import Adjustment
from sfm.adjustment.weighted import observed
from sfm.conventions import FloatArray, angles_from_rotation
from sfm.file_values import or_none
from sfm.report.markup import finer_unit, signed, significant, table
from sfm.report.result import SurveyResult
from sfm.report.text_lines import MOST_ROWS, columns, head, line

PARAMETERS = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
HEADER = "image,parameter,given,sigma,difference,redundancy,w,unit"
OPEN_ROWS = 30  # up to which a table of the page is unfolded


@dataclass(frozen=True)
class ExteriorResiduals:
    """Residuals of observed exterior orientation; X0, Y0, Z0 in the object unit, angles in degrees."""

    images: tuple[str, ...]  # photographs, (e,)
    given: FloatArray  # NaN where not observed, (e, 6)
    sigma: FloatArray  # given standard deviation, 0 where fixed, NaN where not observed, (e, 6)
    difference: FloatArray  # adjusted minus given, NaN where not observed, (e, 6)
    redundancy: FloatArray  # number r of each, NaN where fixed or not observed, (e, 6)
    w: FloatArray  # difference over sigma sqrt(r); NaN without check, (e, 6)


def exterior_residuals(adjustment: Adjustment) -> ExteriorResiduals | None:
    """Return by how much the exterior orientation differs from the observed one; None without."""
    seen = adjustment.network.exterior
    if not len(seen):
        return None
    estimate = adjustment.estimate
    variance = np.einsum("eii->ei", seen.covariance)
    told = np.isfinite(variance)
    given = np.where(told, np.hstack([seen.position, np.degrees(seen.angles)]), np.nan)
    found = np.hstack(
        [estimate.position[seen.image], np.degrees(angles_from_rotation(estimate.rotation[seen.image]))]
    )
    difference = found - given
    difference[:, 3:] = (difference[:, 3:] + 180) % 360 - 180
    q = np.einsum("eii->ei", adjustment.covariance.exterior[seen.image]) / adjustment.sigma0**2
    weighted = observed(variance)
    r = np.where(weighted, np.clip(1 - q / np.where(weighted, variance, 1.0), 0, 1), np.nan)
    sigma = np.where(told, np.sqrt(np.where(told, variance, 0.0)), np.nan)
    sigma[:, 3:] = np.degrees(sigma[:, 3:])
    checked = r > UNCONTROLLED
    own = np.where(checked, sigma * np.sqrt(np.where(checked, r, 1.0)), 1.0)
    w = np.where(checked, difference / own, np.nan)
    images = tuple(adjustment.network.images[i] for i in seen.image)
    return ExteriorResiduals(images, given, sigma, difference, r, w)


def exterior_rows(result: SurveyResult) -> Iterable[Sequence[object]]:
    """Return the rows of observed_exterior.csv, one for each observed parameter."""
    found = exterior_residuals(result.adjustment)
    if found is None:
        return
    for e, image in enumerate(found.images):
        for k in np.flatnonzero(np.isfinite(found.given[e])):
            yield (
                image,
                PARAMETERS[k],
                found.given[e, k],
                found.sigma[e, k],
                found.difference[e, k],
                found.redundancy[e, k],
                found.w[e, k],
                result.length_unit if k < 3 else "deg",
            )


def exterior_summary(result: SurveyResult) -> list[dict[str, Any]]:
    """Return the same for summary.json."""
    names = HEADER.split(",")
    return [
        {
            name: or_none(float(value)) if isinstance(value, float | np.floating) else value
            for name, value in zip(names, row, strict=True)
        }
        for row in exterior_rows(result)
    ]


def exterior_text(result: SurveyResult) -> list[str]:
    """Return the part of report.txt: RMS of each kind, and the worst."""
    found = exterior_residuals(result.adjustment)
    if found is None:
        return []
    lines = head("Observed exterior orientation")
    for what, part in (("X0, Y0, Z0", slice(0, 3)), ("omega, phi, kappa", slice(3, 6))):
        v = found.difference[:, part]
        if not np.isfinite(v).any():
            continue
        factor, unit = _unit(result, v, part)
        shown = ", ".join(significant(_rms(v[:, k]) * factor) for k in range(3))
        count = int(np.isfinite(v).any(axis=1).sum())
        lines.append(line(what, f"{count} photographs; adjusted minus given: RMS {shown} {unit}"))
    size = np.nan_to_num(np.abs(found.w))
    order = [np.unravel_index(k, size.shape) for k in np.argsort(-size, axis=None, kind="stable")]
    order = [(e, k) for e, k in order if np.isfinite(found.w[e, k])]
    rows = []
    for e, k in order[:MOST_ROWS]:
        factor, unit = _unit(result, found.difference[e, k : k + 1], slice(k, k + 1))
        rows.append(
            (found.images[e], PARAMETERS[k], signed(float(found.difference[e, k]) * factor),
             significant(float(found.sigma[e, k]) * factor), unit, f"{found.redundancy[e, k]:.3f}",
             f"{found.w[e, k]:+.2f}")
        )  # fmt: skip
    if rows:
        lines += columns(("photograph", "", "v", "sigma", "unit", "r", "w"), rows, left=2)
    if len(order) > len(rows):
        lines.append(f"  the {len(rows)} largest w of {len(order)}; all in observed_exterior.csv")
    return lines


def exterior_section(result: SurveyResult) -> str:
    """Return the part of report.html: residual, standard deviation and w of each photograph."""
    found = exterior_residuals(result.adjustment)
    if found is None:
        return ""
    text = (
        "<h3>Observed exterior orientation</h3><p class=note>v: adjusted minus given, s: standard deviation "
        "given, w: v over its own standard deviation; by chance 1 of 1000 is beyond 3.3. Of every "
        "parameter: observed_exterior.csv.</p>"
    )
    for part in (slice(0, 3), slice(3, 6)):
        shown = np.isfinite(found.difference[:, part]).any(axis=1)
        if not shown.any():
            continue
        factor, unit = _unit(result, found.difference[:, part], part)
        names = PARAMETERS[part]
        header = (
            "photograph",
            *(f"v {name} [{unit}]" for name in names),
            *(f"s {name} [{unit}]" for name in names),
            *(f"w {name}" for name in names),
        )
        rows = [
            (
                found.images[e],
                *("" if np.isnan(v) else signed(v * factor) for v in found.difference[e, part]),
                *(_sigma(s * factor) for s in found.sigma[e, part]),
                *("" if np.isnan(w) else f"{w:+.2f}" for w in found.w[e, part]),
            )
            for e in np.flatnonzero(shown)
        ]
        rows.append(("RMS", *(significant(_rms(v) * factor) for v in found.difference[:, part].T), *[""] * 6))
        text += (
            f"<details{' open' if len(rows) <= OPEN_ROWS else ''}><summary>{escape(', '.join(names))} of "
            f"{len(rows) - 1} photographs</summary>" + table(header, rows, last_bold=True) + "</details>"
        )
    return text


def worst_exterior(adjustment: Adjustment) -> tuple[str, float]:
    """Return the parameter with the largest w, in words, and its absolute w; ("", 0) without one."""
    found = exterior_residuals(adjustment)
    if found is None or not np.isfinite(found.w).any():
        return "", 0.0
    size = np.nan_to_num(np.abs(found.w))
    e, k = np.unravel_index(int(np.argmax(size)), size.shape)
    return f"{PARAMETERS[k]} of photograph {found.images[e]}", float(size[e, k])


def _unit(result: SurveyResult, v: FloatArray, part: slice) -> tuple[float, str]:
    """Return factor and unit in which residuals of projection centres or angles read well."""
    if part.start >= 3:
        return 1.0, "deg"
    return finer_unit(result.length_unit, float(np.nanmax(np.abs(v), initial=0.0)))


def _sigma(value: float) -> str:
    return "" if np.isnan(value) else "fixed" if value == 0 else significant(value)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(values**2))) if np.isfinite(values).any() else float("nan")
