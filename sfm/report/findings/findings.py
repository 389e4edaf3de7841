"""Everything that the reports of a survey state, computed once: Findings.

Whatever prints a result takes its numbers from here: statistics, checks, geometry, given values, precision,
protocol, verdict.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sfm.adjustment.quality.consistency import Consistency, consistency_of
from sfm.remarks.remark import Remark
from sfm.remarks.verdict import Verdict, judge
from sfm.report.findings.bundle_statistics import (
    Geometry,
    Given,
    Statistics,
    geometry_of,
    given_of,
    statistics_of,
)
from sfm.report.findings.calibrated_cameras import (
    CalibratedCamera,
    InteriorOrientation,
    calibrated_cameras,
    interior_of,
)
from sfm.report.findings.camera_remarks import camera_remarks, edges_of, sharpness_remarks
from sfm.report.findings.checks import (
    LongestResidual,
    ObservationCounts,
    Sigma0,
    count_observations,
    largest_residuals,
    longest_residual,
    sigma0_of,
)
from sfm.report.findings.precision import Precision, precision_of
from sfm.report.findings.protocol import Protocol, check_coordinates, protocol_of
from sfm.report.findings.rigs import Rig, rigs_of
from sfm.report.findings.survey_remarks import (
    adjustment_remarks,
    comparison_remarks,
    consistency_remarks,
    given_remarks,
    headlines_of,
    other_solution_remarks,
    photograph_remarks,
    ray_remarks,
    residual_remarks,
    sigma0_remarks,
)
from sfm.result import SurveyResult

UNCODED = -1


@dataclass(frozen=True)
class Findings:
    """A result and everything that is reported of it."""

    result: SurveyResult
    verdict: Verdict
    sigma0: Sigma0
    counts: ObservationCounts
    longest: LongestResidual  # in standard deviations, of the accepted image points
    largest: tuple[tuple[Any, ...], ...]  # photograph, point, vx and vy in px, w, tau of the accepted
    statistics: Statistics
    geometry: Geometry
    interior: InteriorOrientation
    calibrated: tuple[CalibratedCamera, ...]  # where the cameras are the result
    given: Given
    rigs: tuple[Rig, ...]
    precision: Precision
    object_size: float  # diagonal of the box around the points, object unit
    consistency: Consistency  # tests of points and photographs
    edges: Mapping[str, float]  # blur of each photograph with measured edges, px
    protocol: Protocol  # entries of a bundle protocol


def with_remark(findings: Findings, new: Remark) -> Findings:
    """Return findings with one remark more, and the verdict that follows."""
    result = findings.result
    verdict = judge((*findings.verdict.remarks, new), headlines_of(result))
    return replace(findings, result=replace(result, remarks=(*result.remarks, new)), verdict=verdict)


def findings_of(result: SurveyResult) -> Findings:
    """Return everything that the reports state of a result."""
    a = result.adjustment
    sigma0, longest, statistics = sigma0_of(result), longest_residual(a), statistics_of(result)
    given = given_of(a, result.length_unit)
    consistency, edges = consistency_of(a), edges_of(result.photographs)
    geometry, precision, interior = geometry_of(a), precision_of(a), interior_of(a)
    calibrated = calibrated_cameras(result, interior)
    remarks = (
        *adjustment_remarks(a),
        *photograph_remarks(result),
        *result.remarks,
        *other_solution_remarks(result),
        *sigma0_remarks(sigma0, statistics, a),
        *residual_remarks(result, longest),
        *ray_remarks(a),
        *consistency_remarks(consistency),
        *sharpness_remarks(result, edges, consistency),
        *camera_remarks(result, calibrated),
        *given_remarks(result, given, statistics, check_coordinates(result)),
        *comparison_remarks(result),
    )
    return Findings(
        result=result,
        verdict=judge(remarks, headlines_of(result)),
        sigma0=sigma0,
        counts=count_observations(a),
        longest=longest,
        largest=largest_residuals(a),
        statistics=statistics,
        geometry=geometry,
        interior=interior,
        calibrated=calibrated,
        given=given,
        rigs=rigs_of(a),
        precision=precision,
        object_size=float(np.linalg.norm(np.ptp(a.estimate.points, axis=0))),
        consistency=consistency,
        edges=edges,
        protocol=protocol_of(result, given),
    )
