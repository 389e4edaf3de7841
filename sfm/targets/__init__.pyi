"""The public names of `sfm.targets`, a row each."""

from sfm.targets.detect import Targets as Targets
from sfm.targets.detect import find_targets as find_targets
from sfm.targets.fits.centroid import EdgeEllipses as EdgeEllipses
from sfm.targets.fits.centroid import measure_edge_ellipses as measure_edge_ellipses
