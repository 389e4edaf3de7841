"""Findings of a result: every number of the reports, computed once.

Every renderer takes its numbers from `Findings`: statistics, checks, geometry, given values, precision and
protocol. The verdict is that of the result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sfm.adjustment.quality.consistency import Consistency, consistency_of
from sfm.judgement.bundle_statistics import Given, Statistics, given_of, statistics_of
from sfm.judgement.calibrated_cameras import (
    CalibratedCamera,
    InteriorOrientation,
    calibrated_cameras,
    interior_of,
)
from sfm.judgement.cameras import edges_of
from sfm.judgement.checks import Sigma0, sigma0_of
from sfm.judgement.survey_result import SurveyResult
from sfm.judgement.verdict import with_remark as judge_with_remark
from sfm.model.remarks.remark import Remark
from sfm.model.remarks.verdict import Verdict
from sfm.report.network_geometry import Geometry, geometry_of
from sfm.report.precision import (
    ObservationCounts,
    Precision,
    count_observations,
    largest_residuals,
    precision_of,
)
from sfm.report.protocol import Protocol, protocol_of
from sfm.report.rig_mounts import Rig, rigs_of


@dataclass(frozen=True)
class Findings:
    """A result and everything that is reported about it."""

    result: SurveyResult
    sigma0: Sigma0
    counts: ObservationCounts
    largest: tuple[tuple[Any, ...], ...]  # photograph, point, vx and vy in px, w, tau of the accepted
    statistics: Statistics
    geometry: Geometry
    interior: InteriorOrientation
    calibrated: tuple[CalibratedCamera, ...]  # if the cameras are the result
    given: Given
    rigs: tuple[Rig, ...]
    precision: Precision
    object_size: float  # diagonal of the box around the points, object unit
    consistency: Consistency  # tests of points and photographs
    edges: Mapping[str, float]  # blur of each photograph with measured edges, px
    protocol: Protocol  # entries of a bundle protocol

    @property
    def verdict(self) -> Verdict:
        """The verdict of the result."""
        return self.result.verdict


def with_remark(findings: Findings, new: Remark) -> Findings:
    """Return findings with one more remark, and the resulting verdict."""
    return replace(findings, result=judge_with_remark(findings.result, new))


def findings_of(result: SurveyResult) -> Findings:
    """Return everything that the reports state about a result."""
    a = result.adjustment
    given, interior = given_of(a, result.length_unit), interior_of(a)
    return Findings(
        result=result,
        sigma0=sigma0_of(a),
        counts=count_observations(a),
        largest=largest_residuals(a),
        statistics=statistics_of(a),
        geometry=geometry_of(a),
        interior=interior,
        calibrated=calibrated_cameras(result, interior),
        given=given,
        rigs=rigs_of(a),
        precision=precision_of(a),
        object_size=float(np.linalg.norm(np.ptp(a.estimate.points, axis=0))),
        consistency=consistency_of(a),
        edges=edges_of(result.photographs),
        protocol=protocol_of(result, given),
    )
