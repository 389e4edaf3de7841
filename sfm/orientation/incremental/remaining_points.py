"""Points that no photograph was oriented on: intersected at last, at whatever angle, or named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.orientation.incremental.growth import Growth
from sfm.orientation.intersection import intersect
from sfm.remarks.remark import Remark, remark

PARALLEL_SIGMAS = 4.0  # standard deviations of its angle by which two rays must differ from parallel ones


def intersect_remaining(growth: Growth, *, contradicting: bool) -> tuple[tuple[str, Remark], ...]:
    """Intersect the points that are still missing; return (name, reason) of those that have no place.

    Nothing is oriented on them any more, so that a small angle does no harm: their standard deviations
    show it. Rays that are parallel within their precision, or within the tolerance of the orientation,
    have no point of intersection.

    Args:
        growth: all photographs oriented that can be; gets the points.
        contradicting: whether points whose rays do not meet within the tolerance get a place, too.
    """
    network, estimate = growth.network, growth.estimate
    seen, n = network.image_points, len(network.points)
    missing = ~estimate.determined
    rows = missing[seen.point]
    if not rows.any():
        return _reasons(growth, np.zeros(n, dtype=np.int64), np.zeros(n, dtype=bool))
    oriented = rows & estimate.oriented[seen.image]
    rays = np.bincount(seen.point[oriented], minlength=n)
    uv = np.where(rows[:, None], growth.tangents(), np.nan)
    c = np.array([camera.c_px for camera in estimate.cameras])[network.camera[seen.image]]
    sigma = np.sqrt(np.trace(seen.covariance, axis1=1, axis2=2) / 2) / c
    worst = np.zeros(n)
    np.maximum.at(worst, seen.point[oriented], sigma[oriented])
    points, parallel = estimate.points.copy(), np.zeros(n, dtype=bool)
    tolerance = float(growth.tolerance().max())
    for limit in (tolerance, np.inf) if contradicting else (tolerance,):
        found = intersect(
            uv, seen.image, seen.point, estimate.position, estimate.rotation, n_points=n, tolerance=limit
        )
        # beyond the precision of the rays and what the orientation is known to; False where NaN
        clear = found.angle > np.maximum(PARALLEL_SIGMAS * np.sqrt(2) * worst, tolerance)
        parallel |= np.isfinite(found.angle) & ~clear
        points = np.where((missing & clear & ~np.isfinite(points[:, 0]))[:, None], found.points, points)
    growth.estimate = replace(estimate, points=points)
    return _reasons(growth, rays, parallel)


def _reasons(growth: Growth, rays: np.ndarray, parallel: np.ndarray) -> tuple[tuple[str, Remark], ...]:
    """Say why points have no coordinates, of whose rays so many are from oriented photographs, (n,)."""
    measured = growth.network.rays()
    out = []
    for j in np.flatnonzero(~growth.estimate.determined & (measured > 0)):
        if measured[j] < 2:
            reason = remark("point_with_few_rays", rays=1, needed=2)
        elif rays[j] < 2:
            reason = remark("point_of_lost_photographs", measured=int(measured[j]), needed=2)
        elif parallel[j]:
            reason = remark("point_with_parallel_rays", rays=int(rays[j]))
        else:
            reason = remark("point_with_rays_apart", rays=int(rays[j]))
        out.append((growth.network.points[j], reason))
    return tuple(out)
