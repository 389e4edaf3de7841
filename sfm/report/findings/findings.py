"""Everything that the reports of a survey say, computed once: Findings.

Statistics, checks, geometry, given values, precision, rejected observations, the comparison, the verdict.
Whatever prints a result takes its numbers from here.

The solution row by row: every object point and every photograph with precision, rays and residuals.

Rejections and their reasons: image points by the tests, candidates of the photographs by their looks.

The comparison with the other adjuster: why they do not agree, and the precision of the points by both.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.quality.consistency import Consistency, consistency_of
from sfm.adjustment.result import Adjustment
from sfm.comparison.camera_conversion import Conversion
from sfm.comparison.two_adjusters.adjusters import AdjusterComparison
from sfm.conventions import FloatArray, angles_from_rotation
from sfm.display import program_name
from sfm.remarks.remark import Remark
from sfm.remarks.verdict import Verdict, judge
from sfm.report.findings.bundle_statistics import Statistics, statistics_of
from sfm.report.findings.calibrated_cameras import CalibratedCamera, calibrated_cameras
from sfm.report.findings.camera_remarks import camera_remarks
from sfm.report.findings.checks import (
    CheckedControl,
    LargeResidual,
    LongestResidual,
    ObservationCounts,
    Sigma0,
    checked_control,
    count_observations,
    largest_residuals,
    longest_residual,
    object_size,
    sigma0_of,
)
from sfm.report.findings.geometry import Geometry, geometry_of
from sfm.report.findings.given_remarks import given_remarks
from sfm.report.findings.given_residuals import Given, given_of
from sfm.report.findings.interior_parameters import InteriorOrientation, interior_of
from sfm.report.findings.precision import Precision, precision_of, root_mean_square
from sfm.report.findings.protocol import Protocol, check_coordinates, protocol_of
from sfm.report.findings.rigs import Rig, rigs_of
from sfm.report.findings.sharpness import edges_of, sharpness_remarks
from sfm.report.findings.survey_remarks import (
    adjustment_remarks,
    comparison_remarks,
    consistency_remarks,
    headlines_of,
    other_solution_remarks,
    photograph_remarks,
    ray_remarks,
    residual_remarks,
    sigma0_remarks,
)
from sfm.result import SurveyResult, likest_first

UNCODED = -1


@dataclass(frozen=True)
class Findings:
    """A result and everything that is said about it."""

    result: SurveyResult
    verdict: Verdict
    sigma0: Sigma0
    counts: ObservationCounts
    longest: LongestResidual  # in standard deviations, of the accepted image points
    largest: tuple[LargeResidual, ...]  # standardised, of the accepted image points
    statistics: Statistics
    geometry: Geometry
    interior: InteriorOrientation
    calibrated: tuple[CalibratedCamera, ...]  # where the cameras are the result
    given: Given
    rigs: tuple[Rig, ...]
    check: CheckedControl | None  # control that took no part
    precision: Precision
    points: tuple[PointRow, ...]  # in the order of the network
    photographs: tuple[PhotographRow, ...]  # likewise
    rejected: Rejected
    comparison: ComparisonFindings | None
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
    """Return everything that the reports say of a result."""
    a = result.adjustment
    sigma0, longest, statistics = sigma0_of(result), longest_residual(a), statistics_of(result)
    given, check, size = (
        given_of(a, result.length_unit),
        checked_control(result),
        object_size(a.estimate.points),
    )
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
        check=check,
        precision=precision,
        points=points_of(result, precision, geometry),
        photographs=photographs_of(a, precision, geometry),
        rejected=rejected_of(result, geometry),
        comparison=comparison_of(result),
        object_size=size,
        consistency=consistency,
        edges=edges,
        protocol=protocol_of(result, given, check),
    )


@dataclass(frozen=True)
class PointRow:
    """An object point."""

    name: str
    xyz: FloatArray  # object unit, (3,)
    sigma: FloatArray  # standard deviations of the same, 0 where fixed, (3,)
    rays: int  # accepted image points
    code: int | None  # code number, None if uncoded
    angle_deg: float  # largest angle between two rays; NaN with fewer than two
    rms_px: float  # root mean square residual per coordinate
    limiting: FloatArray  # standard deviations with the cameras free of error, object unit, (3,)

    @property
    def sigma_length(self) -> float:
        """Length of the vector of its standard deviations, object unit; 0 where not known."""
        return float(np.linalg.norm(np.nan_to_num(self.sigma)))


@dataclass(frozen=True)
class PhotographRow:
    """A photograph."""

    name: str
    values: FloatArray  # X0, Y0, Z0, object unit, and omega, phi, kappa, deg, (6,)
    sigma: FloatArray  # standard deviations of the same, (6,)
    camera: str
    points: int  # accepted image points
    rms_px: float  # root mean square residual per coordinate
    coverage: float  # share of the photograph within the convex hull of its image points


def points_of(result: SurveyResult, precision: Precision, geometry: Geometry) -> tuple[PointRow, ...]:
    """Return every object point."""
    network = result.adjustment.network
    return tuple(
        PointRow(
            name,
            result.adjustment.estimate.points[j],
            precision.points[j],
            int(geometry.rays[j]),
            None if result.code[j] == UNCODED else int(result.code[j]),
            float(geometry.angle_deg[j]),
            float(geometry.point_rms_px[j]),
            precision.limiting_points[j],
        )
        for j, name in enumerate(network.points)
    )


def photographs_of(
    adjustment: Adjustment, precision: Precision, geometry: Geometry
) -> tuple[PhotographRow, ...]:
    """Return every photograph."""
    network, estimate = adjustment.network, adjustment.estimate
    values = np.hstack([estimate.position, np.degrees(angles_from_rotation(estimate.rotation))])
    sigma = np.hstack([precision.exterior[:, :3], np.degrees(precision.exterior[:, 3:])])
    return tuple(
        PhotographRow(
            name,
            values[i],
            sigma[i],
            estimate.cameras[network.camera[i]].name,
            int(geometry.image_points[i]),
            float(geometry.image_rms_px[i]),
            float(geometry.hull[i]),
        )
        for i, name in enumerate(network.images)
    )


@dataclass(frozen=True)
class RejectedPoint:
    """An image point that took no part in the adjustment."""

    image: str
    point: str
    xy: FloatArray  # px, (2,)
    v: FloatArray  # residual, px, (2,)

    @property
    def length(self) -> float:
        """Length of the residual, px."""
        return float(np.linalg.norm(self.v))


@dataclass(frozen=True)
class Candidates:
    """Counts of candidates in a photograph, or in all of them."""

    image: str
    measured: int  # targets
    accepted: int  # image points in the result
    reasons: Counter[str]  # candidates that were not measured, by reason


@dataclass(frozen=True)
class Rejected:
    """Rejected image points and candidates."""

    points: tuple[RejectedPoint, ...]  # longest residual first
    share: float  # of all image points
    candidates: tuple[Candidates, ...]  # of each readable photograph
    total: Candidates  # of all

    @property
    def reasons(self) -> tuple[str, ...]:
        """All reasons, those of candidates that are most like targets first."""
        return tuple(likest_first(self.total.reasons))


def rejected_of(result: SurveyResult, geometry: Geometry) -> Rejected:
    """Return what was rejected in a survey."""
    a = result.adjustment
    rows, seen = np.flatnonzero(a.rejected), a.network.image_points
    length = np.linalg.norm(a.residuals[rows], axis=1)
    points = tuple(
        RejectedPoint(
            a.network.images[seen.image[k]], a.network.points[seen.point[k]], seen.xy[k], a.residuals[k]
        )
        for k in rows[np.argsort(-np.nan_to_num(length, nan=np.inf))]
    )
    used = dict(zip(a.network.images, geometry.image_points.tolist(), strict=True))
    candidates = tuple(
        Candidates(one.image, len(one.xy), used.get(one.image, 0), Counter(dict(one.reasons())))
        for one in result.photographs
    )
    total = Candidates(
        "all",
        sum(one.measured for one in candidates),
        sum(used.values()),
        sum((one.reasons for one in candidates), Counter()),
    )
    return Rejected(points, len(rows) / max(len(a.rejected), 1), candidates, total)


@dataclass(frozen=True)
class PointSigma:
    """Standard deviation of a coordinate of the object points."""

    rms: float  # object unit
    largest: float  # object unit


@dataclass(frozen=True)
class ComparisonFindings:
    """Findings of the comparison with the other adjuster."""

    both: AdjusterComparison
    reasons: tuple[str, ...]  # why they do not agree, in words; empty if they do
    survey_models: tuple[str, ...]  # camera models of the survey
    converted: tuple[Conversion, ...]  # cameras that were written in another model
    max_interior_px: float  # largest difference of interior orientation in the photograph, px
    marginal: PointSigma  # in-house, everything adjusted is uncertain
    conditional: PointSigma  # in-house, photographs and cameras held
    backend_conditional: PointSigma | None  # the other's; None where it gives none


def comparison_of(result: SurveyResult) -> ComparisonFindings | None:
    """Return what the comparison of a survey says; None where it asked for none."""
    both = result.comparison
    if both is None:
        return None
    reasons: list[str] = []
    if both.outcome == "differs":
        reasons += both.comparison.exceeded
        if both.comparison.exceeded and both.adjustment.converged:
            reasons.append(_other_minimum(both))
        reasons += [] if both.adjustment.converged else ["Kolinear did not converge in this model"]
        reasons += [] if both.backend_converged else [f"{program_name(both.backend)} did not converge"]
    covariance, other = both.adjustment.covariance, both.backend_points
    return ComparisonFindings(
        both,
        tuple(reasons),
        tuple(sorted({camera.model for camera in result.adjustment.estimate.cameras})),
        tuple(one for one in both.conversions if one.source_model != one.camera.model),
        float(np.nanmax(both.comparison.interior_px, initial=0.0)),
        _point_sigma(covariance.points),
        _point_sigma(covariance.points_limiting),
        None if other is None else _point_sigma(other),
    )


def _other_minimum(both: AdjusterComparison) -> str:
    """Return in words which of two minima is the lower one."""
    ours, theirs = both.comparison.cost
    lower = program_name("kolinear" if ours < theirs else both.backend)
    ratio = max(ours, theirs) / min(ours, theirs) if min(ours, theirs) > 0 else np.inf
    return (
        f"going on from {program_name(both.backend)}'s solution does not lead to Kolinear's: these are two "
        f"minima, and that of {lower} is the lower one, by a factor of {ratio:.6g} in the sum of squares"
    )


def _point_sigma(covariance: FloatArray) -> PointSigma:
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    known = sigma[np.isfinite(sigma)]
    return PointSigma(root_mean_square(sigma), float(known.max()) if len(known) else float("nan"))
