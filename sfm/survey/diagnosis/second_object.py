"""Parts of a survey that do not fit the rest: a second object of the same codes, a mirror image, a motion.

Photographs without orientation are oriented by themselves, both parts are adjusted, and the points that they
have in common are compared as those of any two results (`sfm.comparison`): what a camera explains, that bends
the whole, is no other object, nor is what agrees but for single points.

The orientation of tie points is that of the larger part of them. Where walkers or vehicles hide the most of
an object, it is theirs, and as precise as any other. Tie points that it does not explain are oriented by
themselves; errors by chance have no orientation, another rigid body has one.

Source: Torr (1998), Geometric motion segmentation, Phil. Trans. R. Soc. A 356.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.comparison.significance import compare_results
from sfm.conventions import BoolArray, IntArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network, empty_estimate, rows_of
from sfm.orientation.incremental.growth import MIN_SHARE, TOLERANCE_FACTOR, residual_lengths
from sfm.orientation.incremental.sequence import MIN_POINTS, Orientation
from sfm.reduced_network import reduce_network, supported
from sfm.remarks.remark import Remark, remark, unless_note
from sfm.similarity import mean_distance
from sfm.solution import Solution

MIN_RAYS = 2
MOTION_RAYS = 3  # of a point that shows a motion: two meet by chance
MOTION_POINTS = 20  # in three photographs and more: with fewer an orientation may fit what moves at random


def find_second_objects(
    network: Network, found: Orientation, orient: Callable[[Network, Estimate], Orientation]
) -> dict[str, Remark]:
    """Return why photographs fail that orient one another on points of the others, by their names.

    Args:
        network: image points that have names.
        found: its orientation, in which some photographs are missing.
        orient: returns the orientation of a network from start values; GeometryError where there is none.
    """
    seen, names = network.image_points, np.array(network.images, dtype=object)
    left = ~found.estimate.oriented
    left &= np.array([len(rows) for rows in rows_of(seen.image, len(names))]) >= MIN_POINTS
    reasons: dict[str, Remark] = {}
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
            reasons |= dict.fromkeys(names[images], reason)
    return reasons


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


def find_second_motion(
    network: Network, found: Orientation, orient: Callable[[Network, Estimate], Orientation]
) -> tuple[Remark, ...]:
    """Return the remark on tie points that have another orientation than the others, if there are such.

    Args:
        network: tie points.
        found: its orientation.
        orient: returns the orientation of a network from start values; GeometryError where there is none.
    """
    images = found.estimate.oriented
    on = images[network.image_points.image]
    tolerance_px = TOLERANCE_FACTOR * found.rms_px
    fits = residual_lengths(network, found.estimate) <= tolerance_px
    rays, fitting = _rays(network, on), _rays(network, on & fits)
    left = (rays >= MOTION_RAYS) & (fitting < MIN_SHARE * rays)
    if left.sum() < MOTION_POINTS:
        return ()
    held = tuple(replace(one, free=np.zeros_like(one.free)) for one in found.estimate.cameras)
    part, start = reduce_network(network, empty_estimate(network, held), images, left, on)
    try:
        other = orient(part, start)
    except GeometryError:
        return ()
    moved = _rays(part, residual_lengths(part, other.estimate) <= tolerance_px) >= MOTION_RAYS
    if moved.sum() < MOTION_POINTS:
        return ()
    seen = part.image_points
    of_moved = np.unique(seen.image[moved[seen.point]])
    others = int(((rays >= MOTION_RAYS) & (fitting >= MIN_SHARE * rays)).sum())
    return unless_note(
        remark(
            "second_motion",
            share=float(moved.sum() / (moved.sum() + others)),
            points=int(moved.sum()),
            photographs=[part.images[i] for i in of_moved],
        )
    )


def _rays(network: Network, rows: BoolArray) -> IntArray:
    """Return how many of some image points each object point has, (n,)."""
    return np.bincount(network.image_points.point[rows], minlength=len(network.points))
