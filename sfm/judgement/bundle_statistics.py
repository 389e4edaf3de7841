"""Statistics and given values of a bundle report, each with its residuals.

Source: the figures are those in the report of DBAT (Boerlin and Grussenmeyer 2013, Photogramm. Record
28(144)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.statistics import (
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
    by_source,
)
from sfm.adjustment.result import Adjustment, computed_once
from sfm.model.conventions import FloatArray
from sfm.model.observation_residuals import CENTRE, ROTATION, GivenResiduals, given_residuals
from sfm.model.observations.control_and_bars import InteriorObservations, ObjectPoints, ScaleBars


@dataclass(frozen=True)
class Spread:
    """Smallest, mean, median and largest of the known values, NaN if none is known."""

    smallest: float
    mean: float
    median: float
    largest: float


@dataclass(frozen=True)
class Statistics:
    """Statistics of a bundle report other than the unknowns and their standard deviations."""

    global_tests: tuple[GlobalTest, ...]  # of all observations, or of each kind if there are several
    w: CoordinateTest  # Baarda's test of every image coordinate
    tau: CoordinateTest  # Pope's
    largest_w: float  # absolute, NaN if none is known
    largest_tau: float
    reliability: Reliability  # internal and external, of every image coordinate
    minimal_bias: Spread  # of the image coordinates, px
    external: Spread  # effect of the minimal bias on an unknown, in standard deviations of the unknown
    redundancy: Spread  # redundancy numbers of the image coordinates
    redundancy_of_image_points: float  # sum of their redundancy numbers
    redundancy_sum: float  # sum of the redundancy numbers of all kinds of observation
    kinds: VarianceComponents  # relative to the stated standard deviations, as are the next three
    sources: VarianceComponents  # of image points
    cameras: VarianceComponents
    photographs: VarianceComponents
    significance: tuple[Significance, ...]
    correlations: tuple[Correlation, ...]  # strong ones between parameters of one camera or one photograph
    camera_correlations: tuple[Correlation, ...]  # those of cameras among them

    @property
    def known(self) -> bool:
        """Return whether redundancy numbers are known, which requires a covariance."""
        return bool(np.isfinite(self.redundancy.largest))

    @property
    def not_significant(self) -> tuple[Significance, ...]:
        """The parameters that do not differ significantly from 0."""
        return tuple(test for test in self.significance if not test.significant)


@computed_once
def statistics_of(adjustment: Adjustment) -> Statistics:
    """Return the statistics of an adjustment with its covariance, relative to its stated standard deviations.

    Each kind of observation is tested separately. A test of all kinds together passes by construction if the
    image points have the weight that their residuals suggest.
    """
    kinds = by_kind(adjustment)
    detectable, pairs = reliability(adjustment), correlations(adjustment)
    w, tau = w_test(adjustment), tau_test(adjustment)
    of_cameras = {
        f"{name} of camera {camera.owner_of(s)}"
        for camera in adjustment.estimate.cameras
        for s, name in enumerate(camera.names)
    }
    return Statistics(
        global_tests=component_tests(kinds, alpha=adjustment.false_alarm, reweighted=adjustment.reweighted)
        if len(kinds.names) > 1
        else (global_test(adjustment),),
        w=w,
        tau=tau,
        largest_w=summarise_redundancy(np.abs(w.statistic)).largest,
        largest_tau=summarise_redundancy(np.abs(tau.statistic)).largest,
        reliability=detectable,
        minimal_bias=summarise_redundancy(detectable.minimal_bias),
        external=summarise_redundancy(detectable.external),
        redundancy=summarise_redundancy(adjustment.redundancy_numbers),
        redundancy_of_image_points=float(np.nansum(adjustment.redundancy_numbers)),
        redundancy_sum=float(kinds.redundancy.sum()),
        kinds=kinds,
        sources=by_source(adjustment),
        cameras=by_camera(adjustment),
        photographs=by_photograph(adjustment),
        significance=significance(adjustment),
        correlations=pairs,
        camera_correlations=tuple(pair for pair in pairs if pair.first in of_cameras),
    )


def summarise_redundancy(values: FloatArray) -> Spread:
    """Return smallest, mean, median and largest known value; infinite if nothing checks an observation."""
    known = values[~np.isnan(values)]
    if not len(known):
        return Spread(np.nan, np.nan, np.nan, np.nan)
    return Spread(float(known.min()), float(np.nanmean(values)), float(np.median(known)), float(known.max()))


@dataclass(frozen=True)
class Given:
    """Given values that took part in addition to the image points, kind by kind."""

    kinds: tuple[GivenResiduals, ...]

    @property
    def control(self) -> GivenResiduals | None:
        """Control points; None without any."""
        return self.of(ObjectPoints.single)

    @property
    def bars(self) -> GivenResiduals | None:
        """Scale bars; None without any."""
        return self.of(ScaleBars.single)

    @property
    def interior(self) -> GivenResiduals | None:
        """Observed parameters of interior orientation; None without any."""
        return self.of(InteriorObservations.single)

    @property
    def further(self) -> tuple[GivenResiduals, ...]:
        """Given values other than control points, scale bars, interior and exterior orientation."""
        others = (ObjectPoints.single, ScaleBars.single, InteriorObservations.single, CENTRE, ROTATION)
        return tuple(kind for kind in self.kinds if kind.kind not in others)

    def of(self, kind: str) -> GivenResiduals | None:
        """Return the residuals of a kind by its singular name; None without any."""
        return next((residuals for residuals in self.kinds if residuals.kind == kind), None)

    @property
    def exterior(self) -> tuple[GivenResiduals, ...]:
        """Projection centres and angles of the photographs with observed exterior orientation."""
        kinds = (kind.observed() for kind in self.kinds if kind.kind in (CENTRE, ROTATION))
        return tuple(kind for kind in kinds if kind is not None)


@computed_once
def given_of(a: Adjustment, length_unit: str) -> Given:
    """Return the residuals of all given values that took part in an adjustment, in its unit of lengths."""
    took_part = {part.index: (part.rows, part.redundancy_numbers, part.standardised) for part in a.observed}
    residuals: list[GivenResiduals] = []
    for index, part in given_residuals(a.network, a.estimate, length_unit, took_part):
        if part.kind == InteriorObservations.single:
            residuals += [part.rows(took_part[index][0])] if index in took_part else []
        elif part.kind != ObjectPoints.single or a.datum == "control":
            residuals.append(part)
    return Given(tuple(residuals))
