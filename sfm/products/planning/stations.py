"""Stations of a plan: well-known arrangements, and the photographs to take from each station.

Source: document 000, sec. 2.5.2, text and figures (designs left-right and front-back of V-STARS, four
stations after Fraser); Fraser (1984), Photogramm. Eng. Remote Sens. 50(8) (convergent networks).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import Mounts
from sfm.products.planning.planned_object import PlannedObject
from sfm.products.planning.visibility import best_focus

MIN_CODED_TARGETS = 5  # in every photograph, for its orientation by resection
FILLING = 0.9  # share of the format that the object fills
RING_ELEVATION_DEG = 40.0
TWO_RINGS_DEG = (25.0, 60.0)
CONVERGENCE_DEG = 40.0  # angle to the axis of four stations, and of the designs of document 000
ARRANGEMENTS = {
    "ring": "COUNT: around the object, 40 deg above it",
    "two-rings": "COUNT: half of them 25 and half 60 deg above it",
    "hemisphere": "COUNT: spread over the half sphere above it",
    "strips": "COLUMNSxROWS: parallel views of its largest face",
    "four-stations": "four convergent stations about the axis of its largest face (Fraser)",
    "left-right": "left and right of that axis, two photographs each",
    "front-back": "in front of it and behind it, left and right, two photographs each",
}


@dataclass(frozen=True)
class Stations:
    """Exterior orientation of planned photographs."""

    names: tuple[str, ...]
    position: FloatArray  # projection centres, object unit, (m, 3)
    rotation: FloatArray  # R, image to object axes, (m, 3, 3)
    rig: Mounts | None = None  # mounts of the cameras at each station, see `with_rig`
    taken_by: IntArray | None = None  # camera index of each photograph, (m,); None for a single camera
    taken_at: IntArray | None = None  # moment of each photograph of a rig, (m,)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def camera(self) -> IntArray:
        """Index of the camera of each photograph, (m,)."""
        return np.zeros(len(self), dtype=np.int64) if self.taken_by is None else self.taken_by

    def of(self, which: AnyArray) -> Stations:
        """Return the selected stations, in this order."""
        return Stations(
            tuple(self.names[i] for i in which),
            self.position[which],
            self.rotation[which],
            self.rig,
            None if self.taken_by is None else self.taken_by[which],
            None if self.taken_at is None else self.taken_at[which],
        )

    def renamed(self) -> Stations:
        """Return the stations with consecutive numbers as names."""
        return replace(self, names=_numbered(len(self)))

    def with_rig(self, rig: Mounts, cameras: Sequence[Camera]) -> Stations:
        """Return the photographs of all cameras of a rig, with its reference camera at the stations.

        Args:
            rig: mounts of the cameras.
            cameras: cameras of the rig; their names precede those of the stations.
        """
        m, a = len(self), len(cameras)
        of, at = np.tile(np.arange(a), m), np.repeat(np.arange(m), a)
        R = self.rotation[at]
        return Stations(
            tuple(f"{camera.name}-{name}" for name in self.names for camera in cameras),
            self.position[at] + np.einsum("mab,mb->ma", R, rig.position[of]),
            R @ rig.rotation[of],
            rig,
            of,
            at,
        )

    @property
    def places(self) -> int:
        """Number of different projection centres."""
        return len(np.unique(np.round(self.position, 9), axis=0))


@checked_arguments()
def arrangement(text: str, planned: PlannedObject, camera: Camera) -> Stations:
    """Return the stations of an arrangement, at distances at which the object fills the photographs.

    Every second photograph is rolled by 90 degrees.

    Args:
        text: such as "ring:12", "strips:5x2" or "four-stations"; see ARRANGEMENTS.
        planned: the object.
        camera: camera of the photographs.

    Raises:
        GeometryError: an unknown arrangement, or an impossible number.

    Source: document 000, sec. 2.5.2, figures 2.12 to 2.15.
    """
    kind, _, number = text.partition(":")
    if kind not in ARRANGEMENTS:
        raise GeometryError(f"arrangement '{text:.40}', expected one of {', '.join(ARRANGEMENTS)}")
    if kind == "strips":
        return _strips(text, number, planned, camera)
    axis, right, up = object_axes(planned)
    if kind in ("four-stations", "left-right", "front-back"):
        if number:
            raise GeometryError(f"arrangement '{text:.40}': {kind} has no number")
        tilt = np.radians(CONVERGENCE_DEG)
        if kind == "four-stations":
            turned = np.pi / 4 + np.pi / 2 * np.arange(4)
            sideways = np.cos(turned)[:, None] * right + np.sin(turned)[:, None] * up
        else:
            sideways = np.repeat([-right, right], 2, axis=0)
        away = np.cos(tilt) * axis + np.sin(tilt) * sideways
        if kind == "front-back":
            away = np.concatenate([away, -np.cos(tilt) * axis + np.sin(tilt) * sideways])
        return around(planned, camera, away)
    count = int(number) if number.isdecimal() and len(number) < 5 else 0
    if count < 3:
        raise GeometryError(f"arrangement '{text:.40}': needed {kind}:COUNT with a count of 3 or more")
    if kind == "hemisphere":
        k = np.arange(count)
        elevation = np.arcsin((k + 0.5) / count)
        azimuth = np.pi * (3 - np.sqrt(5)) * k
    else:
        rings = np.radians(TWO_RINGS_DEG if kind == "two-rings" else (RING_ELEVATION_DEG,))
        elevation = rings[np.arange(count) % len(rings)]
        azimuth = 2 * np.pi * np.arange(count) / count
    flat = np.cos(elevation)
    away = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    return around(planned, camera, away)


def around(planned: PlannedObject, camera: Camera, away: FloatArray) -> Stations:
    """Return stations in given directions that look at the middle of an object, which fills the format.

    Args:
        planned: the object.
        camera: camera of the photographs.
        away: directions from the object to the stations, (m, 3).
    """
    rolls = np.pi / 2 * (np.arange(len(away)) % 2)
    away = away / np.linalg.norm(away, axis=1, keepdims=True)
    rotation = np.array([aim_camera(-a, roll) for a, roll in zip(away, rolls, strict=True)])
    distance = np.array([filling_distance(planned, camera, R) for R in rotation])
    return Stations(_numbered(len(away)), planned.centre + distance[:, None] * away, rotation)


def filling_distance(planned: PlannedObject, camera: Camera, rotation: FloatArray) -> float:
    """Return the distance from the middle of an object at which it fills the format, object unit.

    Args:
        planned: the object.
        camera: camera of the photograph.
        rotation: R of the photograph, image to object axes, (3, 3).
    """
    half = np.array(camera.size_px) / 2 / camera.c_px * FILLING
    local = (planned.xyz - planned.centre) @ rotation
    return float((np.abs(local[:, :2]) / half + local[:, 2:]).max())


def aim_camera(direction: FloatArray, roll: float = 0.0) -> FloatArray:
    """Return R of a camera that looks along a direction; with roll 0 the x axis of the image is horizontal.

    Args:
        direction: viewing direction, (3,).
        roll: counter-clockwise rotation about this direction, rad.
    """
    z = -direction / np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0], z)
    if np.linalg.norm(right) < 1e-9:  # straight down: x of the image along X
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    x = np.cos(roll) * right + np.sin(roll) * np.cross(z, right)
    return np.column_stack([x, np.cross(z, x), z])


def roll_rotations(rotation: FloatArray) -> FloatArray:
    """Return the rotations, (..., 3, 3), rolled by 90 degrees."""
    return np.stack([rotation[..., 1], -rotation[..., 0], rotation[..., 2]], axis=-1)


def object_axes(planned: PlannedObject) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the main direction that an object faces, and its right and up directions for a viewer.

    This is the mean of the normals. If these cancel or are unknown, it is the direction of least extent.
    """
    known = planned.normals[~np.isnan(planned.normals).any(axis=1)]
    mean = known.mean(axis=0) if len(known) else np.zeros(3)
    if np.linalg.norm(mean) < 0.5:
        away = planned.xyz - planned.xyz.mean(axis=0)
        axis = np.linalg.svd(away, full_matrices=False)[2][2]
        if axis @ mean < 0 or (np.linalg.norm(mean) < 1e-9 and axis[np.argmax(np.abs(axis))] < 0):
            axis = -axis
    else:
        axis = mean / np.linalg.norm(mean)
    R = aim_camera(-axis)
    return axis, R[:, 0], R[:, 1]


