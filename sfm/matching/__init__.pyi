"""The public names of `sfm.matching`, a row each."""

from sfm.matching.conjugate import match_points as match_points
from sfm.matching.conjugate_patches import ConjugatePoints as ConjugatePoints
from sfm.matching.correlation import NccMatches as NccMatches
from sfm.matching.correlation import match_ncc as match_ncc
from sfm.matching.epipolar import epipolar_paths as epipolar_paths
from sfm.matching.lsm.two_photo import LsmMatches as LsmMatches
from sfm.matching.lsm.two_photo import match_lsm as match_lsm
from sfm.matching.radiometry import LinearRadiometry as LinearRadiometry
from sfm.matching.radiometry import Radiometry as Radiometry
from sfm.matching.radiometry import equalise_histogram as equalise_histogram
from sfm.matching.radiometry import fit_radiometry as fit_radiometry
from sfm.matching.radiometry import histogram as histogram
from sfm.matching.radiometry import match_brightness as match_brightness
from sfm.matching.radiometry import radiometry_of as radiometry_of
from sfm.matching.tracks.correspondence import Correspondences as Correspondences
from sfm.matching.tracks.correspondence import match_targets as match_targets
from sfm.matching.tracks.feature_tracks import TiePoints as TiePoints
from sfm.matching.tracks.feature_tracks import find_tie_points as find_tie_points
from sfm.matching.tracks.interest import InterestPoints as InterestPoints
from sfm.matching.tracks.interest import NaturalPoints as NaturalPoints
from sfm.matching.tracks.interest import foerstner_points as foerstner_points
from sfm.matching.tracks.interest import natural_points as natural_points
from sfm.runtime.sampling import resample as resample
