"""The public names of `sfm.products.calibration`, a row each."""

from sfm.products.calibration.calibration import Calibration as Calibration
from sfm.products.calibration.calibration import calibrate as calibrate
from sfm.products.calibration.crossvalidation import CrossValidation as CrossValidation
from sfm.products.calibration.crossvalidation import cross_validate as cross_validate
from sfm.products.calibration.models import compare_models as compare_models
from sfm.products.calibration.poses import NextPoses as NextPoses
from sfm.products.calibration.poses import next_poses as next_poses
from sfm.products.calibration.projection import ProjectionUncertainty as ProjectionUncertainty
from sfm.products.calibration.projection import projection_uncertainty as projection_uncertainty
from sfm.products.calibration.splined import SplinedCalibration as SplinedCalibration
from sfm.products.calibration.splined import spline_camera as spline_camera
