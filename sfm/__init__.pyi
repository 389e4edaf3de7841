"""The public names of Kolinear and its rooms, a row each."""

from sfm.adjustment.covariance import change_datum as change_datum
from sfm.adjustment.datum import Datum as Datum
from sfm.adjustment.result import Adjustment as Adjustment
from sfm.api import adjust as adjust
from sfm.api import compare as compare
from sfm.api import distance as distance
from sfm.api import measure as measure
from sfm.api import network_from_colmap as network_from_colmap
from sfm.api import read_result as read_result
from sfm.api import run_survey as run_survey
from sfm.api import write_result as write_result
from sfm.camera import Camera as Camera
from sfm.camera import camera_from_values as camera_from_values
from sfm.camera import project as project
from sfm.errors import KolinearError as KolinearError
from sfm.estimate import Estimate as Estimate
from sfm.geometry.shapes.fit import fit_shape as fit_shape
from sfm.network import Network as Network
from sfm.network import empty_estimate as empty_estimate
from sfm.orientation.incremental.sequence import orient as orient
from sfm.photographs.reading import read_photograph as read_photograph
from sfm.result import SurveyResult as SurveyResult
from sfm.similarity import Similarity as Similarity
from sfm.similarity import fit_similarity as fit_similarity
from sfm.solution import Solution as Solution
from sfm.survey.inputs.exterior_table import ObservedExterior as ObservedExterior
from sfm.survey.inputs.given import KnownPoints as KnownPoints
from sfm.survey.inputs.given import Observations as Observations
from sfm.survey.inputs.given import ScaleBar as ScaleBar
from sfm.survey.inputs.survey import CameraSetup as CameraSetup
from sfm.survey.inputs.survey import Survey as Survey
from sfm.survey.inputs.survey import read_survey as read_survey
from sfm.survey.observation_tables import ObservationTable as ObservationTable
from sfm.targets.detect import Targets as Targets
from sfm.targets.detect import find_targets as find_targets

from . import adjustment as adjustment
from . import camera as camera
from . import comparison as comparison
from . import conventions as conventions
from . import epochs as epochs
from . import geometry as geometry
from . import matching as matching
from . import observations as observations
from . import orientation as orientation
from . import planning as planning
from . import targets as targets
from . import textbook as textbook

__version__: str
