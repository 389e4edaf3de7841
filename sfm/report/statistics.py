"""The statistics of a result, gathered once for summary.json, the tables, report.txt and report.html."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.statistics import (
    GLOBAL_ALPHA,
    POWER,
    UNTESTED,
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
from sfm.adjustment.result import Adjustment
from sfm.camera import Camera, camera_families
from sfm.conventions import FloatArray, IntArray
from sfm.result import SurveyResult


@dataclass(frozen=True)
class Statistics:
    """What a bundle report says besides the unknowns and their standard deviations."""

    global_tests: tuple[GlobalTest, ...]  # of all observations, or of each kind where there are several
    w: CoordinateTest  # Baarda's test of every image coordinate
    tau: CoordinateTest  # Pope's
    reliability: Reliability  # internal and external, of every image coordinate
    power: float  # with which the w test finds the minimal detectable bias
    redundancy_sum: float  # of the redundancy numbers of all kinds of observation
    kinds: VarianceComponents
    cameras: VarianceComponents
    photographs: VarianceComponents
    significance: tuple[Significance, ...]
    correlations: tuple[Correlation, ...]


@dataclass(frozen=True)
class InteriorParameter:
    """A parameter of interior orientation as people ask for it: once, whoever shares it."""

    owner: str  # camera, or group of photographs that have it in common
    photographs: int  # how many have it
    name: str
    value: float
    sigma: float  # NaN where it was not adjusted
    unit: str


def statistics_of(result: SurveyResult) -> Statistics:
    """Return the statistics of a result with its covariance, against the standard deviations stated for it.

    Each kind of observation is tested by itself, since a test of all of them together passes by
    construction where the image points have the weight of their own residuals.
    """
    adjustment = result.adjustment
    kinds = by_kind(adjustment)
    return Statistics(
        global_tests=component_tests(kinds, reweighted=adjustment.reweighted)
        if len(kinds.names) > 1
        else (global_test(adjustment),),
        w=w_test(adjustment),
        tau=tau_test(adjustment),
        reliability=reliability(adjustment),
        power=POWER,
        redundancy_sum=float(kinds.redundancy.sum()),
        kinds=kinds,
        cameras=by_camera(adjustment),
        photographs=by_photograph(adjustment),
        significance=significance(adjustment),
        correlations=correlations(adjustment),
    )


def words_of_t(one: InteriorParameter) -> str:
    """Return a parameter over its standard deviation; empty where 0 is no sensible value, as for c."""
    return f"{abs(one.value) / one.sigma:.1f}" if one.sigma > 0 and one.name not in UNTESTED else ""


def words_of_test(test: GlobalTest) -> str:
    """Return what a global test says, the same in every report."""
    if test.passed is None:
        return f"{test.of}: not tested, {test.reason}"
    r = f"{test.redundancy:.1f}".removesuffix(".0")
    side = "better" if test.statistic < test.lower else "worse"
    said = "passed" if test.passed else f"NOT passed, {side} than stated"
    return (
        f"{test.of}: {said}; v'Pv = {test.statistic:.2f}, chi-square of {r} between {test.lower:.2f} and "
        f"{test.upper:.2f} ({100 * (1 - GLOBAL_ALPHA):.0f} %)"
    )


def words_of_weights(result: SurveyResult) -> str:
    """Return which weights the image points have, and what follows for the tests; empty if as stated."""
    factor = result.adjustment.weight_factor
    if factor == 1:
        return ""
    return (
        "Weights: the standard deviations of the image points were multiplied by "
        f"{factor:.3f}, from their own variance component, so that the other kinds of "
        "observation keep those stated for them. A test of all observations together would pass by "
        "construction; each kind is tested against the standard deviations stated for it."
    )


def datum_in_words(adjustment: Adjustment) -> str:
    """Return what carries the datum: its kind, and how many points where they were chosen."""
    points = adjustment.datum_points
    return adjustment.datum if points is None else f"{adjustment.datum} on {int(points.sum())} chosen points"


def interior_parameters(adjustment: Adjustment) -> tuple[InteriorParameter, ...]:
    """Return every parameter of interior orientation once, common ones first, those fixed at 0 left out."""
    network = adjustment.network
    used = np.bincount(network.camera, minlength=len(adjustment.estimate.cameras))
    found: dict[tuple[str, str, int], InteriorParameter] = {}
    for a, camera in enumerate(adjustment.estimate.cameras):
        sigma = parameter_sigmas(adjustment, a)
        for s, name in enumerate(camera.names):
            value = float(camera.parameters[s])
            if not camera.free[s] and value == 0:
                continue
            owner = camera.group_of(s) or camera.name
            key = (owner, name, -1 if camera.group_of(s) else a)
            known = found.get(key)
            count = int(used[a]) + (known.photographs if known else 0)
            found[key] = InteriorParameter(owner, count, name, value, float(sigma[s]), camera.units[s])
    common = {name for name, _ in families(adjustment)}
    return tuple(sorted(found.values(), key=lambda one: one.owner not in common))


def families(adjustment: Adjustment) -> tuple[tuple[str, Camera], ...]:
    """Return the name of each family of cameras that share parameters, and the first camera of it."""
    cameras = adjustment.estimate.cameras
    names, family = camera_families(cameras, adjustment.network.camera)
    return tuple((name, cameras[int(np.argmax(family == f))]) for f, name in enumerate(names))


def family_of_photographs(adjustment: Adjustment) -> IntArray:
    """Return the index of the family of cameras that each photograph was taken with, (m,)."""
    network = adjustment.network
    return camera_families(adjustment.estimate.cameras, network.camera)[1][network.camera]


def parameter_sigmas(adjustment: Adjustment, camera: int) -> FloatArray:
    """Return the standard deviation of each parameter of a camera, NaN for those not adjusted, (p,)."""
    free = np.flatnonzero(adjustment.estimate.cameras[camera].free)
    sigma = np.full(len(adjustment.estimate.cameras[camera].free), np.nan)
    variance = np.diagonal(adjustment.covariance.interior[camera])
    if len(variance):  # a camera without photographs in the network has none
        sigma[free] = np.sqrt(np.where(variance >= 0, variance, np.nan))
    return sigma


def quantiles(values: FloatArray) -> tuple[float, float]:
    """Return median and largest of the known values; infinite where something has no check."""
    known = values[~np.isnan(values)]
    if not len(known):
        return np.nan, np.nan
    return float(np.median(known)), float(known.max())
