"""What explains residuals that are larger than expected: obvious causes, tried on the finished network.

Each cause is a model with more freedom, adjusted from the result with all image points: the rejection has
taken away what shows the cause. The simplest one that comes near the best is told.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.camera import Camera
from sfm.conventions import BoolArray
from sfm.display import listed
from sfm.distortion.models import Role
from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.reduced_network import reduce_network, supported
from sfm.result import Explanation

MUCH_REJECTED = 0.05  # share of rejected image points from which causes are looked for, too
WORTH_A_TRY = 1.5  # sigma0 over the expected one from which causes are looked for
NEAR_THE_BEST = 1.25  # of the least sigma0: what is simpler and reaches this is preferred
MIN_IN_GROUP = 3  # photographs that can show that the object moved before or behind them
MAX_SPLITS = 12  # places in the order of the photographs at which the object is tried to have moved
LENS = (Role.FOCAL, Role.X0, Role.Y0, Role.RADIAL, Role.DECENTRING, Role.AFFINITY)
GROUP = (Role.FOCAL, Role.X0, Role.Y0, Role.RADIAL)


def explain_residuals(found: Adjustment) -> tuple[Explanation, ...]:
    """Return the causes that were tried, what explains most at the lowest price first; empty if all is well.

    Args:
        found: the finished adjustment; its sigma0 says whether there is anything to explain.
    """
    rejected = found.rejected.sum() > MUCH_REJECTED * len(found.rejected)
    if not (rejected or found.sigma0_px > WORTH_A_TRY * found.stated_px):
        return ()
    network, estimate = found.network, found.estimate
    before = _sigma0(network, estimate)
    tried = [Explanation(words, before, after) for words, after in _causes(network, estimate)]
    tried = [one for one in tried if np.isfinite(one.after_px)]
    if not tried:
        return ()
    best = min(one.after_px for one in tried)
    first = next(one for one in tried if one.after_px <= NEAR_THE_BEST * best)
    return (first, *(one for one in tried if one is not first))


def _causes(network: Network, estimate: Estimate) -> Iterator[tuple[str, float]]:
    """Return what each cause is called, and sigma0 with it, px; the simplest first."""
    lens = _cameras(estimate.cameras, LENS)
    held = [
        name
        for now, then in zip(estimate.cameras, lens, strict=True)
        for name, newly in zip(now.names, then.free & ~now.free, strict=True)
        if newly
    ]
    if held:
        freed = ", ".join(dict.fromkeys(held))
        yield f"the camera, with free {freed}", _sigma0(network, replace(estimate, cameras=lens))
    variants = _own_c(network, estimate)
    sigma, adjusted = _adjusted(*variants)
    if adjusted is not None:
        groups = _two_groups(network, adjusted)
        if groups is not None:
            yield _words_of_groups(network, groups, adjusted), _sigma0(*_split(network, estimate, groups))
        yield "c of its own for each photograph (a zoom or focus that was not fixed)", sigma
    splits = range(MIN_IN_GROUP, len(network.images) - MIN_IN_GROUP + 1)
    moved = [(_apart(network, estimate, k), k) for k in splits[:: max(1, len(splits) // MAX_SPLITS)]]
    if moved:
        sigma, k = min(moved)
        yield (
            (
                f"two states of the object, one up to {network.images[k - 1]} and one from "
                f"{network.images[k]} on "
                "(it moved, or was bent)"
            ),
            sigma,
        )


def _sigma0(network: Network, estimate: Estimate) -> float:
    """Return sigma0 of an adjustment that rejects nothing, px; NaN where it cannot be had."""
    return _adjusted(network, estimate)[0]


def _adjusted(network: Network, estimate: Estimate) -> tuple[float, Estimate | None]:
    try:
        found = adjust(network, estimate, datum=Datum("free"), reject="none", covariance=False)
    except (GeometryError, np.linalg.LinAlgError):
        return np.nan, None
    return (found.sigma0_px, found.estimate) if found.converged else (np.nan, None)


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


def _two_groups(network: Network, adjusted: Estimate) -> BoolArray | None:
    """Return which photographs belong to the second of two groups by their c, None without, (m,)."""
    c = np.array([adjusted.cameras[index].c_px for index in range(len(network.images))])
    order = np.argsort(c)
    gap = np.diff(c[order])
    if len(c) < 2 * MIN_IN_GROUP:
        return None
    inner = gap[MIN_IN_GROUP - 1 : len(c) - MIN_IN_GROUP]
    if not len(inner):
        return None
    at = MIN_IN_GROUP - 1 + int(np.argmax(inner))
    return np.asarray(c > (c[order[at]] + c[order[at + 1]]) / 2)


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


def _words_of_groups(network: Network, second: BoolArray, adjusted: Estimate) -> str:
    """Say who is in the smaller group and how far its c is from that of the others."""
    smaller = second if second.sum() <= len(second) / 2 else ~second
    names = [name for name, one in zip(network.images, smaller, strict=True) if one]
    c = np.array([adjusted.cameras[index].c_px for index in range(len(network.images))])
    ratio = float(np.median(c[smaller]) / np.median(c[~smaller]) - 1)
    return f"two cameras or zooms under one name: {listed(names)} with c {100 * ratio:+.1f} %"


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
