"""Statistics of a finished adjustment: redundancy numbers, tests, minimal detectable bias.

Global test of the model, tests of the image coordinates, their minimal detectable bias and external
reliability, significance of parameters, strong correlations.

Redundancy numbers, standardised residuals and the tests of Baarda and Pope.

    R = Q_vv P (redundancy numbers on its diagonal; their sum is the redundancy),
    w = (P v)_i / sqrt(sigma0'^2 (P Q_vv P)_ii)     with sigma0' a priori: Baarda's w ~ N(0, 1),
    tau = the same with sigma0 a posteriori:         Pope's tau ~ tau(r).

Source: Baarda (1968), A testing procedure for use in geodetic networks; Pope (1976), NOAA TR NOS 65 NGS 1;
Luhmann et al., Close-Range Photogrammetry (2020), sec. 2.4; Foerstner and Wrobel (2016), sec. 4.6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sfm.adjustment.engine.cofactors import Cofactors
from sfm.adjustment.engine.iterate import Optimum
from sfm.adjustment.engine.observed import ObservedKind, Reduced, reduced_rows
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.adjustment.quality.variance_components import IMAGE_POINTS, VarianceComponents
from sfm.adjustment.result import Adjustment, ObservedResiduals
from sfm.arguments import checked_arguments
from sfm.camera import Camera
from sfm.conventions import MAD_TO_SIGMA, BoolArray, FloatArray, IntArray
from sfm.distortion.models import MODELS
from sfm.distributions import binomial_sf, chi2_ppf, nct_parameter, normal_ppf, poisson_sf, t_ppf, t_sf
from sfm.errors import GeometryError

ALPHA = 0.001  # Baarda's usual probability of rejecting a good observation
MIN_EXCESS_RATIO = 2.0  # coordinates beyond the critical value over those expected by chance
GLOBAL_ALPHA = 0.05  # of the global test and of the significance of parameters
POWER = 0.8  # and of finding a gross error of the minimal detectable size
MIN_REPORTED_CORRELATION = 0.9  # correlation from which two parameters are reported
Untested = Literal["redundancy", "reweighted"]  # too small; the weights come from the residuals


@dataclass(frozen=True)
class GlobalTest:
    """Test of stated standard deviations against the residuals by the chi-square distribution."""

    of: str  # all observations, or a kind of them
    statistic: float  # v'Pv with the standard deviations stated
    redundancy: float
    lower: float  # acceptance region of v'Pv
    upper: float
    passed: bool | None  # None where it was not tested
    untested: Untested | None = None  # why it was not tested


@dataclass(frozen=True)
class CoordinateTest:
    """Test of every accepted image coordinate for a gross error."""

    alpha: float  # probability of rejecting a good one
    critical: float
    statistic: FloatArray  # w or tau of each coordinate; NaN where rejected, (k, 2)
    tested: int  # coordinates that have a check
    beyond: int  # of them, those beyond the critical value

    @property
    def expected(self) -> float:
        """How many would be beyond the critical value by chance."""
        return self.alpha * self.tested

    @property
    def far_more(self) -> bool:
        """Whether far more are beyond it: MIN_EXCESS_RATIO times as many, by chance once in 1 / ALPHA."""
        return bool(
            self.beyond > MIN_EXCESS_RATIO * self.expected
            and poisson_sf(self.beyond - 1, self.expected) < ALPHA
        )


@dataclass(frozen=True)
class Reliability:
    """How well gross errors of image coordinates can be found, and what the others do."""

    delta0: float  # non-centrality of the test for alpha and power
    critical: float  # value of that test
    minimal_bias: FloatArray  # smallest gross error found with the given power, px, (k, 2); inf: none is
    external: (
        FloatArray  # largest effect that error can have on a function of the unknowns, over its sigma, (k, 2)
    )


@dataclass(frozen=True)
class Significance:
    """t-test of an interior parameter against 0."""

    camera: str
    parameter: str
    value: float
    sigma: float
    t: float
    probability: float  # of a t at least so large by chance
    significant: bool


@dataclass(frozen=True)
class Correlation:
    """Two parameters whose estimates are strongly correlated."""

    first: str
    second: str
    value: float


def global_test(adjustment: Adjustment, *, alpha: float = GLOBAL_ALPHA) -> GlobalTest:
    """Return the two-sided chi-square test of v'Pv of all observations.

    Args:
        adjustment: the adjustment.
        alpha: probability of rejecting a right model.
    """
    test = _chi_square("all observations", adjustment.sigma0, adjustment.redundancy, alpha)
    return replace(test, passed=None, untested="reweighted") if adjustment.reweighted else test


def component_tests(
    components: VarianceComponents, *, alpha: float = GLOBAL_ALPHA, reweighted: bool = False
) -> tuple[GlobalTest, ...]:
    """Return the two-sided chi-square test of the variance component of each group against 1.

    The v'Pv of a group is nearly chi-square distributed with the sum of its redundancy numbers, exactly
    where the other groups take no part in its residuals. Where that sum is a small part of the observations,
    as of two bars that give the scale to the photographs, the test is on the safe side: with one residual in
    common and r = 0.4, v'Pv is 0.4 times chi-square of 1, beyond the limits for 95 % in 1 of 160 cases.

    Args:
        components: of groups, over the standard deviations stated for them.
        alpha: probability of rejecting a group whose standard deviations are right.
        reweighted: whether the weights of the image points come from their residuals: they have no test then.

    Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.2.4.
    """
    tests = [
        _chi_square(name, float(sigma0), float(r), alpha)
        for name, sigma0, r in zip(components.names, components.sigma0, components.redundancy, strict=True)
    ]
    return tuple(
        replace(test, passed=None, untested="reweighted") if reweighted and test.of == IMAGE_POINTS else test
        for test in tests
    )


def _chi_square(of: str, sigma0: float, redundancy: float, alpha: float) -> GlobalTest:
    if not np.isfinite(sigma0):
        return GlobalTest(of, np.nan, redundancy, np.nan, np.nan, None, "redundancy")
    statistic = float(sigma0**2 * redundancy)
    lower, upper = (float(x) for x in chi2_ppf([alpha / 2, 1 - alpha / 2], redundancy))
    return GlobalTest(of, statistic, redundancy, lower, upper, lower <= statistic <= upper)


@checked_arguments()
def w_test(adjustment: Adjustment, *, alpha: float = ALPHA) -> CoordinateTest:
    """Return Baarda's test of each image coordinate: w is standard normal where sigma0 is as stated."""
    return _coordinate_test(adjustment, adjustment.standardised, float(normal_ppf(1 - alpha / 2)), alpha)


