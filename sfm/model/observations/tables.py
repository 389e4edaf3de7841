"""The kinds of observations that a survey gives as tables, by the name in the survey file.

A kind is one class and one row here. The adjustment, its tests and variance components, the survey file, the
tables and the reports get everything they need from the class.
"""

from __future__ import annotations

from sfm.model.observations.kind import TableKind
from sfm.model.observations.planes_and_lines import LevelGroups, Lines, Planes, PlumbLines
from sfm.model.observations.point_pairs import (
    CoordinateDifferences,
    Distances,
    HeightDifferences,
    HorizontalDirections,
    OffsetDistances,
    ZenithAngles,
)
from sfm.model.observations.pose import AntennaPositions, RelativeOrientations
from sfm.model.observations.rigid_frames import RigidFrames

TABLES: dict[str, type[TableKind]] = {  # by the name used in the survey file
    "distance": Distances,
    "distance with additive constant": OffsetDistances,
    "height difference": HeightDifferences,
    "coordinate difference": CoordinateDifferences,
    "zenith angle": ZenithAngles,
    "antenna position": AntennaPositions,
    "relative orientation": RelativeOrientations,
    "horizontal direction": HorizontalDirections,
    "plane": Planes,
    "line": Lines,
    "plumb line": PlumbLines,
    "level": LevelGroups,
    "rigid frame": RigidFrames,
}
