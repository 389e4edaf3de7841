"""The public names of `sfm.products.planning`, a row each."""

from sfm.products.planning.designer import Design as Design
from sfm.products.planning.designer import StationLimits as StationLimits
from sfm.products.planning.designer import design_network as design_network
from sfm.products.planning.plan import Further as Further
from sfm.products.planning.plan import further_photographs as further_photographs
from sfm.products.planning.planned_object import BoxTree as BoxTree
from sfm.products.planning.planned_object import PlannedObject as PlannedObject
from sfm.products.planning.planned_object import box_tree as box_tree
from sfm.products.planning.planned_object import hidden_points as hidden_points
from sfm.products.planning.planned_object import object_of_mesh as object_of_mesh
from sfm.products.planning.planned_object import object_of_points as object_of_points
from sfm.products.planning.planned_object import shape_object as shape_object
from sfm.products.planning.prediction import Prediction as Prediction
from sfm.products.planning.prediction import ScaleBarPlan as ScaleBarPlan
from sfm.products.planning.prediction import WantedPrecision as WantedPrecision
from sfm.products.planning.prediction import predict_network as predict_network
from sfm.products.planning.stations import Stations as Stations
from sfm.products.planning.stations import arrangement as arrangement
from sfm.products.planning.stations import choose_coded as choose_coded
from sfm.products.planning.visibility import DepthOfField as DepthOfField
from sfm.products.planning.visibility import Lens as Lens
from sfm.products.planning.visibility import Seeing as Seeing
from sfm.products.planning.visibility import Sight as Sight
from sfm.products.planning.visibility import TargetImage as TargetImage
from sfm.products.planning.visibility import TargetSize as TargetSize
from sfm.products.planning.visibility import centre_covariance as centre_covariance
from sfm.products.planning.visibility import compute_target_size as compute_target_size
from sfm.products.planning.visibility import depth_of_field as depth_of_field
from sfm.products.planning.visibility import sight_of as sight_of
from sfm.products.planning.weakness import Calibratability as Calibratability
from sfm.products.planning.weakness import calibratability as calibratability

MIN_PIXELS: float
