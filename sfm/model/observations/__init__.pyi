"""The public names of `sfm.model.observations`, a row each."""

from sfm.model.observations.control_and_bars import InteriorObservations as InteriorObservations
from sfm.model.observations.control_and_bars import ObjectPoints as ObjectPoints
from sfm.model.observations.control_and_bars import ScaleBars as ScaleBars
from sfm.model.observations.kind import Block as Block
from sfm.model.observations.kind import Group as Group
from sfm.model.observations.kind import Kind as Kind
from sfm.model.observations.kind import Linear as Linear
from sfm.model.observations.kind import RowKind as RowKind
from sfm.model.observations.kind import TableKind as TableKind
from sfm.model.observations.kind import Values as Values
from sfm.model.observations.planes_and_lines import LevelGroups as LevelGroups
from sfm.model.observations.planes_and_lines import Lines as Lines
from sfm.model.observations.planes_and_lines import Planes as Planes
from sfm.model.observations.planes_and_lines import PlumbLines as PlumbLines
from sfm.model.observations.point_pairs import CoordinateDifferences as CoordinateDifferences
from sfm.model.observations.point_pairs import Distances as Distances
from sfm.model.observations.point_pairs import HeightDifferences as HeightDifferences
from sfm.model.observations.point_pairs import HorizontalDirections as HorizontalDirections
from sfm.model.observations.point_pairs import OffsetDistances as OffsetDistances
from sfm.model.observations.point_pairs import PointPairs as PointPairs
from sfm.model.observations.point_pairs import ZenithAngles as ZenithAngles
from sfm.model.observations.pose import AntennaPositions as AntennaPositions
from sfm.model.observations.pose import ExteriorObservations as ExteriorObservations
from sfm.model.observations.pose import MountObservations as MountObservations
from sfm.model.observations.pose import RelativeOrientations as RelativeOrientations
from sfm.model.observations.rigid_frames import RigidFrames as RigidFrames
