"""Common causes of rejected image points: exchanged names, and points at a second position.

The test of the adjustment has separated these image points from the good ones. They are explained on their
own, with the adjusted photographs, and take no part in the tests of alternatives, which a few would dominate.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sfm.adjustment.quality.consistency import intersect_rays
from sfm.adjustment.result import Adjustment
from sfm.model.camera import Camera, project, rays_from_pixel
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.distributions import chi2_isf, chi2_sf
from sfm.model.network import rows_of
from sfm.model.remarks.remark import Remark, remark

MIN_EXCHANGED = 2  # photographs with two names exchanged from which this is systematic, not accidental
MIN_RAYS = 3  # rays that meet at a second position; two nearly meet anywhere along an epipolar line
# Largest ratio of the variance of a prediction plus its measurement to that of the measurement.
MAX_PREDICTION_RATIO = 2.0
MAX_WIDENING = 2.0  # of the angle to pixels around one, in other directions than along rows and columns
ROUNDING = 1e-9  # of angles between groups of points, rad, whose points are tested on their own
GROUP = 100  # points near one another, that are passed over together where a photograph shows something else


@dataclass(frozen=True)
class SecondPlace:
    """A point that some photographs show at another position."""

    point: int
    distance: float  # between both positions, object unit
    over_sigma: float  # the same in standard deviations of the difference
    images: IntArray  # photographs that show it there


def explain_rejections(a: Adjustment, *, unit: str = "") -> tuple[Remark, ...]:
    """Return remarks that explain the rejected image points of a finished adjustment."""
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
    return (*remarks, *_of_places(a, _second_places(a, used), unit))


def _other_points(a: Adjustment) -> dict[int, int]:
    """Return the rejected image points that lie where another point is expected, with that point."""
    network, estimate, seen = a.network, a.estimate, a.network.image_points
    rejected = np.flatnonzero(a.rejected)
    tolerance = float(np.sqrt(MAX_PREDICTION_RATIO * chi2_isf(a.levels.family, 2))) * a.sigma0_px
    groups = _Groups.of(estimate.points)
    nearest: dict[int, int] = {}
    for i, rows in enumerate(rows_of(seen.image[rejected], len(network.images))):
        camera, position, rotation = (
            estimate.cameras[network.camera[i]],
            estimate.position[i],
            estimate.rotation[i],
        )
        for row in rejected[rows].tolist():
            ray, chord = _reach(camera, seen.xy[row], tolerance)
            near = groups.within(position, rotation @ ray, chord)
            near = near[near != seen.point[row]]
            at = project(camera, position, rotation, estimate.points[near])
            away = np.linalg.norm(at - seen.xy[row], axis=1)
            q = int(np.nanargmin(away)) if np.isfinite(away).any() else -1
            if q >= 0 and away[q] < tolerance:
                nearest[row] = int(near[q])
    return nearest


def _reach(camera: Camera, xy: FloatArray, tolerance: float) -> tuple[FloatArray, float]:
    """Return the direction of a pixel, and the chord to directions that may be seen within a distance of it.

    They are within the angle to the pixels around it, which lenses change little over a few pixels.

    Args:
        camera: interior orientation.
        xy: the pixel, px, (2,).
        tolerance: the distance, px.

    Returns:
        Unit vector in the image frame, (3,), and the chord between unit vectors, not finite where the lens
        has no direction for a pixel.
    """
    around = np.concatenate([np.zeros((1, 2)), *(tolerance * np.array([np.eye(2), -np.eye(2)]))])
    rays = rays_from_pixel(camera, xy + around)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays[0], float(MAX_WIDENING * np.linalg.norm(rays[1:] - rays[0], axis=1).max())


@dataclass(frozen=True)
class _Groups:
    """Object points in groups of near ones, each inside a sphere.

    A photograph shows few of the points of a large network near a pixel. Turning all of them into each
    photograph takes longer than the adjustment.
    """

    points: FloatArray  # (n, 3)
    members: list[IntArray]  # of each of g groups; points that are not finite are in none
    centre: FloatArray  # (g, 3)
    radius: FloatArray  # (g,)

    @classmethod
    def of(cls, points: FloatArray) -> _Groups:
        """Return points in groups of up to `GROUP`."""
        finite = np.flatnonzero(np.isfinite(points).all(axis=1))
        left = [cKDTree(points[finite], leafsize=GROUP).tree] if len(finite) else []
        members = list[IntArray]()
        while left:
            node = left.pop()
            if node.split_dim < 0:
                members.append(finite[node.indices])
            else:
                left += [node.lesser, node.greater]
        centre = np.array([points[rows].mean(axis=0) for rows in members]).reshape(-1, 3)
        radius = np.array(
            [
                np.linalg.norm(points[rows] - middle, axis=1).max()
                for rows, middle in zip(members, centre, strict=True)
            ]
        )
        return cls(points, members, centre, radius)

    def within(self, position: FloatArray, direction: FloatArray, chord: float) -> IntArray:
        """Return the points whose directions from a place are within a chord of a direction, in their order.

        Args:
            position: the place, object unit, (3,).
            direction: unit vector in the object frame, (3,).
            chord: between unit vectors; all points are returned if it is not finite.
        """
        if not np.isfinite(chord):
            return np.arange(len(self.points))
        outward = self.centre - position
        distance = np.linalg.norm(outward, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            away = np.linalg.norm(outward / distance[:, None] - direction, axis=1)
            half_seen = np.arcsin(np.minimum(self.radius / distance, 1.0))  # angle of a sphere, rad
        # a place inside a sphere sees its points in any direction
        hit = (distance <= self.radius) | (_angle(away) <= _angle(chord) + half_seen + ROUNDING)
        near = np.sort(np.concatenate([self.members[g] for g in np.flatnonzero(hit)] or [np.arange(0)]))
        outward = self.points[near] - position
        with np.errstate(divide="ignore", invalid="ignore"):
            outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        return np.asarray(near[np.linalg.norm(outward - direction, axis=1) <= chord])


def _angle(chord: FloatArray | float) -> FloatArray:
    """Return the angle between unit vectors, rad, from the chord between them."""
    return np.asarray(2 * np.arcsin(np.minimum(np.asarray(chord) / 2, 1.0)))


def _key(a: Adjustment, row: int, q: int) -> tuple[int, int]:
    p = int(a.network.image_points.point[row])
    return min(p, q), max(p, q)


def _exchanged(a: Adjustment, misnamed: dict[int, int]) -> tuple[dict[tuple[int, int], list[int]], list[int]]:
    """Return the point pairs exchanged in several photographs, with these, and the remaining image points."""
    seen = a.network.image_points
    where: dict[tuple[int, int], dict[int, list[int]]] = defaultdict(lambda: defaultdict(list))
    for row, q in misnamed.items():
        where[_key(a, row, q)][int(seen.image[row])].append(row)
    pairs, rest = {}, []
    for key, images in where.items():
        with_both = [i for i, rows in images.items() if len(rows) == 2]
        if len(with_both) >= MIN_EXCHANGED:
            pairs[key] = sorted(images)
        else:
            rest += [row for rows in images.values() for row in rows]
    return pairs, rest


def _second_places(a: Adjustment, explained: set[int]) -> list[SecondPlace]:
    """Return the points with rejected rays that meet at another position."""
    seen, n = a.network.image_points, len(a.network.points)
    left = np.array([row for row in np.flatnonzero(a.rejected).tolist() if row not in explained], dtype=int)
    several = np.bincount(seen.point[left], minlength=n) >= MIN_RAYS
    accepted = np.flatnonzero(~a.rejected & several[seen.point])
    out_of, kept_of = rows_of(seen.point[left], n), rows_of(seen.point[accepted], n)
    places = []
    for j in np.flatnonzero(several).tolist():
        out, kept = left[out_of[j]], accepted[kept_of[j]]
        if len(kept) < 2:
            continue
        X, Q, misfit = intersect_rays(a, out)
        first, Q0, _ = intersect_rays(a, kept)
        if not np.isfinite(misfit) or chi2_sf(misfit, 2 * len(out) - 3) < a.levels.family:
            continue
        apart = X - first
        over = float(np.sqrt(apart @ np.linalg.pinv(Q + Q0) @ apart))
        if chi2_sf(over**2, 3) < a.levels.family / len(left):
            places.append(SecondPlace(j, float(np.linalg.norm(apart)), over, np.sort(seen.image[out])))
    return places


def _of_places(a: Adjustment, places: list[SecondPlace], unit: str) -> list[Remark]:
    """Return remarks on points that moved together at one photograph, and on each other point."""
    names, seen = a.network.images, a.network.image_points
    together: dict[int, list[SecondPlace]] = defaultdict(list)
    alone = []
    accepted = np.flatnonzero(~a.rejected & np.isin(seen.point, [place.point for place in places]))
    kept_of = rows_of(seen.point[accepted], len(a.network.points))
    for place in places:
        others = seen.image[accepted[kept_of[place.point]]]
        if place.images.min() > others.max() or place.images.max() < others.min():
            together[int(max(place.images.min(), others.min()))].append(place)
        else:
            alone.append(place)
    moved = [
        remark(
            "points_moved",
            points=tuple(a.network.points[place.point] for place in moved_together),
            distance=(max(place.distance for place in moved_together), unit),
            shift=max(place.over_sigma for place in moved_together),
            wrong=0.0,  # rejected image points do not shift the others
            **{"from": names[start]},
        )
        for start, moved_together in sorted(together.items())
    ]
    elsewhere = [
        remark(
            "two_places",
            point=a.network.points[place.point],
            distance=(place.distance, unit),
            sigmas=place.over_sigma,
            photographs=tuple(names[i] for i in place.images),
        )
        for place in alone
    ]
    return moved + elsewhere