@checked_arguments()
def tau_test(adjustment: Adjustment, *, alpha: float = ALPHA) -> CoordinateTest:
    """Return Pope's test of each image coordinate, which takes sigma0 from the adjustment."""
    critical = tau_critical(alpha, adjustment.redundancy)
    return _coordinate_test(adjustment, adjustment.tau, critical, alpha)


def robust_test(adjustment: Adjustment, *, alpha: float = ALPHA) -> CoordinateTest:
    """Return the test of w over its standard deviation by its median, which half of the coordinates make.

    It finds gross errors that were not rejected: tau is blind where they are so many that they make sigma0, w
    where the standard deviation is not as stated. Residuals that are rounding are not tested.

    Source: Rousseeuw and Leroy (1987), Robust Regression and Outlier Detection, sec. 1.2.
    """
    w = np.full_like(adjustment.standardised, np.nan) if adjustment.is_exact else adjustment.standardised
    known = np.abs(w[np.isfinite(w)])
    sigma = MAD_TO_SIGMA * float(np.median(known)) if len(known) else 0.0
    return _coordinate_test(adjustment, w / (sigma or np.inf), float(normal_ppf(1 - alpha / 2)), alpha)


def more_than_chance(events: IntArray, trials: IntArray, level: float) -> BoolArray:
    """Return which groups have more events than chance makes, by the share of them in all other groups, (n,).

    Args:
        events: of each group, such as its rejected image points, (n,).
        trials: of each group, (n,).
        level: probability that any group is called so where none is.

    Source: the share by Laplace's rule of succession; the binomial distribution; Bonferroni.
    """
    share = (events.sum() - events + 1) / (trials.sum() - trials + 2)
    return np.asarray(binomial_sf(events - 1, trials, share) < level / max(1, len(events)))


def _coordinate_test(
    adjustment: Adjustment, statistic: FloatArray, critical: float, alpha: float
) -> CoordinateTest:
    if not 0 < alpha < 1:
        raise GeometryError(
            f"test of image coordinates: alpha is {alpha:g}, expected more than 0 and below 1"
        )
    r = adjustment.redundancy_numbers
    checked = np.isfinite(r) & (r > MIN_CHECKED_REDUNDANCY)
    shown = np.where(np.isfinite(r), statistic, np.nan)
    beyond = int((np.abs(shown[checked]) > critical).sum())
    return CoordinateTest(alpha, critical, shown, int(checked.sum()), beyond)


