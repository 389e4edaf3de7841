"""Adjustment of a network by least squares: from measurements and start values to the solution,
its statistics and its covariance.

Unified least squares on the collinearity equations with self-calibration; gross errors by iterative
data snooping; rank defect found numerically; nothing is damped where the result is taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.cofactors import (
    Cofactors,
    cofactors,
    hat_complement,
    marginal_covariance,
    without_held,
)
from sfm.adjustment.engine.collinearity import State, behind_camera, residuals
from sfm.adjustment.engine.iterate import (
    METHODS,
    TOLERANCE,
    Optimum,
    Problem,
    iterate,
    optimum_at,
    problem_of,
)
from sfm.adjustment.engine.local_frame import Local, local_of
from sfm.adjustment.engine.observed_unknowns import weighted_of
from sfm.adjustment.engine.unknowns import estimate_of, start_weights, unknowns_of
from sfm.adjustment.quality.rank import rank_defect, undetermined_of
from sfm.adjustment.quality.reliability import redundancy_numbers as numbers_of
from sfm.adjustment.quality.reliability import redundancy_of_bars, standardised_residuals
from sfm.adjustment.quality.robust import (
    huber_slopes,
    huber_weights,
    inflation,
    robust_scale,
    snoop,
    tukey_slopes,
    tukey_weights,
)
from sfm.adjustment.result import Adjustment, Covariance
from sfm.conventions import FloatArray
from sfm.errors import GeometryError
from sfm.kernels.threads import own_threads
from sfm.network import Estimate, Network

MAX_ROUNDS = 200  # of data snooping
ROUND_TOLERANCE = 1e-3  # |A dx| / |v| that is near enough to judge gross errors
BENT = 2.0  # spread of residuals over that with the start values, above which gross errors bend the network
REWEIGHTINGS = 30
REWEIGHTED = 1e-3  # largest change of a weight at which reweighting ends
REJECTS = ("tau", "huber", "tukey", "none")
SLOPES = {"huber": huber_slopes, "tukey": tukey_slopes}  # of the M-estimators


def adjust(
    network: Network,
    estimate: Estimate,
    *,
    datum: Datum,
    sigma_px: float = 0.1,
    image_sigma_factor: float | FloatArray = 1.0,
    reject: str = "tau",
    alpha: float = 0.001,
    method: str = "levenberg-marquardt",
    max_iterations: int = 50,
    tolerance: float = TOLERANCE,
    covariance: bool = True,
    redundancy_numbers: bool = True,
) -> Adjustment:
    """Return the least-squares adjustment of a network.

    Weights are the inverse covariances of the observations. Which interior parameters are free is
    said by the cameras of the estimate.

    Args:
        network: what was measured.
        estimate: start values; NaN where a photograph or point has none (it is held out and named).
        datum: how position, attitude and scale are decided.
        sigma_px: standard deviation of unit weight, in which sigma0_px is told, px.
        image_sigma_factor: on the stated standard deviations of the image points, of all or of each, (k,);
            the network of the result keeps those stated.
        reject: "tau" (data snooping by Pope's test), "huber" or "tukey" (reweighting; Tukey's biweight,
            from Huber's start, rejects what it gives weight 0) or "none".
        alpha: probability with which the test of one image coordinate rejects a good one.
        method: "gauss-newton" (line search) or "levenberg-marquardt" (ends in undamped Gauss-Newton).
        max_iterations: steps at most, in each round of the robust test.
        tolerance: |A dx| / |v| at which the iteration has converged.
        covariance: whether covariance and redundancy numbers are wanted; NaN otherwise.
        redundancy_numbers: whether they and standardised residuals are wanted beside the covariance.

    Raises:
        GeometryError: nothing to adjust, an unknown option, or datum points that cannot carry the datum.
    """
    if reject not in REJECTS:
        raise GeometryError(f"adjustment: reject '{reject}', expected one of {', '.join(REJECTS)}")
    if method not in METHODS:
        raise GeometryError(f"adjustment: method '{method}', expected one of {', '.join(METHODS)}")
    use_control = datum.kind == "control"
    local = local_of(network, estimate, datum.resolve(network))
    factor = np.broadcast_to(np.asarray(image_sigma_factor, dtype=float), (len(network.image_points),))
    layout, state = unknowns_of(
        local.network, local.estimate, use_control=use_control, image_sigma_factor=factor
    )
    weighted = weighted_of(local.network, layout, use_control=use_control)
    weight = start_weights(layout, state)
    with own_threads():
        near = tolerance if reject == "none" else max(tolerance, ROUND_TOLERANCE)
        exact = covariance or reject == "tau"
        run = _Run(problem_of(layout, weighted, local.datum), method, max_iterations, near, exact)
        optimum, weight = _plain(run, state, weight) if reject == "none" else _sound(run, state, weight)
        if reject == "tau":
            optimum, weight = _snoop_all(run, optimum, weight, alpha)
        elif reject in ("huber", "tukey"):
            optimum, weight = _reweight(run, optimum, weight, huber_weights)
            if reject == "tukey":
                optimum, weight = _reweight(run, optimum, weight, tukey_weights)
        if near > tolerance:
            run.tolerance = tolerance
            optimum = run.again(optimum, weight)
        Q = cofactors(optimum, layout, cross=redundancy_numbers) if covariance else None
        result = _result(local, run, optimum, weight, Q, sigma_px, SLOPES.get(reject))
        return local.back(replace(result, image_sigma_factor=factor))


@dataclass
class _Run:
    """What stays the same over the rounds of one adjustment, and the steps taken so far."""

    problem: Problem
    method: str
    max_iterations: int
    tolerance: float
    exact: bool  # whether the factor must belong to the last normal equations
    iterations: int = 0
    remarks: tuple[str, ...] = ()

    def start(self, state, weight: FloatArray) -> Optimum:  # type: ignore[no-untyped-def]
        """Return the optimum from start values by the method asked for."""
        return self._iterate(state, weight, self.method)

    def minimise(self, optimum: Optimum, weight: FloatArray) -> tuple[Optimum, FloatArray]:
        """Return the optimum with image points that were behind their camera at the start back in."""
        ready = self.problem.layout.active & ~behind_camera(self.problem.layout.observations, optimum.state)
        if (ready & (weight == 0)).any():
            weight = np.where(ready, 1.0, weight)
            optimum = self._iterate(optimum.state, weight, self.method)
        return optimum, weight

    def again(self, optimum: Optimum, weight: FloatArray) -> Optimum:
        """Return the optimum with other weights, from a near one."""
        return self._iterate(optimum.state, weight, "gauss-newton", near=True)

    def redundancy(self, optimum: Optimum, weight: FloatArray) -> int:
        """Observations and constraints minus unknowns."""
        held = optimum.motions.defect + optimum.factor.further.shape[1]
        held += int(optimum.equations.blocks.held.sum())
        observations = 2 * int((weight > 0).sum()) + self.problem.weighted.count
        return observations - self.problem.layout.count + held

    def _iterate(self, state, weight: FloatArray, method: str, near: bool = False) -> Optimum:  # type: ignore[no-untyped-def]
        optimum = iterate(
            self.problem,
            state,
            weight,
            method=method,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
            near=near,
            exact=self.exact,
        )
        self.iterations += optimum.iterations
        return optimum


def _plain(run: _Run, state: State, weight: FloatArray) -> tuple[Optimum, FloatArray]:
    """Return the optimum of all image points."""
    return run.minimise(run.start(state, weight), weight)


def _sound(run: _Run, state: State, weight: FloatArray) -> tuple[Optimum, FloatArray]:
    """Return the optimum from which gross errors are judged: of all image points, unless they bend it.

    An error of hundreds of pixels can turn a photograph over or let the principal distance collapse. Then
    the adjustment does not converge, or most image points fit worse than with the start values; it is
    begun again there by Huber's and Tukey's weights, and what Tukey's weigh 0 is left out.

    Raises:
        GeometryError: neither can be solved.
    """
    layout = run.problem.layout

    def spread(at: State) -> float:
        v = residuals(layout.observations, at)
        return robust_scale(layout.observations, v, layout.active & np.isfinite(v).all(axis=1), freedom=1.0)

    try:
        (optimum, plain), begun = _plain(run, state, weight), None
    except GeometryError:
        begun = optimum_at(run.problem, state, weight)
        if begun is None:
            raise
        optimum, plain = replace(begun, converged=False), weight
    limit = spread(optimum.state)
    if optimum.converged and limit <= BENT * spread(state):
        return optimum, plain
    begun = begun or optimum_at(run.problem, state, weight)
    if begun is None:
        return optimum, plain
    try:
        robust, factor = _reweight(run, begun, weight, huber_weights)
        robust, factor = _reweight(run, robust, factor, tukey_weights)
        factor = (factor > 0).astype(float)
        robust = run.again(robust, factor)
    except GeometryError:
        return optimum, plain
    return (robust, factor) if robust.converged and spread(robust.state) < limit else (optimum, plain)


def _snoop_all(run: _Run, optimum: Optimum, weight: FloatArray, alpha: float) -> tuple[Optimum, FloatArray]:
    """Return the optimum without the image points that fail Pope's test.

    Ends with the last round that could be solved where the next one cannot.
    """
    layout = run.problem.layout
    returned = np.zeros(len(weight), dtype=bool)
    for _ in range(MAX_ROUNDS):
        redundancy = run.redundancy(optimum, weight)
        if redundancy < 2:
            break
        v = residuals(layout.observations, optimum.state)
        complement = hat_complement(optimum, layout, cofactors(optimum, layout), weight)
        out, back = snoop(
            layout.observations,
            v,
            complement,
            weight > 0,
            vPv=optimum.vPv,
            redundancy=redundancy,
            alpha=alpha,
        )
        back &= layout.active & ~returned
        if not (out.any() or back.any()):
            break
        if out.any():
            changed = np.where(out, 0.0, weight)
        else:  # take back only once nothing large is left
            changed = np.where(back, 1.0, weight)
            returned |= back
        try:
            optimum, weight = run.again(optimum, changed), changed
        except GeometryError as error:
            run.remarks = (
                f"data snooping ended before its last round: with {int((changed == 0).sum())} image points "
                f"rejected in place of {int((weight == 0).sum())}, {error}",
            )
            break
    return optimum, weight


def _reweight(
    run: _Run, optimum: Optimum, weight: FloatArray, weights: Callable[..., FloatArray]
) -> tuple[Optimum, FloatArray]:
    """Return the optimum of an M-estimator by reweighting; a scale from the median goes with every round."""
    layout = run.problem.layout
    ready = layout.active & ~behind_camera(layout.observations, optimum.state)
    count = 2 * int(ready.sum()) + run.problem.weighted.count
    freedom = run.redundancy(optimum, ready.astype(float)) / max(count, 1)
    for _ in range(REWEIGHTINGS):
        v = residuals(layout.observations, optimum.state)
        sigma0 = robust_scale(layout.observations, v, ready & np.isfinite(v).all(axis=1), freedom=freedom)
        new = np.where(ready, weights(layout.observations, v, sigma0=sigma0), 0.0)
        change = float(np.abs(new - weight).max())
        weight = new
        optimum = run.again(optimum, weight)
        if change <= REWEIGHTED:
            break
    return optimum, weight


def _result(
    local: Local,
    run: _Run,
    optimum: Optimum,
    weight: FloatArray,
    Q: Cofactors | None,
    sigma_px: float,
    slopes: Callable[[FloatArray], FloatArray] | None,
) -> Adjustment:
    layout, network, estimate = run.problem.layout, local.network, local.estimate
    of_control = run.problem.datum.kind == "control"
    allowed = 0 if of_control else 7  # motions: control is meant to fix all of them
    defect = rank_defect(optimum, layout)
    undetermined = undetermined_of(optimum, layout, network, estimate, allowed_motions=allowed)
    redundancy = run.redundancy(optimum, weight)
    observations = 2 * int((weight > 0).sum()) + run.problem.weighted.count
    sigma0 = float(np.sqrt(optimum.vPv / redundancy)) if redundancy > 0 else float("nan")
    v = residuals(layout.observations, optimum.state)
    factor = 1.0
    if slopes is not None and redundancy > 0:
        factor = inflation(
            layout.observations, v, weight, slopes(weight),
            vPv=optimum.vPv, count=observations, redundancy=redundancy,
        )  # fmt: skip
        sigma0 *= factor
    k, n, m = len(weight), len(network.points), len(network.images)
    back = np.empty(k, dtype=np.int64)  # place of each image point of the network in the layout
    back[layout.order] = np.arange(k)
    numbers = standardised = np.full((k, 2), np.nan)
    of_bars = np.full(len(network.scale_bars), np.nan)
    if Q is None:
        empty = np.full((n, 3, 3), np.nan)
        interior = tuple(np.full((len(free), len(free)), np.nan) for free in layout.interior_free)
        result = Covariance(empty, np.full((m, 6, 6), np.nan), interior, empty)
    else:
        result = marginal_covariance(optimum, layout, Q, sigma0**2)
        result = without_held(result, layout)
        kept = Q.border[layout.kept_start - 6 * m :, layout.kept_start - 6 * m :]
        of_bars[layout.bars] = redundancy_of_bars(run.problem.weighted, layout, optimum.state, kept)
    if Q is not None and Q.has_cross:
        complement = hat_complement(optimum, layout, Q, weight)
        numbers = numbers_of(complement, layout.observations.whitening)
        numbers[weight == 0] = np.nan
        numbers = np.take(numbers, back, axis=0)
        standardised = np.take(
            standardised_residuals(v, complement, layout.observations.whitening), back, axis=0
        )
    return Adjustment(
        network=network,
        estimate=estimate_of(optimum.state, estimate),
        converged=optimum.converged,
        iterations=run.iterations,
        datum=run.problem.datum.kind,
        defect=defect,
        expected_defect=0 if of_control else optimum.motions.defect,
        undetermined=undetermined,
        residuals=np.take(v, back, axis=0),
        rejected=np.take((weight == 0), back, axis=0),
        redundancy_numbers=numbers,
        sigma_px=sigma_px,
        sigma0=sigma0,
        redundancy=redundancy,
        unknowns=layout.count,
        observations=observations,
        covariance=result,
        standardised=standardised,
        weights=np.take(weight, back, axis=0),
        inflation=factor,
        bar_redundancy=of_bars,
        datum_points=run.problem.datum.points,
        remarks=run.remarks,
    )
