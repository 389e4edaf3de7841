"""The public names of `sfm.products.epochs`, a row each."""

from sfm.products.epochs.differences import Differences as Differences
from sfm.products.epochs.differences import Epoch as Epoch
from sfm.products.epochs.differences import epoch_differences as epoch_differences
from sfm.products.epochs.displacements import Displacements as Displacements
from sfm.products.epochs.displacements import find_displacements as find_displacements
from sfm.products.epochs.series import BlockMotion as BlockMotion
from sfm.products.epochs.series import EpochSeries as EpochSeries
from sfm.products.epochs.series import analyse_epochs as analyse_epochs
from sfm.products.epochs.series import block_motion as block_motion
from sfm.products.epochs.together import SharedCamera as SharedCamera
from sfm.products.epochs.together import adjust_together as adjust_together
