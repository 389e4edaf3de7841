"""Coordinates reduced to the centroid of a network that is far from the origin, and given back.

Near 5e6 m a coordinate in double precision has steps of 1e-9 m, which in a close-range network is more
than the change at which an iteration has converged.

Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 2.2.2.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.conventions import FloatArray
from sfm.network import Estimate, Network

FAR = 1000.0  # extents of the network from the origin at which an axis is reduced: three digits are lost


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
    centre = np.median(known, axis=0)
    extent = np.abs(known - centre).max()
    # Far from the origin x - c is exact for all x between c / 2 and 2 c (Sterbenz), so is giving it back.
    return np.where(np.abs(centre) > FAR * extent, centre, 0.0)


def shifted(network: Network, estimate: Estimate, by: FloatArray) -> tuple[Network, Estimate]:
    """Return a network and an estimate with all object coordinates changed by a shift, object unit, (3,)."""
    moved = replace(
        network,
        control=replace(network.control, xyz=network.control.xyz + by),
        exterior=replace(network.exterior, position=network.exterior.position + by),
    )
    return moved, replace(estimate, position=estimate.position + by, points=estimate.points + by)
