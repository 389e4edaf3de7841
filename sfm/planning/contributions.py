"""Contributions of the rig and of each kind of observation beside image points to a planned network.

Precision without and with a kind is compared in the datum of the network without it: with inner constraints
for the motions that it leaves open. It is the datum of the plan unless the kind alone gives a motion, as the
only scale bars do.

Source: Baarda (1973), S-transformations and criterion matrices.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import predict
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network, ScaleBars
from sfm.observations.mounts import MountObservations
from sfm.planning.prediction import Prediction, spread_evenly, usable
from sfm.reduced_network import reduce_network
from sfm.similarity import OPEN, motions_along

RIG = "rig"
MIN_SHAPE = 3  # points that have one


@dataclass(frozen=True)
class Contribution:
    """A kind of observation of a plan, or its rig."""

    name: str  # of the kind
    count: int  # observations, or moments of the rig
    shifts: int  # of the network that nothing else fixes, up to 3
    rotations: int  # likewise
    scale: bool  # whether nothing else gives it
    points: int  # that nothing else determines
    sigma_without: float  # of the other points, RMS of a coordinate, object unit; infinite where nothing is
    # determined without it
    sigma_with: float

    @property
    def gain(self) -> float:
        """Standard deviations of points without it over those with it."""
        return self.sigma_without / self.sigma_with


def contributions(prediction: Prediction) -> tuple[Contribution, ...]:
    """Return what the rig and each kind of observations add to a plan."""
    a = prediction.adjustment
    found = []
    if a.estimate.mounts is not None and a.network.moment is not None:
        moments = len(np.unique(a.network.moment))
        found.append(_contribution(a, RIG, moments, *_without_rig(a.network, a.estimate)))
    for name in dict.fromkeys(kind.name for kind in a.network.kinds if len(kind)):
        count = sum(len(kind) for kind in a.network.kinds if kind.name == name)
        found.append(_contribution(a, name, count, *_without(a.network, a.estimate, name)))
    return tuple(found)


def _contribution(a: Adjustment, name: str, count: int, network: Network, estimate: Estimate) -> Contribution:
    """Return what is gained from a network without a kind to the whole one."""
    rest = tuple(kind for kind in network.observations if not kind.needs_scale)
    known, less = _determined(a), None
    for observations in (network.observations, rest):  # the others need a scale, which only this one may give
        with suppress(GeometryError):
            less = less or predict(replace(network, observations=observations), estimate)
    left = np.zeros(0, dtype=bool) if less is None else _determined(less)
    names = () if less is None else less.network.points
    place = {point: j for j, point in enumerate(names) if left[j]}
    both = [(j, place[point]) for j, point in enumerate(a.network.points) if known[j] and point in place]
    if less is None or len(both) < MIN_SHAPE:
        every = spread_evenly(np.flatnonzero(known))
        sigma = sigma_beside(a, every, open_motions(a, every))
        return Contribution(name, count, 0, 0, False, int(known.sum()), np.inf, sigma)
    whole, part = spread_evenly(np.array(both, dtype=np.int64)).T
    motions = open_motions(less, part)
    before, after = sigma_beside(less, part, motions), sigma_beside(a, whole, motions)
    shifts, rotations, scale = open_counts(less, part) - open_counts(a, whole)
    points = int(known.sum()) - len(both)
    return Contribution(name, count, int(shifts), int(rotations), bool(scale), points, before, after)


def _without(network: Network, estimate: Estimate, name: str) -> tuple[Network, Estimate]:
    """Return a network without the observations of a kind."""
    mounts = estimate.mounts
    if name == MountObservations.name and mounts is not None:
        given = [a for one in network.observations if isinstance(one, MountObservations) for a in one.camera]
        free = mounts.free.copy()
        free[given] = True
        estimate = replace(estimate, mounts=replace(mounts, free=free))
    return replace(
        network,
        scale_bars=ScaleBars() if name == ScaleBars.name else network.scale_bars,
        observations=tuple(kind for kind in network.observations if kind.name != name),
    ), estimate


def _without_rig(network: Network, estimate: Estimate) -> tuple[Network, Estimate]:
    """Return a network of single photographs, of those that can be oriented alone."""
    network, _ = _without(replace(network, moment=None), estimate, MountObservations.name)
    seen = network.incidence(np.ones(len(network.image_points), dtype=bool)).toarray() > 0
    images, points = np.zeros(len(network.images), dtype=bool), np.zeros(len(network.points), dtype=bool)
    left = usable(seen)
    images[left[0]], points[left[1]] = True, True
    every = np.ones(len(network.image_points), dtype=bool)
    return reduce_network(network, replace(estimate, mounts=None), images, points, every)


def _determined(a: Adjustment) -> BoolArray:
    """Return which points have a covariance, (n,)."""
    trace = np.trace(a.covariance.points, axis1=1, axis2=2)
    return np.asarray(np.isfinite(trace) & (trace > 0))


def open_counts(adjustment: Adjustment, points: IntArray) -> IntArray:
    """Return how many shifts, rotations and scales of the network are open, (3,).

    Args:
        adjustment: of the network.
        points: index of those by which it is seen, MIN_SHAPE or more, (n,).
    """
    X = adjustment.estimate.points[points]
    centre, size = X.mean(axis=0), float(np.ptp(X, axis=0).max())
    along = motions_along(X, open_motions(adjustment, points), centre=centre, size=size)
    turned, scaled = (int(np.linalg.matrix_rank(along[k:], tol=OPEN)) for k in (3, 6))
    return np.array([adjustment.expected_defect - turned, turned - scaled, scaled])


def sigma_beside(adjustment: Adjustment, points: IntArray, motions: FloatArray) -> float:
    """Return the standard deviation of points with inner constraints for some motions.

    Args:
        adjustment: of the network.
        points: index of each, (n,).
        motions: how they move, those that are open among them, (n, 3, d).

    Returns:
        RMS of a coordinate, object unit.
    """
    Q = marginal_of(adjustment).joint(np.zeros(0, dtype=np.int64), points)
    H = np.linalg.qr(motions.reshape(len(Q), -1))[0]
    return float(np.sqrt((np.trace(Q) - np.trace(H.T @ Q @ H)) / len(Q)))


def open_motions(adjustment: Adjustment, points: IntArray) -> FloatArray:
    """Return how points move with each motion of the network that is open, (n, 3, d)."""
    motions = marginal_of(adjustment).optimum.motions.points[points]
    return motions.reshape(len(points), 3, -1)[:, :, : adjustment.expected_defect]
