"""Measured points that are not part of a result: which, how many image points they had, and why."""

from __future__ import annotations

import numpy as np

from sfm.conventions import BoolArray, IntArray
from sfm.network import Network
from sfm.remarks.remark import Remark, remark
from sfm.result import LeftOutPoint


def left_out_points(
    whole: Network,
    in_result: tuple[str, ...],
    *,
    reasons: tuple[tuple[str, Remark], ...],
    accepted_rays: IntArray,
    needed: IntArray,
) -> tuple[LeftOutPoint, ...]:
    """Return the measured points of a network that a result lacks, each with the reason.

    Args:
        whole: everything that was measured.
        in_result: names of the points of the result.
        reasons: (name, reason) of points for which the orientation found no coordinates.
        accepted_rays: accepted rays of each point when it left, (n,).
        needed: rays that each point needs, (n,).
    """
    told, rays = dict(reasons), whole.rays()
    kept = set(in_result)
    out = []
    for j, name in enumerate(whole.points):
        if name in kept or not rays[j]:
            continue
        if rays[j] < needed[j]:
            reason = remark("point_with_few_rays", rays=int(rays[j]), needed=int(needed[j]))
        elif name in told:
            reason = told[name]
        elif accepted_rays[j] >= needed[j]:
            reason = remark("point_of_lost_photographs", measured=int(rays[j]), needed=int(needed[j]))
        else:
            reason = remark(
                "point_with_rays_rejected",
                accepted=int(accepted_rays[j]),
                measured=int(rays[j]),
                needed=int(needed[j]),
            )
        out.append(LeftOutPoint(name, int(rays[j]), reason))
    return tuple(out)


def unused_image_points(whole: Network, images: BoolArray, points: BoolArray) -> int:
    """Return how many image points are of photographs (m,) or points (n,) that are not in the result."""
    seen = whole.image_points
    return int((~(images[seen.image] & points[seen.point])).sum())


def remarks_on_left_out(left_out: tuple[LeftOutPoint, ...], measured: int) -> tuple[Remark, ...]:
    """Return which of so many measured points are not in the result: contradicted, or just not determined."""
    groups = {
        "points_contradicted": [one.point for one in left_out if one.reason.severity != "note"],
        "points_not_determined": [one.point for one in left_out if one.reason.severity == "note"],
    }
    return tuple(remark(kind, points=names, measured=measured) for kind, names in groups.items() if names)


def datum_carriers(angles_deg: np.ndarray, least_deg: float) -> BoolArray | None:
    """Return the points that carry a free datum, None for all.

    A point far away at a small angle is a long and soft lever on which position, attitude and scale of
    all the others would hang.

    Args:
        angles_deg: largest angle between two rays of each point, NaN with fewer than two, deg, (n,).
        least_deg: smallest of a point that carries the datum, deg.
    """
    weak = angles_deg < least_deg
    return None if not weak.any() or 2 * weak.sum() > len(weak) else np.asarray(~weak)