def non_centrality(alpha: float = ALPHA, power: float = POWER, redundancy: int | None = None) -> float:
    """Return delta0, by which the test of an observation finds an error with the given power.

    Args:
        alpha: probability with which the test rejects a good observation.
        power: probability with which it finds the error.
        redundancy: r of an adjustment whose sigma0 the test takes (Pope's tau); None where sigma0 is known
            (Baarda's w). With the observation left out, tau is Student's t of r - 1 degrees of freedom.

    Returns:
        Infinite where r is less than 2.

    Source: Baarda (1968), sec. 3; Pope (1976), sec. 3, for t; Johnson, Kotz and Balakrishnan (1995),
    Continuous Univariate Distributions 2, ch. 31, for the non-central t.
    """
    if redundancy is None:
        return float(normal_ppf(1 - alpha / 2) + normal_ppf(power))
    if redundancy < 2:
        return float("inf")
    return nct_parameter(float(t_ppf(1 - alpha / 2, redundancy - 1)), redundancy - 1, power)


def reliability(adjustment: Adjustment, *, alpha: float | None = None, power: float = POWER) -> Reliability:
    """Return internal and external reliability of each image coordinate; NaN where rejected.

    Args:
        adjustment: the adjustment.
        alpha: probability with which the test that is to find the error rejects a good observation; that of
            the test by which the adjustment rejected, if not given. The test is Pope's, which takes sigma0
            from the adjustment, for errors in the standard deviations that it gives.
        power: probability with which it finds an error of the minimal size.

    Source: Baarda (1968): with C = P Qvv P, delta0 sigma0 / sqrt(C_ii), which is delta0 sigma / sqrt(r) for
    uncorrelated coordinates; effect bounded by delta0 sqrt(P_ii / C_ii - 1).
    """
    alpha = adjustment.test_alpha if alpha is None else alpha
    r = adjustment.redundancy
    critical = tau_critical(alpha, r)
    delta0 = non_centrality(alpha, power, r)
    P = np.diagonal(np.linalg.inv(adjustment.image_covariance), axis1=1, axis2=2)
    C = adjustment.residual_weights
    unknown = np.isnan(C)
    controlled = np.nan_to_num(C) > MIN_CHECKED_REDUNDANCY * P
    safe = np.where(controlled, C, 1.0)

    def where(values: FloatArray) -> FloatArray:
        return np.where(unknown, np.nan, np.where(controlled, values, np.inf))

    return Reliability(
        delta0,
        critical,
        where(delta0 * adjustment.sigma0 / np.sqrt(safe)),
        where(delta0 * np.sqrt(np.maximum(P / safe - 1, 0.0))),
    )


def significance(adjustment: Adjustment, *, alpha: float = GLOBAL_ALPHA) -> tuple[Significance, ...]:
    """Return the t-test against 0 of each free parameter of distortion and principal point in mm.

    A parameter that several cameras share is tested once, under the name of their group.

    Args:
        adjustment: the adjustment.
        alpha: probability of calling a parameter significant that is 0.
    """
    tests: dict[tuple[str, str], Significance] = {}
    for camera, Q in zip(adjustment.estimate.cameras, adjustment.covariance.interior, strict=True):
        for s, sigma in zip(_free(camera, Q), np.sqrt(np.diagonal(Q)), strict=True):
            name, owner = camera.names[s], camera.owner_of(s)
            if not MODELS[camera.model].parameters[s].has_null_hypothesis or not sigma > 0:
                continue
            value = float(camera.parameters[s])
            t = abs(value) / float(sigma)
            p = float(2 * t_sf(t, adjustment.redundancy))
            tests[owner, name] = Significance(owner, name, value, float(sigma), t, p, p < alpha)
    return tuple(tests.values())


def correlations(
    adjustment: Adjustment, *, limit: float = MIN_REPORTED_CORRELATION
) -> tuple[Correlation, ...]:
    """Return the pairs of parameters of one camera, or of one photograph, correlated beyond a limit.

    Args:
        adjustment: the adjustment.
        limit: absolute correlation from which a pair is reported.
    """
    found = []
    for camera, Q in zip(adjustment.estimate.cameras, adjustment.covariance.interior, strict=True):
        free = _free(camera, Q)
        names = [f"{camera.names[s]} of camera {camera.owner_of(s)}" for s in free]
        found += _strong(Q, names, limit)
    parts = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
    for image, Q in zip(adjustment.network.images, adjustment.covariance.exterior, strict=True):
        found += _strong(Q, [f"{part} of photograph {image}" for part in parts], limit)
    once = {(pair.first, pair.second): pair for pair in found}  # of shared parameters every camera has it
    return tuple(sorted(once.values(), key=lambda pair: -abs(pair.value)))


