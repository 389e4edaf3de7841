"""Weaknesses of a planned network, and the contributions of the rig and of each kind of observation.

The contribution of the rig, or of a kind of observation besides image points, is the gain in precision by it.
Precision without and with it is compared in the datum of the network without it: with inner constraints for
the motions that this network leaves open. This is the datum of the plan, unless a kind alone determines a
motion, as the only scale bars do.

Source: Fraser (1997), ISPRS J. Photogramm. Remote Sens. 52(4) (what determines interior orientation:
convergence, rolled photographs, depth of the object); Baarda (1968) for reliability; Baarda (1973),
S-transformations and criterion matrices.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.quality.correlations import (
    OrientationCorrelation,
    orientation_correlations,
    projection_covariance,
)
from sfm.adjustment.quality.statistics import Correlation, correlations
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import predict
from sfm.model.arguments import checked_arguments
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, ScaleBars
from sfm.model.observations.pose import MountObservations
from sfm.model.reduced_network import reduce_network
from sfm.model.similarity import OPEN, motions_along
from sfm.products.planning.prediction import (
    MIN_POINTS,
    Prediction,
    predict_network,
    select_usable,
    spread_evenly,
)
from sfm.products.planning.visibility import WORDS, Seeing, Visibility

RIG = "rig"
MIN_SHAPE = 3  # points that form a shape
MIN_WEAK_RATIO = 1.5  # a point with a larger sigma, over the median sigma, is weak
MIN_RAYS = 4  # with fewer rays a gross error is hardly found, and can hardly be located
FLAT_DEG = 40.0  # if the largest angle of rays is smaller, depth is much weaker than the rest
ROLLED_DEG = 45.0  # least roll against the others of a photograph that counts as rolled
MIN_DEPTH = 0.1  # depth of the object over its distance; with less it is flat for the camera
MOTIONS = ("position", "attitude", "scale")  # of a network
MAX_PLACES = 500  # image points at which the calibration is judged


@dataclass(frozen=True)
class WeakPoint:
    """A point with a worse predicted precision than the others, or an undetermined point."""

    name: str
    sigma: float  # RMS of its coordinates, object unit; infinite if undetermined
    reason: str


@dataclass(frozen=True)
class Calibratability:
    """Whether a network determines the interior orientation of a camera."""

    camera: str  # name of the camera
    parameters: tuple[str, ...]  # free parameters
    sigma: FloatArray  # predicted, in the units of the camera's model, NaN if undetermined
    # effect of their uncertainty on the angles between rays, that is, on image points after a rotation of the
    # camera: RMS over the image points, in sigmas of an image coordinate
    contribution: float
    cost: float  # sigma of points over their sigma with the camera held
    rolled: float  # share of photographs rolled by about 90 deg against the others, at most 1/2
    convergence_deg: float  # largest angle between two optical axes
    depth: float  # largest depth of the object in a photograph over its mean distance there
    correlations: tuple[Correlation, ...]  # strong correlations of camera parameters with one another
    with_exterior: tuple[OrientationCorrelation, ...]  # strong correlations with exterior orientation
    undetermined: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether nothing is undetermined and the contribution is at most that of an image point."""
        return not self.undetermined and self.contribution <= 1.0

    @property
    def reasons(self) -> tuple[str, ...]:
        """The causes in the geometry of the network, in words."""
        words = []
        if self.rolled < 0.2:
            words.append(f"{self.rolled:.0%} of the photographs are rolled by 90 deg, better half of them")
        if self.convergence_deg < FLAT_DEG:
            words.append(f"optical axes converge by {self.convergence_deg:.0f} deg at most")
        if self.depth < MIN_DEPTH:
            words.append(f"the object is {self.depth:.0%} of its distance deep")
        return tuple(words)


def weak_points(prediction: Prediction) -> tuple[WeakPoint, ...]:
    """Return the undetermined points and those much worse than the median, the worst first."""
    sigma, determined = prediction.sigma, prediction.determined
    limit = MIN_WEAK_RATIO * float(np.median(sigma[determined])) if determined.any() else 0.0
    weak = np.flatnonzero(~determined | (sigma > limit) | (prediction.rays < 2))
    order = weak[np.lexsort((prediction.rays[weak], -sigma[weak]))]
    return tuple(
        WeakPoint(prediction.planned.names[j], float(sigma[j]), reason_of(prediction, int(j))) for j in order
    )


