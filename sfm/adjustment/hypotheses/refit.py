"""The winning alternative adjusted together with everything else, from all image points.

The parameters of the alternative take the score step, their effect leaves the image points, and the network
is adjusted anew; a few rounds end at the joint optimum. Rejected image points come back where they fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.hypotheses.columns import Columns, columns_of
from sfm.adjustment.hypotheses.families import Alternative
from sfm.adjustment.hypotheses.score import gain_of, least_share, reduce_adjustment
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import FloatArray
from sfm.errors import GeometryError
from sfm.similarity import fit_similarity

ROUNDS = 6
HALVINGS = 4  # of a step: linear in what a large error makes of the image points, it may go too far
MAX_ITERATIONS = 15  # of an adjustment that starts next to its optimum; half of those that converge need 3
LAST_GAIN = 0.01  # gain of v'Pv over the variance factor at which the rounds end


@dataclass(frozen=True)
class Refit:
    """An adjustment with an alternative."""

    adjustment: Adjustment  # of the image points without the effect of the alternative
    beta: FloatArray  # parameters of the alternative, (q,)
    gain: float  # of ln likelihood, rejected image points counted as spread over their photograph
    shift: float  # largest change of a coordinate, in the standard deviations stated without the alternative
    rms: float  # root mean square of the same
    before: tuple[FloatArray, ...] = ()  # parameters of the alternatives that were there before


def refit(
    plain: Adjustment,
    one: Alternative,
    start: Adjustment,
    before: Sequence[tuple[Alternative, FloatArray]] = (),
) -> Refit | None:
    """Adjust with an alternative; None where that does not converge.

    Args:
        plain: the adjustment that states coordinates and standard deviations.
        one: the alternative.
        start: adjustment to begin from, of image points without the effect of others.
        before: these others with their parameters, which are adjusted along with it.
    """
    every = (*(other for other, _ in before), one)
    ends = np.cumsum([0, *(len(beta) for _, beta in before), len(one.gain.beta)])
    beta = np.concatenate([*(beta for _, beta in before), one.gain.beta])
    current, step = start, np.concatenate([np.zeros(int(ends[-2])), one.gain.beta])
    D = _side_by_side(every, current, columns_of(current))
    for number in range(ROUNDS):
        found = _stepped(plain, D, current, beta - step, step)
        if found is None:
            return None
        current, beta = found
        columns = columns_of(current)
        D = _side_by_side(every, current, columns)
        try:
            reduced = reduce_adjustment(current, columns)
        except np.linalg.LinAlgError:
            return None
        gain = gain_of(*reduced.project(reduced.whiten(D)), least_share(D.shape[2]))
        if gain.value < LAST_GAIN or number == ROUNDS - 1:
            break
        step = gain.beta
        beta = beta + step
    gained = log_likelihood(current) - log_likelihood(start)
    parts = [beta[ends[k] : ends[k + 1]] for k in range(len(every))]
    return Refit(
        *(current, parts[-1], gained, *shifts_of(plain, start, current, one, parts[-1])), tuple(parts[:-1])
    )


def _stepped(
    plain: Adjustment, D: FloatArray, start: Adjustment, beta: FloatArray, step: FloatArray
) -> tuple[Adjustment, FloatArray] | None:
    """Return the adjustment after a step of the parameters, halved while it makes v'Pv larger, and these."""
    xy, best = plain.network.image_points.xy, None
    for _ in range(HALVINGS):
        points = replace(plain.network.image_points, xy=xy - D @ (beta + step))
        try:
            found = adjust(
                replace(plain.network, image_points=points),
                start.estimate,
                datum=Datum("control" if plain.datum == "control" else "free"),
                image_sigma_factor=plain.image_sigma_factor,
                reject="tau",
                alpha=plain.test_alpha,
                rejected=start.rejected,
                max_iterations=MAX_ITERATIONS,
            )
        except GeometryError:
            found = None
        if found is not None and found.converged:
            found = replace(found, error_correlation=plain.error_correlation)  # as far as is known
            if log_likelihood(found) > log_likelihood(start) - LAST_GAIN:
                return found, beta + step
            best = best or (found, beta + step)
        step = step / 2
    return best


def _side_by_side(every: Sequence[Alternative], a: Adjustment, columns: Columns) -> FloatArray:
    """Return the columns of alternatives, (k, 2, q)."""
    return np.concatenate([one.columns(a, columns) for one in every], axis=2)


def log_likelihood(a: Adjustment, freed: int = 0) -> float:
    """Return ln of the likelihood, rejected image points spread evenly over their photograph.

    Without redundancy, where every network fits, it is that of the rejected image points alone.

    Args:
        a: the adjustment.
        freed: unknowns in it that others it is compared with do not have; their price is reckoned apart.

    Source: Rissanen (1978), Automatica 14; Foerstner and Wrobel (2016), sec. 4.7 (mixture of good and bad).
    """
    sizes = np.array([float(np.prod(camera.size_px)) for camera in a.estimate.cameras])
    area = sizes[a.network.camera[a.network.image_points.image[a.rejected]]]
    if a.redundancy <= 0:
        return float(-np.log(area).sum())
    redundancy = a.redundancy + freed
    variance = a.sigma0_px**2 * a.redundancy / redundancy
    return float(-redundancy / 2 * (np.log(2 * np.pi * variance) + 1) - np.log(area).sum())


def shifts_of(
    plain: Adjustment, before: Adjustment, other: Adjustment, one: Alternative, beta: FloatArray
) -> tuple[float, float]:
    """Return the largest and the RMS change of what a survey determines, in standard deviations.

    It is that of coordinates after a similarity; with control, which is given them, of the cameras.

    Args:
        plain: states the standard deviations.
        before: without the alternative.
        other: with it.
        one: the alternative.
        beta: its parameters, (q,).
    """
    if plain.datum == "control":
        return _shifts_of_cameras(plain, before, other)
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


def _shifts_of_cameras(plain: Adjustment, before: Adjustment, other: Adjustment) -> tuple[float, float]:
    """Return the largest and the RMS change of determined interior parameters, in standard deviations."""
    change = [np.zeros(0)]
    for k, (one, changed) in enumerate(zip(before.estimate.cameras, other.estimate.cameras, strict=True)):
        sigma = plain.interior_sigma(k)
        known = np.isfinite(sigma) & (sigma > 0)
        change.append((changed.parameters - one.parameters)[known] / sigma[known])
    every = np.concatenate(change)
    return float(np.abs(every).max(initial=0.0)), float(np.sqrt((every**2).mean())) if len(every) else 0.0
