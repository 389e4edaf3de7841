"""The statistics of a bundle report: tests, reliability, variance components, significance, correlations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.statistics import (
    POWER,
    CoordinateTest,
    Correlation,
    GlobalTest,
    Reliability,
    Significance,
    component_tests,
    correlations,
    global_test,
    reliability,
    significance,
    tau_test,
    w_test,
)
from sfm.adjustment.quality.variance_components import (
    VarianceComponents,
    by_camera,
    by_kind,
    by_photograph,
)
from sfm.conventions import FloatArray
from sfm.result import SurveyResult


@dataclass(frozen=True)
class Spread:
    """Smallest, mean, median and largest of the values known, NaN without any."""

    smallest: float
    mean: float
    median: float
    largest: float


@dataclass(frozen=True)
class Statistics:
    """Statistics of a bundle report besides the unknowns and their standard deviations."""

    global_tests: tuple[GlobalTest, ...]  # of all observations, or of each kind where there are several
    w: CoordinateTest  # Baarda's test of every image coordinate
    tau: CoordinateTest  # Pope's
    largest_w: float  # absolute, NaN where none is known
    largest_tau: float
    reliability: Reliability  # internal and external, of every image coordinate
    power: float  # with which the w test finds the minimal detectable bias
    minimal_bias: Spread  # of the image coordinates, px
    external: Spread  # effect of the same on an unknown, in its standard deviations
    redundancy: Spread  # redundancy numbers of the image coordinates
    redundancy_of_image_points: float  # sum of the same
    redundancy_sum: float  # of the redundancy numbers of all kinds of observation
    kinds: VarianceComponents  # over the standard deviations stated, as the next two
    cameras: VarianceComponents
    photographs: VarianceComponents
    significance: tuple[Significance, ...]
    correlations: tuple[Correlation, ...]  # strong ones of parameters of one camera or one photograph
    camera_correlations: tuple[Correlation, ...]  # of them, those of cameras

    @property
    def known(self) -> bool:
        """Whether there are redundancy numbers, as there are with a covariance."""
        return bool(np.isfinite(self.redundancy.largest))

    @property
    def not_significant(self) -> tuple[Significance, ...]:
        """The parameters that do not differ significantly from 0."""
        return tuple(test for test in self.significance if not test.significant)


def statistics_of(result: SurveyResult) -> Statistics:
    """Return the statistics of a result with its covariance, against the standard deviations stated for it.

    Each kind of observation is tested by itself, since a test of all of them together passes by
    construction where the image points have the weight that their residuals give.
    """
    adjustment = result.adjustment
    kinds = by_kind(adjustment)
    found, w, tau, pairs = (
        reliability(adjustment),
        w_test(adjustment),
        tau_test(adjustment),
        correlations(adjustment),
    )
    of_cameras = {
        f"{name} of camera {camera.owner_of(s)}"
        for camera in adjustment.estimate.cameras
        for s, name in enumerate(camera.names)
    }
    return Statistics(
        global_tests=component_tests(kinds, reweighted=adjustment.reweighted)
        if len(kinds.names) > 1
        else (global_test(adjustment),),
        w=w,
        tau=tau,
        largest_w=spread(np.abs(w.statistic)).largest,
        largest_tau=spread(np.abs(tau.statistic)).largest,
        reliability=found,
        power=POWER,
        minimal_bias=spread(found.minimal_bias),
        external=spread(found.external),
        redundancy=spread(adjustment.redundancy_numbers),
        redundancy_of_image_points=float(np.nansum(adjustment.redundancy_numbers)),
        redundancy_sum=float(kinds.redundancy.sum()),
        kinds=kinds,
        cameras=by_camera(adjustment),
        photographs=by_photograph(adjustment),
        significance=significance(adjustment),
        correlations=pairs,
        camera_correlations=tuple(pair for pair in pairs if pair.first in of_cameras),
    )


def spread(values: FloatArray) -> Spread:
    """Return smallest, mean, median and largest of the known values; infinite where nothing checks them."""
    known = values[~np.isnan(values)]
    if not len(known):
        return Spread(np.nan, np.nan, np.nan, np.nan)
    return Spread(float(known.min()), float(np.nanmean(values)), float(np.median(known)), float(known.max()))
