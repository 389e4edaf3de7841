"""What control and scale bars say against the free network of the same image points.

An adjustment shares a contradiction among all observations, and weak photographs bend until nothing shows.
The free network has the shape that the image points give by themselves: by it the scale of the bars is held
against that of the control, and by its sum of squares everything that was added, in an F-test.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.2.3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.engine.observed_unknowns import inverse_of_observed
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import FloatArray
from sfm.distributions import f_sf
from sfm.errors import GeometryError
from sfm.network import ExteriorObservations, ObjectPoints, ScaleBars
from sfm.similarity import fit_similarity, similarity_motions

MIN_CONTROL = 4  # points whose residuals after a similarity say how good they are
SIMILARITY = 7  # parameters
SIMILARITY_POINTS, TRIPLES = 3, 300  # of as many a similarity is tried, so often
MEDIAN_LENGTH_IN_SPACE = 0.65  # sigma of a coordinate over the median length of a normal vector in space
APART = 10.0  # standard deviations from which a control point does not fit


@dataclass(frozen=True)
class ScaleDifference:
    """By how much lengths by the control are larger than lengths by the bars."""

    relative: float  # over the length
    sigma: float  # standard deviation of the same, the larger one of that stated and that of the residuals

    @property
    def over_sigma(self) -> float:
        """The difference in its standard deviations."""
        return abs(self.relative) / self.sigma if self.sigma > 0 else float("inf")


@dataclass(frozen=True)
class GivenTest:
    """F-test of everything given beside the image points against the free network."""

    statistic: float  # increase of v'Pv over its redundancy, over the variance factor of the free network
    redundancy: int  # that control, bars and observed orientation add
    probability: float  # of an F so large by chance


@dataclass(frozen=True)
class ControlApart:
    """A control point that does not fit the shape of the free network as most of the others do."""

    point: str
    distance: float  # object unit
    over_sigma: float  # over its stated standard deviation, or the scatter of the others if that is larger


@dataclass(frozen=True)
class FreeNetwork:
    """Adjustment of the accepted image points without control, bars and observed exterior orientation."""

    points: FloatArray  # in a frame of their own, (n, 3)
    vPv: float  # with the weights of the adjustment that it is held against
    redundancy: int


def free_network_of(final: Adjustment) -> FreeNetwork | None:
    """Adjust the accepted image points of an adjustment alone, with the same weights; None if in vain."""
    network, accepted = final.network, ~final.rejected
    held = (len(network.control) + len(network.exterior)) if final.datum == "control" else 0
    if not final.converged or not (held or len(network.scale_bars)):
        return None
    alone = replace(
        network,
        image_points=network.image_points.select(accepted),
        control=ObjectPoints(),
        scale_bars=ScaleBars(),
        exterior=ExteriorObservations(),
    )
    factor = final.image_sigma_factor[accepted]
    try:
        free = adjust(alone, final.estimate, image_sigma_factor=factor, reject="none", covariance=False)
    except GeometryError:
        return None
    sound = free.converged and not free.undetermined
    return FreeNetwork(free.estimate.points, free.vPv, free.redundancy) if sound else None


def given_test(a: Adjustment, free: FreeNetwork | None) -> GivenTest | None:
    """Return the F-test of control, bars and orientation; None where nothing was added that is checked."""
    if free is None or a.reweighted or free.redundancy < 1 or a.redundancy <= free.redundancy:
        return None
    added = a.redundancy - free.redundancy
    statistic = max(a.vPv - free.vPv, 0.0) / added / (free.vPv / free.redundancy)
    return GivenTest(statistic, added, float(f_sf(statistic, added, free.redundancy)))


def control_apart(a: Adjustment, free: FreeNetwork | None) -> tuple[ControlApart, ...]:
    """Return the control points that do not fit the shape of the free network, the farthest first.

    The free network is placed on the control that most points agree upon: of many similarities by three
    of them that of the smallest median distance, then by all that fit.

    Source: Rousseeuw (1984), J. Am. Stat. Assoc. 79(388), least median of squares.
    """
    control = a.network.control.complete
    n = len(control)
    if free is None or a.datum != "control" or n < MIN_CONTROL:
        return ()
    X, given = free.points[control.point], control.xyz
    stated = np.sqrt(np.maximum(np.einsum("nii->ni", control.covariance).max(axis=1), 0.0))
    rng = np.random.default_rng(n)
    best, off = np.inf, np.zeros(n)
    for _ in range(TRIPLES):
        some = rng.choice(n, SIMILARITY_POINTS, replace=False)
        try:
            distance = np.linalg.norm(fit_similarity(X[some], given[some]).apply(X) - given, axis=1)
        except GeometryError:
            continue
        if np.median(distance) < best:
            best, off = float(np.median(distance)), distance
    for _ in range(2):
        scatter = MEDIAN_LENGTH_IN_SPACE * float(np.median(off))
        fits = off <= APART * np.maximum(stated, scatter)
        if 2 * fits.sum() <= n or fits.sum() < MIN_CONTROL:
            return ()
        off = np.linalg.norm(fit_similarity(X[fits], given[fits]).apply(X) - given, axis=1)
    apart = off / np.maximum(stated, scatter)
    return tuple(
        ControlApart(a.network.points[control.point[k]], float(off[k]), float(apart[k]))
        for k in np.argsort(-off)
        if apart[k] > APART
    )


def scale_difference(a: Adjustment, free: FreeNetwork | None) -> ScaleDifference | None:
    """Return the difference of scale between control and bars; None where not both take part.

    Its standard deviation comes from what was stated for control and bars or, where that is larger, from
    their own residuals: control that is worse than stated is no contradiction of scale.
    """
    control, bars = a.network.control.complete, a.network.scale_bars
    if free is None or a.datum != "control" or len(control) < MIN_CONTROL or not len(bars):
        return None
    X = fit_similarity(free.points[control.point], control.xyz).apply(free.points)
    weight, _ = inverse_of_observed(control.covariance)
    by_control, var_control = _scale_of_control(control.xyz, X[control.point], weight)
    found = np.linalg.norm(X[bars.end] - X[bars.start], axis=1)
    share, p = bars.length / found - 1, (found / bars.sigma) ** 2
    by_bars = float(p @ share / p.sum())
    scatter = float(p @ (share - by_bars) ** 2 / (len(bars) - 1)) if len(bars) > 1 else 1.0
    var_bars = max(1.0, scatter) / float(p.sum())
    return ScaleDifference(by_control - by_bars, float(np.sqrt(var_control + var_bars)))


def _scale_of_control(given: FloatArray, adjusted: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Return the scale of given over adjusted control less 1, and its variance, by a linear similarity."""
    A = similarity_motions(adjusted, centre=adjusted.mean(axis=0))
    d = given - adjusted
    fixed = not weight.any()
    P = np.broadcast_to(np.eye(3), weight.shape) if fixed else weight
    Q = np.linalg.pinv(np.einsum("nai,nab,nbj->ij", A, P, A))
    dx = Q @ np.einsum("nai,nab,nb->i", A, P, d)
    v = d - A @ dx
    observed = int((np.einsum("nii->ni", P) > 0).sum())
    factor = float(np.einsum("na,nab,nb->", v, P, v)) / max(observed - SIMILARITY, 1)
    return float(dx[6]), float(Q[6, 6]) * (factor if fixed else max(1.0, factor))
