"""The public names of `sfm.observations`, a row each."""

from sfm.observations.control_and_bars import InteriorObservations as InteriorObservations
from sfm.observations.control_and_bars import ObjectPoints as ObjectPoints
from sfm.observations.control_and_bars import ScaleBars as ScaleBars
from sfm.observations.kind import Block as Block
from sfm.observations.kind import Group as Group
from sfm.observations.kind import Kind as Kind
from sfm.observations.kind import Linear as Linear
from sfm.observations.kind import RowKind as RowKind
from sfm.observations.kind import TableKind as TableKind
from sfm.observations.kind import Values as Values
from sfm.observations.planes_and_lines import LevelGroups as LevelGroups
from sfm.observations.planes_and_lines import Lines as Lines
from sfm.observations.planes_and_lines import Planes as Planes
from sfm.observations.planes_and_lines import PlumbLines as PlumbLines
from sfm.observations.point_pairs import CoordinateDifferences as CoordinateDifferences
from sfm.observations.point_pairs import Distances as Distances
from sfm.observations.point_pairs import HeightDifferences as HeightDifferences
from sfm.observations.point_pairs import HorizontalDirections as HorizontalDirections
from sfm.observations.point_pairs import OffsetDistances as OffsetDistances
from sfm.observations.point_pairs import PointPairs as PointPairs
from sfm.observations.point_pairs import ZenithAngles as ZenithAngles
from sfm.observations.pose import AntennaPositions as AntennaPositions
from sfm.observations.pose import ExteriorObservations as ExteriorObservations
from sfm.observations.pose import MountObservations as MountObservations
from sfm.observations.pose import RelativeOrientations as RelativeOrientations
from sfm.observations.rigid_frames import RigidFrames as RigidFrames