def _free(camera: Camera, Q: FloatArray) -> IntArray:
    """Indices of the parameters that a covariance belongs to; none for a camera that took no part."""
    return np.flatnonzero(camera.free)[: len(Q)]


def _strong(Q: FloatArray, names: list[str], limit: float) -> list[Correlation]:
    sigma = np.sqrt(np.clip(np.diagonal(Q), 0, None))
    known = (sigma > 0) & np.isfinite(sigma)
    rho = Q / np.where(known, sigma, 1.0)[:, None] / np.where(known, sigma, 1.0)
    rows, columns = np.nonzero(np.triu(np.abs(rho) > limit, 1))
    return [Correlation(names[r], names[c], float(rho[r, c])) for r, c in zip(rows, columns, strict=True)]


def redundancy_numbers(complement: FloatArray, whitening: FloatArray) -> FloatArray:
    """Return the diagonal of Q_vv P of each image point, (k, 2).

    Args:
        complement: I - A Q A' in whitened coordinates, shape (k, 2, 2).
        whitening: a, b, c of F = (a 0; b c) with F'F = P, shape (k, 3).
    """
    F = whitening_matrix(whitening)
    R = np.linalg.inv(F) @ complement @ F
    return np.ascontiguousarray(np.diagonal(R, axis1=1, axis2=2))


def standardised_residuals(
    residuals: FloatArray, complement: FloatArray, whitening: FloatArray
) -> FloatArray:
    """Return Baarda's w of each image coordinate for sigma0 = 1, (k, 2); 0 where it is not controlled.

    Args:
        residuals: v, px, shape (k, 2).
        complement: I - A Q A' in whitened coordinates, shape (k, 2, 2).
        whitening: a, b, c of F = (a 0; b c) with F'F = P, shape (k, 3).
    """
    F = whitening_matrix(whitening)
    Ft = np.swapaxes(F, 1, 2)
    Pv = np.einsum("kab,kb->ka", Ft @ F, residuals)
    PQP = residual_weights(complement, whitening)
    P = np.diagonal(Ft @ F, axis1=1, axis2=2)
    controlled = PQP > MIN_CHECKED_REDUNDANCY * P
    return np.where(controlled, Pv / np.sqrt(np.where(controlled, PQP, 1.0)), 0.0)


def residual_weights(complement: FloatArray, whitening: FloatArray) -> FloatArray:
    """Return the diagonal of P Qvv P of each image point, px^-2, (k, 2).

    Args:
        complement: I - A Q A' in whitened coordinates, shape (k, 2, 2).
        whitening: a, b, c of F = (a 0; b c) with F'F = P, shape (k, 3).
    """
    F = whitening_matrix(whitening)
    with np.errstate(invalid="ignore"):  # the cofactors of a ray that nothing determines are infinite
        return np.diagonal(np.swapaxes(F, 1, 2) @ complement @ F, axis1=1, axis2=2).copy()


MIN_CHECKED_REDUNDANCY = 1e-6  # redundancy number below which an observation has no check


