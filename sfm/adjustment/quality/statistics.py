"""Statistics of a finished adjustment: redundancy numbers, tests, reliability, significance, correlations.

The global test compares v'Pv with the redundancy. Baarda's and Pope's tests of single image coordinates use

    R = Q_vv P (redundancy numbers on its diagonal; their sum is the redundancy),
    w = (P v)_i / sqrt(sigma0'^2 (P Q_vv P)_ii)     with sigma0' a priori: Baarda's w ~ N(0, 1),
    tau = the same with sigma0 a posteriori:         Pope's tau ~ tau(r).

Reliability states the minimal detectable bias of an image coordinate and its effect on the unknowns. Interior
parameters are tested for significance, and strong correlations between parameters are listed.

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
from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera
from sfm.model.conventions import MAD_TO_SIGMA, BoolArray, FloatArray, IntArray
from sfm.model.distortion.models import MODELS
from sfm.model.distributions import (
    FALSE_ALARM,
    LEVEL,
    POWER,
    binomial_sf,
    chi2_ppf,
    nct_parameter,
    normal_ppf,
    poisson_sf,
    t_ppf,
    t_sf,
)
from sfm.model.errors import GeometryError

MIN_EXCESS_RATIO = 2.0  # coordinates beyond the critical value, relative to the number expected by chance
MIN_REPORTED_CORRELATION = 0.9  # absolute correlation from which two parameters are reported
Untested = Literal["redundancy", "reweighted"]  # redundancy too small; weights computed from the residuals


@dataclass(frozen=True)
class GlobalTest:
    """Test of stated standard deviations against the residuals by the chi-square distribution."""

    of: str  # all observations, or one kind
    statistic: float  # v'Pv with the stated standard deviations
    redundancy: float
    lower: float  # acceptance region of v'Pv
    upper: float
    passed: bool | None  # None if not tested
    alpha: float  # probability of rejecting right standard deviations
    untested: Untested | None = None  # reason why it was not tested


@dataclass(frozen=True)
class CoordinateTest:
    """Test of every accepted image coordinate for a gross error."""

    alpha: float  # probability of rejecting a good coordinate
    critical: float
    statistic: FloatArray  # w or tau of each coordinate; NaN where rejected, (k, 2)
    tested: int  # number of checked coordinates
    beyond: int  # number of these beyond the critical value

    @property
    def expected(self) -> float:
        """Number expected beyond the critical value by chance."""
        return self.alpha * self.tested

    @property
    def far_more(self) -> bool:
        """Whether more than MIN_EXCESS_RATIO times as many are beyond it, which chance makes unlikely."""
        return bool(
            self.beyond > MIN_EXCESS_RATIO * self.expected
            and poisson_sf(self.beyond - 1, self.expected) < self.alpha
        )


@dataclass(frozen=True)
class Reliability:
    """Detectability of gross errors in image coordinates, and the effect of undetected ones."""

    delta0: float  # non-centrality of the test for alpha and power
    critical: float  # critical value of the test
    minimal_bias: FloatArray  # smallest gross error found with the given power, px, (k, 2); inf: none found
    # largest effect of that error on a function of the unknowns, over the sigma of the function, (k, 2)
    external: FloatArray


@dataclass(frozen=True)
class Significance:
    """t-test of an interior parameter against 0."""

    camera: str
    parameter: str
    value: float
    sigma: float
    t: float
    probability: float  # chance probability of such a large t
    significant: bool


@dataclass(frozen=True)
class Correlation:
    """Two parameters with strongly correlated estimates."""

    first: str
    second: str
    value: float


def global_test(adjustment: Adjustment, *, alpha: float | None = None) -> GlobalTest:
    """Return the two-sided chi-square test of v'Pv of all observations.

    Args:
        adjustment: finished adjustment.
        alpha: probability of rejecting a correct model; the false alarm of the adjustment if not given.
    """
    alpha = adjustment.false_alarm if alpha is None else alpha
    test = _chi_square("all observations", adjustment.sigma0, adjustment.redundancy, alpha)
    return replace(test, passed=None, untested="reweighted") if adjustment.reweighted else test


def component_tests(
    components: VarianceComponents, *, alpha: float = FALSE_ALARM, reweighted: bool = False
) -> tuple[GlobalTest, ...]:
    """Return the two-sided chi-square test of the variance component of each group against 1.

    The v'Pv of a group is approximately chi-square distributed with the sum of its redundancy numbers. This
    is exact if the other groups do not affect its residuals. The test is conservative if the sum is a small
    part of the observations, as for two bars that give the photographs their scale. With one common residual
    and r = 0.4, v'Pv is 0.4 times chi-square of 1, which is beyond the limits for 95 % in 1 of 160 cases.

    Args:
        components: components of groups relative to their stated standard deviations.
        alpha: probability of rejecting a group with correct standard deviations.
        reweighted: whether the weights of the image points come from their residuals; then they have no test.

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
        return GlobalTest(of, np.nan, redundancy, np.nan, np.nan, None, alpha, "redundancy")
    statistic = float(sigma0**2 * redundancy)
    lower, upper = (float(x) for x in chi2_ppf([alpha / 2, 1 - alpha / 2], redundancy))
    return GlobalTest(of, statistic, redundancy, lower, upper, lower <= statistic <= upper, alpha)


