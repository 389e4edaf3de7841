"""Orient a whole network from nothing but image points: a start, then photograph by photograph.

The start is control or given approximate values where there are some, else the pair of photographs
whose model most other photographs can be resected on. Planar pairs have two solutions; the one
is taken that the other photographs confirm. After that: resection of every photograph that sees enough
points, intersection of all points, and adjustment by a function of the caller, so that the interior
orientation is learnt while the network grows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.camera import Camera
from sfm.conventions import BoolArray, FloatArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.orientation.growth import FIRST_ADJUSTMENT, Growth, Refine
from sfm.orientation.resection.robust import fewest_fitting
from sfm.orientation.start import Start
from sfm.similarity import fit_similarity

MIN_POINTS = 4  # of a photograph: three are always fitted by P3P, the fourth checks it
START_TOLERANCE = 0.03  # of the photograph's diagonal: what an unknown distortion leaves after resection
FINAL_TOLERANCE_PX = 4.0  # below this no image point is put aside here; the adjustment tests further
GROWTH = 1.25  # the network is adjusted when it has this many times the photographs of last time
MAX_ROUNDS = 200
FINAL_ROUNDS = 3  # of resection, intersection and adjustment of all, while image points come or go


@dataclass(frozen=True)
class Orientation:
    """Approximate values of a whole network and what could not be had."""

    estimate: Estimate  # NaN for photographs and points that are not determined
    failures: tuple[tuple[str, str], ...]  # (name of the photograph, reason)
    pair: tuple[str, str] | None  # photographs it started from; None: from control or given values
    kind: str  # start: spatial | planar | control | given
    fits: BoolArray  # image points within the tolerance, (k,)
    rms_px: float  # over these, per coordinate, px
    tolerance_px: FloatArray  # last tolerance of each camera, px, one per camera


def orient(
    network: Network,
    estimate: Estimate,
    *,
    seed: int = 0,
    refine: Refine | None = None,
    start_tolerance: float = START_TOLERANCE,
    final_tolerance_px: float = FINAL_TOLERANCE_PX,
    min_points: int = MIN_POINTS,
) -> Orientation:
    """Return exterior orientations and points of a network, from its image points.

    Args:
        network: measured facts; image points without a known object point belong out of it.
        estimate: cameras with start values; exterior orientation and points NaN, or given where known.
        seed: of all random choices.
        refine: adjusts a fully determined part of the network (no NaN in it) and returns it adjusted; the
            cameras it is given have as many free parameters as the part can determine. Its result
            is taken only if the image points fit better with it.
        start_tolerance: largest residual at the beginning, as a fraction of the photograph's diagonal.
        final_tolerance_px: the tolerance follows the residuals down to this, px.
        min_points: points that a photograph must share with the network, at least 4.

    Raises:
        GeometryError: no two photographs could be oriented.
    """
    cameras = estimate.cameras
    diagonal = np.array([np.hypot(*camera.size_px) for camera in cameras])
    growth = Growth(network, estimate, seed, start_tolerance * diagonal, max(min_points, MIN_POINTS))
    start = growth.begin()
    adjusted = 0
    for _ in range(MAX_ROUNDS):
        added = growth.resect_next()
        growth.intersect()
        now = int(growth.estimate.oriented.sum())
        if now >= FIRST_ADJUSTMENT and (now >= GROWTH * adjusted or (not added and now > adjusted)):
            growth.refined(refine)
            growth.adapt_tolerance(final_tolerance_px)
            growth.intersect()
            adjusted = now
        elif not added:
            break
    for _ in range(FINAL_ROUNDS):
        growth.adapt_tolerance(final_tolerance_px)
        growth.resect_all()
        growth.intersect()
        if not growth.refined(refine):
            break
    return _finish(growth, start, cameras)


def _finish(growth: Growth, start: Start, cameras: tuple[Camera, ...]) -> Orientation:
    """Bring the network onto control if it started free, drop what does not hold, and report."""
    network, control = growth.network, growth.network.control
    seen = network.image_points
    residuals = growth.residuals_px()
    fits = residuals <= growth.tolerance_px[network.camera[seen.image]]
    count = np.bincount(seen.image[fits], minlength=len(network.images))
    known = growth.estimate.determined[seen.point]
    total = np.bincount(seen.image[known], minlength=len(network.images))
    tolerance = growth.tolerance()
    needed = [
        fewest_fitting(int(n), tolerance[i], growth.field[i], minimum=growth.min_points)
        for i, n in enumerate(total)
    ]
    weak = growth.estimate.oriented & (count < needed)
    for i in np.flatnonzero(weak).tolist():
        growth.reasons[i] = (
            f"only {count[i]} of its {total[i]} points fit the network, {needed[i]} are needed"
        )
    drop = weak[:, None]
    growth.estimate = replace(
        growth.estimate,
        position=np.where(drop, np.nan, growth.estimate.position),
        rotation=np.where(drop[:, :, None], np.nan, growth.estimate.rotation),
    )
    fits &= ~weak[seen.image]
    if growth.estimate.oriented.sum() < 2:
        raise GeometryError(
            f"orientation: {growth.estimate.oriented.sum()} of {len(network.images)} photographs could be "
            "oriented, at least 2 are needed"
        )
    if start.pair is not None and len(control) >= 3:
        known = growth.estimate.determined[control.point]
        if known.sum() >= 3:
            model = growth.estimate.points[control.point[known]]
            growth.estimate = fit_similarity(model, control.xyz[known]).apply_estimate(growth.estimate)
    failures = tuple(
        (network.images[i], growth.reasons.get(int(i), "shares too few points with the others"))
        for i in np.flatnonzero(~growth.estimate.oriented)
    )
    pair = None if start.pair is None else (network.images[start.pair[0]], network.images[start.pair[1]])
    used = residuals[fits]
    rms = float(np.sqrt(np.mean(used**2) / 2)) if len(used) else np.nan
    restored = tuple(
        replace(new, free=old.free) for new, old in zip(growth.estimate.cameras, cameras, strict=True)
    )
    estimate = replace(growth.estimate, cameras=restored)
    return Orientation(estimate, failures, pair, start.kind, fits, rms, growth.tolerance_px)
