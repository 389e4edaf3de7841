"""The list of photographs that a plan asks for, and the coded targets that each of them needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.planning.sight.optics import best_focus
from sfm.planning.stations import Stations

MIN_CODED_TARGETS = 5  # targets in every photograph, by which it is oriented by resection


@dataclass(frozen=True)
class Shot:
    """A photograph to be taken."""

    station: str
    position: FloatArray  # object unit, (3,)
    azimuth_deg: float  # of the direction in which the camera looks, from +X towards +Y
    elevation_deg: float  # of the same, down is negative
    roll_deg: float  # counter-clockwise about it; 0 = upright
    distance: float  # mean along the axis of the points that it shows, object unit
    focus: float  # of the lens, one for all photographs, object unit
    points: int  # that it shows
    coded: int  # of them coded


def shots(
    xyz: FloatArray, stations: Stations, seen: BoolArray, coded: IntArray, *, focus: float | None = None
) -> tuple[Shot, ...]:
    """Return the list of photographs of a plan.

    They have one focus, as they have one calibration: another focus is another principal distance.

    Args:
        xyz: points, object unit, (n, 3).
        stations: of the m photographs.
        seen: which photograph shows which point, (m, n).
        coded: which points are coded targets, see `choose_coded`.
        focus: distance in focus, object unit; None = as sharp at the nearest point as at the farthest.
    """
    found = []
    if focus is None:
        depth = np.concatenate(
            [(stations.position[i] - xyz[seen[i]]) @ stations.rotation[i, :, 2] for i in range(len(stations))]
        )
        focus = best_focus(float(depth.min()), float(depth.max())) if len(depth) else float("nan")
    for i, name in enumerate(stations.names):
        R, X0 = stations.rotation[i], stations.position[i]
        axis = -R[:, 2]
        depth = (xyz[seen[i]] - X0) @ axis
        found.append(
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
    return tuple(found)


def roll_deg(rotation: FloatArray) -> float:
    """Return by how much a camera is rolled about its axis, deg, -180 to 180; 0 where image x is horizontal.

    Of a camera that looks straight down or up, the roll is that of image x against X.
    """
    level = np.cross([0.0, 0.0, 1.0], rotation[:, 2])
    if np.linalg.norm(level) < 1e-6:
        level = np.array([1.0, 0.0, 0.0])
    up = np.cross(rotation[:, 2], level)
    # + 0.0: no roll of -0.0
    return float(np.round(np.degrees(np.arctan2(rotation[:, 0] @ up, rotation[:, 0] @ level)), 9) + 0.0)


@checked_arguments(seen="m n")
def choose_coded(seen: BoolArray, *, per_photograph: int = MIN_CODED_TARGETS) -> IntArray:
    """Return few points which, as coded targets, give every photograph so many, or all that it shows.

    The point that most photographs still lack comes first.

    Args:
        seen: which photograph shows which point, (m, n).
        per_photograph: coded targets in each.

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