@checked_arguments()
def w_test(adjustment: Adjustment, *, alpha: float | None = None) -> CoordinateTest:
    """Return Baarda's test of each image coordinate; w is standard normal if the stated sigma0 is correct.

    Args:
        adjustment: finished adjustment.
        alpha: probability of rejecting a good image coordinate; that of one question of the adjustment if not
            given.
    """
    alpha = adjustment.levels.question if alpha is None else alpha
    return _coordinate_test(adjustment, adjustment.standardised, float(normal_ppf(1 - alpha / 2)), alpha)


@checked_arguments()
def tau_test(adjustment: Adjustment, *, alpha: float | None = None) -> CoordinateTest:
    """Return Pope's test of each image coordinate, which uses sigma0 of the adjustment.

    Args:
        adjustment: finished adjustment.
        alpha: probability of rejecting a good image coordinate; that of one question of the adjustment if not
            given.
    """
    alpha = adjustment.levels.question if alpha is None else alpha
    critical = tau_critical(alpha, adjustment.redundancy)
    return _coordinate_test(adjustment, adjustment.tau, critical, alpha)


def robust_test(adjustment: Adjustment, *, alpha: float | None = None) -> CoordinateTest:
    """Return the test of w over its standard deviation from the median, which half of the coordinates fix.

    It finds gross errors that were not rejected. Tau misses them if they are so many that they determine
    sigma0, and w misses them if the stated standard deviations are wrong. Residuals that are mere rounding
    are not tested.

    Args:
        adjustment: finished adjustment.
        alpha: probability of rejecting a good image coordinate; that of one question of the adjustment if not
            given.

    Source: Rousseeuw and Leroy (1987), Robust Regression and Outlier Detection, sec. 1.2.
    """
    alpha = adjustment.levels.question if alpha is None else alpha
    w = np.full_like(adjustment.standardised, np.nan) if adjustment.is_exact else adjustment.standardised
    known = np.abs(w[_checked(adjustment) & np.isfinite(w)])
    sigma = MAD_TO_SIGMA * float(np.median(known)) if len(known) else 0.0
    return _coordinate_test(adjustment, w / (sigma or np.inf), float(normal_ppf(1 - alpha / 2)), alpha)


def more_than_chance(events: IntArray, trials: IntArray, level: float) -> BoolArray:
    """Return which groups have more events than chance explains, given the share in all other groups, (n,).

    Args:
        events: number of events in each group, such as rejected image points, (n,).
        trials: number of trials in each group, (n,).
        level: probability that any group is reported if chance explains all.

    Source: the share by Laplace's rule of succession; the binomial distribution; Bonferroni.
    """
    share = (events.sum() - events + 1) / (trials.sum() - trials + 2)
    return np.asarray(binomial_sf(events - 1, trials, share) < level / max(1, len(events)))


def _checked(adjustment: Adjustment) -> BoolArray:
    """Return which image coordinates others check, unlike those along the epipolar line of a pair, (k, 2)."""
    r = adjustment.redundancy_numbers
    return np.asarray(np.isfinite(r) & (r > MIN_CHECKED_REDUNDANCY))