def reason_of(prediction: Prediction, j: int) -> str:
    """Return the reason for the weakness of a point: "2 rays, 9 degrees", and why rays are missing.

    Args:
        prediction: prediction of the network.
        j: index of the point.
    """
    rays, angle = int(prediction.rays[j]), float(prediction.angle_deg[j])
    words = [counted(rays, "ray")]
    if np.isfinite(angle):
        words.append(f"{angle:.0f} degrees")
    if rays < MIN_RAYS:
        why = prediction.sight.visibility[:, j]
        counts = [(int((why == kind).sum()), WORDS[kind]) for kind in Visibility if kind != Visibility.SEEN]
        seen_by_few = int(((why == Visibility.SEEN) & (prediction.photograph < 0)).sum())
        counts.append((seen_by_few, f"in photographs that share fewer than {MIN_POINTS} points with others"))
        words += [f"{what} in {count}" for count, what in sorted(counts, reverse=True) if count]
    elif (by := prediction.motion_variance[j]).sum() > prediction.sigma[j] ** 2 / 2:
        motion = MOTIONS[int(by.argmax())]
        words.append(f"mostly from the {motion} of the whole network, which its observations give weakly")
    elif angle >= FLAT_DEG:
        median = counted(int(np.median(prediction.rays)), "ray")
        words.append(f"far from the stations or seen by few (median of points: {median})")
    return ", ".join(words)


def unusable_photographs(prediction: Prediction) -> tuple[str, ...]:
    """Return the names of the photographs that share too few points with others to be oriented."""
    return tuple(
        name for name, k in zip(prediction.stations.names, prediction.photograph, strict=True) if k < 0
    )


def separate_groups(prediction: Prediction) -> tuple[tuple[str, ...], ...]:
    """Return the groups of photographs that share too few points to form one network, the largest first.

    Two groups are merged if they share MIN_POINTS points, as for single photographs. A connected network is
    one group.
    """
    network = prediction.adjustment.network
    m = len(network.images)
    seen = np.zeros((m, len(network.points)), dtype=np.float32)
    seen[network.image_points.image, network.image_points.point] = 1
    group = np.arange(m)
    while True:
        of_group = np.zeros((int(group.max()) + 1, seen.shape[1]), dtype=np.float32)
        np.maximum.at(of_group, group, seen)
        count, joined = connected_components(of_group @ of_group.T >= MIN_POINTS, directed=False)
        group = joined[group]
        if count == len(of_group):
            break
    groups = [np.flatnonzero(group == k) for k in range(count)]
    groups.sort(key=lambda members: (-len(members), int(members[0])))
    return tuple(tuple(network.images[k] for k in members) for members in groups)


