"""The public names of `sfm.adjustment`, a row each."""

from sfm.adjustment.covariance import Marginal as Marginal
from sfm.adjustment.covariance import change_datum as change_datum
from sfm.adjustment.covariance import marginal_of as marginal_of
from sfm.adjustment.covariance import with_error_correlation as with_error_correlation
from sfm.adjustment.datum import Datum as Datum
from sfm.adjustment.quality.correlations import estimate_error_correlation as estimate_error_correlation
from sfm.adjustment.quality.correlations import with_neighbours as with_neighbours
from sfm.adjustment.quality.statistics import CoordinateTest as CoordinateTest
from sfm.adjustment.quality.statistics import tau_test as tau_test
from sfm.adjustment.quality.statistics import w_test as w_test
from sfm.adjustment.result import Adjustment as Adjustment
from sfm.adjustment.solve import AdjustmentOptions as AdjustmentOptions
from sfm.adjustment.solve import adjust as adjust
from sfm.adjustment.solve import predict as predict
