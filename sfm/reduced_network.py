"""A part of a network: some of its photographs, points and image points, counted anew."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from sfm.conventions import BoolArray, IntArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.observations.kind import Kind

K = TypeVar("K", bound=Kind)
MIN_IMAGE_POINTS = 4  # of a photograph in the final adjustment: three determine it, the fourth checks


def reduce_network(
    network: Network, estimate: Estimate, images: BoolArray, points: BoolArray, image_points: BoolArray
) -> tuple[Network, Estimate]:
    """Return the network and estimate of some photographs, points and image points only.

    Args:
        network: of m photographs, n points and k image points.
        estimate: of the same.
        images: photographs to keep, (m,).
        points: points to keep, (n,).
        image_points: image points to keep (those of dropped photographs and points go anyway), (k,).

    Returns:
        Reduced network and estimate, counted anew; observations of dropped points and photographs are gone.
    """
    image_index = np.cumsum(images) - 1
    point_index = np.cumsum(points) - 1
    seen = network.image_points.select(
        image_points & images[network.image_points.image] & points[network.image_points.point]
    )

    def kept(kind: K) -> K:
        return kind.keep(points, images).renumbered(point_index, image_index)

    reduced = replace(
        network,
        images=tuple(name for name, keep in zip(network.images, images, strict=True) if keep),
        camera=network.camera[images],
        moment=None if network.moment is None else network.moment[images],
        points=tuple(name for name, keep in zip(network.points, points, strict=True) if keep),
        image_points=replace(seen, image=image_index[seen.image], point=point_index[seen.point]),
        control=kept(network.control),
        scale_bars=kept(network.scale_bars),
        exterior=kept(network.exterior),
        observations=tuple(one for one in map(kept, network.observations) if len(one)),
    )
    return reduced, replace(
        estimate,
        position=estimate.position[images],
        rotation=estimate.rotation[images],
        points=estimate.points[points],
    )


def supported(
    network: Network,
    estimate: Estimate,
    accepted: BoolArray,
    *,
    min_points: int | IntArray,
    min_rays: int | IntArray,
) -> tuple[BoolArray, BoolArray]:
    """Return the photographs and points that are left when those with too few image points go, in turn.

    Args:
        network: of m photographs, n points and k image points.
        estimate: of the same.
        accepted: image points that count, (k,).
        min_points: image points that a photograph needs, of all or of each, (m,).
        min_rays: image points that a point needs, of all or of each, (n,).

    Returns:
        Photographs (m,) and points (n,); of those, oriented and determined ones only.
    """
    seen = network.image_points
    images, points = estimate.oriented, estimate.determined
    while True:
        used = accepted & images[seen.image] & points[seen.point]
        shown = np.bincount(seen.image[used], minlength=len(images))
        rays = np.bincount(seen.point[used], minlength=len(points))
        still_images, still_points = images & (shown >= min_points), points & (rays >= min_rays)
        if (still_images == images).all() and (still_points == points).all():
            return images, points
        images, points = still_images, still_points


def determined(
    network: Network,
    estimate: Estimate,
    accepted: BoolArray,
    min_rays: IntArray,
    min_points: int | IntArray = MIN_IMAGE_POINTS,
) -> tuple[BoolArray, BoolArray]:
    """Return the photographs (m,) and points (n,) that accepted image points determine.

    Raises:
        GeometryError: fewer than two photographs are left.
    """
    images, points = supported(network, estimate, accepted, min_points=min_points, min_rays=min_rays)
    if images.sum() < 2:
        raise GeometryError(
            f"{images.sum()} of {len(images)} photographs see at least {MIN_IMAGE_POINTS} points of the "
            "network, at least 2 photographs are needed"
        )
    return images, points


def merge_estimate(part: Estimate, images: BoolArray, points: BoolArray) -> Estimate:
    """Return the estimate of all photographs (m,) and points (n,); NaN but for those of a part."""
    position, rotation = np.full((len(images), 3), np.nan), np.full((len(images), 3, 3), np.nan)
    xyz = np.full((len(points), 3), np.nan)
    position[images], rotation[images], xyz[points] = part.position, part.rotation, part.points
    return replace(part, position=position, rotation=rotation, points=xyz)
