"""Common causes of rejected image points: names that were exchanged, points at a second place.

The test of the adjustment has separated them from the good ones; here they are explained among themselves,
with photographs as adjusted. They take no part in the tests of `alternatives`, which a few of them would
decide.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.5 (alternative hypotheses).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from sfm.adjustment.hypotheses.alternatives import ALPHA
from sfm.adjustment.quality.consistency import intersected
from sfm.adjustment.result import Adjustment
from sfm.camera import project
from sfm.conventions import IntArray
from sfm.distributions import chi2_isf, chi2_sf
from sfm.network import rows_of
from sfm.remarks.remark import Remark, remark

MIN_EXCHANGED = 2  # photographs in which two names are exchanged, from which it is a rule and no accident
MIN_RAYS = 3  # that meet at a second place; two nearly meet wherever they are along an epipolar line
# Variance of a prediction and its measurement over that of the measurement, at most.
MAX_PREDICTION_RATIO = 2.0


@dataclass(frozen=True)
class SecondPlace:
    """A point that some photographs show elsewhere."""

    point: int
    distance: float  # object unit
    over_sigma: float  # the same in standard deviations of the difference
    images: IntArray  # that show it there


def explain_rejections(
    a: Adjustment, *, unit: str = "", bodies: Sequence[Collection[str]] = ()
) -> tuple[Remark, ...]:
    """Return what explains the rejected image points of an adjustment.

    Args:
        a: finished.
        unit: object unit, for the remarks.
        bodies: names of the points of each rigid body, as a plate, that may move against the others.
    """
    if not a.rejected.any() or not a.sigma0 > 0 or a.undetermined:
        return ()
    misnamed = _other_points(a)
    pairs, rest = _exchanged(a, misnamed)
    remarks = [
        remark(
            "names_exchanged",
            first=a.network.points[p],
            second=a.network.points[q],
            photographs=tuple(a.network.images[i] for i in images),
        )
        for (p, q), images in sorted(pairs.items())
    ]
    if rest:
        seen = a.network.image_points
        remarks.append(
            remark(
                "image_points_misnamed",
                count=len(rest),
                photographs=tuple(sorted({a.network.images[seen.image[row]] for row in rest})),
            )
        )
    used = set(rest) | {row for row, q in misnamed.items() if _key(a, row, q) in pairs}
    return (*remarks, *_of_places(a, _second_places(a, used), unit, bodies))


def _other_points(a: Adjustment) -> dict[int, int]:
    """Return the rejected image points that lie where another point is seen, with that point."""
    network, estimate, seen = a.network, a.estimate, a.network.image_points
    rejected = np.flatnonzero(a.rejected)
    tolerance = float(np.sqrt(MAX_PREDICTION_RATIO * chi2_isf(ALPHA, 2))) * a.sigma0_px
    found: dict[int, int] = {}
    for i, rows in enumerate(rows_of(seen.image[rejected], len(network.images))):
        if not len(rows):
            continue
        camera = estimate.cameras[network.camera[i]]
        at = project(camera, estimate.position[i], estimate.rotation[i], estimate.points)
        for row in rejected[rows].tolist():
            away = np.linalg.norm(at - seen.xy[row], axis=1)
            away[seen.point[row]] = np.inf
            q = int(np.nanargmin(away)) if np.isfinite(away).any() else -1
            if q >= 0 and away[q] < tolerance:
                found[row] = q
    return found


def _key(a: Adjustment, row: int, q: int) -> tuple[int, int]:
    p = int(a.network.image_points.point[row])
    return min(p, q), max(p, q)


def _exchanged(a: Adjustment, misnamed: dict[int, int]) -> tuple[dict[tuple[int, int], list[int]], list[int]]:
    """Return the pairs of points exchanged in several photographs, with these, and the other image points."""
    seen = a.network.image_points
    where: dict[tuple[int, int], dict[int, list[int]]] = defaultdict(lambda: defaultdict(list))
    for row, q in misnamed.items():
        where[_key(a, row, q)][int(seen.image[row])].append(row)
    pairs, rest = {}, []
    for key, images in where.items():
        both = [i for i, rows in images.items() if len(rows) == 2]
        if len(both) >= MIN_EXCHANGED:
            pairs[key] = sorted(images)
        else:
            rest += [row for rows in images.values() for row in rows]
    return pairs, rest


def _second_places(a: Adjustment, explained: set[int]) -> list[SecondPlace]:
    """Return the points of which rejected rays meet at another place."""
    seen = a.network.image_points
    left = np.array([row for row in np.flatnonzero(a.rejected).tolist() if row not in explained], dtype=int)
    places = []
    for j in np.unique(seen.point[left]).tolist():
        out = left[seen.point[left] == j]
        kept = np.flatnonzero((seen.point == j) & ~a.rejected)
        if len(out) < MIN_RAYS or len(kept) < 2:
            continue
        X, Q, misfit = intersected(a, out)
        first, Q0, _ = intersected(a, kept)
        if not np.isfinite(misfit) or chi2_sf(misfit, 2 * len(out) - 3) < ALPHA:
            continue
        apart = X - first
        over = float(np.sqrt(apart @ np.linalg.pinv(Q + Q0) @ apart))
        if chi2_sf(over**2, 3) < ALPHA / len(left):
            places.append(SecondPlace(j, float(np.linalg.norm(apart)), over, np.sort(seen.image[out])))
    return places


def _of_places(
    a: Adjustment, places: list[SecondPlace], unit: str, bodies: Sequence[Collection[str]] = ()
) -> list[Remark]:
    """Return a remark on points that moved together at one place in the sequence, and on each other point.

    Most of the points of one of several bodies, and no others, are that body.
    """
    names = a.network.images
    together: dict[int, list[SecondPlace]] = defaultdict(list)
    alone = []
    for one in places:
        others = _kept_images(a, one.point)
        if one.images.min() > others.max() or one.images.max() < others.min():
            together[int(max(one.images.min(), others.min()))].append(one)
        else:
            alone.append(one)
    moved = {start: {a.network.points[one.point] for one in some} for start, some in together.items()}
    of_body = {
        start
        for start, points in moved.items()
        if len(bodies) > 1 and any(points <= set(one) and 2 * len(points) > len(one) for one in bodies)
    }
    remarks = [
        remark(
            "plate_moved" if start in of_body else "points_moved",
            points=tuple(a.network.points[one.point] for one in some),
            distance=(max(one.distance for one in some), unit),
            shift=max(one.over_sigma for one in some),
            wrong=0.0,  # rejected image points do not shift the others
            **{"from": names[start]},
        )
        for start, some in sorted(together.items())
    ]
    return remarks + [
        remark(
            "two_places",
            point=a.network.points[one.point],
            distance=(one.distance, unit),
            sigmas=one.over_sigma,
            photographs=tuple(names[i] for i in one.images),
        )
        for one in alone
    ]


def _kept_images(a: Adjustment, point: int) -> IntArray:
    seen = a.network.image_points
    return np.asarray(seen.image[(seen.point == point) & ~a.rejected])
