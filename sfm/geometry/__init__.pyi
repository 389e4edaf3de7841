"""The public names of `sfm.geometry`, a row each."""

from sfm.geometry.alignment import Alignment as Alignment
from sfm.geometry.alignment import Nominal as Nominal
from sfm.geometry.alignment import align_321 as align_321
from sfm.geometry.alignment import align_features as align_features
from sfm.geometry.alignment import align_points as align_points
from sfm.geometry.measured import Function as Function
from sfm.geometry.measured import MeasuredPoints as MeasuredPoints
from sfm.geometry.measured import angle_at as angle_at
from sfm.geometry.measured import angle_of_directions as angle_of_directions
from sfm.geometry.measured import coordinates_in as coordinates_in
from sfm.geometry.measured import distance as distance
from sfm.geometry.measured import distance_from_axis as distance_from_axis
from sfm.geometry.measured import height as height
from sfm.geometry.measured import measured_points as measured_points
from sfm.geometry.measured import point_function as point_function
from sfm.geometry.measured import with_hidden_point as with_hidden_point
from sfm.geometry.shapes.fit import ShapeFit as ShapeFit
from sfm.geometry.shapes.fit import fit_shape as fit_shape
from sfm.geometry.tolerance import Deviations as Deviations
from sfm.geometry.tolerance import Mesh as Mesh
from sfm.geometry.tolerance import decide as decide
from sfm.geometry.tolerance import deviations_from_mesh as deviations_from_mesh
from sfm.geometry.tolerance import deviations_from_points as deviations_from_points
from sfm.geometry.tolerance import deviations_from_shape as deviations_from_shape
