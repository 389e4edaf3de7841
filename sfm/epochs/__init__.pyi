"""The public names of `sfm.epochs`, a row each."""

from sfm.epochs.differences import Differences as Differences
from sfm.epochs.differences import Epoch as Epoch
from sfm.epochs.differences import epoch_differences as epoch_differences
from sfm.epochs.displacements import Displacements as Displacements
from sfm.epochs.displacements import find_displacements as find_displacements
from sfm.epochs.series import BlockMotion as BlockMotion
from sfm.epochs.series import EpochSeries as EpochSeries
from sfm.epochs.series import analyse_epochs as analyse_epochs
from sfm.epochs.series import block_motion as block_motion
from sfm.epochs.together import SharedCamera as SharedCamera
from sfm.epochs.together import adjust_together as adjust_together
