"""summary.json: the key figures of a result for other programs."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Sequence
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from sfm.adjustment.quality.statistics import CoordinateTest
from sfm.adjustment.quality.variance_components import VarianceComponents
from sfm.files.plain_text import or_none
from sfm.judgement.bundle_statistics import Spread, summarise_redundancy
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import FloatArray
from sfm.model.observation_residuals import CENTRE, ROTATION, GivenResiduals
from sfm.report.findings import Findings
from sfm.report.page import plain, values_of
from sfm.report.phrases import describe_test, describe_weights
from sfm.report.precision import point_sigma
from sfm.report.rig_mounts import Rig


def write_summary(findings: Findings, folder: Path) -> None:
    """Write summary.json into an existing folder."""
    text = json.dumps(summary(findings), indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")


def summary(findings: Findings) -> dict[str, Any]:
    """Return the content of summary.json: plain values only, None for values not known or not finite."""
    names: list[str] = []
    figures: dict[str, Any] = _finite(_figures(findings), "", names)
    return figures | {"not_finite": names}


def _finite(value: Any, name: str, names: list[str]) -> Any:
    """Return a value with None for every number that is not finite, and append the names of these."""
    if isinstance(value, dict):
        return {key: _finite(item, f"{name}.{key}".lstrip("."), names) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item, f"{name}[{k}]", names) for k, item in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        names.append(name)
        return None
    return value


def _figures(findings: Findings) -> dict[str, Any]:
    """Return the figures of a result, some of which may not be finite."""
    result, given = findings.result, findings.given
    a, correlation = result.adjustment, result.adjustment.error_correlation
    bars, names = a.network.scale_bars, a.network.points
    further = defaultdict[str, list[dict[str, Any]]](list)  # with all groups of a kind together
    for kind in given.further:
        further[kind.kind] += _given_values(kind, "name", "component")
    coded = int((result.code >= 0).sum())
    return {
        **values_of(result, "survey unit length_unit"),
        "verdict": findings.verdict.entry,
        **values_of(a, "converged iterations"),
        "sigma0_at_start": or_none(a.start_sigma0),
        "images": {
            "used": len(a.network.images),
            "total": result.images_total,
            "failed": [{"image": f.image, "reason": f.reason.as_dict()} for f in result.failed],
        },
        "points": {"total": len(result.code), "coded": coded, "uncoded": len(result.code) - coded},
        "sources": [
            values_of(source, "name names_last has_common_errors design_effect")
            | {
                "image_points": int((a.network.source == k).sum()),
                "rejected": int(a.rejected[a.network.source == k].sum()),
                "sigma_px": a.sigma_of_sources[k],
                "sigma0": float(findings.statistics.sources.sigma0[k]),
            }
            for k, source in enumerate(a.network.sources)
        ],
        "observations": {
            "used": int((~a.rejected).sum()),
            "rejected": int(a.rejected.sum()),
            "not_in_result": result.unused_image_points,
        },
        "left_out": [
            values_of(point, "point image_points") | {"reason": point.reason.as_dict()}
            for point in result.left_out
        ],
        **values_of(a, "unknowns redundancy"),
        "datum": {
            "kind": a.datum,
            "points": None if a.datum_points is None else list(compress(a.network.points, a.datum_points)),
            **values_of(a, "defect expected_defect undetermined"),
        },
        **values_of(a, "sigma0 sigma0_px"),
        "error_correlation": correlation  # None if all errors are independent
        and dict(zip(("alone_px", "common_px"), correlation.sigmas_px(a.sigma0_px), strict=True))
        | values_of(correlation, "length_px design_effect"),
        **values_of(a, "rms_px max_residual_px"),
        "cameras": [
            values_of(camera, "name model size_px pixel_mm")
            | {
                "parameters": {
                    name: {"value": or_none(value), "sigma": or_none(sigma), "unit": unit}
                    for name, value, sigma, unit in zip(
                        camera.names, camera.parameters, sigmas, camera.units, strict=True
                    )
                }
            }
            for camera, sigmas in zip(a.estimate.cameras, findings.interior.sigmas, strict=True)
        ],
        "rigs": summary_of_rigs(findings.rigs),
        "statistics": _statistics(findings),
        "consistency": _consistency(findings),
        "geometry": _geometry(findings),
        "control": _control(findings),
        "scale_bars": [
            {"from": names[i], "to": names[j]}
            | values_of(bar, "difference sigma r w")
            | {"length": plain(bar.given)}
            for i, j, bar in zip(bars.start, bars.end, given.bars.values if given.bars else (), strict=True)
        ],
        "equipment": [
            values_of(equipment, "name given_as")
            | {"calibrated": equipment.calibrated.isoformat()}
            | values_of(
                equipment,
                "calibration_temperature expansion expansion_sigma temperature temperature_sigma correction",
            )
            for equipment in result.equipment
        ],
        "weighted_interior": _given_values(given.interior, "parameter"),
        "observed_exterior": [
            value
            for kind in (CENTRE, ROTATION)
            for value in _given_values(given.of(kind), "image", "parameter")
        ],
        "further_observations": dict(further),
        "group_parameters": [
            {
                "group": parameters.group,
                "names": list(parameters.names),
                "values": parameters.value.tolist(),
                "covariance": [[or_none(value) for value in row] for row in parameters.covariance.tolist()],
                "unit": result.length_unit,
            }
            for parameters in a.group_parameters
        ],
        "eccentricity": result.eccentricity and values_of(result.eccentricity, "largest_px rms_px sigma_px"),
        "no_circles": list(result.no_circles),
        "comparison": _comparison(result),
        "baseline": _baseline(result),
        "seconds": {time.stage: round(time.seconds, 3) for time in result.seconds},
    }


def _statistics(findings: Findings) -> dict[str, Any]:
    """Return the tests, reliability, components, correlations and significance of a result."""
    result, statistics, sigma0, counts = (
        findings.result,
        findings.statistics,
        findings.sigma0,
        findings.counts,
    )
    return {
        "sigma0_ratio": or_none(sigma0.ratio),
        **values_of(sigma0, "image_points_px stated_px"),
        "weight_factor": result.adjustment.weight_factor,
        "weights": describe_weights(result),
        "global_tests": [
            {
                "of": test.of,
                "vPv": or_none(test.statistic),
                **values_of(test, "redundancy lower upper passed"),
                "words": describe_test(test, result.adjustment),
            }
            for test in statistics.global_tests
        ],
        "w_test": _coordinate_test(statistics.w, statistics.largest_w),
        "tau_test": _coordinate_test(statistics.tau, statistics.largest_tau),
        "observations": {
            "image_coordinates": counts.image,
            **values_of(counts, "control exterior interior scale_bars further constraints total"),
        },
        "redundancy_number": {
            "sum": or_none(statistics.redundancy_sum),
            "mean": or_none(statistics.redundancy.mean),
            "min": or_none(statistics.redundancy.smallest),
        },
        "minimal_detectable_bias_px": _median_and_max(statistics.minimal_bias),
        "external_reliability_sigmas": _median_and_max(statistics.external),
        "sigma0_by_kind": _components(statistics.kinds),
        "sigma0_by_camera": _components(statistics.cameras),
        "sigma0_by_photograph": _components(statistics.photographs),
        "correlations": [values_of(pair, "first second value") for pair in statistics.correlations],
        "orientation_correlations": [
            {
                "parameter": correlation.parameter,
                "with": correlation.part,
                "image": correlation.image,
                "value": correlation.largest,
                "photographs": dict(correlation.counts),
            }
            for correlation in result.orientation_correlations
        ],
        "significance": [
            values_of(test, "camera parameter t probability significant") for test in statistics.significance
        ],
        "not_significant": [values_of(test, "camera parameter t") for test in statistics.not_significant],
    }


def _consistency(findings: Findings) -> dict[str, Any]:
    """Return the outcome of the tests of points, photographs and the format."""
    consistency = findings.consistency
    return {
        "large_residuals": list(consistency.large),
        "doubtful": [
            values_of(remark, "point rejected instead misfit other") for remark in consistency.doubtful
        ],
        "uneven_photographs": consistency.uneven
        and values_of(consistency.uneven, "probability worst largest median"),
        "other_solutions": [
            {
                **values_of(other, "camera c unit reflected"),
                "moved_over_sigma": or_none(other.moved),
                "vPv_ratio": or_none(other.vPv),
            }
            for other in findings.result.other_solutions
        ],
        "given_against_free_network": [
            {
                "what": test.what,
                "chi2": None if test.statistic is None else or_none(test.statistic),
                "degrees_of_freedom": test.dof,
                "probability": or_none(test.probability),
            }
            for test in findings.result.given_tests
        ],
    }


def _median_and_max(values: Spread) -> dict[str, float | None]:
    return {"median": or_none(values.median), "max": or_none(values.largest)}


def _coordinate_test(test: CoordinateTest, largest: float) -> dict[str, Any]:
    return values_of(test, "alpha critical tested beyond expected") | {"max": or_none(largest)}


def _components(components: VarianceComponents) -> dict[str, float | None]:
    return {name: or_none(float(s)) for name, s in zip(components.names, components.sigma0, strict=True)}


def _geometry(findings: Findings) -> dict[str, Any]:
    geometry, network = findings.geometry, findings.result.adjustment.network
    return {
        "rays": _spread(geometry.rays.astype(float)),
        "points_by_rays": {str(rays): n for rays, n in geometry.histogram()},
        "intersection_angle_deg": _spread(geometry.angle_deg),
        "weak_points": [network.points[j] for j in geometry.weak],
        "point_rms_px": _spread(geometry.point_rms_px),
        "image_rms_px": _spread(geometry.image_rms_px),
        "coverage": [
            {
                "camera": coverage.camera,
                "hull": _spread(coverage.hull) | {"all": or_none(coverage.hull_of_all)},
                "radius": _spread(coverage.radius),
            }
            for coverage in geometry.coverage
        ],
    }


def _spread(values: FloatArray) -> dict[str, float | None]:
    """Return smallest, mean and largest of the known values."""
    known = summarise_redundancy(values)
    return {"min": or_none(known.smallest), "mean": or_none(known.mean), "max": or_none(known.largest)}


def _control(findings: Findings) -> dict[str, Any] | None:
    check, control = findings.result.control_check, findings.given.control
    if check is not None:
        return {
            "role": "check",
            **values_of(check, "scale rms"),
            "differences": plain(dict(zip(check.points, check.differences, strict=True))),
        }
    if control is None:
        return None
    columns = ("difference", "sigma", "r", "w")
    return {
        "role": "datum",
        "points": [
            {"id": name} | {c: plain(getattr(control, c)[k]) for c in columns}
            for k, name in enumerate(control.names)
        ],
    }


def _given_values(residuals: GivenResiduals | None, *keys: str) -> list[dict[str, Any]]:
    """Return every given value of a kind; `keys` are the keys of its name and coordinate."""
    return [
        dict(zip(keys, (value.name, value.coordinate), strict=False))
        | values_of(value, "unit given difference sigma r w")
        for value in (residuals.values if residuals is not None else ())
    ]


def _comparison(result: SurveyResult) -> dict[str, Any] | None:
    """Return the comparison with the other adjuster; None without one."""
    adjusters = result.comparison
    if adjusters is None:
        return None
    difference, C, other = adjusters.comparison, adjusters.adjustment.covariance, adjusters.backend_points
    return {
        **values_of(adjusters, "backend agree outcome gap model stopped_early"),
        **values_of(difference, "max_sigmas max_position max_rotation_deg max_point"),
        "max_interior_px": or_none(float(np.nanmax(difference.interior_px, initial=0.0))),
        "object_size": or_none(difference.object_size),
        "rms_px": {"kolinear": difference.rms_px[0], adjusters.backend: difference.rms_px[1]},
        "cost": {"kolinear": difference.cost[0], adjusters.backend: difference.cost[1]},
        "point_sigma_rms": {
            "kolinear_marginal": or_none(point_sigma(C.points)[0]),
            "kolinear_conditional": or_none(point_sigma(C.points_limiting)[0]),
            f"{adjusters.backend}_conditional": None if other is None else or_none(point_sigma(other)[0]),
        },
        "exceeded": list(difference.exceeded),
        **values_of(adjusters, "held unshared freed"),
        "conversions": [
            {
                "camera": conversion.camera.name,
                "from": conversion.source_model,
                "to": conversion.camera.model,
                **values_of(conversion, "rms_px max_px"),
            }
            for conversion in adjusters.conversions
        ],
    }


def _baseline(result: SurveyResult) -> dict[str, Any] | None:
    """Return the comparison with the other pipeline; None without one."""
    baseline = result.baseline
    if baseline is None:
        return None

    def pair(values: tuple[float, float]) -> dict[str, float | None]:
        return {"kolinear": or_none(values[0]), baseline.name: or_none(values[1])}

    return {
        "pipeline": baseline.name,
        "images": {
            "kolinear": baseline.photographs[0],
            baseline.name: baseline.photographs[1],
            "total": baseline.total,
        },
        "rms_px": pair(baseline.rms_px),
        "seconds": pair(baseline.seconds),
        "targets": baseline.targets,
        **values_of(baseline, "target_rms_px point_rms max_point position_rms max_rotation_deg"),
    }


def summary_of_rigs(rigs: Sequence[Rig]) -> list[dict[str, Any]]:
    """Return the mounts of the cameras of rigs."""

    def stated(values: Any) -> dict[str, Any]:
        return {name: {"value": or_none(value), "sigma": or_none(sigma)} for name, value, sigma, _ in values}

    return [
        {
            **values_of(rig, "name reference moments"),
            "mounts": [
                {
                    "camera": mount.camera,
                    **({} if mount.epipolar is None else {"epipolar_rms_px": or_none(mount.epipolar.rms_px)}),
                    **stated(value for value in mount.values if value[3]),
                    "rotation_deg": stated(value for value in mount.values if not value[3]),
                }
                for mount in rig.mounts
            ],
        }
        for rig in rigs
    ]
