"""The public names of Kolinear and its rooms, a row each."""

from sfm.adjustment.covariance import change_datum as change_datum
from sfm.adjustment.datum import Datum as Datum
from sfm.adjustment.result import Adjustment as Adjustment
from sfm.adjustment.solve import AdjustmentOptions as AdjustmentOptions
from sfm.judgement.survey_result import SurveyResult as SurveyResult
from sfm.library.results import adjust as adjust
from sfm.library.results import compare as compare
from sfm.library.results import distance as distance
from sfm.library.results import measure as measure
from sfm.library.results import network_from_colmap as network_from_colmap
from sfm.library.results import read_cameras as read_cameras
from sfm.library.results import read_result as read_result
from sfm.library.results import write_cameras as write_cameras
from sfm.library.surveys import run_survey as run_survey
from sfm.library.surveys import write_result as write_result
from sfm.model import camera as camera
from sfm.model import conventions as conventions
from sfm.model import observations as observations
from sfm.model.camera import Camera as Camera
from sfm.model.camera import camera_from_values as camera_from_values
from sfm.model.camera import project as project
from sfm.model.camera_file import CameraFile as CameraFile
from sfm.model.errors import KolinearError as KolinearError
from sfm.model.estimate import Estimate as Estimate
from sfm.model.network import Network as Network
from sfm.model.network import empty_estimate as empty_estimate
from sfm.model.similarity import Similarity as Similarity
from sfm.model.similarity import fit_similarity as fit_similarity
from sfm.model.solution import Solution as Solution
from sfm.orientation.incremental.sequence import OrientSettings as OrientSettings
from sfm.orientation.incremental.sequence import orient as orient
from sfm.photographs.reading import read_photograph as read_photograph
from sfm.products import calibration as calibration
from sfm.products import epochs as epochs
from sfm.products import geometry as geometry
from sfm.products import planning as planning
from sfm.products.geometry.shapes.fit import fit_shape as fit_shape
from sfm.survey.inputs.exterior_table import ObservedExterior as ObservedExterior
from sfm.survey.inputs.given_values import KnownPoints as KnownPoints
from sfm.survey.inputs.given_values import Observations as Observations
from sfm.survey.inputs.given_values import ScaleBar as ScaleBar
from sfm.survey.inputs.survey import CameraSetup as CameraSetup
from sfm.survey.inputs.survey import Survey as Survey
from sfm.survey.inputs.survey import read_survey as read_survey
from sfm.survey.observation_tables import ObservationTable as ObservationTable
from sfm.targets.detect import Targets as Targets
from sfm.targets.detect import find_targets as find_targets

from . import adjustment as adjustment
from . import comparison as comparison
from . import matching as matching
from . import orientation as orientation
from . import targets as targets
from . import textbook as textbook

__version__: str
