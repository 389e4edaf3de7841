"""Candidates for stations: where one may stand, and where to look from there.

Source: van der Corput, Halton (1960), Numer. Math. 2 (evenly spread positions).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.camera import Camera
from sfm.conventions import FloatArray
from sfm.errors import GeometryError
from sfm.planning.planned_object import PlannedObject, farthest_points
from sfm.planning.sight.visibility import Seeing, Sight, sight_of
from sfm.planning.stations import Stations, filling_distance, looking, rolled

COUNT = 300  # stations that the designer chooses from, each upright and rolled
DISTANCES = (0.75, 1.25)  # of that at which the object fills the photograph, by default
AIMS = 8  # parts of the object that a station may look at, besides its middle
TRIES = 60  # positions tried for each that is wanted, until no room is reported
MIN_POINTS = 4  # points that a candidate must show
BASES = (2, 3, 5)


@dataclass(frozen=True)
class StationLimits:
    """Where one may stand."""

    distance: tuple[float, float] | None = None  # to the nearest point of the object, least and most, object
    # unit; None = as fills the photographs
    space: FloatArray | None = None  # least and largest X, Y, Z of a station, object unit, (2, 3)
    floor: float | None = None  # least Z of a station, object unit


@dataclass(frozen=True)
class Candidates:
    """Stations to choose from: the upright ones, then the same rolled by 90 deg."""

    stations: Stations
    sight: Sight

    @property
    def count(self) -> int:
        """How many different stations there are."""
        return len(self.stations) // 2


def candidates(
    planned: PlannedObject, camera: Camera, allowed: StationLimits, seeing: Seeing, *, count: int = COUNT
) -> Candidates:
    """Return stations that may be taken, spread evenly over the room that is allowed.

    From each place a camera looks at the middle of the object or at the part where it shows most points.

    Args:
        planned: the object.
        camera: interior orientation.
        allowed: where one may stand.
        seeing: what is seen.
        count: stations, each upright and rolled.

    Raises:
        GeometryError: no room, or nothing is seen from where one may stand.
    """
    least, most = _distances(planned, camera, allowed)
    low, high = _room(planned, allowed, most)
    aims = np.concatenate([planned.centre[None], planned.xyz[farthest_points(planned.xyz, AIMS)]])
    sees_all = float(np.linalg.norm(np.array(camera.size_px)) / camera.c_px)
    position, rotation, counted = [], [], 0
    tried = _halton(TRIES * count) * (high - low) + low
    inside = 0
    for place in tried:
        if counted == count:
            break
        away = planned.xyz - place
        nearest = np.linalg.norm(away, axis=1).min()
        if not least <= nearest <= most:
            continue
        inside += 1
        faced = (planned.normals * -away).sum(axis=1) > 0
        faced |= np.isnan(planned.normals[:, 0])
        if faced.sum() < MIN_POINTS:
            continue
        near = planned.size / nearest > sees_all  # the object does not fit in a photograph from here
        aimed_at = np.concatenate([planned.xyz[faced].mean(axis=0)[None], aims]) if near else aims[:1]
        ways = np.array([looking(aim - place) for aim in aimed_at])
        shown = sight_of(planned, camera, np.tile(place, (len(ways), 1)), ways, seeing).seen.sum(axis=1)
        best = int(np.argmax(shown))
        if shown[best] < MIN_POINTS:
            continue
        if near and counted % 2:  # half of them look elsewhere, so that neighbours overlap in several ways
            others = np.flatnonzero(shown >= max(MIN_POINTS, shown[best] / 2))
            best = int(others[counted // 2 % len(others)])
        position.append(place)
        rotation.append(ways[best])
        counted += 1
    if counted < 2:
        raise GeometryError(_no_room(planned, least, most, inside))
    places, ways = np.array(position), np.array(rotation)
    names = tuple(f"{k + 1}" for k in range(2 * counted))
    stations = Stations(names, np.tile(places, (2, 1)), np.concatenate([ways, rolled(ways)]))
    return Candidates(stations, sight_of(planned, camera, stations.position, stations.rotation, seeing))


def _distances(planned: PlannedObject, camera: Camera, allowed: StationLimits) -> tuple[float, float]:
    """Return least and largest distance to the nearest point of the object."""
    if allowed.distance is not None:
        least, most = allowed.distance
        if not 0 < least < most:
            raise GeometryError(f"plan: distances {least:g} to {most:g}, needed 0 < least < most")
        return least, most
    ways = [looking(np.array(way)) for way in ((1.0, 0, 0), (0, 1.0, 0), (0, 0, -1.0), (1.0, 1.0, -1.0))]
    fills = max(filling_distance(planned, camera, R) for R in ways)
    return DISTANCES[0] * fills - planned.size / 2 if fills > planned.size else 0.2 * fills, (
        DISTANCES[1] * fills
    )


def _room(planned: PlannedObject, allowed: StationLimits, most: float) -> tuple[FloatArray, FloatArray]:
    low, high = planned.xyz.min(axis=0) - most, planned.xyz.max(axis=0) + most
    if allowed.space is not None:
        if not (allowed.space[0] < allowed.space[1]).all():
            raise GeometryError("plan: the space to stand in has a side without length, needed X0 < X1")
        low, high = np.maximum(low, allowed.space[0]), np.minimum(high, allowed.space[1])
    if allowed.floor is not None:
        if not np.isfinite(allowed.floor):
            raise GeometryError(f"plan: floor at {allowed.floor:g}, expected a finite number")
        low[2] = max(low[2], allowed.floor)
    if not (low < high).all():
        raise GeometryError(
            f"plan: no room within {most:g} of the object in the space and above the floor that are allowed; "
            "needed a space that reaches to the object"
        )
    return low, high


def _no_room(planned: PlannedObject, least: float, most: float, inside: int) -> str:
    if not inside:
        return (
            f"plan: no station is {least:g} to {most:g} from the object in the space that is allowed; needed "
            "another distance or space"
        )
    return (
        f"plan: of {inside} places that are allowed fewer than 2 show {MIN_POINTS} points; the object faces "
        "away, or is too far, too oblique or not sharp from there"
    )


def _halton(count: int) -> FloatArray:
    """Return evenly spread points of the unit cube, (count, 3)."""
    out = np.zeros((count, 3))
    for axis, base in enumerate(BASES):
        rest, share = np.arange(1, count + 1), 1.0
        while rest.any():
            share /= base
            out[:, axis] += share * (rest % base)
            rest //= base
    return out