def standardised_of_given(
    difference: FloatArray, weight: FloatArray, cofactor: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return Baarda's w for sigma0 = 1, and the redundancy number, of unknowns that were observed, (n, d).

    w is NaN where the observation has no check, both are where a component was not observed.

    Args:
        difference: v, adjusted minus given, shape (n, d).
        weight: P, inverse covariance of what was given, 0 where it was not, shape (n, d, d).
        cofactor: Q of the adjusted unknowns, shape (n, d, d).
    """
    PQP = np.diagonal(weight - weight @ cofactor @ weight, axis1=1, axis2=2)
    P = np.diagonal(weight, axis1=1, axis2=2)
    r = np.where(P > 0, 1 - np.diagonal(cofactor @ weight, axis1=1, axis2=2), np.nan)
    Pv = np.einsum("nab,nb->na", weight, difference)
    checked = PQP > MIN_CHECKED_REDUNDANCY * P
    return np.where(checked, Pv / np.sqrt(np.where(checked, PQP, 1.0)), np.nan), np.clip(r, 0.0, 1.0)


def residuals_of_observed(
    one: ObservedKind, layout: Unknowns, optimum: Optimum, cofactors: Cofactors | None
) -> ObservedResiduals:
    """Return the residuals of observations of a kind, with their redundancy numbers and tests.

    Args:
        one: observations of a kind.
        layout: order of the unknowns.
        optimum: undamped normal equations and their factor.
        cofactors: of the same; None where they are not wanted, and numbers are NaN.
    """
    linear = one.kind.linearise(optimum.state)
    shape = linear.difference.shape
    l = linear.difference.reshape(one.weight.shape[:2])
    vPv = float(np.einsum("na,nab,nb->", l, one.weight, l))
    r, w, redundancy = np.full(shape, np.nan), np.full(shape, np.nan), float("nan")
    if cofactors is not None:
        if one.point is not None:
            Q = linear.J[0] @ cofactors.points[one.point] @ np.swapaxes(linear.J[0], 1, 2)
        else:
            Q = _cofactors_of(reduced_rows(one, layout, optimum.state), optimum, cofactors)
        if linear.taken is not None:
            Q = Q + linear.taken
        w, r = (part.reshape(shape) for part in standardised_of_given(l, one.weight, Q))
        redundancy = float(one.components.sum() - np.einsum("nab,nba->", one.weight, Q))
    return ObservedResiduals(one.index, one.rows, linear.difference, r, w, one.count, vPv, redundancy)


def _cofactors_of(rows: Reduced, optimum: Optimum, cofactors: Cofactors) -> FloatArray:
    """Return J Q J' of observations by the reduced unknowns, (n, d, d); estimable, so in any datum."""
    (columns, J, _), poses = rows, len(cofactors.exterior)
    n, d, u = J.shape
    outer = columns < 6 * poses
    pose = np.where(outer, columns // 6, -1)
    lone = pose.max(axis=1, initial=-1)
    if (outer & (pose != lone[:, None])).any():  # several poses in one observation
        found = np.empty((n, d, d))
        for row in range(n):
            right = np.zeros((d, len(optimum.equations.parts.scale)))
            np.add.at(right, (np.arange(d)[:, None], columns[row]), J[row])
            found[row] = right @ optimum.factor.solve(right.T)
        return found
    Q = np.zeros((n, u, u))
    inner, part = np.where(outer, 0, columns - 6 * poses), np.where(outer, columns % 6, 0)
    r, c = outer[:, :, None], outer[:, None]
    if outer.any():
        at = np.maximum(lone, 0)[:, None, None]
        Q += np.where(r & c, cofactors.exterior[at, part[:, :, None], part[:, None]], 0.0)
    if not outer.all():
        Q += np.where(r | c, 0.0, cofactors.border[inner[:, :, None], inner[:, None]])
        if outer.any():
            mixed = cofactors.mixed.reshape(poses, 6, -1)[at, part[:, :, None], inner[:, None]]
            mixed = np.where(r & ~c, mixed, 0.0)
            Q += mixed + np.swapaxes(mixed, 1, 2)
    return np.asarray(J @ Q @ np.swapaxes(J, 1, 2))


FALSE_ALARM = 0.05  # chance that a survey without any outlier loses an image coordinate; Pope (1976)


def level_of_single(family: float, tests: int) -> float:
    """Return the level of each of some tests, so that any of them rejects what is good with a probability.

    Args:
        family: that probability, of all tests together.
        tests: how many there are.

    Source: Sidak (1967), J. Am. Stat. Assoc. 62.
    """
    return float(1 - (1 - family) ** (1 / max(tests, 1)))


def tau_critical(alpha: float, redundancy: float) -> float:
    """Return the critical value of Pope's tau for a two-sided test of one observation.

    Args:
        alpha: probability of rejecting a good observation.
        redundancy: r of the adjustment; infinite if not positive at least 2.

    Source: Pope (1976), eq. 21: tau = t sqrt(r) / sqrt(r - 1 + t^2), t of r - 1 degrees of freedom.
    """
    if redundancy < 2:
        return np.inf
    t = t_ppf(1 - alpha / 2, redundancy - 1)
    return float(t * np.sqrt(redundancy) / np.sqrt(redundancy - 1 + t**2))


def whitening_matrix(whitening: FloatArray) -> FloatArray:
    """Return F = (a 0; b c), (k, 2, 2)."""
    F = np.zeros((len(whitening), 2, 2))
    F[:, 0, 0], F[:, 1, 0], F[:, 1, 1] = whitening.T
    return F