def _strips(text: str, number: str, planned: PlannedObject, camera: Camera) -> Stations:
    columns, _, rows = number.partition("x")
    if not all(part.isdecimal() and len(part) < 4 and int(part) > 0 for part in (columns, rows)):
        raise GeometryError(f"arrangement '{text:.40}': needed strips:COLUMNSxROWS, such as strips:5x2")
    axis, right, up = object_axes(planned)
    a, b = int(columns), int(rows)
    local = (planned.xyz - planned.centre) @ np.stack([right, up, axis], axis=1)
    low, high = local.min(axis=0), local.max(axis=0)
    # the photographs overlap: each shows a part of the object three steps wide
    part = np.ptp(local[:, :2], axis=0) * np.minimum(1.0, 3 / (np.array([a, b]) + 2))
    half = np.array(camera.size_px) / 2 / camera.c_px * FILLING
    distances = np.array([(part / 2 / h).max() for h in (half, half[::-1])]) + high[2]  # upright, rolled
    places = [
        [
            (low[0] + high[0]) / 2 + (high[0] - low[0] - part[0]) * ((i / (a - 1) if a > 1 else 0.5) - 0.5),
            (low[1] + high[1]) / 2 + (high[1] - low[1] - part[1]) * ((j / (b - 1) if b > 1 else 0.5) - 0.5),
        ]
        for j in range(b)
        for i in range(a)
    ]
    rolls = np.array([(i + j) % 2 for j in range(b) for i in range(a)])
    position = planned.centre + np.array(places) @ np.stack([right, up]) + distances[rolls][:, None] * axis
    rotation = np.array([aim_camera(-axis, np.pi / 2 * roll) for roll in rolls])
    return Stations(_numbered(a * b), position, rotation)


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(f"S{k + 1:0{len(str(count))}d}" for k in range(count))


