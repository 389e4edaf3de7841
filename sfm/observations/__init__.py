"""Kinds of observations beside image points, one in each module; `kind` has what they share.

A kind that a survey gives as a table is one module and one row of TABLES. The adjustment, its tests and
variance components, the survey file, the tables and the reports take everything they need from there.
"""

from __future__ import annotations

from sfm.observations.antenna_positions import AntennaPositions
from sfm.observations.coordinate_differences import CoordinateDifferences
from sfm.observations.distances import Distances
from sfm.observations.height_differences import HeightDifferences
from sfm.observations.horizontal_directions import HorizontalDirections
from sfm.observations.kind import TableKind
from sfm.observations.level_groups import LevelGroups
from sfm.observations.offset_distances import OffsetDistances
from sfm.observations.planes import Planes
from sfm.observations.plumb_lines import Lines, PlumbLines
from sfm.observations.relative_orientations import RelativeOrientations
from sfm.observations.rigid_frames import RigidFrames
from sfm.observations.zenith_angles import ZenithAngles

TABLES: dict[str, type[TableKind]] = {  # by the word of the survey file
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