@checked_arguments()
def calibratability(prediction: Prediction, seeing: Seeing, camera_index: int = 0) -> Calibratability | None:
    """Return whether the network determines the free parameters of a camera; None if it has none.

    Args:
        prediction: prediction of the network.
        seeing: settings of this prediction.
        camera_index: index of the camera on a rig.

    Source: Fraser (1997), ISPRS J. Photogramm. Remote Sens. 52(4).
    """
    a, cameras = prediction.adjustment, prediction.cameras
    camera = cameras[camera_index]
    if not camera.free.any():
        return None
    held = list(cameras)
    held[camera_index] = replace(camera, free=np.zeros_like(camera.free))
    fixed = predict_network(prediction.planned, held, prediction.stations, seeing, sight=prediction.sight)
    free = predict_network(prediction.planned, cameras, prediction.stations, seeing, sight=prediction.sight)
    used = (prediction.photograph >= 0) & (prediction.stations.camera == camera_index)
    R, X0 = prediction.stations.rotation[used], prediction.stations.position[used]
    axes = R[:, :, 2]
    depth = -((prediction.planned.xyz[None] - X0[:, None]) * axes[:, None]).sum(axis=2)
    depth = np.where(prediction.sight.seen[used], depth, np.nan)
    names = tuple(n for n, f in zip(camera.names, camera.free, strict=True) if f)
    sigma = a.interior_sigma(camera_index)[camera.free]
    xy = a.network.image_points.xy[a.network.camera[a.network.image_points.image] == camera_index]
    rows = {f"{n} of camera {camera.name}" for n in names}
    # A small shift of the principal point cannot be distinguished from a rotation of the camera, and need not
    # be. Therefore the effect of a rotation is removed.
    places = xy[:: 1 + len(xy) // MAX_PLACES]
    Q = projection_covariance(camera, a.covariance.interior[camera_index], places, places)
    return Calibratability(
        camera=camera.name,
        parameters=names,
        sigma=np.where(sigma > 0, sigma, np.nan),
        contribution=float(np.sqrt(np.nanmean(np.einsum("kii->ki", Q)))) / prediction.sigma_px,  # RMS
        cost=free.rms_sigma / fixed.rms_sigma,
        rolled=rolled_share(R),
        convergence_deg=float(np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1).min()))),
        depth=float(
            np.max((np.nanmax(depth, axis=1) - np.nanmin(depth, axis=1)) / np.nanmean(depth, axis=1))
        ),
        correlations=tuple(pair for pair in correlations(a) if pair.first in rows),
        with_exterior=tuple(pair for pair in orientation_correlations(a) if pair.parameter in rows),
        undetermined=tuple(a.undetermined),
    )


def rolled_share(rotation: FloatArray) -> float:
    """Return the share of photographs rolled by about 90 deg against the others, at most 1/2.

    Roll is the angle of the image's x axis against the horizontal, or against X for views straight down or
    up.

    Args:
        rotation: R of each photograph, image to object axes, (m, 3, 3).
    """
    z, x = rotation[:, :, 2], rotation[:, :, 0]
    level = np.cross([0.0, 0.0, 1.0], z)
    length = np.linalg.norm(level, axis=1, keepdims=True)
    level = np.where(length > 1e-6, level / np.maximum(length, 1e-12), [1.0, 0.0, 0.0])
    upright = np.abs((level * x).sum(axis=1)) < np.cos(np.radians(ROLLED_DEG))
    return float(min(upright.mean(), 1 - upright.mean()))


@dataclass(frozen=True)
class Contribution:
    """Contribution of a kind of observation of a plan, or of its rig."""

    name: str  # of the kind
    count: int  # number of observations, or of moments of the rig
    shifts: int  # number of shifts of the network that nothing else determines, up to 3
    rotations: int  # the same for rotations
    scale: bool  # whether nothing else determines the scale
    points: int  # number of points that nothing else determines
    # RMS sigma of a coordinate of the other points, object unit; infinite if nothing is determined without
    # the kind
    sigma_without: float
    sigma_with: float  # the same with the kind

    @property
    def gain(self) -> float:
        """Standard deviation of points without the kind over that with it."""
        return self.sigma_without / self.sigma_with


def contributions(prediction: Prediction) -> tuple[Contribution, ...]:
    """Return the contributions of the rig and of each kind of observation to a plan."""
    a = prediction.adjustment
    parts = []
    if a.estimate.mounts is not None and a.network.moment is not None:
        moments = len(np.unique(a.network.moment))
        network, _ = _without(replace(a.network, moment=None), a.estimate, MountObservations.name)
        seen = network.incidence(np.ones(len(network.image_points), dtype=bool)).toarray() > 0
        images, points = np.zeros(len(network.images), dtype=bool), np.zeros(len(network.points), dtype=bool)
        left = select_usable(seen)  # photographs that can be oriented alone
        images[left[0]], points[left[1]] = True, True
        every = np.ones(len(network.image_points), dtype=bool)
        network, start = reduce_network(network, replace(a.estimate, mounts=None), images, points, every)
        parts.append(_contribution_of(a, RIG, moments, network, start))
    for name in dict.fromkeys(kind.name for kind in a.network.observations if len(kind)):
        count = sum(len(kind) for kind in a.network.observations if kind.name == name)
        parts.append(_contribution_of(a, name, count, *_without(a.network, a.estimate, name)))
    return tuple(parts)


