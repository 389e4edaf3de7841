"""The public names of `sfm.orientation`, a row each."""

from sfm.model.similarity import AbsoluteOrientation as AbsoluteOrientation
from sfm.model.similarity import orient_absolute as orient_absolute
from sfm.orientation.incremental.sequence import Orientation as Orientation
from sfm.orientation.incremental.sequence import OrientSettings as OrientSettings
from sfm.orientation.incremental.sequence import orient as orient
from sfm.orientation.intersection import Intersection as Intersection
from sfm.orientation.intersection import RayLimits as RayLimits
from sfm.orientation.intersection import intersect as intersect
from sfm.orientation.relative import RelativeOrientation as RelativeOrientation
from sfm.orientation.relative import refine_coplanarity as refine_coplanarity
from sfm.orientation.relative import relative_orientations as relative_orientations
from sfm.orientation.resection.fischler_bolles import leg_quartic as leg_quartic
from sfm.orientation.resection.fischler_bolles import resect_fischler_bolles as resect_fischler_bolles
from sfm.orientation.resection.least_squares import LineFit as LineFit
from sfm.orientation.resection.least_squares import Resection as Resection
from sfm.orientation.resection.least_squares import ResectionSolution as ResectionSolution
from sfm.orientation.resection.least_squares import choose_by_line as choose_by_line
from sfm.orientation.resection.least_squares import resect_least_squares as resect_least_squares
from sfm.orientation.resection.least_squares import tangents_of as tangents_of
from sfm.orientation.resection.ransac import RobustResection as RobustResection
from sfm.orientation.resection.ransac import expected_trials as expected_trials
from sfm.orientation.resection.ransac import resect_robust as resect_robust
