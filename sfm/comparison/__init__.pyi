"""The public names of `sfm.comparison`, a row each."""

from sfm.comparison.camera_difference import CameraDifference as CameraDifference
from sfm.comparison.camera_difference import compare_cameras as compare_cameras
from sfm.comparison.significance import ResultComparison as ResultComparison
from sfm.comparison.significance import compare_results as compare_results
from sfm.comparison.solutions import Comparison as Comparison
from sfm.comparison.solutions import compare as compare
from sfm.comparison.stable_points import Candidates as Candidates
from sfm.comparison.stable_points import StablePoints as StablePoints
from sfm.comparison.stable_points import find_stable_points as find_stable_points
from sfm.comparison.stable_points import robust_weights as robust_weights
