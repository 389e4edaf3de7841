"""Photographs that are not oriented or fit badly: which are not connected, and whether c is the reason."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from sfm.adjustment.hypotheses.alternatives import ALPHA
from sfm.conventions import BoolArray, IntArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.orientation.incremental.sequence import MIN_POINTS, Orientation
from sfm.remarks.remark import Remark, remark
from sfm.survey.diagnosis.photograph_cameras import MAJORITY_FRACTION

C_FACTORS = (1.4, 0.7, 2.0, 0.5)  # on the given principal distance: a crop factor, an extender, a zoom
MISFIT = 3.0  # standard deviations of image points, of residuals that another minimum may explain


@dataclass(frozen=True)
class Lost:
    """Photographs without orientation that belong together."""

    images: IntArray  # indices of the photographs
    shared: IntArray  # points of theirs that oriented photographs determine
    connected: bool  # whether one of them shows enough of these to be oriented


def explain_lost_photographs(network: Network, found: Orientation, *, named: bool = True) -> Orientation:
    """Return the orientation with what is missing between the groups of photographs that are not connected.

    A photograph with fewer points than any orientation needs is no group: its reason states it.

    Args:
        network: image points that have names.
        found: its orientation.
        named: whether a person knows the points by these names.
    """
    groups = [
        one
        for one in lost_groups(network, found.estimate)
        if not one.connected and len(_points_of(network, one.images)) >= MIN_POINTS
    ]
    if not groups:
        return found
    oriented = found.estimate.oriented
    reasons = dict(found.failures)
    for group in groups:
        for i in group.images:
            count = int(np.isin(_points_of(network, [i]), group.shared).sum())
            reasons[network.images[i]] = remark("photograph_not_connected", shared=count, needed=MIN_POINTS)
    groups.sort(key=lambda one: -len(one.images))
    remarks = (_not_connected(network, oriented, group, named=named) for group in groups)
    failures = tuple((image, reasons[image]) for image, _ in found.failures)
    return replace(found, failures=failures, remarks=(*found.remarks, *remarks))


def lost_groups(network: Network, estimate: Estimate) -> list[Lost]:
    """Return the photographs without orientation in groups that could be oriented among themselves."""
    oriented, seen = estimate.oriented, network.image_points
    lost = np.flatnonzero(~oriented)
    rays = np.bincount(seen.point[oriented[seen.image]], minlength=len(network.points))
    in_network = (rays >= 2) | ((rays == 1) & estimate.determined)  # one ray and no coordinates: no place
    label = np.arange(len(network.images))  # the group of each photograph
    for first, second, common in network.common_points(~oriented[seen.image]):
        linked = label[first[common >= MIN_POINTS]], label[second[common >= MIN_POINTS]]
        links = csr_matrix((np.ones(len(linked[0])), linked), shape=(len(label), len(label)))
        label = connected_components(links, directed=False)[1][label]
    groups = []
    for number in np.unique(label[lost]):
        images = lost[label[lost] == number]
        points = _points_of(network, images)
        most = max(int(in_network[_points_of(network, [i])].sum()) for i in images)
        groups.append(Lost(images, points[in_network[points]], most >= MIN_POINTS))
    return groups


def try_other_principal_distances(
    network: Network, estimate: Estimate, found: Orientation | None, orient: Callable[[Estimate], Orientation]
) -> tuple[Orientation | None, tuple[Remark, ...]]:
    """Return the orientation with another principal distance if that orients more photographs, and remarks.

    Tried where photographs are lost that show enough points of the others and are no mirrored pictures, which
    no principal distance turns over. It must orient most of them, and be likelier for all image points: more
    photographs at residuals many times as large are no better.

    Tried with the cameras held, too, where c is adjusted and all is oriented with residuals far larger than
    the image points have: a network that learns its camera while it grows may have run along the valley of c
    and distance into a false minimum.

    Args:
        network: image points that have names.
        estimate: start values.
        found: the orientation with the given principal distance; None if there was none.
        orient: returns the orientation from start values.

    Returns:
        The better orientation where the survey adjusts c; else that which was given. No remarks where no
        other principal distance orients more.
    """
    m = len(network.images)
    lost = m if found is None else _unexplained(network, found)
    if not len(network.image_points):
        return found, ()
    free = all(camera.free[0] for camera in estimate.cameras)
    if lost < 2:  # one alone has another cause
        misfit = found is not None and free and found.rms_px > MISFIT * network.image_points.median_sigma_px
        held = [_with_c(estimate, factor, free=False) for factor in (1.0, *C_FACTORS)] if misfit else []
        best = _likeliest(network, estimate, found, held, orient, least=_oriented(found))
        return (found if best is None else _restored(best, estimate)), ()
    others = [_with_c(estimate, factor, free=True) for factor in C_FACTORS]
    least = _oriented(found) + int(MAJORITY_FRACTION * lost) + 1
    best = _likeliest(network, estimate, found, others, orient, least=least)
    if best is None:
        return found, ()
    remarks = tuple(
        remark(
            "c_looks_wrong",
            camera=given.name,
            given=(given.c_px * float(np.mean(given.pixel_mm)), "mm"),
            better=(better.c_px * float(np.mean(given.pixel_mm)), "mm"),
            oriented=_oriented(best),
            total=m,
            before=_oriented(found),
        )
        for given, better in zip(estimate.cameras, best.estimate.cameras, strict=True)
    )
    return (_restored(best, estimate) if free else found), remarks


def _likeliest(
    network: Network,
    estimate: Estimate,
    found: Orientation | None,
    starts: list[Estimate],
    orient: Callable[[Estimate], Orientation],
    *,
    least: int,
) -> Orientation | None:
    """Return the likeliest orientation from other start values, None if that found is likelier.

    Args:
        network: image points that have names.
        estimate: start values of that found.
        found: an orientation; None if there was none.
        starts: the other start values.
        orient: returns the orientation from start values.
        least: photographs that it must orient; once all are with residuals as they should be, no more is
            tried.
    """
    search = math.log(2 * len(network.image_points)) / 2 + math.log(len(C_FACTORS) / ALPHA)
    likeliest = _log_likelihood(network, estimate, found) + search
    best = None
    for start in starts:
        try:
            other = orient(start)
        except GeometryError:
            continue
        likelihood = _log_likelihood(network, estimate, other)
        if _oriented(other) >= least and likelihood > likeliest:
            best, likeliest = other, likelihood
            if (
                _oriented(best) == len(network.images)
                and best.rms_px <= MISFIT * network.image_points.median_sigma_px
            ):
                break
    return best


def _oriented(found: Orientation | None) -> int:
    """Return how many photographs are oriented."""
    return 0 if found is None else int(found.estimate.oriented.sum())


def _restored(found: Orientation, estimate: Estimate) -> Orientation:
    """Return an orientation with the parameters free that the start values have free."""
    cameras = tuple(
        replace(new, free=old.free) for new, old in zip(found.estimate.cameras, estimate.cameras, strict=True)
    )
    return replace(found, estimate=replace(found.estimate, cameras=cameras))


def _unexplained(network: Network, found: Orientation) -> int:
    """Return how many photographs are lost though they show enough points, and are no mirrored pictures."""
    mirrored = [image for image, reason in found.failures if reason.kind == "photograph_mirrored"]
    lost = [i for one in lost_groups(network, found.estimate) if one.connected for i in one.images.tolist()]
    return sum(network.images[i] not in mirrored for i in lost)


def _log_likelihood(network: Network, estimate: Estimate, found: Orientation | None) -> float:
    """Return ln of the likelihood of all image points, what does not fit spread evenly over the format."""
    camera = estimate.cameras[0]
    count, fitting = len(network.image_points), 0 if found is None else int(found.fits.sum())
    outlier = -math.log(float(np.prod(camera.size_px)))
    if found is None:
        return count * outlier
    sigma = max(found.rms_px, float(np.spacing(float(max(camera.size_px)))))  # no smaller than rounding
    return fitting * (-math.log(2 * math.pi * sigma**2) - 1) + (count - fitting) * outlier


def _with_c(estimate: Estimate, factor: float, *, free: bool) -> Estimate:
    """Return start values with another principal distance, which is free, or with all of the cameras held."""
    cameras = []
    for camera in estimate.cameras:
        p, focal = camera.parameters.copy(), camera.parts[0]
        p[focal] *= factor
        adjusted = camera.free | focal if free else np.zeros_like(camera.free)
        cameras.append(replace(camera.with_parameters(p), free=adjusted))
    return replace(estimate, cameras=tuple(cameras))


def _not_connected(network: Network, oriented: BoolArray, group: Lost, *, named: bool) -> Remark:
    """Return the remark on photographs that are not connected, with points to connect them."""
    theirs = _often_seen(network, group.images) if named else []
    return remark(
        "not_connected",
        photographs=[network.images[i] for i in group.images],
        oriented=int(oriented.sum()),
        shared=[network.points[j] for j in group.shared if named] or None,
        needed=MIN_POINTS,
        points=theirs if len(theirs) >= MIN_POINTS else None,
        others=(_often_seen(network, np.flatnonzero(oriented)) or None) if named else None,
    )


def _often_seen(network: Network, images: IntArray) -> list[str]:
    """Return the names of the points that photographs show most often."""
    seen = network.image_points
    rays = np.bincount(seen.point[np.isin(seen.image, images)], minlength=len(network.points))
    order = np.argsort(-rays, kind="stable")[: MIN_POINTS + 2]
    return [network.points[j] for j in order if rays[j]]


def _points_of(network: Network, images: IntArray | list[int]) -> IntArray:
    """Return the points that photographs show."""
    seen = network.image_points
    return np.unique(seen.point[np.isin(seen.image, images)])
