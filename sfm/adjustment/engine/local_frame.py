"""A network as it is best computed with: coordinates near the origin, near points near in memory; and back.

Near 5e6 m a coordinate in double precision has steps of 1e-9 m, which in a close-range network is more
than the change at which an iteration has converged: it is reduced to its centroid. The points of a large
network are put in order along a curve that fills space, so that a photograph meets those that it sees in few
stretches of memory; sums over 646,000 image points take a third of the time then.

Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 2.2.2; Morton (1966), A computer oriented
geodetic data base and a new technique in file sequencing, IBM.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import ResolvedDatum
from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, IntArray
from sfm.network import Estimate, Network

# Extents of the network from the origin at which an axis is reduced: three digits are lost.
MAX_EXTENTS = 1000.0
MIN_SORTED_POINTS = 5000  # points from which their order matters; fewer stay in the cache
LEVELS = 10  # of the curve: each axis is cut into 2^10 parts


@dataclass(frozen=True)
class Local:
    """A network to compute with, and the way back to the coordinates and order of another."""

    network: Network
    estimate: Estimate
    datum: ResolvedDatum
    given: Network  # the other one
    centroid: FloatArray  # by which its coordinates are reduced, (3,)
    order: IntArray | None  # its points in the order here, None if that is the same, (n,)

    def back(self, result: Adjustment) -> Adjustment:
        """Return an adjustment of this network as one of the other."""
        if self.order is not None:
            place = np.argsort(self.order)
            covariance = result.covariance
            result = replace(
                result,
                estimate=replace(result.estimate, points=result.estimate.points[place]),
                covariance=replace(
                    covariance,
                    points=covariance.points[place],
                    points_limiting=covariance.points_limiting[place],
                ),
                datum_points=None if result.datum_points is None else result.datum_points[place],
            )
        estimate = result.estimate
        if self.centroid.any():
            _, estimate = shifted(self.given, estimate, self.centroid)
        return replace(result, network=self.given, estimate=estimate)


def local_of(network: Network, estimate: Estimate, datum: ResolvedDatum) -> Local:
    """Return a network, its start values and its datum as they are best computed with."""
    centroid = centroid_of(network, estimate)
    local, start = network, estimate
    if centroid.any():
        local, start = shifted(network, estimate, -centroid)
    order = None
    if len(network.points) >= MIN_SORTED_POINTS:
        order = along_curve(start.points)
        local, start, datum = _renumbered(local, start, datum, order)
    return Local(local, start, datum, network, centroid, order)


def along_curve(points: FloatArray) -> IntArray:
    """Return the order of points along Morton's curve, those without coordinates last.

    Args:
        points: object points, NaN where there is none, shape (n, 3).
    """
    known = np.isfinite(points).all(axis=1)
    key = np.full(len(points), np.iinfo(np.int64).max)
    if known.any():
        cloud = points[known] - points[known].min(axis=0)
        cells = (cloud * ((2**LEVELS - 1) / max(float(cloud.max()), np.finfo(float).tiny))).astype(np.int64)
        code = np.zeros(len(cells), dtype=np.int64)
        for level in range(LEVELS):
            for axis in range(3):
                code |= ((cells[:, axis] >> level) & 1) << (3 * level + axis)
        key[known] = code
    return np.argsort(key, kind="stable")


def _renumbered(
    network: Network, estimate: Estimate, datum: ResolvedDatum, order: IntArray
) -> tuple[Network, Estimate, ResolvedDatum]:
    """Return them with the points in another order."""
    place = np.argsort(order)
    renumbered = replace(
        network,
        points=tuple(network.points[j] for j in order),
        image_points=replace(network.image_points, point=place[network.image_points.point]),
        control=network.control.renumbered(place),
        scale_bars=network.scale_bars.renumbered(place),
        observations=tuple(kind.renumbered(place) for kind in network.observations),
    )
    if datum.points is not None:
        datum = datum._replace(points=datum.points[order])
    return renumbered, replace(estimate, points=estimate.points[order]), datum


def centroid_of(network: Network, estimate: Estimate) -> FloatArray:
    """Return by how much to shift a network, 0 in each axis in which its origin is near, (3,).

    Args:
        network: gives the control.
        estimate: gives all other points and the projection centres; NaN where there are none.
    """
    control = network.control.xyz
    xyz = np.concatenate([estimate.points, estimate.position, control])
    known = xyz[np.isfinite(xyz).all(axis=1)]
    if len(known) == 0:
        return np.zeros(3)
    low, high = known.min(axis=0), known.max(axis=0)
    if max(high.max(), -low.min()) <= MAX_EXTENTS * (high - low).max() / 2:  # the extent is at least that
        return np.zeros(3)
    centre = np.median(known, axis=0)
    extent = np.abs(known - centre).max()
    # Far from the origin x - c is exact for all x between c / 2 and 2 c (Sterbenz), so is giving it back.
    return np.where(np.abs(centre) > MAX_EXTENTS * extent, centre, 0.0)


def shifted(network: Network, estimate: Estimate, by: FloatArray) -> tuple[Network, Estimate]:
    """Return a network and an estimate with all object coordinates changed by a shift, object unit, (3,)."""
    moved = replace(
        network,
        control=network.control.shifted(by),
        exterior=network.exterior.shifted(by),
        observations=tuple(kind.shifted(by) for kind in network.observations),
    )
    return moved, replace(estimate, position=estimate.position + by, points=estimate.points + by)
