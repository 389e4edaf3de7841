"""summary.json: the figures of a result for programs.

The parts of summary.json on the other adjuster and the other pipeline.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray
from sfm.files.plain_text import or_none
from sfm.given_residuals import CENTRE, ROTATION, GivenResiduals
from sfm.report.findings.bundle_statistics import spread
from sfm.report.findings.findings import Findings
from sfm.report.findings.precision import point_sigma
from sfm.report.findings.rigs import Rig
from sfm.report.page import plain, values_of
from sfm.report.tables.summary_of_statistics import summary_of_consistency, summary_of_statistics
from sfm.result import SurveyResult


def write_summary(findings: Findings, folder: Path) -> None:
    """Write summary.json into an existing folder."""
    text = json.dumps(summary(findings), indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")


def _finite(value: Any, name: str, names: list[str]) -> Any:
    """Return a value with None for every number that is not finite; the names of these are appended.

    Args:
        value: as for JSON.
        name: of the value, the keys that lead to it joined by dots.
        names: which numbers were not finite so far.
    """
    if isinstance(value, dict):
        return {key: _finite(one, f"{name}.{key}".lstrip("."), names) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one, f"{name}[{k}]", names) for k, one in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        names.append(name)
        return None
    return value


def summary(findings: Findings) -> dict[str, Any]:
    """Return what summary.json holds: plain values only, None for what is not known or not finite."""
    names: list[str] = []
    figures: dict[str, Any] = _finite(_figures(findings), "", names)
    return figures | {"not_finite": names}


def _figures(findings: Findings) -> dict[str, Any]:
    """Return the figures of a result, some of which may not be finite."""
    result, verdict = findings.result, findings.verdict
    adjustment, given = result.adjustment, findings.given
    coded = int((result.code >= 0).sum())
    return {
        "survey": result.survey,
        "unit": result.unit,
        "length_unit": result.length_unit,
        "verdict": {
            "level": verdict.level,
            "headline": verdict.headline,
            "remarks": [one.as_dict() for one in verdict.remarks],
        },
        "converged": adjustment.converged,
        "iterations": adjustment.iterations,
        "sigma0_at_start": or_none(adjustment.start_sigma0),
        "images": {
            "used": len(adjustment.network.images),
            "total": result.images_total,
            "failed": [{"image": f.image, "reason": f.reason.as_dict()} for f in result.failed],
        },
        "points": {"total": len(result.code), "coded": coded, "uncoded": len(result.code) - coded},
        "observations": {
            "used": int((~adjustment.rejected).sum()),
            "rejected": int(adjustment.rejected.sum()),
            "not_in_result": result.unused_image_points,
        },
        "left_out": [
            {"point": one.point, "image_points": one.image_points, "reason": one.reason.as_dict()}
            for one in result.left_out
        ],
        "unknowns": adjustment.unknowns,
        "redundancy": adjustment.redundancy,
        "datum": {
            "kind": adjustment.datum,
            "points": _datum_points(adjustment),
            "defect": adjustment.defect,
            "expected_defect": adjustment.expected_defect,
            "undetermined": list(adjustment.undetermined),
        },
        "sigma0": or_none(adjustment.sigma0),
        "sigma0_px": or_none(adjustment.sigma0_px),
        "error_correlation": _error_correlation(adjustment),
        "rms_px": or_none(adjustment.rms_px),
        "max_residual_px": or_none(adjustment.max_residual_px),
        "cameras": [
            {
                "name": camera.name,
                "model": camera.model,
                "size_px": list(camera.size_px),
                "pixel_mm": [or_none(value) for value in camera.pixel_mm],
                "parameters": {
                    name: {"value": or_none(value), "sigma": or_none(sigma), "unit": unit}
                    for name, value, sigma, unit in zip(
                        camera.names,
                        camera.parameters,
                        findings.interior.sigmas[index],
                        camera.units,
                        strict=True,
                    )
                },
            }
            for index, camera in enumerate(adjustment.estimate.cameras)
        ],
        "rigs": summary_of_rigs(findings.rigs),
        "statistics": summary_of_statistics(findings),
        "consistency": summary_of_consistency(findings),
        "geometry": _geometry(findings),
        "control": _control(findings),
        "scale_bars": _scale_bars(findings),
        "weighted_interior": _given_values(given.interior, "parameter"),
        "observed_exterior": [
            one for kind in (CENTRE, ROTATION) for one in _given_values(given.of(kind), "image", "parameter")
        ],
        "further_observations": {
            kind.kind: _given_values(kind, "name", "component") for kind in given.further
        },
        "eccentricity": result.eccentricity and values_of(result.eccentricity, "largest_px rms_px sigma_px"),
        "no_circles": list(result.no_circles),
        "comparison": summary_of_comparison(result),
        "baseline": summary_of_baseline(result),
        "seconds": {time.stage: round(time.seconds, 3) for time in result.seconds},
    }


def _error_correlation(a: Adjustment) -> dict[str, float] | None:
    """Return what neighbouring image points err alone and together, px; None where they are independent."""
    if a.error_correlation is None:
        return None
    alone, common = a.error_correlation.sigmas_px(a.sigma0_px)
    return {"alone_px": alone, "common_px": common, "length_px": a.error_correlation.length_px}


def _datum_points(adjustment: Adjustment) -> list[str] | None:
    """Return the names of chosen datum points, None where all points carry the datum."""
    if adjustment.datum_points is None:
        return None
    return list(compress(adjustment.network.points, adjustment.datum_points))


def _geometry(findings: Findings) -> dict[str, Any]:
    found, network = findings.geometry, findings.result.adjustment.network
    return {
        "rays": _spread(found.rays.astype(float)),
        "points_by_rays": {str(rays): n for rays, n in found.histogram()},
        "intersection_angle_deg": _spread(found.angle_deg),
        "weak_points": [network.points[j] for j in found.weak],
        "point_rms_px": _spread(found.point_rms_px),
        "image_rms_px": _spread(found.image_rms_px),
        "coverage": [
            {
                "camera": one.camera,
                "hull": _spread(one.hull) | {"all": or_none(one.hull_of_all)},
                "radius": _spread(one.radius),
            }
            for one in found.coverage
        ],
    }


def _spread(values: FloatArray) -> dict[str, float | None]:
    """Return the smallest, mean and largest of the values known."""
    found = spread(values)
    return {"min": or_none(found.smallest), "mean": or_none(found.mean), "max": or_none(found.largest)}


def _control(findings: Findings) -> dict[str, Any] | None:
    check, found = findings.result.control_check, findings.given.control
    if check is not None:
        return {
            "role": "check",
            **values_of(check, "scale rms"),
            "differences": plain(dict(zip(check.points, check.differences, strict=True))),
        }
    if found is None:
        return None
    columns = ("difference", "sigma", "r", "w")
    return {
        "role": "datum",
        "points": [
            {"id": name} | {c: plain(getattr(found, c)[k]) for c in columns}
            for k, name in enumerate(found.names)
        ],
    }


def _scale_bars(findings: Findings) -> list[dict[str, Any]]:
    network = findings.result.adjustment.network
    bars, names = network.scale_bars, network.points
    ends = [{"from": names[i], "to": names[j]} for i, j in zip(bars.start, bars.end, strict=True)]
    values = _given_values(findings.given.bars)
    for one in values:
        one["length"] = one.pop("given")
        del one["unit"]
    return [end | one for end, one in zip(ends, values, strict=True)]


def _given_values(found: GivenResiduals | None, *keys: str) -> list[dict[str, Any]]:
    """Return every given value of a kind; the keys are what its name and coordinate are called."""
    return [
        dict(zip(keys, (one.name, one.coordinate), strict=False))
        | values_of(one, "unit given difference sigma r w")
        for one in (found.values if found is not None else ())
    ]


def summary_of_comparison(result: SurveyResult) -> dict[str, Any] | None:
    """Return the comparison with the other adjuster, None without one."""
    both = result.comparison
    if both is None:
        return None
    difference, C, other = both.comparison, both.adjustment.covariance, both.backend_points
    return {
        **values_of(both, "backend agree outcome gap model stopped_early"),
        **values_of(difference, "max_sigmas max_position max_rotation_deg max_point"),
        "max_interior_px": or_none(float(np.nanmax(difference.interior_px, initial=0.0))),
        "object_size": or_none(difference.object_size),
        "rms_px": {"kolinear": difference.rms_px[0], both.backend: difference.rms_px[1]},
        "cost": {"kolinear": difference.cost[0], both.backend: difference.cost[1]},
        "point_sigma_rms": {
            "kolinear_marginal": or_none(point_sigma(C.points)[0]),
            "kolinear_conditional": or_none(point_sigma(C.points_limiting)[0]),
            f"{both.backend}_conditional": None if other is None else or_none(point_sigma(other)[0]),
        },
        "exceeded": list(difference.exceeded),
        **values_of(both, "held unshared freed"),
        "conversions": [
            {
                "camera": one.camera.name,
                "from": one.source_model,
                "to": one.camera.model,
                **values_of(one, "rms_px max_px"),
            }
            for one in both.conversions
        ],
    }


def summary_of_baseline(result: SurveyResult) -> dict[str, Any] | None:
    """Return the comparison with the other pipeline, None without one."""
    found = result.baseline
    if found is None:
        return None

    def pair(values: tuple[float, float]) -> dict[str, float | None]:
        return {"kolinear": or_none(values[0]), found.name: or_none(values[1])}

    return {
        "pipeline": found.name,
        "images": {"kolinear": found.photographs[0], found.name: found.photographs[1], "total": found.total},
        "rms_px": pair(found.rms_px),
        "seconds": pair(found.seconds),
        "targets": found.targets,
        **values_of(found, "target_rms_px point_rms max_point position_rms max_rotation_deg"),
    }


def summary_of_rigs(rigs: Sequence[Rig]) -> list[dict[str, Any]]:
    """Return what files of a result or a plan say of rigs: every mount with its standard deviations."""
    return [
        {
            "name": rig.name,
            "reference": rig.reference,
            "moments": rig.moments,
            "mounts": [
                {"camera": mount.camera}
                | {name: _value(*one) for name, *one, is_length in mount.values if is_length}
                | {
                    "rotation_deg": {
                        name: _value(*one) for name, *one, is_length in mount.values if not is_length
                    }
                }
                for mount in rig.mounts
            ],
        }
        for rig in rigs
    ]


def _value(value: float, sigma: float) -> dict[str, float | None]:
    return {"value": or_none(value), "sigma": or_none(sigma)}
