"""Statistics, geometry and given values of a bundle report, each with its residuals.

The geometry of an adjusted network consists of rays and intersection angles of points, and of the coverage of
photographs. Only accepted image points count.

Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 7.1 (network design: rays, intersection
angles, full format). The figures are those in the report of DBAT (Boerlin and Grussenmeyer 2013,
Photogramm. Record 28(144)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.correlations import observed_part
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
from sfm.judgement.calibrated_cameras import families, family_of_photographs
from sfm.judgement.checks import rms_of_groups
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.network import rows_of
from sfm.model.observation_residuals import CENTRE, ROTATION, GivenResiduals, given_residuals
from sfm.model.observations.control_and_bars import InteriorObservations, ObjectPoints, ScaleBars
from sfm.orientation.image_rays import ray_angles

WEAK_DEG = 10.0  # below this angle a point is eleven times less precise along its rays than across


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
class Coverage:
    """The part of its photographs that a camera's image points cover."""

    camera: str
    hull: FloatArray  # area of their convex hull over that of the photograph, for each photograph, (p,)
    hull_of_all: float  # the same for the image points of all photographs together
    radius: FloatArray  # largest distance from the centre over half the diagonal, for each photograph, (p,)


@dataclass(frozen=True)
class Geometry:
    """Rays, angles, coverage and residuals; NaN if not known."""

    rays: IntArray  # of each point, (n,)
    angle_deg: FloatArray  # largest angle between two rays of each point, 0 parallel to 90, deg, (n,)
    point_rms_px: FloatArray  # root mean square residual per coordinate of each point, px, (n,)
    image_rms_px: FloatArray  # root mean square residual per coordinate of each photograph, px, (m,)
    hull: FloatArray  # part of each photograph within the convex hull of its image points, (m,)
    coverage: tuple[Coverage, ...]  # of each camera that took photographs
    image_points: IntArray  # accepted image points of each photograph, (m,)

    @property
    def weak(self) -> IntArray:
        """Points whose rays meet at a small angle, smallest angle first."""
        order = np.argsort(self.angle_deg, kind="stable")
        return order[self.angle_deg[order] < WEAK_DEG]

    def histogram(self) -> tuple[tuple[int, int], ...]:
        """Return pairs of a number of rays and the number of points with that many rays."""
        values, counts = np.unique(self.rays, return_counts=True)
        return tuple(zip(values.tolist(), counts.tolist(), strict=True))


def geometry_of(adjustment: Adjustment) -> Geometry:
    """Return the geometry of an adjusted network."""
    network = adjustment.network
    m, n = len(network.images), len(network.points)
    used = network.image_points.select(~adjustment.rejected)
    size = np.array([adjustment.estimate.cameras[a].size_px for a in network.camera], dtype=float)[used.image]
    scaled = (used.xy - (size - 1) / 2) / size  # -1/2 to 1/2 in both axes
    radius = np.linalg.norm(scaled * size, axis=1) / (np.linalg.norm(size, axis=1) / 2)
    of_images = rows_of(used.image, m)
    hull = np.array([hull_area(scaled[rows]) for rows in of_images])
    farthest = np.array([radius[rows].max(initial=0.0) for rows in of_images])
    family = family_of_photographs(adjustment)
    coverage = tuple(
        Coverage(name, hull[family == f], hull_area(scaled[family[used.image] == f]), farthest[family == f])
        for f, (name, _) in enumerate(families(adjustment))
        if (family == f).any()
    )
    v = adjustment.residuals[~adjustment.rejected]
    image_rms, point_rms = rms_of_groups(used.image, v, m), rms_of_groups(used.point, v, n)
    rays, image_points = np.bincount(used.point, minlength=n), np.bincount(used.image, minlength=m)
    angle = ray_angles(adjustment.network, adjustment.estimate, ~adjustment.rejected)
    return Geometry(rays, angle, point_rms, image_rms, hull, coverage, image_points)


def hull_area(xy: FloatArray) -> float:
    """Return the area of the convex hull of points (k, 2), 0 if they lie on a line."""
    return observed_part(xy, np.zeros((0, 2)))[0]


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
