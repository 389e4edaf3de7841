"""The public names of `sfm.products.geometry`, a row each."""

from sfm.products.geometry.alignment import Alignment as Alignment
from sfm.products.geometry.alignment import Nominal as Nominal
from sfm.products.geometry.alignment import align_321 as align_321
from sfm.products.geometry.alignment import align_features as align_features
from sfm.products.geometry.alignment import align_points as align_points
from sfm.products.geometry.measured import Function as Function
from sfm.products.geometry.measured import MeasuredPoints as MeasuredPoints
from sfm.products.geometry.measured import angle_at as angle_at
from sfm.products.geometry.measured import angle_of_directions as angle_of_directions
from sfm.products.geometry.measured import coordinates_in as coordinates_in
from sfm.products.geometry.measured import distance as distance
from sfm.products.geometry.measured import distance_from_axis as distance_from_axis
from sfm.products.geometry.measured import height as height
from sfm.products.geometry.measured import measured_points as measured_points
from sfm.products.geometry.measured import point_function as point_function
from sfm.products.geometry.measured import with_hidden_point as with_hidden_point
from sfm.products.geometry.shapes.fit import ShapeFit as ShapeFit
from sfm.products.geometry.shapes.fit import fit_shape as fit_shape
from sfm.products.geometry.tolerance import Deviations as Deviations
from sfm.products.geometry.tolerance import Mesh as Mesh
from sfm.products.geometry.tolerance import Tolerance as Tolerance
from sfm.products.geometry.tolerance import decide as decide
from sfm.products.geometry.tolerance import deviations_from_mesh as deviations_from_mesh
from sfm.products.geometry.tolerance import deviations_from_points as deviations_from_points
from sfm.products.geometry.tolerance import deviations_from_shape as deviations_from_shape
