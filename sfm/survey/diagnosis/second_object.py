"""Photographs without orientation that fit one another: a second object of the same codes, or a mirror image.

They are oriented by themselves, both parts are adjusted, and the points that they have in common are compared
as those of any two results (`sfm.comparison`): what a camera explains, that bends the whole, is no other
object, nor is what agrees but for single points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.comparison.significance import compare_results
from sfm.errors import GeometryError
from sfm.network import Estimate, Network, empty_estimate, rows_of
from sfm.orientation.incremental.sequence import MIN_POINTS, Orientation
from sfm.reduced_network import reduce_network, supported
from sfm.remarks.remark import Remark, remark
from sfm.similarity import mean_distance
from sfm.solution import Solution

MIN_RAYS = 2


@dataclass(frozen=True)
class SecondObject:
    """Photographs that confirm themselves only."""

    images: tuple[str, ...]  # their names
    reason: Remark  # why each of them is not in the result


def find_second_objects(
    network: Network, found: Orientation, orient: Callable[[Network, Estimate], Orientation]
) -> tuple[SecondObject, ...]:
    """Return the groups of photographs without orientation that orient one another on points of the others.

    Args:
        network: image points that have names.
        found: its orientation, in which some photographs are missing.
        orient: returns the orientation of a network from start values; GeometryError where there is none.
    """
    seen, names = network.image_points, np.array(network.images, dtype=object)
    left = ~found.estimate.oriented
    left &= np.array([len(rows) for rows in rows_of(seen.image, len(names))]) >= MIN_POINTS
    groups: list[SecondObject] = []
    while left.sum() >= 2:
        points = np.isin(np.arange(len(network.points)), seen.point[left[seen.image]])
        every = np.ones(len(seen), dtype=bool)
        start = empty_estimate(network, found.estimate.cameras)
        part = reduce_network(network, start, left, points, every)[0]
        part = replace(part, control=type(part.control)(), exterior=type(part.exterior)())
        try:
            other = orient(part, empty_estimate(part, found.estimate.cameras))
        except GeometryError:
            break
        images = np.flatnonzero(left)[other.estimate.oriented]
        left[images] = False
        try:
            reason = _reason(_adjusted(network, found), _adjusted(part, other), tuple(names[images]))
        except (GeometryError, np.linalg.LinAlgError):  # too little is determined to compare
            continue
        if reason is not None:
            groups.append(SecondObject(tuple(names[images]), reason))
    return tuple(groups)


def tell_second_objects(found: Orientation, groups: tuple[SecondObject, ...]) -> Orientation:
    """Return the orientation with what second objects are as the reason of their photographs."""
    reasons = {image: group.reason for group in groups for image in group.images}
    failures = tuple((image, reasons.get(image, reason)) for image, reason in found.failures)
    return replace(found, failures=failures)


def _adjusted(network: Network, found: Orientation) -> Solution | None:
    """Return the image points that fit in an orientation adjusted by themselves; None without a solution."""
    alone = Network(network.images, network.camera, network.points, network.image_points)
    images, points = supported(alone, found.estimate, found.fits, min_points=MIN_POINTS, min_rays=MIN_RAYS)
    part, start = reduce_network(alone, found.estimate, images, points, found.fits)
    a = adjust(part, start, datum=Datum("free"), reject="tau")
    if not a.converged or a.undetermined:
        return None
    return a.solution.with_joint_covariance


def _reason(others: Solution | None, group: Solution | None, images: tuple[str, ...]) -> Remark | None:
    """Return why photographs do not fit the others; None where they show the same object or too little."""
    if others is None or group is None:
        return None
    both = compare_results(others, group)
    cause, size = both.cause, mean_distance(others.estimate.points[both.pairing.points[:, 0]])
    if cause is not None and cause.row.mirror:
        return remark("photograph_of_mirror_image", photographs=images, points=len(both.points))
    if both.majority if cause is None else cause.row.strain or cause.row.bending:
        return None
    rms = float(np.sqrt((both.point_difference**2).sum(axis=1).mean()))
    return remark(
        "photograph_of_second_object", photographs=images, points=len(both.points), misfit=rms / size
    )
