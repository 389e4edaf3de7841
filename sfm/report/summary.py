"""summary.json: the figures of a result for programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from sfm.adjustment.quality.statistics import CoordinateTest
from sfm.adjustment.quality.variance_components import VarianceComponents
from sfm.adjustment.result import Adjustment
from sfm.files.plain_text import or_none
from sfm.report.checks import (
    count_observations,
    sigma0_ratio,
)
from sfm.report.given import EXTERIOR, bar_residuals, control_residuals, given_rows, interior_residuals
from sfm.report.section_geometry import geometry_summary
from sfm.report.statistics import (
    parameter_sigmas,
    quantiles,
    statistics_of,
    words_of_test,
    words_of_weights,
)
from sfm.report.summary_comparison import baseline_summary, comparison_summary
from sfm.report.tables import UNCODED
from sfm.report.verdict import verdict_of
from sfm.result import SurveyResult


def write_summary(result: SurveyResult, folder: Path) -> None:
    """Write summary.json into an existing folder."""
    text = json.dumps(summary(result), indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")


def summary(result: SurveyResult) -> dict[str, Any]:
    """Return what summary.json holds: plain values only, None for what is not known."""
    adjustment = result.adjustment
    coded = int((result.code != UNCODED).sum())
    return {
        "survey": result.survey,
        "unit": result.unit,
        "length_unit": result.length_unit,
        "verdict": _verdict(result),
        "converged": adjustment.converged,
        "iterations": adjustment.iterations,
        "images": {
            "used": len(adjustment.network.images),
            "total": result.images_total,
            "failed": [{"image": f.image, "reason": f.reason} for f in result.failed],
        },
        "points": {"total": len(result.code), "coded": coded, "uncoded": len(result.code) - coded},
        "observations": {
            "used": int((~adjustment.rejected).sum()),
            "rejected": int(adjustment.rejected.sum()),
        },
        "unknowns": adjustment.unknowns,
        "redundancy": adjustment.redundancy,
        "datum": {
            "kind": adjustment.datum,
            "points": _datum_points(adjustment),
            "defect": adjustment.defect,
            "expected_defect": adjustment.expected_defect,
            "undetermined": list(adjustment.undetermined),
        },
        "sigma0_px": or_none(adjustment.sigma0_px),
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
                        parameter_sigmas(adjustment, index),
                        camera.units,
                        strict=True,
                    )
                },
            }
            for index, camera in enumerate(adjustment.estimate.cameras)
        ],
        "statistics": _statistics(result),
        "geometry": geometry_summary(result),
        "control": _control(result),
        "scale_bars": _scale_bars(result),
        "weighted_interior": _weighted_interior(result),
        "observed_exterior": _observed_exterior(result),
        "eccentricity": _eccentricity(result),
        "no_circles": list(result.no_circles),
        "comparison": comparison_summary(result),
        "baseline": baseline_summary(result),
        "warnings": list(result.warnings),
        "seconds": {time.stage: round(time.seconds, 3) for time in result.seconds},
    }


def _verdict(result: SurveyResult) -> dict[str, Any]:
    verdict = verdict_of(result)
    return {"level": verdict.level, "headline": verdict.headline, "remarks": list(verdict.remarks)}


def _statistics(result: SurveyResult) -> dict[str, Any]:
    a, found = result.adjustment, statistics_of(result)
    counts, r = count_observations(a), a.redundancy_numbers
    known = np.isfinite(r).any()
    bias, external = quantiles(found.reliability.minimal_bias), quantiles(found.reliability.external)
    return {
        "sigma0_ratio": or_none(sigma0_ratio(result)),
        "image_points_px": or_none(sigma0_ratio(result) * result.adjustment.stated_px),
        "stated_px": or_none(result.adjustment.stated_px),
        "weight_factor": result.adjustment.weight_factor,
        "weights": words_of_weights(result),
        "global_tests": [
            {
                "of": test.of,
                "vPv": or_none(test.statistic),
                "redundancy": test.redundancy,
                "lower": or_none(test.lower),
                "upper": or_none(test.upper),
                "passed": test.passed,
                "words": words_of_test(test),
            }
            for test in found.global_tests
        ],
        "w_test": _coordinate_test(found.w),
        "tau_test": _coordinate_test(found.tau),
        "observations": {
            "image_coordinates": counts.image,
            "control": counts.control,
            "exterior": counts.exterior,
            "interior": counts.interior,
            "scale_bars": counts.scale_bars,
            "constraints": counts.constraints,
            "total": counts.total,
        },
        "redundancy_number": {
            "sum": or_none(found.redundancy_sum),
            "mean": or_none(float(np.nanmean(r))) if known else None,
            "min": or_none(float(np.nanmin(r))) if known else None,
        },
        "minimal_detectable_bias_px": {"median": or_none(bias[0]), "max": or_none(bias[1])},
        "external_reliability_sigmas": {
            "median": or_none(external[0]),
            "max": or_none(external[1]),
        },
        "sigma0_by_kind": _components(found.kinds),
        "sigma0_by_camera": _components(found.cameras),
        "sigma0_by_photograph": _components(found.photographs),
        "correlations": [
            {"first": pair.first, "second": pair.second, "value": or_none(pair.value)}
            for pair in found.correlations
        ],
        "orientation_correlations": [
            {
                "parameter": one.parameter,
                "with": one.part,
                "image": one.image,
                "value": one.largest,
                "photographs": dict(one.counts),
            }
            for one in result.orientation_correlations
        ],
        "significance": [
            {
                "camera": test.camera,
                "parameter": test.parameter,
                "t": or_none(test.t),
                "probability": or_none(test.probability),
                "significant": bool(test.significant),
            }
            for test in found.significance
        ],
        "not_significant": [
            {"camera": test.camera, "parameter": test.parameter, "t": or_none(test.t)}
            for test in found.significance
            if not test.significant
        ],
    }


def _datum_points(adjustment: Adjustment) -> list[str] | None:
    """Return the names of chosen datum points, None where all points carry the datum."""
    if adjustment.datum_points is None:
        return None
    names = adjustment.network.points
    return [name for name, on in zip(names, adjustment.datum_points, strict=True) if on]


def _coordinate_test(test: CoordinateTest) -> dict[str, Any]:
    known = np.isfinite(test.statistic)
    return {
        "alpha": test.alpha,
        "critical": or_none(test.critical),
        "tested": test.tested,
        "beyond": test.beyond,
        "expected": test.expected,
        "max": or_none(float(np.abs(test.statistic[known]).max())) if known.any() else None,
    }


def _components(components: VarianceComponents) -> dict[str, float | None]:
    return {name: or_none(float(s)) for name, s in zip(components.names, components.sigma0, strict=True)}


def _control(result: SurveyResult) -> dict[str, Any] | None:
    check = result.control_check
    if check is not None:
        return {
            "role": "check",
            "scale": or_none(check.scale),
            "rms": [or_none(value) for value in check.rms],
            "differences": {
                name: [or_none(value) for value in difference]
                for name, difference in zip(check.points, check.differences, strict=True)
            },
        }
    found = control_residuals(result)
    if found is None:
        return None
    columns = ("difference", "sigma", "r", "w")
    return {
        "role": "datum",
        "points": [
            {"id": name} | {c: [or_none(value) for value in getattr(found, c)[k]] for c in columns}
            for k, name in enumerate(found.names)
        ],
    }


def _scale_bars(result: SurveyResult) -> list[dict[str, Any]]:
    found, bars, names = (
        bar_residuals(result), result.adjustment.network.scale_bars, result.adjustment.network.points
    )  # fmt: skip
    if found is None:
        return []
    return [
        {
            "from": names[bars.start[b]],
            "to": names[bars.end[b]],
            "length": or_none(found.given[b, 0]),
            "difference": or_none(found.difference[b, 0]),
            "sigma": or_none(found.sigma[b, 0]),
            "r": or_none(found.r[b, 0]),
            "w": or_none(found.w[b, 0]),
        }
        for b in range(len(bars))
    ]


def _weighted_interior(result: SurveyResult) -> list[dict[str, Any]]:
    found = interior_residuals(result)
    if found is None:
        return []
    return [
        {
            "parameter": name,
            "unit": found.units[q],
            "given": or_none(found.given[q, 0]),
            "difference": or_none(found.difference[q, 0]),
            "sigma": or_none(found.sigma[q, 0]),
            "r": or_none(found.r[q, 0]),
            "w": or_none(found.w[q, 0]),
        }
        for q, name in enumerate(found.names)
    ]


def _observed_exterior(result: SurveyResult) -> list[dict[str, Any]]:
    names = ("image", "parameter", "unit", "given", "difference", "sigma", "r", "w")
    kinds = [kind for kind, _ in EXTERIOR]
    return [
        dict(zip(names, (*row[1:4], *(or_none(float(str(value))) for value in row[4:])), strict=True))
        for row in given_rows(result)
        if row[0] in kinds
    ]


def _eccentricity(result: SurveyResult) -> dict[str, Any] | None:
    found = result.eccentricity
    if found is None:
        return None
    return {
        "largest_px": or_none(found.largest_px),
        "rms_px": or_none(found.rms_px),
        "sigma_px": or_none(found.sigma_px),
    }