@dataclass(frozen=True)
class Shot:
    """A photograph to take."""

    station: str
    position: FloatArray  # object unit, (3,)
    azimuth_deg: float  # of the viewing direction, from +X towards +Y
    elevation_deg: float  # of the viewing direction, negative downwards
    roll_deg: float  # counter-clockwise about the viewing direction; 0 = upright
    distance: float  # mean distance along the axis of the points that it shows, object unit
    focus: float  # focus distance of the lens, the same for all photographs, object unit
    points: int  # number of points that it shows
    coded: int  # number of coded points among them


def shots(
    xyz: FloatArray, stations: Stations, seen: BoolArray, coded: IntArray, *, focus: float | None = None
) -> tuple[Shot, ...]:
    """Return the list of photographs of a plan.

    All photographs have one focus, since they have one calibration: another focus changes the principal
    distance.

    Args:
        xyz: points, object unit, (n, 3).
        stations: stations of the m photographs.
        seen: which photograph shows which point, (m, n).
        coded: indices of the coded targets, see `choose_coded`.
        focus: focus distance, object unit; None = equally sharp at the nearest and the farthest point.
    """
    photographs = []
    if focus is None:
        depth = np.concatenate(
            [(stations.position[i] - xyz[seen[i]]) @ stations.rotation[i, :, 2] for i in range(len(stations))]
        )
        focus = best_focus(float(depth.min()), float(depth.max())) if len(depth) else float("nan")
    for i, name in enumerate(stations.names):
        R, X0 = stations.rotation[i], stations.position[i]
        axis = -R[:, 2]
        depth = (xyz[seen[i]] - X0) @ axis
        photographs.append(
            Shot(
                name,
                X0,
                float(np.round(np.degrees(np.arctan2(axis[1], axis[0])), 9) + 0.0),
                float(np.degrees(np.arcsin(np.clip(axis[2], -1, 1)))),
                roll_deg(R),
                float(depth.mean()) if len(depth) else np.nan,
                focus,
                len(depth),
                int(seen[i, coded].sum()),
            )
        )
    return tuple(photographs)


def roll_deg(rotation: FloatArray) -> float:
    """Return the roll of a camera about its axis, deg, -180 to 180; 0 if image x is horizontal.

    If a camera looks straight down or up, its roll is the angle of image x against X.

    Args:
        rotation: R of the camera, image to object axes, (3, 3).
    """
    level = np.cross([0.0, 0.0, 1.0], rotation[:, 2])
    if np.linalg.norm(level) < 1e-6:
        level = np.array([1.0, 0.0, 0.0])
    up = np.cross(rotation[:, 2], level)
    # + 0.0 turns -0.0 into 0.0
    return float(np.round(np.degrees(np.arctan2(rotation[:, 0] @ up, rotation[:, 0] @ level)), 9) + 0.0)


@checked_arguments(seen="m n")
def choose_coded(seen: BoolArray, *, per_photograph: int = MIN_CODED_TARGETS) -> IntArray:
    """Return few points that, as coded targets, give every photograph enough of them, or all that it shows.

    The point that most photographs still need is chosen first.

    Args:
        seen: which photograph shows which point, (m, n).
        per_photograph: number of coded targets in each photograph.

    Source: Chvatal (1979), Math. Oper. Res. 4(3) (greedy covering).
    """
    lack = np.minimum(per_photograph, seen.sum(axis=1))
    chosen: list[int] = []
    free = np.ones(seen.shape[1], dtype=bool)
    while (lack > 0).any():
        helps = np.where(free, seen[lack > 0].sum(axis=0), -1)
        best = int(np.argmax(helps))
        chosen.append(best)
        free[best] = False
        lack = lack - (seen[:, best] & (lack > 0))
    return np.array(sorted(chosen), dtype=np.int64)
