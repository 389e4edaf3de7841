"""summary.json: the figures of a result for programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sfm.adjustment.quality.statistics import CoordinateTest
from sfm.adjustment.quality.variance_components import VarianceComponents
from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray
from sfm.files.plain_text import or_none
from sfm.report.findings.bundle_statistics import Spread, spread
from sfm.report.findings.findings import Findings
from sfm.report.findings.given_residuals import GivenResiduals
from sfm.report.phrases import words_of_test, words_of_weights
from sfm.result import SurveyResult


def write_summary(findings: Findings, folder: Path) -> None:
    """Write summary.json into an existing folder."""
    text = json.dumps(summary(findings), indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")


def summary(findings: Findings) -> dict[str, Any]:
    """Return what summary.json holds: plain values only, None for what is not known."""
    result, verdict = findings.result, findings.verdict
    adjustment, given = result.adjustment, findings.given
    coded = sum(point.code is not None for point in findings.points)
    return {
        "survey": result.survey,
        "unit": result.unit,
        "length_unit": result.length_unit,
        "verdict": {
            "level": verdict.level,
            "headline": verdict.headline,
            "remarks": list(verdict.remarks),
        },
        "converged": adjustment.converged,
        "iterations": adjustment.iterations,
        "sigma0_at_start": or_none(adjustment.start_sigma0),
        "images": {
            "used": len(adjustment.network.images),
            "total": result.images_total,
            "failed": [{"image": f.image, "reason": f.reason} for f in result.failed],
        },
        "points": {"total": len(result.code), "coded": coded, "uncoded": len(result.code) - coded},
        "observations": {
            "used": int((~adjustment.rejected).sum()),
            "rejected": int(adjustment.rejected.sum()),
            "not_in_result": result.unused_image_points,
        },
        "left_out": [
            {"point": one.point, "image_points": one.image_points, "reason": one.reason}
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
                        findings.interior.sigmas[index],
                        camera.units,
                        strict=True,
                    )
                },
            }
            for index, camera in enumerate(adjustment.estimate.cameras)
        ],
        "statistics": _statistics(findings),
        "consistency": _consistency(findings),
        "geometry": _geometry(findings),
        "control": _control(findings),
        "scale_bars": _scale_bars(findings),
        "weighted_interior": _given_values(given.interior, "parameter"),
        "observed_exterior": [
            *_given_values(given.position, "image", "parameter"),
            *_given_values(given.rotation, "image", "parameter"),
        ],
        "eccentricity": None
        if result.eccentricity is None
        else {
            name: or_none(getattr(result.eccentricity, name)) for name in ("largest_px", "rms_px", "sigma_px")
        },
        "no_circles": list(result.no_circles),
        "comparison": _comparison(findings),
        "baseline": _baseline(result),
        "warnings": list(result.warnings),
        "seconds": {time.stage: round(time.seconds, 3) for time in result.seconds},
    }


def _statistics(findings: Findings) -> dict[str, Any]:
    result, found, sigma0, counts = findings.result, findings.statistics, findings.sigma0, findings.counts
    return {
        "sigma0_ratio": or_none(sigma0.ratio),
        "image_points_px": or_none(sigma0.image_points_px),
        "stated_px": or_none(sigma0.stated_px),
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
                "words": words_of_test(test, result.adjustment),
            }
            for test in found.global_tests
        ],
        "w_test": _coordinate_test(found.w, found.largest_w),
        "tau_test": _coordinate_test(found.tau, found.largest_tau),
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
            "mean": or_none(found.redundancy.mean),
            "min": or_none(found.redundancy.smallest),
        },
        "minimal_detectable_bias_px": _median_and_max(found.minimal_bias),
        "external_reliability_sigmas": _median_and_max(found.external),
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
            for test in found.not_significant
        ],
    }


def _consistency(findings: Findings) -> dict[str, Any]:
    """Return what the tests of points, photographs and the format have found."""
    found, test = findings.consistency, findings.given_test
    return {
        "two_positions": [
            {
                "point": one.point,
                "distance": or_none(one.distance),
                "over_sigma": or_none(one.over_sigma),
                "first": list(one.first),
                "second": list(one.second),
            }
            for one in found.two_positions
        ],
        "large_residuals": list(found.large),
        "doubtful": [
            {
                "point": one.point,
                "rejected": one.rejected,
                "instead": one.instead,
                "misfit": or_none(one.misfit),
                "other": or_none(one.other),
            }
            for one in found.doubtful
        ],
        "uneven_photographs": None
        if found.uneven is None
        else {
            "probability": or_none(found.uneven.probability),
            "worst": found.uneven.worst,
            "largest": or_none(found.uneven.largest),
            "median": or_none(found.uneven.median),
        },
        "patterns": [
            {
                "camera": one.camera,
                "probability": or_none(one.probability),
                "explained": or_none(one.explained),
                "largest_px": or_none(one.largest_px),
            }
            for one in found.patterns
        ],
        "other_solutions": [
            {
                "camera": one.camera,
                "c": or_none(one.c),
                "unit": one.unit,
                "reflected": one.reflected,
                "moved_over_sigma": or_none(one.moved),
                "vPv_ratio": or_none(one.vPv),
            }
            for one in findings.result.other_solutions
        ],
        "given_against_free_network": None
        if test is None
        else {
            "F": or_none(test.statistic),
            "redundancy": test.redundancy,
            "probability": or_none(test.probability),
        },
    }


def _datum_points(adjustment: Adjustment) -> list[str] | None:
    """Return the names of chosen datum points, None where all points carry the datum."""
    if adjustment.datum_points is None:
        return None
    names = adjustment.network.points
    return [name for name, on in zip(names, adjustment.datum_points, strict=True) if on]


def _median_and_max(values: Spread) -> dict[str, float | None]:
    return {"median": or_none(values.median), "max": or_none(values.largest)}


def _coordinate_test(test: CoordinateTest, largest: float) -> dict[str, Any]:
    return {
        "alpha": test.alpha,
        "critical": or_none(test.critical),
        "tested": test.tested,
        "beyond": test.beyond,
        "expected": test.expected,
        "max": or_none(largest),
    }


def _components(components: VarianceComponents) -> dict[str, float | None]:
    return {name: or_none(float(s)) for name, s in zip(components.names, components.sigma0, strict=True)}


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
            "scale": or_none(check.scale),
            "rms": [or_none(value) for value in check.rms],
            "differences": {
                name: [or_none(value) for value in difference]
                for name, difference in zip(check.points, check.differences, strict=True)
            },
        }
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
    numbers = ("given", "difference", "sigma", "r", "w")
    return [
        dict(zip(keys, (one.name, one.coordinate), strict=False))
        | {"unit": one.unit}
        | {number: or_none(getattr(one, number)) for number in numbers}
        for one in (found.values if found is not None else ())
    ]


def _comparison(findings: Findings) -> dict[str, Any] | None:
    """Return the comparison with the other adjuster, None without one."""
    found = findings.comparison
    if found is None:
        return None
    both, difference = found.both, found.both.comparison
    other = found.backend_conditional
    return {
        "backend": both.backend,
        "agree": both.agree,
        "model": both.model,
        "stopped_early": both.stopped_early,
        "max_sigmas": or_none(difference.max_sigmas),
        "max_position": or_none(difference.max_position),
        "max_rotation_deg": or_none(difference.max_rotation_deg),
        "max_point": or_none(difference.max_point),
        "max_interior_px": or_none(found.max_interior_px),
        "object_size": or_none(difference.object_size),
        "rms_px": {"kolinear": difference.rms_px[0], both.backend: difference.rms_px[1]},
        "cost": {"kolinear": difference.cost[0], both.backend: difference.cost[1]},
        "point_sigma_rms": {
            "kolinear_marginal": or_none(found.marginal.rms),
            "kolinear_conditional": or_none(found.conditional.rms),
            f"{both.backend}_conditional": None if other is None else or_none(other.rms),
        },
        "exceeded": list(difference.exceeded),
        "held": list(both.held),
        "unshared": list(both.unshared),
        "freed": list(both.freed),
        "conversions": [
            {
                "camera": one.camera.name,
                "from": one.source_model,
                "to": one.camera.model,
                "rms_px": or_none(one.rms_px),
                "max_px": or_none(one.max_px),
            }
            for one in both.conversions
        ],
    }


def _baseline(result: SurveyResult) -> dict[str, Any] | None:
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
        "target_rms_px": or_none(found.target_rms_px),
        "point_rms": or_none(found.point_rms),
        "max_point": or_none(found.max_point),
        "position_rms": or_none(found.position_rms),
        "max_rotation_deg": or_none(found.max_rotation_deg),
    }