def _coordinate_test(
    adjustment: Adjustment, statistic: FloatArray, critical: float, alpha: float
) -> CoordinateTest:
    if not 0 < alpha < 1:
        raise GeometryError(
            f"test of image coordinates: alpha is {alpha:g}, expected more than 0 and below 1"
        )
    checked = _checked(adjustment)
    shown = np.where(np.isfinite(adjustment.redundancy_numbers), statistic, np.nan)
    beyond = int((np.abs(shown[checked]) > critical).sum())
    return CoordinateTest(alpha, critical, shown, int(checked.sum()), beyond)


def non_centrality(alpha: float = LEVEL, power: float = POWER, redundancy: int | None = None) -> float:
    """Return delta0, the non-centrality with which the test of an observation finds an error.

    Args:
        alpha: probability that the test rejects a good observation.
        power: probability that it finds the error.
        redundancy: r of the adjustment if the test uses its sigma0 (Pope's tau); None if sigma0 is known
            (Baarda's w). With the observation left out, tau is Student's t with r - 1 degrees of freedom.

    Returns:
        delta0; infinite if r is less than 2.

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
        adjustment: finished adjustment.
        alpha: probability that the test rejects a good observation; if not given, that of the test used for
            rejection in the adjustment. It is Pope's test, which uses sigma0 of the adjustment; errors are in
            terms of the standard deviations that the adjustment gives.
        power: probability that the test finds an error of the minimal size.

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


def significance(adjustment: Adjustment, *, alpha: float | None = None) -> tuple[Significance, ...]:
    """Return the t-test against 0 of each free parameter of distortion and principal point in mm.

    A parameter shared by several cameras is tested once, under the name of their group.

    Args:
        adjustment: finished adjustment.
        alpha: probability that a parameter is called significant although it is 0; the false alarm of the
            adjustment if not given.
    """
    alpha = adjustment.false_alarm if alpha is None else alpha
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
        adjustment: finished adjustment.
        limit: absolute correlation above which a pair is reported.
    """
    strong = []
    for camera, Q in zip(adjustment.estimate.cameras, adjustment.covariance.interior, strict=True):
        free = _free(camera, Q)
        names = [f"{camera.names[s]} of camera {camera.owner_of(s)}" for s in free]
        strong += _strong(Q, names, limit)
    parts = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
    for image, Q in zip(adjustment.network.images, adjustment.covariance.exterior, strict=True):
        strong += _strong(Q, [f"{part} of photograph {image}" for part in parts], limit)
    once = {(pair.first, pair.second): pair for pair in strong}  # every camera repeats shared parameters
    return tuple(sorted(once.values(), key=lambda pair: -abs(pair.value)))


def _free(camera: Camera, Q: FloatArray) -> IntArray:
    """Return the indices of the parameters of a covariance; none for a camera that took no part."""
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
    """Return Baarda's w of each image coordinate for sigma0 = 1, (k, 2); 0 where it is not checked.

    Args:
        residuals: v, px, shape (k, 2).
        complement: I - A Q A' in whitened coordinates, shape (k, 2, 2).
        whitening: a, b, c of F = (a 0; b c) with F'F = P, shape (k, 3).
    """
    a, b, c = whitening.T
    x, y = residuals.T
    P = np.stack([a * a + b * b, c * c], axis=1)
    Pv = np.stack([P[:, 0] * x + b * c * y, b * c * x + P[:, 1] * y], axis=1)
    PQP = residual_weights(complement, whitening)
    controlled = PQP > MIN_CHECKED_REDUNDANCY * P
    return np.where(controlled, Pv / np.sqrt(np.where(controlled, PQP, 1.0)), 0.0)


def residual_weights(complement: FloatArray, whitening: FloatArray) -> FloatArray:
    """Return the diagonal of P Qvv P of each image point, px^-2, (k, 2).

    Args:
        complement: I - A Q A' in whitened coordinates, shape (k, 2, 2).
        whitening: a, b, c of F = (a 0; b c) with F'F = P, shape (k, 3).
    """
    a, b, c = whitening.T
    across = complement[:, 0, 1] + complement[:, 1, 0]
    with np.errstate(invalid="ignore"):  # the cofactors of a ray that nothing determines are infinite
        along_x = a * a * complement[:, 0, 0] + a * b * across + b * b * complement[:, 1, 1]
        return np.stack([along_x, c * c * complement[:, 1, 1]], axis=1)


MIN_CHECKED_REDUNDANCY = 1e-6  # redundancy number below which an observation has no check


