"""The orientation of a model from its key points measured anew, and all that is intersected from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import MAD_TO_SIGMA, BoolArray, IntArray
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.matching.lsm.coverage import points_apart
from sfm.matching.match_flags import LsmFlag, in_words
from sfm.network import Estimate, ImagePoints, Network, ObjectPoints, ScaleBars
from sfm.orientation.image_rays import intersect_image_points
from sfm.reduced_network import determined, merge_estimate, reduce_network
from sfm.survey.correspondences import TOLERANCE_FACTOR
from sfm.survey.refining.targets import ModelTargets, join_targets
from sfm.survey.refining.windows import MIN_RAYS, Windows

SIGMA_PX = 0.02  # of a matched point, on top of what matching knows: surfaces are not plane over a window


@dataclass(frozen=True)
class OrientedKeyPoints:
    """Key points measured anew, and the orientation given by those whose windows do not overlap."""

    windows: Windows
    window_px: int
    network: Network  # of these image points and the targets
    rows: IntArray  # image point of the model of each of them, targets behind
    rays: IntArray  # that each point needs
    solved: Estimate  # of these points, NaN where they do not determine it
    whole: Estimate  # the model in this orientation; see `whole_model`
    accepted: BoolArray  # image points of the network that fit
    spread_px: float  # of the residuals of the key points among these
    lost: list[tuple[str, int]]  # why key points were not measured, and how many


def orient(
    network: Network,
    estimate: Estimate,
    windows: Windows,
    window_px: int,
    targets: ModelTargets | None,
    lost: list[tuple[str, int]],
) -> OrientedKeyPoints:
    """Adjust what was measured with windows that do not overlap, and find what does not fit.

    Raises:
        GeometryError: too few.
    """
    seen, came = network.image_points, estimate
    good = np.asarray(np.isfinite(windows.xy).all(axis=1))
    apart = points_apart(replace(seen, xy=windows.xy), good, window_px, n_points=len(network.points))
    rows = np.flatnonzero(good & apart[seen.point])
    anew = replace(
        network,
        image_points=ImagePoints(
            seen.image[rows],
            seen.point[rows],
            windows.xy[rows],
            windows.covariance[rows] + SIGMA_PX**2 * np.eye(2),
        ),
    )
    rays = np.full(len(network.points), MIN_RAYS)
    if targets is not None:
        anew, estimate = join_targets(anew, estimate, targets)
        rays = np.concatenate([rays, targets.min_rays])
    try:
        part, start, images, points = part_of(
            anew, estimate, np.ones(len(anew.image_points), dtype=bool), rays
        )
    except GeometryError as error:
        why = describe_reasons(by_count(lost))
        raise GeometryError(
            f"refine: {int(good.sum())} of {len(seen)} key points could be measured anew"
            + (f" (not: {why})" if why else "")
            + f", {len(rows)} of them with windows that do not overlap: too few to adjust; are these the "
            "photographs of the model?"
        ) from error
    alone = replace(part, control=ObjectPoints(), scale_bars=ScaleBars())
    adjusted = adjust(alone, start, datum=Datum("free"), reject="huber", covariance=False)
    refuse_undetermined(alone, adjusted, lost)
    v = np.abs(adjusted.residuals)
    fits = np.ones(len(v), dtype=bool)
    matched = part.image_points.point < int(points[: len(network.points)].sum())
    for kind in (~matched, matched):  # targets are measured in another way, with other residuals
        if kind.any():
            spread = MAD_TO_SIGMA * float(np.median(v[kind]))
            fits[kind] = (v[kind] <= TOLERANCE_FACTOR * spread).all(axis=1)
    accepted = images[anew.image_points.image] & points[anew.image_points.point]
    accepted[accepted] = fits
    solved = merge_estimate(adjusted.estimate, images, points)
    of_model = points[: len(network.points)]
    whole, _ = whole_model(
        network, came, adjusted.estimate, windows, images, of_model, TOLERANCE_FACTOR * spread
    )
    return OrientedKeyPoints(windows, window_px, anew, rows, rays, solved, whole, accepted, spread, lost)


def refuse_undetermined(part: Network, adjusted: Adjustment, lost: list[tuple[str, int]]) -> None:
    """Refuse an adjustment that nothing checks: every measurement fits it.

    Raises:
        GeometryError: no redundancy.
    """
    if adjusted.redundancy <= 0:
        why = describe_reasons(by_count(lost))
        raise GeometryError(
            f"refine: {counted(2 * len(part.image_points), 'coordinate')} of {len(part.points)} points "
            "measured anew in "
            f"{counted(len(part.images), 'photograph')} are not more than is to be estimated from them; "
            "hold parameters "
            "of the cameras" + (f" (not measured anew: {why})" if why else "")
        )


def reasons_of(windows: Windows, rows: IntArray, *, few: int, masked: int) -> list[tuple[str, int]]:
    """Return why key points were not measured, and how many.

    Args:
        windows: what was measured.
        rows: image points that were to be measured.
        few: image points of points that too few photographs see.
        masked: where the mask is black.
    """
    lost = [(in_words(LsmFlag, flag), int(((windows.flag & flag) != 0).sum())) for flag in LsmFlag if flag]
    templates = int(((windows.flag[rows] == 0) & ~np.isfinite(windows.xy[rows]).all(axis=1)).sum())
    lost.append(("template of a point without a match", templates))
    lost.append((f"of a point that fewer than {MIN_RAYS} photographs see", few))
    lost.append(("where the mask is black", masked))
    return lost


def by_count(reasons: list[tuple[str, int]]) -> tuple[tuple[str, int], ...]:
    """Return why key points took no part, most frequent first, without what there was none of."""
    return tuple((why, count) for why, count in sorted(reasons, key=lambda one: -one[1]) if count)


def describe_reasons(reasons: tuple[tuple[str, int], ...]) -> str:
    """Return the reasons as a list within a sentence."""
    return ", ".join(f"{count} {why}" for why, count in reasons)


def whole_model(
    network: Network,
    estimate: Estimate,
    part: Estimate,
    windows: Windows,
    images: BoolArray,
    points: BoolArray,
    tolerance_px: float,
) -> tuple[Estimate, IntArray]:
    """Return the whole model with an adjusted part in it, its other points intersected with what is new.

    Where three photographs or more measured such a point anew these rays meet in it, else all rays as they
    came.

    Args:
        network: the model.
        estimate: as it came.
        part: adjusted, targets behind the points of the model.
        windows: image points measured anew.
        images: photographs of the part, (m,).
        points: points of the part, (n,).
        tolerance_px: largest residual of a ray measured anew.

    Returns:
        The estimate, and the image points measured anew that meet in points which were not adjusted.
    """
    position, rotation, xyz = estimate.position.copy(), estimate.rotation.copy(), estimate.points.copy()
    position[images], rotation[images] = part.position, part.rotation
    xyz[points] = part.points[: int(points.sum())]
    oriented = Estimate(part.cameras, position, rotation, xyz, part.mounts)
    seen = network.image_points
    other = ~points[seen.point] & images[seen.image]
    rows = np.flatnonzero(other & np.isfinite(windows.xy).all(axis=1))
    anew = ImagePoints(seen.image[rows], seen.point[rows], windows.xy[rows], windows.covariance[rows])
    n = len(network.points)
    met = intersect_image_points(anew, network.camera, oriented, n_points=n, tolerance_px=tolerance_px)
    enough = met.rays >= MIN_RAYS
    xyz[enough] = met.points[enough]
    as_it_came = seen.select(other & ~enough[seen.point])
    found = intersect_image_points(
        as_it_came, network.camera, oriented, n_points=n, tolerance_px=np.inf
    ).points
    again = np.isfinite(found).all(axis=1)
    xyz[again] = found[again]
    return replace(oriented, points=xyz), rows[met.used & enough[anew.point]]


def part_of(
    network: Network, estimate: Estimate, accepted: BoolArray, rays: IntArray
) -> tuple[Network, Estimate, BoolArray, BoolArray]:
    """Return what accepted image points determine, and which photographs and points that are.

    Args:
        network: the whole.
        estimate: its solution.
        accepted: image points, (k,).
        rays: that each point needs, (n,).
    """
    images, points = determined(network, estimate, accepted, rays)
    part, start = reduce_network(network, estimate, images, points, accepted)
    return part, start, images, points
