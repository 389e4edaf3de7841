"""What control and scale bars say against the free network of the same image points.

An adjustment shares a contradiction among all observations, and weak photographs bend until nothing shows.
The free network has the shape that the image points give by themselves: by it the scale of the bars is held
against that of the control, and by its sum of squares everything that was added, in an F-test.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.2.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from sfm.adjustment.engine.observed_unknowns import inverse_of_observed
from sfm.conventions import FloatArray
from sfm.result import SurveyResult
from sfm.similarity import fit_similarity

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


def given_test(result: SurveyResult) -> GivenTest | None:
    """Return the F-test of control, bars and orientation; None where nothing was added that is checked."""
    a, free = result.adjustment, result.free_network
    if free is None or a.reweighted or free.redundancy < 1 or a.redundancy <= free.redundancy:
        return None
    added = a.redundancy - free.redundancy
    statistic = max(a.vPv - free.vPv, 0.0) / added / (free.vPv / free.redundancy)
    return GivenTest(statistic, added, float(stats.f.sf(statistic, added, free.redundancy)))


def scale_difference(result: SurveyResult) -> ScaleDifference | None:
    """Return the difference of scale between control and bars; None where not both take part.

    Its standard deviation comes from what was stated for control and bars or, where that is larger, from
    their own residuals: control that is worse than stated is no contradiction of scale.
    """
    a, free = result.adjustment, result.free_network
    control, bars = a.network.control, a.network.scale_bars
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
    x = adjusted - adjusted.mean(axis=0)
    A = np.zeros((len(x), 3, SIMILARITY))
    A[:, :, :3] = np.eye(3)
    A[:, 0, 4], A[:, 0, 5] = x[:, 2], -x[:, 1]
    A[:, 1, 3], A[:, 1, 5] = -x[:, 2], x[:, 0]
    A[:, 2, 3], A[:, 2, 4] = x[:, 1], -x[:, 0]
    A[:, :, 6] = x
    d = given - adjusted
    fixed = not weight.any()
    P = np.broadcast_to(np.eye(3), weight.shape) if fixed else weight
    Q = np.linalg.pinv(np.einsum("nai,nab,nbj->ij", A, P, A))
    dx = Q @ np.einsum("nai,nab,nb->i", A, P, d)
    v = d - A @ dx
    observed = int((np.einsum("nii->ni", P) > 0).sum())
    factor = float(np.einsum("na,nab,nb->", v, P, v)) / max(observed - SIMILARITY, 1)
    return float(dx[6]), float(Q[6, 6]) * (factor if fixed else max(1.0, factor))
