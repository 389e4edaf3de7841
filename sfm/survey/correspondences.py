"""Which target is which object point: uncoded targets named by the orientation, and checked as circles."""

from __future__ import annotations

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.conventions import MAD_TO_SIGMA
from sfm.network import Estimate, Network
from sfm.orientation.incremental.sequence import Orientation
from sfm.reduced_network import reduce_network
from sfm.survey.adjusting.settling import determined, merge_estimate
from sfm.survey.adjusting.solution import TOLERANCE_FACTOR, Correspondences
from sfm.survey.circles import check_circles
from sfm.survey.inputs.measurements import MeasuredPhotographs, Measurements, Naming
from sfm.survey.inputs.survey import Survey
from sfm.survey.target_network import build_network, match_uncoded, min_rays

ROUNDS = 3  # matching with the orientation at hand, with the adjusted one, and once more to confirm
MIN_TOLERANCE_PX = 1.0  # below it a difference is for the statistical test, not for the matching


def find_correspondences(survey: Survey, measured: Measurements, start: Orientation) -> Correspondences:
    """Return the network with the uncoded targets in it; where all points have names, as it was measured.

    Args:
        survey: what to do.
        measured: the named image points, and all targets.
        start: orientation from the named ones, with the tolerance it has left.

    Raises:
        GeometryError: fewer than two photographs keep enough points.
    """
    photographs, naming = measured.photographs, measured.naming
    if photographs is None or naming is None:
        return Correspondences(
            measured.network,
            start.estimate,
            measured.min_rays,
            point_failures=start.point_failures,
            given=start.kind == "given",
        )
    naming, network, estimate = _match_and_adjust(survey, photographs, naming, start)
    circles = check_circles(survey, photographs, naming, network, estimate)
    return Correspondences(
        circles.network,
        circles.estimate,
        min_rays(naming),
        naming,
        circles.eccentricity,
        circles.no_circles,
        circles.warnings,
        start.point_failures,
        start.kind == "given",
    )


def _match_and_adjust(
    survey: Survey, photographs: MeasuredPhotographs, naming: Naming, start: Orientation
) -> tuple[Naming, Network, Estimate]:
    """Name the uncoded targets and adjust in turn, with a tolerance that shrinks with the residuals.

    Args:
        survey: what to do.
        photographs: all measured targets.
        naming: the coded targets by name.
        start: orientation from the coded targets, with the tolerance it has left.

    Returns:
        The naming, its network, and the adjusted estimate.
    """
    estimate, tolerance_px = start.estimate, float(start.tolerance_px.max())
    for _ in range(ROUNDS):
        naming, estimate = match_uncoded(photographs, naming, estimate, tolerance_px=tolerance_px)
        network = build_network(survey, photographs, naming)
        everything = np.ones(len(network.image_points), dtype=bool)
        images, points = determined(network, estimate, everything, min_rays(naming))
        part, values = reduce_network(network, estimate, images, points, everything)
        adjusted = adjust(part, values, datum=Datum("free"), reject="huber", covariance=False)
        estimate = merge_estimate(estimate, adjusted.estimate, images, points)
        spread = MAD_TO_SIGMA * float(np.median(np.abs(adjusted.residuals)))
        tolerance_px = float(np.clip(TOLERANCE_FACTOR * spread, MIN_TOLERANCE_PX, tolerance_px))
    return naming, network, estimate
