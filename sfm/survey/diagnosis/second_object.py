"""Photographs without orientation that fit one another: a second object with the same codes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.conventions import FloatArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network, empty_estimate, rows_of
from sfm.orientation.incremental.sequence import MIN_POINTS, Orientation
from sfm.reduced_network import reduce_network
from sfm.remarks.remark import Remark, remark
from sfm.similarity import fit_similarity

FITTING = 0.8  # of the image points of a group that must fit in it for the group to confirm itself
OTHER_SHAPE = 0.1  # misfit of common points over their spread, from which no wrong camera explains it
MIRROR = np.diag([1.0, 1.0, -1.0])
SAME_SHAPE = 0.01  # misfit from which two groups show different states of an object, or no mirror images


@dataclass(frozen=True)
class SecondObject:
    """Photographs that confirm themselves only."""

    images: tuple[str, ...]  # their names
    points: int  # points that they have, and the oriented photographs too
    misfit: float  # RMS of these points after a similarity, over their RMS distance from their centre
    mirrored_misfit: float = np.inf  # the same after a similarity with a reflection

    @property
    def certain(self) -> bool:
        """Whether the points are so much elsewhere that no wrong interior orientation explains it."""
        return self.misfit > OTHER_SHAPE

    @property
    def reason(self) -> Remark:
        """Why each of the photographs is not in the result."""
        if self.mirrored_misfit <= SAME_SHAPE:
            return remark(
                "photograph_of_mirror_image",
                photographs=self.images,
                points=self.points,
                misfit=self.mirrored_misfit,
            )
        return remark(
            "photograph_of_second_object", photographs=self.images, points=self.points, misfit=self.misfit
        )


def find_second_objects(
    network: Network, found: Orientation, orient: Callable[[Network, Estimate], Orientation]
) -> tuple[SecondObject, ...]:
    """Return the groups of photographs without orientation that orient one another on points of the others.

    Args:
        network: image points that have names.
        found: its orientation, in which some photographs are missing.
        orient: returns the orientation of a network from start values; GeometryError where there is none.
    """
    seen = network.image_points
    left = ~found.estimate.oriented
    groups: list[SecondObject] = []
    while True:
        count = np.array([len(rows) for rows in rows_of(seen.image, len(network.images))])
        left &= count >= MIN_POINTS
        if left.sum() < 2:
            return tuple(groups)
        points = np.isin(np.arange(len(network.points)), seen.point[left[seen.image]])
        every = np.ones(len(seen), dtype=bool)
        start = empty_estimate(network, found.estimate.cameras)
        part = reduce_network(network, start, left, points, every)[0]
        part = replace(part, control=type(part.control)(), exterior=type(part.exterior)())
        try:
            other = orient(part, empty_estimate(part, found.estimate.cameras))
        except GeometryError:
            return tuple(groups)
        inside = other.estimate.oriented
        rows = inside[part.image_points.image]
        images = np.flatnonzero(left)[inside]
        left[images] = False
        misfit, common = _misfit(found.estimate.points[points], other.estimate.points)
        if other.fits[rows].mean() >= FITTING and misfit > SAME_SHAPE:
            mirrored, _ = _misfit(found.estimate.points[points], other.estimate.points @ MIRROR)
            names = tuple(network.images[i] for i in images)
            groups.append(SecondObject(names, common, misfit, mirrored))


def tell_second_objects(found: Orientation, groups: tuple[SecondObject, ...]) -> Orientation:
    """Return the orientation with what second objects are as the reason of their photographs."""
    reasons = {image: group.reason for group in groups for image in group.images}
    failures = tuple((image, reasons.get(image, reason)) for image, reason in found.failures)
    return replace(found, failures=failures)


def _misfit(first: FloatArray, second: FloatArray) -> tuple[float, int]:
    """Return how far common points are apart after a similarity, over their spread, and their number."""
    known = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    count = int(known.sum())
    if count < MIN_POINTS:
        return 0.0, count
    spread = np.sqrt(np.sum((first[known] - first[known].mean(axis=0)) ** 2))
    try:
        moved = fit_similarity(second[known], first[known]).apply(second[known])
    except GeometryError:
        return 0.0, count
    return float(np.sqrt(np.sum((moved - first[known]) ** 2)) / spread), count
