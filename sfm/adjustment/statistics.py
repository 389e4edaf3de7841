"""Statistics of a finished adjustment, in the words of the field.

Global test of the model, minimal detectable bias and external reliability of each image coordinate,
variance components of groups of observations, significance of parameters, strong correlations.

Source: Baarda (1968), A testing procedure for use in geodetic networks; Foerstner (1979), Ein Verfahren
zur Schaetzung von Varianz- und Kovarianzkomponenten; Luhmann et al., Close-Range Photogrammetry (2020),
sec. 2.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from sfm.adjustment.marginal import Marginal
from sfm.adjustment.reliability import UNCONTROLLED
from sfm.adjustment.result import Adjustment
from sfm.adjustment.weighted import bar_rows, exterior_misclosure
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.network import Network

ALPHA = 0.001  # Baarda's usual probability of rejecting a good observation
POWER = 0.8  # and of finding a gross error of the minimal detectable size
STRONG = 0.95  # correlation from which two parameters are reported
SETTLED = 1e-3  # relative change of a variance component at which its estimation ends
MAX_ROUNDS = 20
FEW = 1.0  # redundancy of a group below which its variance component is not estimated
UNTESTED = ("c", "fx", "fy", "cx", "cy")  # parameters for which 0 is no sensible null hypothesis


@dataclass(frozen=True)
class GlobalTest:
    """Test of sigma0 a posteriori against 1 by the chi-square distribution."""

    statistic: float  # v'Pv
    redundancy: int
    lower: float  # acceptance region of v'Pv
    upper: float
    passed: bool


@dataclass(frozen=True)
class Reliability:
    """How well gross errors of image coordinates can be found, and what the others do."""

    delta0: float  # non-centrality of the test for alpha and power
    minimal_bias: FloatArray  # smallest gross error found with the given power, px, (k, 2); inf: none is
    external: FloatArray  # largest effect of that error on any unknown over its sigma, (k, 2)


@dataclass(frozen=True)
class VarianceComponents:
    """Variance factors of groups of image points."""

    names: tuple[str, ...]
    sigma0: FloatArray  # a posteriori over a priori standard deviation, (g,); NaN with too little redundancy
    redundancy: FloatArray  # of each group, (g,)
    count: IntArray  # scalar observations of each group, (g,)


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
    """Two parameters whose estimates hang together."""

    first: str
    second: str
    value: float


def global_test(adjustment: Adjustment, *, alpha: float = 0.05) -> GlobalTest:
    """Return the two-sided chi-square test of v'Pv.

    Args:
        adjustment: the adjustment.
        alpha: probability of rejecting a right model.
    """
    r = adjustment.redundancy
    if r < 1:
        return GlobalTest(0.0, r, 0.0, np.inf, True)
    lower, upper = stats.chi2.ppf([alpha / 2, 1 - alpha / 2], r)
    return GlobalTest(adjustment.vPv, r, float(lower), float(upper), bool(lower <= adjustment.vPv <= upper))


def non_centrality(alpha: float = ALPHA, power: float = POWER) -> float:
    """Return delta0, by which a test of size alpha finds an error with the given power."""
    return float(stats.norm.ppf(1 - alpha / 2) + stats.norm.ppf(power))


def reliability(adjustment: Adjustment, *, alpha: float = ALPHA, power: float = POWER) -> Reliability:
    """Return internal and external reliability of each image coordinate; NaN where rejected.

    Args:
        adjustment: the adjustment.
        alpha, power: of the test that is to find the error.

    Source: Baarda (1968): delta0 sigma / sqrt(r); effect bounded by delta0 sqrt((1 - r)/r).
    """
    delta0 = non_centrality(alpha, power)
    r = np.clip(adjustment.redundancy_numbers, 0, 1)
    k = adjustment.network.image_points
    sigma = np.sqrt(np.diagonal(k.covariance, axis1=1, axis2=2))
    controlled = r > UNCONTROLLED
    safe = np.where(controlled, r, 1.0)
    unknown = np.isnan(r)

    def where(values: FloatArray) -> FloatArray:
        return np.where(unknown, np.nan, np.where(controlled, values, np.inf))

    return Reliability(
        delta0, where(delta0 * sigma / np.sqrt(safe)), where(delta0 * np.sqrt((1 - safe) / safe))
    )


def variance_components(
    adjustment: Adjustment, group: IntArray, names: tuple[str, ...]
) -> VarianceComponents:
    """Return the variance factor of each group of image points, v'Pv over the group's redundancy.

    Args:
        adjustment: the adjustment.
        group: group of each image point, shape (k,).
        names: names of the groups, g of them.
    """
    g = len(names)
    used = ~adjustment.rejected
    v = adjustment.residuals[used]
    P = np.linalg.inv(adjustment.network.image_points.covariance[used])
    vPv, redundancy = np.zeros(g), np.zeros(g)
    np.add.at(vPv, group[used], adjustment.weights[used] * np.einsum("ka,kab,kb->k", v, P, v))
    np.add.at(redundancy, group[used], adjustment.redundancy_numbers[used].sum(axis=1))
    enough = redundancy > FEW
    sigma0 = np.where(enough, np.sqrt(vPv / np.where(enough, redundancy, 1.0)), np.nan)
    return VarianceComponents(names, sigma0, redundancy, 2 * np.bincount(group[used], minlength=g))


def by_photograph(adjustment: Adjustment) -> VarianceComponents:
    """Return the variance factor of each photograph."""
    network = adjustment.network
    return variance_components(adjustment, network.image_points.image, network.images)


def by_camera(adjustment: Adjustment) -> VarianceComponents:
    """Return the variance factor of the photographs of each camera."""
    network = adjustment.network
    names = tuple(camera.name for camera in adjustment.estimate.cameras)
    return variance_components(adjustment, network.camera[network.image_points.image], names)


def by_kind(marginal: Marginal) -> VarianceComponents:
    """Return the variance factor of each kind of observation.

    Kinds are image points, control points, exterior and interior orientation, and scale bars; those
    that were not observed are left out. The redundancy of a kind is its count less tr(P Q) of what it
    observes.
    """
    a, w, layout, state = marginal.adjustment, marginal.weighted, marginal.layout, marginal.optimum.state
    Q = marginal.cofactors
    image = variance_components(a, np.zeros(len(a.rejected), dtype=np.int64), ("image points",))
    kinds = [("image points", a.vPv * np.nan, image.redundancy[0], int(image.count[0]))]
    dX = state.points[w.point] - w.xyz
    e, J = exterior_misclosure(w, state)
    own = (6 * w.image[:, None] + np.arange(6))[:, :, None]
    exterior = J @ Q.reduced[own, np.swapaxes(own, 1, 2)] @ np.swapaxes(J, 1, 2)
    dp = state.parameters[w.camera, w.parameter] - w.value
    rows, length = bar_rows(w, layout, state)
    kept = Q.reduced[layout.kept_start :, layout.kept_start :]
    for name, count, vPv, taken in (
        (
            "control points",
            int((np.diagonal(w.point_weight, axis1=1, axis2=2) > 0).sum()),
            np.einsum("pa,pab,pb->", dX, w.point_weight, dX),
            np.einsum("pab,pba->", w.point_weight, Q.points[w.point]),
        ),
        (
            "exterior orientation",
            int((np.diagonal(w.exterior_weight, axis1=1, axis2=2) > 0).sum()),
            np.einsum("ea,eab,eb->", e, w.exterior_weight, e),
            np.einsum("eab,eba->", w.exterior_weight, exterior),
        ),
        (
            "interior orientation",
            len(w.column),
            w.interior_weight @ dp**2,
            w.interior_weight @ np.diagonal(Q.reduced)[w.column],
        ),
        (
            "scale bars",
            len(length),
            w.length_weight @ length**2,
            w.length_weight @ np.einsum("ba,ac,bc->b", rows, kept, rows),
        ),
    ):
        if count:
            kinds.append((name, float(vPv), count - float(taken), count))
    rest = a.vPv - sum(kind[1] for kind in kinds[1:])
    vPv_of = np.array([rest] + [kind[1] for kind in kinds[1:]])
    redundancy = np.array([kind[2] for kind in kinds])
    enough = redundancy > FEW / 10
    sigma0 = np.where(enough, np.sqrt(np.maximum(vPv_of, 0) / np.where(enough, redundancy, 1.0)), np.nan)
    names = tuple(kind[0] for kind in kinds)
    return VarianceComponents(names, sigma0, redundancy, np.array([kind[3] for kind in kinds]))


def estimate_components(
    adjust_network: Callable[[Network], Adjustment], network: Network, group: IntArray, names: tuple[str, ...]
) -> tuple[Adjustment, FloatArray]:
    """Return the adjustment with the weights of groups of image points estimated from the data.

    The covariance of each group is multiplied by its variance factor and the network adjusted again,
    until the factors are 1.

    Args:
        adjust_network: adjusts a network from fixed start values and returns the adjustment.
        network: what was measured.
        group: group of each image point, shape (k,).
        names: names of the groups, g of them.

    Returns:
        Last adjustment, and standard deviation of each group over that given, shape (g,).
    """
    factor = np.ones(len(names))
    k = network.image_points
    adjustment = adjust_network(network)
    for _ in range(MAX_ROUNDS):
        found = variance_components(adjustment, group, names).sigma0
        found = np.where(np.isfinite(found) & (found > 0), found, 1.0)
        factor = factor * found
        scaled = replace(k, covariance=k.covariance * factor[group][:, None, None] ** 2)
        adjustment = adjust_network(replace(network, image_points=scaled))
        if np.abs(found - 1).max() <= SETTLED:
            break
    return adjustment, factor


def significance(adjustment: Adjustment, *, alpha: float = 0.05) -> tuple[Significance, ...]:
    """Return the t-test against 0 of each free parameter of distortion and principal point in mm.

    Args:
        adjustment: the adjustment.
        alpha: probability of calling a parameter significant that is 0.
    """
    tests = []
    for camera, Q in zip(adjustment.estimate.cameras, adjustment.covariance.interior, strict=True):
        for s, sigma in zip(_free(camera.free, Q), np.sqrt(np.diagonal(Q)), strict=True):
            name = camera.names[s]
            if name in UNTESTED or not sigma > 0:
                continue
            t = abs(camera.parameters[s]) / sigma
            p = float(2 * stats.t.sf(t, adjustment.redundancy))
            tests.append(
                Significance(
                    camera.name, name, float(camera.parameters[s]), float(sigma), float(t), p, p < alpha
                )
            )
    return tuple(tests)


def correlations(adjustment: Adjustment, *, limit: float = STRONG) -> tuple[Correlation, ...]:
    """Return the pairs of parameters of one camera, or of one photograph, correlated beyond a limit.

    Args:
        adjustment: the adjustment.
        limit: absolute correlation from which a pair is reported.
    """
    found = []
    for camera, Q in zip(adjustment.estimate.cameras, adjustment.covariance.interior, strict=True):
        names = [f"{camera.names[s]} of camera {camera.name}" for s in _free(camera.free, Q)]
        found += _strong(Q, names, limit)
    parts = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
    for image, Q in zip(adjustment.network.images, adjustment.covariance.exterior, strict=True):
        found += _strong(Q, [f"{part} of photograph {image}" for part in parts], limit)
    return tuple(sorted(found, key=lambda pair: -abs(pair.value)))


def _free(free: BoolArray, Q: FloatArray) -> IntArray:
    """Indices of the parameters that a covariance belongs to; none for a camera that took no part."""
    return np.flatnonzero(free)[: len(Q)]


def _strong(Q: FloatArray, names: list[str], limit: float) -> list[Correlation]:
    sigma = np.sqrt(np.clip(np.diagonal(Q), 0, None))
    known = sigma > 0
    rho = Q / np.where(known, sigma, 1.0)[:, None] / np.where(known, sigma, 1.0)
    rows, columns = np.nonzero(np.triu(np.abs(rho) > limit, 1))
    return [Correlation(names[r], names[c], float(rho[r, c])) for r, c in zip(rows, columns, strict=True)]
