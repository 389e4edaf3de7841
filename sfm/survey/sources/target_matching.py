"""Uncoded targets of a survey, matched with the oriented photographs and checked as circles.

Photographs of another object are removed by their contradicting codes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.model.camera import tangents_from_pixel
from sfm.model.conventions import MAD_TO_SIGMA, BoolArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, rows_of, without_given
from sfm.model.reduced_network import merge_estimate, reduce_network, select_determined
from sfm.model.remarks.remark import Remark
from sfm.orientation.incremental.growth import residual_lengths
from sfm.orientation.incremental.sequence import Orientation
from sfm.orientation.intersection import RayLimits, intersect
from sfm.runtime.progress import reported
from sfm.survey.circles import check_circles
from sfm.survey.diagnosis.contradicting_codes import (
    ContestedCodes,
    find_contested_codes,
    plates_elsewhere,
    remarks_on_contested,
)
from sfm.survey.diagnosis.photograph_cameras import find_photograph_cameras
from sfm.survey.inputs.measurements import MeasuredPhotographs, Measurements, Naming
from sfm.survey.inputs.survey import Survey
from sfm.survey.orientation import Oriented
from sfm.survey.sources.source import Correspondences
from sfm.survey.target_network import build_network, match_uncoded, min_rays

ROUNDS = 3  # of matching: with the given orientation, with the adjusted one, and once more to confirm
MAX_STRAY = 100.0  # median residual, in tolerances, beyond which a photograph has lost its points
MIN_TOLERANCE_PX = 1.0  # the statistical test judges smaller differences, not the matching
TOLERANCE_FACTOR = 6.0  # of the robust spread of the residuals


def match_targets_of(
    oriented: Oriented, measured: Measurements, start: Orientation, *, jobs: int = 1
) -> Correspondences:
    """Return the network of all targets, the uncoded ones too.

    Args:
        oriented: the survey with the image points of all its sources.
        measured: the coded targets, and all others without a name.
        start: orientation of the photographs, with its final tolerance.
        jobs: not used, the targets are measured already.

    """
    survey, photographs, naming = oriented.survey, measured.photographs, measured.naming
    assert photographs is not None
    matched, left_out, contested = _without_other_objects(survey, photographs, naming, start)
    naming, network, estimate = matched.naming, matched.network, matched.estimate
    circles = check_circles(survey, photographs, naming, network, estimate)
    return Correspondences(
        circles.network,
        circles.estimate,
        min_rays(naming),
        naming,
        circles.eccentricity,
        circles.no_circles,
        (*circles.remarks, *contested),
        start.point_failures,
        start.kind == "given",
        left_out,
        matched.suspected,
    )


@dataclass(frozen=True)
class _Matched:
    """All targets with their names, their network, and its adjusted values."""

    naming: Naming
    network: Network
    estimate: Estimate
    suspected: tuple[str, ...]  # photographs that were matched with a per-photograph camera


def _without_other_objects(
    survey: Survey, photographs: MeasuredPhotographs, naming: Naming, start: Orientation
) -> tuple[_Matched, tuple[tuple[str, Remark], ...], tuple[Remark, ...]]:
    """Match, leave out the photographs whose codes contradict the others, and match the others again.

    Returns:
        The matches; photographs that are left out, with the reason; remarks on codes that are still at
        several positions.
    """
    matched = _match_and_adjust(survey, photographs, naming, start)
    contested = find_contested_codes(photographs, matched.naming, survey.family)
    moved = plates_elsewhere(contested, photographs, survey.family)
    reasons = tuple((photographs.names[i], reason) for i, reason in sorted(contested.left_out.items()))
    if contested.left_out or contested.main.keys() - matched.naming.code[list(contested.main.values())]:
        estimate = _without_contested(photographs, matched.naming, matched.estimate, contested)
        matched = _match_and_adjust(survey, photographs, matched.naming, replace(start, estimate=estimate))
        contested = find_contested_codes(photographs, matched.naming, survey.family)
        for plate, images in plates_elsewhere(contested, photographs, survey.family).items():
            moved[plate] = images | moved.get(plate, frozenset())
    return (
        matched,
        reasons,
        remarks_on_contested(contested, photographs, matched.naming, moved, survey.family),
    )


def _without_contested(
    photographs: MeasuredPhotographs, naming: Naming, estimate: Estimate, contested: ContestedCodes
) -> Estimate:
    """Return the estimate without left-out photographs, and with contested codes intersected again."""
    position, rotation, points = estimate.position.copy(), estimate.rotation.copy(), estimate.points.copy()
    out = list(contested.left_out)
    position[out], rotation[out] = np.nan, np.nan
    estimate = replace(estimate, position=position, rotation=rotation)
    kept = np.flatnonzero(estimate.oriented).tolist()
    for code in contested.places:
        of_code = [photographs.targets[i].xy[photographs.targets[i].code == code] for i in kept]
        image = np.repeat(kept, [len(xy) for xy in of_code])
        uv = [
            tangents_from_pixel(estimate.cameras[photographs.camera[i]], xy)
            for i, xy in zip(kept, of_code, strict=True)
        ]
        c_px = min(camera.c_px for camera in estimate.cameras)
        points[np.flatnonzero(naming.code == code)] = intersect(
            np.concatenate(uv),
            image,
            np.zeros(len(image), dtype=np.int64),
            position,
            rotation,
            n_points=1,
            limits=RayLimits(tolerance=MIN_TOLERANCE_PX / c_px),
        ).points[0]
    return replace(estimate, points=points)


def _match_and_adjust(
    survey: Survey, photographs: MeasuredPhotographs, naming: Naming, start: Orientation
) -> _Matched:
    """Name the uncoded targets and adjust in turn, with a tolerance that shrinks with the residuals.

    Args:
        survey: settings of the survey.
        photographs: all measured targets.
        naming: names of the coded targets.
        start: orientation from the coded targets, with its final tolerance.
    """
    estimate, tolerance_px = start.estimate, float(start.tolerance_px.max())
    for _ in reported("rounds of matching", range(ROUNDS), ROUNDS):
        naming, estimate = match_uncoded(photographs, naming, estimate, tolerance_px=tolerance_px)
        network = build_network(survey, photographs, naming)
        everything = np.ones(len(network.image_points), dtype=bool)
        try:
            images, points = select_determined(network, estimate, everything, min_rays(naming))
        except GeometryError:  # too few targets to orient photographs, which other sources may orient
            break
        part, values = reduce_network(without_given(network), estimate, images, points, everything)
        adjusted = adjust(part, values, datum=Datum("free"), reject="huber", covariance=False)
        estimate = restore_strayed(estimate, adjusted, images, points, tolerance_px=tolerance_px)
        spread = MAD_TO_SIGMA * float(np.nanmedian(np.abs(adjusted.residuals)))
        tolerance_px = float(np.clip(TOLERANCE_FACTOR * spread, MIN_TOLERANCE_PX, tolerance_px))
    return _match_by_photograph_cameras(
        survey, photographs, _Matched(naming, network, estimate, ()), tolerance_px
    )


def restore_strayed(
    before: Estimate, adjusted: Adjustment, images: BoolArray, points: BoolArray, *, tolerance_px: float
) -> Estimate:
    """Return the adjusted values; photographs that lost their points or took no part keep earlier ones.

    Robust weights reject a photograph that does not fit, such as a zoomed one. It then moves away until it no
    longer sees its points. The search for the reason starts from its earlier values. A photograph that shows
    too few points to take part is oriented by other image points, by its rig, or by given values. Points that
    were not adjusted may be seen in it.

    Args:
        before: values of all photographs and points before the adjustment.
        adjusted: adjustment of some of them.
        images: photographs in the adjustment, (m,).
        points: points in the adjustment, (n,).
        tolerance_px: limit of the residuals before the adjustment, px.
    """
    estimate = merge_estimate(adjusted.estimate, images, points)
    length = np.nan_to_num(np.linalg.norm(adjusted.residuals, axis=1), nan=np.inf)
    of_photograph = rows_of(adjusted.network.image_points.image, int(images.sum()))
    median = np.array([np.median(length[rows]) if len(rows) else 0.0 for rows in of_photograph])
    as_before = ~images
    as_before[np.flatnonzero(images)[median > MAX_STRAY * tolerance_px]] = True
    position, rotation, xyz = estimate.position.copy(), estimate.rotation.copy(), estimate.points.copy()
    position[as_before], rotation[as_before] = before.position[as_before], before.rotation[as_before]
    if before.oriented[~images].any():
        xyz[~points] = before.points[~points]
    return replace(estimate, position=position, rotation=rotation, points=xyz)


def _match_by_photograph_cameras(
    survey: Survey, photographs: MeasuredPhotographs, matched: _Matched, tolerance_px: float
) -> _Matched:
    """Match photographs that fit only with a per-photograph camera, using that camera; else return `matched`.

    With the shared camera their targets lie beyond the tolerance and would become other points. The
    adjustment decides later which camera they have.
    """
    estimate = matched.estimate
    accepted = residual_lengths(matched.network, estimate) <= tolerance_px
    per_photograph = find_photograph_cameras(
        matched.network, estimate, accepted, oriented=estimate.oriented, false_alarm=survey.adjust.false_alarm
    )
    if per_photograph is None or not per_photograph.photographs:
        return matched
    separate = replace(photographs, camera=per_photograph.network.camera)
    naming, values = match_uncoded(
        separate, matched.naming, per_photograph.estimate, tolerance_px=tolerance_px
    )
    network = build_network(survey, photographs, naming)
    return _Matched(naming, network, replace(values, cameras=estimate.cameras), per_photograph.photographs)
