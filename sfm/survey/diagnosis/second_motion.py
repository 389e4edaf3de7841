"""Tie points that fit one another and not the others: a thing that moved, or the object before which it did.

The orientation is that of the larger part of the tie points. Where walkers or vehicles hide the most of an
object, it is theirs, and as precise as any other. Tie points that it does not explain are oriented by
themselves; errors by chance have no orientation, another rigid body has one.

Source: Torr (1998), Geometric motion segmentation, Phil. Trans. R. Soc. A 356.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sfm.conventions import BoolArray, IntArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network, empty_estimate
from sfm.orientation.incremental.growth import MIN_SHARE, TOLERANCE_FACTOR, residual_lengths
from sfm.orientation.incremental.sequence import Orientation
from sfm.reduced_network import reduce_network
from sfm.remarks.remark import Remark, remark, unless_note

MIN_RAYS = 3  # of a point that shows a motion: two meet by chance
MIN_POINTS = 20  # in three photographs and more: with fewer an orientation may fit what moves at random


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
    left = (rays >= MIN_RAYS) & (fitting < MIN_SHARE * rays)
    if left.sum() < MIN_POINTS:
        return ()
    held = tuple(replace(one, free=np.zeros_like(one.free)) for one in found.estimate.cameras)
    part, start = reduce_network(network, empty_estimate(network, held), images, left, on)
    try:
        other = orient(part, start)
    except GeometryError:
        return ()
    moved = _rays(part, residual_lengths(part, other.estimate) <= tolerance_px) >= MIN_RAYS
    if moved.sum() < MIN_POINTS:
        return ()
    seen = part.image_points
    of_moved = np.unique(seen.image[moved[seen.point]])
    others = int(((rays >= MIN_RAYS) & (fitting >= MIN_SHARE * rays)).sum())
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
