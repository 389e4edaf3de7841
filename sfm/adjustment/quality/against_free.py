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
