"""The comparison with the other adjuster: why they do not agree, and the precision of the points by both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.comparison.camera_conversion import Conversion
from sfm.comparison.two_adjusters.adjusters import AdjusterComparison
from sfm.conventions import FloatArray
from sfm.display import program_name
from sfm.report.findings.precision import root_mean_square
from sfm.result import SurveyResult


@dataclass(frozen=True)
class PointSigma:
    """Standard deviation of a coordinate of the object points."""

    rms: float  # object unit
    largest: float  # object unit


@dataclass(frozen=True)
class ComparisonFindings:
    """What the comparison with the other adjuster says."""

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
