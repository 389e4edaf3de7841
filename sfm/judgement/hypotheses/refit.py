"""Refit: adjusts the winning alternative with all other unknowns; external reliability of alternatives.

The parameters of the alternative take the score step, their effect is removed from the image points, and the
network is adjusted again. A few rounds reach the joint optimum. Rejected image points return if they fit.

External reliability is the largest error of an assumption that the tests do not detect. Parameters b of an
alternative have the noncentrality b'Hb and shift coordinates by E b. Let lambda be the noncentrality that the
tests detect with 80 % probability. A coordinate with standard deviation s and row e of E can shift undetected
by up to sqrt(lambda e H^-1 e') / s.

Source: Baarda (1968), A testing procedure for use in geodetic networks (external reliability); Foerstner and
Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.4.2.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chndtrinc

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.judgement.hypotheses.alternatives import (
    MIN_GROUP,
    cameras_of_photographs,
    count_alternatives,
    interior_parameters,
    needed_gain,
    patterns_of,
    photographs_among,
    too_many_cameras,
)
from sfm.judgement.hypotheses.columns import Columns, columns_of
from sfm.judgement.hypotheses.families import (
    CAMERA_FAMILIES,
    HELD,
    STRAIN,
    Alternative,
    InteriorFamily,
)
from sfm.judgement.hypotheses.score import (
    MIN_DETERMINED_SHARE,
    ROUNDING,
    Reduced,
    determined_inverse,
    directions_of,
    gain_of,
    least_share,
    reduce_adjustment,
)
from sfm.model.conventions import FloatArray
from sfm.model.distributions import POWER
from sfm.model.errors import GeometryError
from sfm.model.likelihood import areas_of_photographs, log_likelihood
from sfm.model.network import Network
from sfm.model.remarks.remark import Remark, remark
from sfm.model.remarks.row import WRONG_SIGMAS
from sfm.model.similarity import fit_similarity, without_motions

ROUNDS = 6
MEMORY = 2  # rounds whose smallest ln likelihood the next one must exceed
HALVINGS = 4  # most halvings of a step, because a linear step may go too far for a large error
MAX_ITERATIONS = 15  # the start is near the optimum; half of the adjustments that converge need 3
LAST_GAIN = 0.01  # gain of v'Pv over the variance factor below which the rounds end


@dataclass(frozen=True)
class Refit:
    """An adjustment with an alternative."""

    adjustment: Adjustment  # adjustment of image points from which the effect of the alternative is removed
    beta: FloatArray  # parameters of the alternative, (q,)
    gain: float  # gain of ln likelihood; rejected image points are assumed uniform over their photograph
    shift: float  # largest change of a coordinate, in standard deviations stated without the alternative
    rms: float  # root mean square of these changes; NaN of cameras
    before: tuple[FloatArray, ...] = ()  # parameters of the earlier alternatives
    finished: bool = True  # whether the rounds ended before the largest number of adjustments
    reduced: Reduced | None = None  # its adjustment with all unknowns eliminated, if that is kept


def refit(
    plain: Adjustment,
    alternative: Alternative,
    start: Adjustment,
    before: Sequence[tuple[Alternative, FloatArray]] = (),
    *,
    least: float = 0.0,
    asked: float = -np.inf,
    most: int = ROUNDS * HALVINGS,
    columns: Columns | None = None,
) -> Refit | None:
    """Adjust with an alternative; None if the adjustment does not converge.

    Args:
        plain: adjustment that states coordinates and standard deviations.
        alternative: what is adjusted in addition.
        start: adjustment to start from, of image points without the effect of earlier alternatives.
        before: earlier alternatives with their parameters, which are adjusted jointly.
        least: gain of ln likelihood below which a step is halved.
        asked: gain of ln likelihood that is asked for; the rounds end when it is out of reach.
        most: number of adjustments after which no further round begins.
        columns: derivatives of the image points of the start; they are computed if not given.
    """
    every = [other for other, _ in before] + [alternative]
    betas = [beta for _, beta in before] + [alternative.gain.beta]
    ends, beta = np.cumsum([0] + [len(beta) for beta in betas]), np.concatenate(betas)
    current, step = start, np.concatenate([np.zeros(int(ends[-2])), alternative.gain.beta])
    D = _side_by_side(every, current, columns or columns_of(current))
    before_all = log_likelihood_of(start)
    taken, finished, likelihoods = 0, True, [before_all + least]
    for number in range(ROUNDS):
        stepped = _stepped(plain, D, current, beta - step, step, least=min(likelihoods[-MEMORY:]))
        if stepped is None:
            return None
        current, beta, adjustments = stepped
        likelihoods.append(log_likelihood_of(current))
        taken += adjustments
        try:
            reduced = reduce_adjustment(current)
        except np.linalg.LinAlgError:
            return None
        D = _side_by_side(every, current, reduced.columns)
        gain = gain_of(*reduced.project(reduced.whiten(D)), least_share(D.shape[2]))
        # even with the next step; the first one may be far off, with image points rejected that return
        out_of_reach = number > 0 and likelihoods[-1] + gain.value < before_all + max(least, asked)
        finished = out_of_reach or gain.value < LAST_GAIN or number == ROUNDS - 1
        if finished or taken >= most:
            break
        step = gain.beta
        beta = beta + step
    gained = likelihoods[-1] - before_all
    parts = [beta[ends[k] : ends[k + 1]] for k in range(len(every))]
    shift, rms = shifts_of(plain, start, current, alternative, parts[-1])
    return Refit(current, parts[-1], gained, shift, rms, tuple(parts[:-1]), finished, reduced)


def _stepped(
    plain: Adjustment, D: FloatArray, start: Adjustment, beta: FloatArray, step: FloatArray, *, least: float
) -> tuple[Adjustment, FloatArray, int] | None:
    """Return the adjustment after a step, the parameters, and how many adjustments it took.

    The step is halved until ln likelihood is above `least`, and whole if no part of it is so good. As image
    points are rejected and return, ln likelihood may fall in a round before it rises in the next.

    Source: Grippo, Lampariello and Lucidi (1986), SIAM J. Numer. Anal. 23(4) (nonmonotone line search).
    """
    xy, whole = plain.network.image_points.xy, None
    flat = D.reshape(2 * len(xy), -1)
    for taken in range(1, HALVINGS + 1):
        points = replace(plain.network.image_points, xy=xy - (flat @ (beta + step)).reshape(-1, 2))
        adjusted = readjusted(plain, replace(plain.network, image_points=points), start)
        if adjusted is not None:
            if log_likelihood_of(adjusted) > least - LAST_GAIN:
                return adjusted, beta + step, taken
            whole = whole or (adjusted, beta + step)
        step = step / 2
    return None if whole is None else (*whole, HALVINGS)


def readjusted(plain: Adjustment, network: Network, start: Adjustment) -> Adjustment | None:
    """Adjust other image points of a network as it was adjusted; None without a tested solution.

    The start is near: undamped steps reach the optimum in fewer, and damped ones are taken where they do not.
    A covariance is computed only where errors in common leave less redundancy.

    Args:
        plain: adjustment of the network, with the datum, weights and level of rejection.
        network: the network with the other image points.
        start: start values, and which image points are rejected at first.
    """
    for method in ("gauss-newton", "levenberg-marquardt"):
        try:
            adjusted = adjust(
                network,
                start.estimate,
                datum=Datum("control" if plain.datum == "control" else "free"),
                reject="tau",
                false_alarm=plain.false_alarm,
                rejected=start.rejected,
                covariance=bool((network.share < 1).any()),
                options=AdjustmentOptions(
                    image_sigma_factor=plain.image_sigma_factor,
                    method=method,
                    alpha=plain.test_alpha,
                    max_iterations=MAX_ITERATIONS,
                ),
            )
        except GeometryError:
            return None
        if adjusted.converged:
            break
    if not adjusted.converged or adjusted.redundancy < 1:  # it may reject all but what it needs
        return None
    return replace(adjusted, error_correlation=plain.error_correlation)  # the best known one


def _side_by_side(every: Sequence[Alternative], a: Adjustment, columns: Columns) -> FloatArray:
    """Return the columns of alternatives, (k, 2, q)."""
    of_each = [alternative.columns(a, columns) for alternative in every]
    return of_each[0] if len(of_each) == 1 else np.concatenate(of_each, axis=2)


def log_likelihood_of(a: Adjustment, freed: int = 0) -> float:
    """Return ln of the likelihood of an adjustment; its rejected image points are misfits.

    Args:
        a: adjustment.
        freed: number of unknowns that adjustments it is compared with lack; their price is counted elsewhere.
    """
    return log_likelihood(
        a.sigma0_px**2 * a.redundancy,
        ~a.rejected,
        areas_of_photographs(a.network, a.estimate.cameras),
        redundancy=a.redundancy + freed if a.redundancy > 0 else 0,
        share=a.network.share,
    )


def shifts_of(
    plain: Adjustment, before: Adjustment, other: Adjustment, alternative: Alternative, beta: FloatArray
) -> tuple[float, float]:
    """Return the largest and the RMS change of the result of a survey, in standard deviations.

    The change is that of coordinates after a similarity. With control, coordinates are given, and the change
    is that of the cameras.

    Args:
        plain: adjustment that states the standard deviations.
        before: adjustment without the alternative.
        other: adjustment with the alternative.
        alternative: what the other adjustment takes into account.
        beta: parameters of the alternative, (q,).
    """
    if plain.datum == "control":
        largest = 0.0  # of determined interior parameters
        for k, (camera, changed) in enumerate(
            zip(before.estimate.cameras, other.estimate.cameras, strict=True)
        ):
            sigma = plain.interior_sigma(k)
            determined = np.isfinite(sigma) & (sigma > 0)
            change = np.abs((changed.parameters - camera.parameters)[determined] / sigma[determined])
            largest = max(largest, float(change.max(initial=0.0)))
        return largest, float("nan")
    sigma = np.sqrt(np.diagonal(plain.covariance.points, axis1=1, axis2=2))
    X, Y = before.estimate.points, other.estimate.points
    stays = np.ones(len(X), dtype=bool)
    stays[alternative.points] = False
    known = np.isfinite(X).all(axis=1) & np.isfinite(Y).all(axis=1) & (sigma > 0).all(axis=1)
    try:
        moved = fit_similarity(Y[known & stays], X[known & stays]).apply(Y) - X
    except GeometryError:
        return float("nan"), float("nan")
    change = moved[known] / sigma[known]
    away = alternative.family.displaced(alternative, plain.estimate.points, beta)[known] / sigma[known]
    largest, squares = np.abs(change).max(initial=0.0), (change**2).mean()
    return float(max(largest, np.abs(away).max(initial=0.0))), float(np.sqrt(max(squares, (away**2).mean())))


def spread_of_photographs(refitted: Refit, alternative: Alternative, others: Sequence[Alternative]) -> float:
    """Return the variance of what photographs say of an alternative, relative to that expected by chance.

    Errors that image points of a photograph have in common resemble a movement of many points. They differ
    among the photographs of one state of the object, where a true movement is the same. The effects of the
    others, which were adjusted too, are removed.

    Raises:
        numpy.linalg.LinAlgError: the network is not determined.

    Source: White (1982), Econometrica 50, for a score test with dependent observations.
    """
    reduced = refitted.reduced or reduce_adjustment(refitted.adjustment)
    effect = alternative.whitened(reduced) @ refitted.beta
    left = reduced.absorb(effect[:, :, None])[2]
    if others:
        taken = reduced.whiten(_side_by_side(others, reduced.adjustment, reduced.columns))
        H, _, squares = reduced.project(taken)
        share = determined_inverse(H, squares, ROUNDING) @ (taken.reshape(-1, len(H)).T @ left.ravel())
        left = left - reduced.absorb((taken @ share)[:, :, None])[2]
    left = left[:, :, 0]
    m = reduced.photographs
    slope = np.bincount(reduced.image, (reduced.v * left).sum(axis=1), minlength=m)
    return float(slope @ slope / (left**2).sum()) * m / (m - 1)


def precision_factor(a: Adjustment) -> float:
    """Return the factor by which errors common to a photograph exceed the stated precision, RMS.

    It is the standard deviation of a coordinate from the scatter of what the photographs contribute to it,
    over the stated one; with control, of an interior parameter. Errors that groups of photographs have in
    common are not in it.

    Raises:
        numpy.linalg.LinAlgError: the network is not determined.

    Source: Liang and Zeger (1986), Biometrika 73 (covariance from the scatter of groups).
    """
    reduced = reduce_adjustment(a)
    of_points, of_interior = reduced.contributions()
    m = reduced.photographs
    if a.datum == "control":
        relative = of_interior
    else:
        X = a.estimate.points
        sigma = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
        known = np.isfinite(X).all(axis=1) & (sigma > 0).all(axis=1)
        relative = (without_motions(X, of_points)[known] / sigma[known][:, :, None]).reshape(-1, m)
    squares = (relative**2).sum(axis=1) * m / (m - 1) * reduced.count / reduced.redundancy
    return float(np.sqrt(squares.mean())) if len(squares) else float("nan")


def unchecked_assumptions(a: Adjustment, without: str | None = None) -> tuple[Remark, ...]:
    """Return remarks on assumptions that the tests hardly check, with the shift of an undetected error.

    The adjustment is that of the image points alone. If something fixes all coordinates of the result, they
    shift without it only: `without` is its name.

    Raises:
        numpy.linalg.LinAlgError: the network is not determined.
    """
    reduced = reduce_adjustment(a)
    number, rows = cameras_of_photographs(a), count_alternatives(a)
    untested: tuple[Remark, ...] = ()
    if too_many_cameras(number):
        untested = (remark("cameras_untested", cameras=int(number.max()) + 1),)
    constancy: dict[str, float] = {}
    held: dict[str, dict[str, float]] = defaultdict(dict)
    for alternative in _typical(a):
        reach = reach_of(alternative, reduced, rows=rows)
        if not reach > WRONG_SIGMAS:
            continue
        if isinstance(alternative.family, InteriorFamily):
            index, s = alternative.parameters[0]
            camera = a.estimate.cameras[index]
            held[camera.owner_of(s)][camera.names[s]] = reach
        else:
            constancy[alternative.family.constant] = max(
                reach, constancy.get(alternative.family.constant, 0.0)
            )
    of_held = tuple(
        remark(
            "held_weakly_tested",
            camera=camera,
            parameters=tuple(parameters),
            sigmas=max(parameters.values()),
            without=without,
        )
        for camera, parameters in held.items()
    )
    of_constancy = tuple(
        remark("constancy_weakly_tested", of=constant, sigmas=reach, without=without)
        for constant, reach in constancy.items()
    )
    return untested + of_held + of_constancy


def _typical(a: Adjustment) -> Iterator[Alternative]:
    """Yield alternatives for each held parameter, and for a change of camera or a strain halfway through.

    If a camera has three photographs, the last one differs. Bending is left out, because the worst of
    its 18 directions is not the shape of any real object.
    """
    for owner in interior_parameters(a, HELD):
        for parameters in owner:
            yield Alternative(HELD, "all", np.ones(len(a.network.images)), parameters=parameters)
    camera = cameras_of_photographs(a)
    for family in (*CAMERA_FAMILIES, STRAIN):
        for among in photographs_among(family, camera):
            m = int(among.sum())
            if m < 2 * MIN_GROUP:
                pattern, first, tried = "single", m - 1, m
            else:
                pattern, first, tried = "split", m // 2, m - 2 * MIN_GROUP + 1
            if any(name == pattern for name, _ in patterns_of(family, m)):
                after = (among & (np.cumsum(among) > first)).astype(float)
                yield Alternative(family, pattern, after, search=float(np.log(tried)), among=among)


def reach_of(alternative: Alternative, reduced: Reduced, *, rows: int) -> float:
    """Return the largest shift of coordinates before an alternative is detected, in standard deviations.

    As many rows are tested together and share the level.
    """
    a, D = reduced.adjustment, alternative.whitened(reduced)
    H, _, squares = reduced.project(D)
    values, vectors, scale = directions_of(H, squares)
    rank = max(int((values > MIN_DETERMINED_SHARE).sum()), 1)
    touched = int((D != 0).any(axis=(1, 2)).sum())
    needed = needed_gain(rank, touched, alternative.search, rows, a.levels.family)
    least = chndtrinc(needed, rank, 1 - POWER) * reduced.design_effect(D)  # detected noncentrality
    longest = scale[:, None] * vectors * np.sqrt(least / np.maximum(values, MIN_DETERMINED_SHARE))
    X = a.estimate.points
    sigma = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
    known = np.isfinite(X).all(axis=1) & (sigma > 0).all(axis=1)
    shifted = without_motions(X, reduced.absorb(D)[0] @ longest)
    away = np.stack([alternative.family.displaced(alternative, X, b) for b in longest.T], axis=2)
    return max(
        float((np.linalg.norm(part[known], axis=2) / sigma[known]).max(initial=0.0))
        for part in (shifted, away)
    )
