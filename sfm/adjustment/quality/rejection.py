"""Rounds of an adjustment with gross errors: which image points take part, and with what weight.

The optimum of all image points, or of those that a robust start leaves where gross errors bend the network;
then data snooping or an M-estimator, each round from the optimum of the last one.

Source: Pope (1976), NOAA TR NOS 65 NGS 1; Huber and Ronchetti (2009), Robust Statistics, ch. 7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.engine.cofactors import cofactors, hat_complement
from sfm.adjustment.engine.collinearity import State, behind_camera, residuals
from sfm.adjustment.engine.iterate import Optimum, Problem, iterate, optimum_at
from sfm.adjustment.engine.unknowns import start_weights
from sfm.adjustment.quality.robust import huber_weights, robust_scale, snoop, tukey_weights
from sfm.conventions import FloatArray
from sfm.errors import GeometryError

MAX_ROUNDS = 200  # of data snooping
ROUND_TOLERANCE = 1e-3  # |A dx| / |v| that is near enough to judge gross errors
BENT = 2.0  # spread of residuals over that with the start values, above which gross errors bend the network
REWEIGHTINGS = 30
REWEIGHTED = 1e-3  # largest change of a weight at which reweighting ends
REJECTS = ("tau", "huber", "tukey", "none")


def find_optimum(run: Run, state: State, *, reject: str, alpha: float) -> tuple[Optimum, FloatArray]:
    """Return the optimum and the factor on the weight of each image point, 0 where rejected, (k,).

    Args:
        run: what is adjusted, and how.
        state: where to start.
        reject: tau | huber | tukey | none.
        alpha: probability with which the test of one image coordinate rejects a good one.

    Raises:
        GeometryError: start values whose normal equations cannot be solved.
    """
    weight = start_weights(run.problem.layout, state)
    if reject == "none":
        return _plain(run, state, weight)
    wanted, run.tolerance = run.tolerance, max(run.tolerance, ROUND_TOLERANCE)
    optimum, weight = _sound(run, state, weight)
    if reject == "tau":
        optimum, weight = _snoop_all(run, optimum, weight, alpha)
    else:
        optimum, weight = _reweight(run, optimum, weight, huber_weights)
        if reject == "tukey":
            optimum, weight = _reweight(run, optimum, weight, tukey_weights)
    if run.tolerance > wanted:
        run.tolerance = wanted
        optimum = run.again(optimum, weight)
    return optimum, weight


@dataclass
class Run:
    """What stays the same over the rounds of one adjustment, and the steps taken so far."""

    problem: Problem
    method: str
    max_iterations: int
    tolerance: float
    exact: bool  # whether the factor must belong to the last normal equations
    iterations: int = 0
    remarks: tuple[str, ...] = ()

    def start(self, state: State, weight: FloatArray) -> Optimum:
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
        held = optimum.motions.defect + int(optimum.factor.further.shape[1])
        held += int(optimum.equations.blocks.held.sum())
        observations = 2 * int((weight > 0).sum()) + self.problem.weighted.count
        return observations - self.problem.layout.count + held

    def _iterate(self, state: State, weight: FloatArray, method: str, near: bool = False) -> Optimum:
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


def _plain(run: Run, state: State, weight: FloatArray) -> tuple[Optimum, FloatArray]:
    """Return the optimum of all image points."""
    return run.minimise(run.start(state, weight), weight)


def _sound(run: Run, state: State, weight: FloatArray) -> tuple[Optimum, FloatArray]:
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


def _snoop_all(run: Run, optimum: Optimum, weight: FloatArray, alpha: float) -> tuple[Optimum, FloatArray]:
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
    run: Run, optimum: Optimum, weight: FloatArray, weights: Callable[..., FloatArray]
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
