"""The public names of `sfm.targets`, a row each."""

from sfm.targets.detect import Targets as Targets
from sfm.targets.detect import find_targets as find_targets
from sfm.targets.fits.edge_ellipse import EdgeEllipses as EdgeEllipses
from sfm.targets.fits.edge_ellipse import measure_edge_ellipses as measure_edge_ellipses
