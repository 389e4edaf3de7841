"""The winning alternative adjusted together with everything else, from all image points.

The parameters of the alternative take the score step, their effect leaves the image points, and the network
is adjusted anew; a few rounds end at the joint optimum. Rejected image points come back where they fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.hypotheses.columns import columns_of
from sfm.adjustment.hypotheses.families import Alternative
from sfm.adjustment.hypotheses.score import gain_of, reduce_adjustment
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import FloatArray
from sfm.errors import GeometryError
from sfm.similarity import fit_similarity

ROUNDS = 6
SETTLED = 0.01  # gain of v'Pv over the variance factor at which the rounds end


@dataclass(frozen=True)
class Refit:
    """An adjustment with an alternative."""

    adjustment: Adjustment  # of the image points without the effect of the alternative
    beta: FloatArray  # parameters of the alternative, (q,)
    gain: float  # of ln likelihood, rejected image points counted as spread over their photograph
    shift: float  # largest change of a coordinate, in the standard deviations stated without the alternative
    rms: float  # root mean square of the same


def refit(plain: Adjustment, one: Alternative, start: Adjustment) -> Refit | None:
    """Adjust with an alternative; None where that does not converge.

    Args:
        plain: the adjustment that states coordinates and standard deviations.
        one: the alternative.
        start: adjustment to begin from, which may be without the effect of another alternative.
    """
    current, beta = start, one.gain.beta
    xy = start.network.image_points.xy
    for _ in range(ROUNDS):
        D = one.columns(current, columns_of(current))
        points = replace(start.network.image_points, xy=xy - D @ beta)
        try:
            current = adjust(
                replace(start.network, image_points=points),
                current.estimate,
                datum=Datum("free"),
                image_sigma_factor=start.image_sigma_factor,
                reject="tau",
                alpha=plain.test_alpha,
                rejected=current.rejected,
            )
            if not current.converged:
                return None
            columns = columns_of(current)
            reduced = reduce_adjustment(current, columns)
        except (GeometryError, np.linalg.LinAlgError):
            return None
        gain = gain_of(*reduced.project(reduced.whiten(one.columns(current, columns))))
        beta = beta + gain.beta
        if gain.value < SETTLED:
            break
    gained = log_likelihood(current) - log_likelihood(start)
    return Refit(current, beta, gained, *shifts_of(plain, start, current, one, beta))


def log_likelihood(a: Adjustment) -> float:
    """Return ln of the likelihood, rejected image points spread evenly over their photograph.

    Source: Rissanen (1978), Automatica 14; Foerstner and Wrobel (2016), sec. 4.7 (mixture of good and bad).
    """
    sizes = np.array([float(np.prod(camera.size_px)) for camera in a.estimate.cameras])
    area = sizes[a.network.camera[a.network.image_points.image[a.rejected]]]
    variance = a.sigma0_px**2
    return float(-a.redundancy / 2 * (np.log(2 * np.pi * variance) + 1) - np.log(area).sum())


def shifts_of(
    plain: Adjustment, before: Adjustment, other: Adjustment, one: Alternative, beta: FloatArray
) -> tuple[float, float]:
    """Return the largest and the RMS change of coordinates after a similarity, in standard deviations.

    Args:
        plain: states the standard deviations.
        before: without the alternative.
        other: with it.
        one: the alternative.
        beta: its parameters, (q,).
    """
    sigma = np.sqrt(np.diagonal(plain.covariance.points, axis1=1, axis2=2))
    X, Y = before.estimate.points, other.estimate.points
    stays = np.ones(len(X), dtype=bool)
    stays[one.points] = False
    known = np.isfinite(X).all(axis=1) & np.isfinite(Y).all(axis=1) & (sigma > 0).all(axis=1)
    try:
        moved = fit_similarity(Y[known & stays], X[known & stays]).apply(Y) - X
    except GeometryError:
        return float("nan"), float("nan")
    change = moved[known] / sigma[known]
    away = one.family.displaced(one, plain.estimate.points, beta)[known] / sigma[known]
    largest, squares = np.abs(change).max(initial=0.0), (change**2).mean()
    return float(max(largest, np.abs(away).max(initial=0.0))), float(np.sqrt(max(squares, (away**2).mean())))
