"""The public names of `sfm.planning`, a row each."""

from sfm.planning.designer import Design as Design
from sfm.planning.designer import StationLimits as StationLimits
from sfm.planning.designer import design_network as design_network
from sfm.planning.plan import Further as Further
from sfm.planning.plan import further_photographs as further_photographs
from sfm.planning.planned_object import BoxTree as BoxTree
from sfm.planning.planned_object import PlannedObject as PlannedObject
from sfm.planning.planned_object import box_tree as box_tree
from sfm.planning.planned_object import hidden_points as hidden_points
from sfm.planning.planned_object import object_of_mesh as object_of_mesh
from sfm.planning.planned_object import object_of_points as object_of_points
from sfm.planning.planned_object import shape_object as shape_object
from sfm.planning.prediction import Prediction as Prediction
from sfm.planning.prediction import ScaleBarPlan as ScaleBarPlan
from sfm.planning.prediction import WantedPrecision as WantedPrecision
from sfm.planning.prediction import predict_network as predict_network
from sfm.planning.stations import Stations as Stations
from sfm.planning.stations import arrangement as arrangement
from sfm.planning.stations import choose_coded as choose_coded
from sfm.planning.visibility import DepthOfField as DepthOfField
from sfm.planning.visibility import Lens as Lens
from sfm.planning.visibility import Seeing as Seeing
from sfm.planning.visibility import Sight as Sight
from sfm.planning.visibility import TargetImage as TargetImage
from sfm.planning.visibility import TargetSize as TargetSize
from sfm.planning.visibility import centre_covariance as centre_covariance
from sfm.planning.visibility import compute_target_size as compute_target_size
from sfm.planning.visibility import depth_of_field as depth_of_field
from sfm.planning.visibility import sight_of as sight_of
from sfm.planning.weakness import Calibratability as Calibratability
from sfm.planning.weakness import calibratability as calibratability

MIN_PIXELS: float
