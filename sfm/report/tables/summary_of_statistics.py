"""The parts of summary.json on the statistics of a result, and on contradictions of its observations."""

from __future__ import annotations

from typing import Any

from sfm.adjustment.quality.statistics import CoordinateTest
from sfm.adjustment.quality.variance_components import VarianceComponents
from sfm.files.plain_text import or_none
from sfm.report.findings.bundle_statistics import Spread
from sfm.report.findings.findings import Findings
from sfm.report.page import values_of
from sfm.report.phrases import words_of_test, words_of_weights


def summary_of_statistics(findings: Findings) -> dict[str, Any]:
    """Return the tests, reliability, components, correlations and significance of a result."""
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
            **values_of(counts, "control exterior interior scale_bars further constraints total"),
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
        "correlations": [values_of(pair, "first second value") for pair in found.correlations],
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
            values_of(test, "camera parameter t probability significant") for test in found.significance
        ],
        "not_significant": [values_of(test, "camera parameter t") for test in found.not_significant],
    }


def summary_of_consistency(findings: Findings) -> dict[str, Any]:
    """Return what the tests of points, photographs and the format have found."""
    found = findings.consistency
    return {
        "large_residuals": list(found.large),
        "doubtful": [values_of(one, "point rejected instead misfit other") for one in found.doubtful],
        "uneven_photographs": found.uneven and values_of(found.uneven, "probability worst largest median"),
        "other_solutions": [
            {
                **values_of(one, "camera c unit reflected"),
                "moved_over_sigma": or_none(one.moved),
                "vPv_ratio": or_none(one.vPv),
            }
            for one in findings.result.other_solutions
        ],
        "given_against_free_network": [
            {
                "what": one.what,
                "chi2": or_none(one.statistic),
                "degrees_of_freedom": one.dof,
                "probability": or_none(one.probability),
            }
            for one in findings.result.given_tests
        ],
    }


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
