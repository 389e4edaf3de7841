"""What explains residuals that are larger than expected: obvious causes, tried on the finished network.

Each cause is a model with more freedom, adjusted from the result with all image points: the rejection has
taken away what shows the cause. The simplest one that comes near the best is told.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.camera import Camera, pixel_from_tangents, tangents_from_pixel
from sfm.conventions import BoolArray, FloatArray
from sfm.display import listed
from sfm.distortion.models import Role
from sfm.errors import GeometryError
from sfm.network import Estimate, InteriorObservations, Network
from sfm.reduced_network import reduce_network, supported
from sfm.result import Explanation
from sfm.similarity import fit_similarity
from sfm.survey.diagnosis.two_groups import two_groups

MUCH_REJECTED = 0.05  # share of rejected image points from which causes are looked for, too
LARGE = 50_000  # image points: from which on nothing is tried while sigma0 is as expected; most to try with
FEW = 50  # image points of a photograph of which none is left out of such a trial
WORTH_A_TRY = 1.5  # sigma0 over the expected one from which causes are looked for
NEAR_THE_BEST = 1.25  # of the least sigma0: what is simpler and reaches this is preferred
MIN_BEFORE = 3  # photographs that can show that the object moved before or behind them
MAX_SPLITS = 12  # places in the order of the photographs at which the object is tried to have moved
NOMINAL = (Role.FOCAL, Role.X0, Role.Y0, Role.RADIAL)
NOMINAL_ERROR = 0.02  # of the half diagonal, at the corner: what nominal values are apart from true ones
SMALL_MOVE_PX = 1.0  # of the corner, in which distortion is linear in its parameters
LENS = (Role.FOCAL, Role.X0, Role.Y0, Role.RADIAL, Role.DECENTRING, Role.AFFINITY)
GROUP = (Role.FOCAL, Role.X0, Role.Y0, Role.RADIAL)


def explain_residuals(found: Adjustment) -> tuple[Explanation, ...]:
    """Return the causes that were tried, what explains most at the lowest price first; empty if all is well.

    Args:
        found: the finished adjustment; its sigma0 says whether there is anything to explain.
    """
    rejected = found.rejected.sum() > MUCH_REJECTED * len(found.rejected)
    conspicuous = bool(rejected or found.sigma0_px > WORTH_A_TRY * found.stated_px)
    network, estimate = found.network, found.estimate
    if not conspicuous and len(found.rejected) > LARGE:
        return ()
    used = _enough_points(network)
    everywhere = np.ones(len(network.images), dtype=bool)
    network, estimate = reduce_network(network, estimate, everywhere, used, np.ones_like(found.rejected))
    groups = _groups(network, estimate)
    if not (conspicuous or groups is not None):
        return ()
    before = _adjusted(network, estimate)[0]
    variance = float(np.trace(found.covariance.points[used], axis1=1, axis2=2).mean())

    def explanation(one: _Cause) -> Explanation:
        moved = _moved(estimate.points, variance, one.estimate)
        return Explanation(one.words, before, one.sigma0_px, moved, one is groups)

    if not conspicuous and not (groups and explanation(groups).explains):
        return ()
    causes = _causes(network, estimate, groups, states=conspicuous)
    tried = [explanation(one) for one in causes if np.isfinite(one.sigma0_px)]
    if not tried:
        return ()
    best = min(one.after_px for one in tried)
    near = [one for one in tried if one.after_px <= NEAR_THE_BEST * best]
    first = next((one for one in near if one.explains), near[0])
    return (first, *(one for one in tried if one is not first))


@dataclass(frozen=True)
class _Cause:
    """A model with more freedom, adjusted."""

    words: str
    sigma0_px: float  # NaN where it could not be adjusted
    estimate: Estimate | None = None  # of the same points; None where there is no single one


def _causes(network: Network, estimate: Estimate, groups: _Cause | None, *, states: bool) -> Iterator[_Cause]:
    """Return the causes with what they leave of the residuals, the simplest first; states take longest."""
    lens = _cameras(estimate.cameras, LENS)
    held = [
        name
        for now, then in zip(estimate.cameras, lens, strict=True)
        for name, newly in zip(now.names, then.free & ~now.free, strict=True)
        if newly
    ]
    if held:
        freed = _adjusted(network, replace(estimate, cameras=lens))
        if freed[1] is not None:
            yield _Cause(f"the camera, with free {', '.join(dict.fromkeys(held))}", *freed)
        elif not any(camera.free.any() for camera in estimate.cameras):
            words = "another camera, near the values at which it is held"
            # where parameters are known by their weights only, steps along the valley are long
            yield _Cause(words, *_adjusted(*_nominal(network, estimate), method="gauss-newton"))
    if groups is not None:
        yield groups
    words = "c of its own for each photograph (a zoom or focus that was not fixed)"
    yield _Cause(words, *_adjusted(*_own_c(network, estimate)))
    if not states:
        return
    splits = range(MIN_BEFORE, len(network.images) - MIN_BEFORE + 1)
    moved = [(_apart(network, estimate, k), k) for k in splits[:: max(1, len(splits) // MAX_SPLITS)]]
    if moved:
        sigma, k = min(moved)
        words = (
            f"two states of the object, one up to {network.images[k - 1]} and one from {network.images[k]} "
            "on (it moved, or was bent)"
        )
        yield _Cause(words, sigma)


def _enough_points(network: Network) -> BoolArray:
    """Return points of about LARGE image points, all of a smaller network, (n,).

    Causes are of photographs and cameras, which a sample of their points tells as well: every so many, and
    all of photographs of few image points and of scale bars.
    """
    seen, every = network.image_points, -(-len(network.image_points) // LARGE)
    used: BoolArray = np.arange(len(network.points)) % every == 0
    few = np.bincount(seen.image, minlength=len(network.images)) < FEW * every
    used[seen.point[few[seen.image]]] = True
    used[network.scale_bars.start] = used[network.scale_bars.end] = True
    return used


def _moved(points: FloatArray, variance: float, other: Estimate | None) -> float:
    """Return how far points are from others, RMS over the root of the variance of X, Y and Z together."""
    if other is None:
        return np.nan
    try:
        apart = fit_similarity(other.points, points).apply(other.points) - points
    except GeometryError:  # points on a line
        return np.nan
    return float(np.sqrt((apart**2).sum(axis=1).mean() / variance)) if variance > 0 else np.nan


def _adjusted(
    network: Network, estimate: Estimate, method: str = "levenberg-marquardt"
) -> tuple[float, Estimate | None]:
    """Return sigma0 of an adjustment that rejects nothing, px, and its values; NaN and None without one."""
    try:
        found = adjust(network, estimate, datum=Datum("free"), reject="none", covariance=False, method=method)
    except (GeometryError, np.linalg.LinAlgError):
        return np.nan, None
    return (found.sigma0_px, found.estimate) if found.converged else (np.nan, None)


def _nominal(network: Network, estimate: Estimate) -> tuple[Network, Estimate]:
    """Return the network with c, x0, y0 and radial distortion known as well as nominal values are."""
    cameras, observed = [], []
    for index, camera in enumerate(estimate.cameras):
        own = camera.plays(*NOMINAL)
        half = float(np.hypot(*camera.size_px)) / 2
        for s in np.flatnonzero(own).tolist():
            value = float(camera.parameters[s])
            observed.append((index, s, value, NOMINAL_ERROR * half * _per_corner_px(camera, s)))
        cameras.append(replace(camera, free=own))
    columns = list(zip(*observed, strict=True))
    interior = InteriorObservations(
        np.array(columns[0], dtype=np.int64),
        np.array(columns[1], dtype=np.int64),
        np.array(columns[2], dtype=float),
        np.array(columns[3], dtype=float),
    )
    return replace(network, interior=interior), replace(estimate, cameras=tuple(cameras))


def _per_corner_px(camera: Camera, s: int) -> float:
    """Return by how much a parameter changes where the corner of the photograph moves by a pixel."""
    corner = np.zeros((1, 2))
    rays = tangents_from_pixel(camera, corner)
    step, moved = 1.0, np.inf
    while not moved < SMALL_MOVE_PX:  # NaN where the model has no inverse so far away
        step /= 10
        p = camera.parameters.copy()
        p[s] += step
        moved = float(np.hypot(*(pixel_from_tangents(camera.with_parameters(p), rays) - corner)[0]))
    return step / moved


def _cameras(cameras: tuple[Camera, ...], roles: tuple[Role, ...]) -> tuple[Camera, ...]:
    """Return the cameras with all parameters of some roles free."""
    return tuple(replace(one, free=one.free | one.plays(*roles)) for one in cameras)


def _own_c(network: Network, estimate: Estimate) -> tuple[Network, Estimate]:
    """Return the network with c of its own for each photograph, all other parameters shared as they are."""
    cameras = []
    for i, index in enumerate(network.camera.tolist()):
        one = estimate.cameras[index]
        own = one.plays(Role.FOCAL)
        shared = tuple("" if mine else (one.group_of(s) or one.name) for s, mine in enumerate(own))
        cameras.append(
            replace(one, name=f"{one.name} {network.images[i]}", free=one.free | own, shared=shared)
        )
    owner = np.arange(len(network.images))
    return replace(network, camera=owner), replace(estimate, cameras=tuple(cameras))


def _groups(network: Network, estimate: Estimate) -> _Cause | None:
    """Return the photographs that seem to be of a second camera, adjusted with one of their own."""
    found = two_groups(network, estimate)
    if found is None:
        return None
    split, start = _split(network, estimate, found.second)
    sigma, adjusted = _adjusted(split, start)
    if adjusted is None:
        return None
    second = int(np.flatnonzero(found.second)[0])
    same = np.flatnonzero((network.camera == network.camera[second]) & ~found.second)
    mine, others = adjusted.cameras[split.camera[second]], adjusted.cameras[split.camera[same[0]]]
    away = float(np.hypot(*(_principal_point_px(mine) - _principal_point_px(others))))
    names = [name for name, one in zip(network.images, found.second, strict=True) if one]
    ratio = 100 * (mine.c_px / others.c_px - 1)
    words = (
        f"two cameras, zooms or states of the lens under one name: {listed(names)} with c {ratio:+.2f} % and "
        f"the principal point {away:.2g} px from that of the others"
    )
    return _Cause(words, sigma, adjusted)


def _principal_point_px(camera: Camera) -> FloatArray:
    """Return the principal point, px, (2,)."""
    return np.asarray(pixel_from_tangents(camera, np.zeros((1, 2)))[0])


def _split(network: Network, estimate: Estimate, second: BoolArray) -> tuple[Network, Estimate]:
    """Return the network with cameras of their own for the photographs of the second group."""
    count = len(estimate.cameras)
    freed = _cameras(estimate.cameras, GROUP)
    again = tuple(
        replace(
            one,
            name=f"{one.name} (second)",
            shared=tuple(f"{group} (second)" if group else "" for group in one.shared),
        )
        for one in freed
    )
    used, owner = np.unique(network.camera + count * second, return_inverse=True)
    every = (*freed, *again)
    cameras = tuple(every[k] for k in used.tolist())
    return replace(network, camera=owner.astype(np.int64)), replace(estimate, cameras=cameras)


def _apart(network: Network, estimate: Estimate, k: int) -> float:
    """Return sigma0 where the photographs before and from the k-th on are two networks by themselves, px."""
    m = len(network.images)
    squares, redundancy = 0.0, 0
    for images in (np.arange(m) < k, np.arange(m) >= k):
        every = np.ones(len(network.image_points), dtype=bool)
        start = replace(estimate, position=np.where(images[:, None], estimate.position, np.nan))
        inside, points = supported(network, start, every, min_points=4, min_rays=2)
        if inside.sum() < 2:
            return float("inf")
        part = reduce_network(network, estimate, inside, points, every)
        held = tuple(replace(one, free=np.zeros_like(one.free)) for one in part[1].cameras)
        try:
            found = adjust(
                part[0], replace(part[1], cameras=held), datum=Datum("free"), reject="none", covariance=False
            )
        except (GeometryError, np.linalg.LinAlgError):
            return float("inf")
        squares += found.sigma0_px**2 * found.redundancy
        redundancy += found.redundancy
    return float(np.sqrt(squares / redundancy)) if redundancy > 0 else float("inf")