def _contribution_of(
    a: Adjustment, name: str, count: int, network: Network, estimate: Estimate
) -> Contribution:
    """Return the contribution of a kind from the network without it and the whole network."""
    rest = tuple(kind for kind in network.further if not kind.needs_scale)
    known, less = _determined(a), None
    for observations in (network.further, rest):  # other kinds need a scale, which only this may give
        with suppress(GeometryError):
            less = less or predict(network.with_given(further=observations), estimate)
    left = np.zeros(0, dtype=bool) if less is None else _determined(less)
    names = () if less is None else less.network.points
    place = {point: j for j, point in enumerate(names) if left[j]}
    common = [(j, place[point]) for j, point in enumerate(a.network.points) if known[j] and point in place]
    if less is None or len(common) < MIN_SHAPE:
        every = spread_evenly(np.flatnonzero(known))
        sigma = sigma_beside(a, every, open_motions(a, every))
        return Contribution(name, count, 0, 0, False, int(known.sum()), np.inf, sigma)
    in_all, part = spread_evenly(np.array(common, dtype=np.int64)).T
    motions = open_motions(less, part)
    before, after = sigma_beside(less, part, motions), sigma_beside(a, in_all, motions)
    shifts, rotations, scale = open_counts(less, part) - open_counts(a, in_all)
    points = int(known.sum()) - len(common)
    return Contribution(name, count, int(shifts), int(rotations), bool(scale), points, before, after)


def _without(network: Network, estimate: Estimate, name: str) -> tuple[Network, Estimate]:
    """Return a network without the observations of a kind."""
    mounts = estimate.mounts
    if name == MountObservations.name and mounts is not None:
        given = [a for kind in network.further if isinstance(kind, MountObservations) for a in kind.camera]
        free = mounts.free.copy()
        free[given] = True
        estimate = replace(estimate, mounts=replace(mounts, free=free))
    return network.with_given(
        ScaleBars() if name == ScaleBars.name else network.scale_bars,
        further=tuple(kind for kind in network.further if kind.name != name),
    ), estimate


def _determined(a: Adjustment) -> BoolArray:
    """Return which points have a covariance, (n,)."""
    trace = np.trace(a.covariance.points, axis1=1, axis2=2)
    return np.asarray(np.isfinite(trace) & (trace > 0))


def open_counts(adjustment: Adjustment, points: IntArray) -> IntArray:
    """Return the numbers of open shifts, rotations and scales of a network, (3,).

    Args:
        adjustment: adjustment of the network.
        points: indices of points that show the motions, MIN_SHAPE or more, (n,).
    """
    X = adjustment.estimate.points[points]
    centre, size = X.mean(axis=0), float(np.ptp(X, axis=0).max())
    along = motions_along(X, open_motions(adjustment, points), centre=centre, size=size)
    turned, scaled = (int(np.linalg.matrix_rank(along[k:], tol=OPEN)) for k in (3, 6))
    return np.array([adjustment.expected_defect - turned, turned - scaled, scaled])


def sigma_beside(adjustment: Adjustment, points: IntArray, motions: FloatArray) -> float:
    """Return the standard deviation of points with inner constraints for some motions.

    Args:
        adjustment: adjustment of the network.
        points: indices of the points, (n,).
        motions: displacements of the points by these motions, including all open motions, (n, 3, d).

    Returns:
        RMS of a coordinate, object unit.
    """
    Q = marginal_of(adjustment).joint(np.zeros(0, dtype=np.int64), points)
    H = np.linalg.qr(motions.reshape(len(Q), -1))[0]
    return float(np.sqrt((np.trace(Q) - np.trace(H.T @ Q @ H)) / len(Q)))


def open_motions(adjustment: Adjustment, points: IntArray) -> FloatArray:
    """Return the displacements of points by each open motion of the network, (n, 3, d).

    Args:
        adjustment: adjustment of the network.
        points: indices of the points, (n,).
    """
    motions = marginal_of(adjustment).optimum.motions.points[points]
    return motions.reshape(len(points), 3, -1)[:, :, : adjustment.expected_defect]