def standardised_of_given(
    difference: FloatArray, weight: FloatArray, cofactor: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return Baarda's w for sigma0 = 1 and the redundancy number of observed unknowns, (n, d) each.

    w is NaN if the observation is not checked. Both are NaN for components that were not observed.

    Args:
        difference: v, adjusted minus given, shape (n, d).
        weight: P, inverse covariance of the given values, 0 where not given, shape (n, d, d).
        cofactor: Q of the adjusted unknowns, shape (n, d, d).
    """
    PQP = np.diagonal(weight - weight @ cofactor @ weight, axis1=1, axis2=2)
    P = np.diagonal(weight, axis1=1, axis2=2)
    r = np.where(P > 0, 1 - np.diagonal(cofactor @ weight, axis1=1, axis2=2), np.nan)
    Pv = np.einsum("nab,nb->na", weight, difference)
    checked = PQP > MIN_CHECKED_REDUNDANCY * P
    return np.where(checked, Pv / np.sqrt(np.where(checked, PQP, 1.0)), np.nan), np.clip(r, 0.0, 1.0)


def residuals_of_observed(
    observed_kind: ObservedKind, layout: Unknowns, optimum: Optimum, cofactors: Cofactors | None
) -> ObservedResiduals:
    """Return the residuals of observations of a kind, with their redundancy numbers and tests.

    Args:
        observed_kind: observations of one kind.
        layout: order of the unknowns.
        optimum: undamped normal equations and their factor.
        cofactors: cofactors at the optimum; without them redundancy numbers and tests are NaN.
    """
    linear = observed_kind.kind.linearise(optimum.state)
    shape = linear.difference.shape
    l = linear.difference.reshape(observed_kind.weight.shape[:2])
    vPv = float(np.einsum("na,nab,nb->", l, observed_kind.weight, l))
    r, w, redundancy = np.full(shape, np.nan), np.full(shape, np.nan), float("nan")
    if cofactors is not None:
        if observed_kind.point is not None:
            Q = linear.J[0] @ cofactors.points[observed_kind.point] @ np.swapaxes(linear.J[0], 1, 2)
        else:
            Q = _cofactors_of(reduced_rows(observed_kind, layout, optimum.state), optimum, cofactors)
        if linear.taken is not None:
            Q = Q + linear.taken
        w, r = (part.reshape(shape) for part in standardised_of_given(l, observed_kind.weight, Q))
        redundancy = float(observed_kind.components.sum() - np.einsum("nab,nba->", observed_kind.weight, Q))
    return ObservedResiduals(
        observed_kind.index, observed_kind.rows, linear.difference, r, w, observed_kind.count, vPv, redundancy
    )


def _cofactors_of(rows: Reduced, optimum: Optimum, cofactors: Cofactors) -> FloatArray:
    """Return J Q J' of observations, (n, d, d), from Q in any datum, because they are estimable."""
    (columns, J, _), poses = rows, len(cofactors.exterior)
    n, d, u = J.shape
    outer = columns < 6 * poses
    pose = np.where(outer, columns // 6, -1)
    lone = pose.max(axis=1, initial=-1)
    if (outer & (pose != lone[:, None])).any():  # several poses in one observation
        cofactors_of_rows = np.empty((n, d, d))
        for row in range(n):
            right = np.zeros((d, len(optimum.equations.scale)))
            np.add.at(right, (np.arange(d)[:, None], columns[row]), J[row])
            cofactors_of_rows[row] = right @ optimum.factor.solve(right.T)
        return cofactors_of_rows
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


def tau_critical(alpha: float, redundancy: float) -> float:
    """Return the critical value of Pope's tau for a two-sided test of one observation.

    Args:
        alpha: probability of rejecting a good observation.
        redundancy: r of the adjustment; the critical value is infinite if r is below 2.

    Source: Pope (1976), eq. 21: tau = t sqrt(r) / sqrt(r - 1 + t^2), t of r - 1 degrees of freedom.
    """
    if redundancy < 2:
        return np.inf
    t = t_ppf(1 - alpha / 2, redundancy - 1)
    return float(t * np.sqrt(redundancy) / np.sqrt(redundancy - 1 + t**2))


def whitening_matrix(whitening: FloatArray) -> FloatArray:
    """Return F = (a 0; b c), (k, 2, 2), from a, b, c, (k, 3)."""
    F = np.zeros((len(whitening), 2, 2))
    F[:, 0, 0], F[:, 1, 0], F[:, 1, 1] = whitening.T
    return F
