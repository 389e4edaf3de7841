"""Iteration of the normal equations to the least sum of squares.

Gauss-Newton with an Armijo line search, or Levenberg-Marquardt to get near and Gauss-Newton to end:
the last steps are undamped in either case. A step that would bring a point behind a camera has an
infinite sum of squares and is shortened or damped. Converged means that the predicted change of the
adjusted observations, |A dx| weighted, is at most `tolerance` times the residuals |v|, or at most
MIN_SHIFT, so that no unknown would move by more than that share of its own a priori standard deviation.

Source: Boerlin and Grussenmeyer (2013), Photogrammetric Record 28(144), for criterion, line search and
veto; Nielsen (1999), IMM-REP-1999-05, for the damping.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.collinearity import State, sum_of_squares
from sfm.adjustment.datum import Datum, Motions, motions_of
from sfm.adjustment.normals import Blocks, Normals, new_blocks, normal_equations, point_step
from sfm.adjustment.parameters import Unknowns, step
from sfm.adjustment.reduced import Factor, factor
from sfm.adjustment.weighted import Weighted, weighted_vPv
from sfm.conventions import FloatArray
from sfm.errors import GeometryError

TOLERANCE = 1e-6
MIN_SHIFT = 1e-6
ARMIJO = 1e-4  # share of the predicted decrease that a step must bring (Nocedal and Wright, sec. 3.1)
SHORTEST = 2.0**-12  # shortest share of a Gauss-Newton step that is tried
START_DAMPING = 1e-3  # share of the diagonal
NEAR = 1e-2  # |A dx| / |v| below which Levenberg-Marquardt hands over to Gauss-Newton
MAX_DAMPING = 1e10
METHODS = ("gauss-newton", "levenberg-marquardt", "undamped")


@dataclass(frozen=True)
class Optimum:
    """Where an iteration ended, with the undamped normal equations of its last step."""

    state: State
    normals: Normals
    factor: Factor
    motions: Motions
    converged: bool
    iterations: int
    vPv: float


def iterate(
    layout: Unknowns,
    weighted: Weighted,
    state: State,
    weight: FloatArray,
    datum: Datum,
    *,
    method: str = "gauss-newton",
    max_iterations: int = 50,
    tolerance: float = TOLERANCE,
) -> Optimum:
    """Return the state of least weighted sum of squares.

    Args:
        layout: order of the unknowns.
        weighted: observed unknowns.
        state: where to start.
        weight: factor on the weight of each image point, shape (k,).
        datum: kind and points.
        method: gauss-newton, levenberg-marquardt, or undamped (Gauss-Newton with full steps, to compare).
        max_iterations: steps to try at most.
        tolerance: |A dx| / |v| at which the iteration has converged.

    Raises:
        GeometryError: unknown method.
    """
    if method not in METHODS:
        raise GeometryError(f"adjustment: method '{method}' is none of {', '.join(METHODS)}")
    space = new_blocks(layout)
    taken = 0
    if method == "levenberg-marquardt":
        state, taken = _approach(layout, weighted, state, weight, datum, max_iterations, space)
    converged = False
    while True:
        normals = normal_equations(layout, weighted, state, weight, space=space)
        motions = motions_of(layout, weighted, state, datum)
        factored = factor(normals, motions)
        if factored is None:
            raise GeometryError("adjustment: the normal equations cannot be solved from these start values")
        reduced, points, predicted = _newton_step(normals, factored, motions, layout)
        converged = np.sqrt(predicted) <= max(tolerance * np.sqrt(normals.vPv), MIN_SHIFT)
        vPv = normals.vPv
        if converged:
            moved = step(layout, state, reduced, points)
            reached = total(layout, weighted, moved, weight)
            if reached <= vPv:
                state, vPv = moved, reached
            break
        if taken >= max_iterations:
            break
        taken += 1
        shortest = 1.0 if method == "undamped" else SHORTEST
        wanted = -np.inf if method == "undamped" else predicted
        found, reached = _line_search(layout, weighted, state, weight, reduced, points, vPv, wanted, shortest)
        if found is None:
            break
        state, vPv = found, reached
    return Optimum(state, normals, factored, motions, bool(converged), taken, vPv)


def _approach(
    layout: Unknowns,
    weighted: Weighted,
    state: State,
    weight: FloatArray,
    datum: Datum,
    max_iterations: int,
    space: Blocks,
) -> tuple[State, int]:
    """Return a state near the optimum by Levenberg-Marquardt, and how many steps were tried."""
    damping, growth = START_DAMPING, 2.0
    for taken in range(max_iterations):
        normals = normal_equations(layout, weighted, state, weight, damping=damping, space=space)
        motions = motions_of(layout, weighted, state, datum)
        factored = factor(normals, motions, damped=True)
        gain = -1.0
        if factored is not None:
            reduced, points, predicted = _newton_step(normals, factored, motions, layout)
            if np.sqrt(predicted) <= max(NEAR * np.sqrt(normals.vPv), MIN_SHIFT):
                return state, taken
            moved = step(layout, state, reduced, points)
            gain = (normals.vPv - total(layout, weighted, moved, weight)) / predicted
        if gain > ARMIJO:
            state = moved
            damping *= max(1 / 10, 1 - (2 * gain - 1) ** 3)
            growth = 2.0
        else:
            damping *= growth
            growth *= 2
        if damping > MAX_DAMPING:
            break
    return state, max_iterations


def total(layout: Unknowns, weighted: Weighted, state: State, weight: FloatArray) -> float:
    """Return v'Pv of image points and observed unknowns; infinite if a point is behind a camera."""
    return float(sum_of_squares(layout.obs, state, weight)) + weighted_vPv(weighted, layout, state)


def _newton_step(
    normals: Normals, factored: Factor, motions: Motions, layout: Unknowns
) -> tuple[FloatArray, FloatArray, float]:
    """Return the step in the datum and g'N^-1 g = |A dx|^2."""
    reduced = -factored.solve(normals.g)
    points = point_step(normals, reduced, layout)
    y = normals.blocks.y.ravel()
    predicted = float(y @ y - normals.g @ reduced)
    reduced, points = motions.transform(reduced, points)
    return reduced, points, max(predicted, 0.0)


def _line_search(
    layout: Unknowns,
    weighted: Weighted,
    state: State,
    weight: FloatArray,
    reduced: FloatArray,
    points: FloatArray,
    vPv: float,
    predicted: float,
    shortest: float,
) -> tuple[State | None, float]:
    """Return the first of the steps 1, 1/2, 1/4 ... that meets Armijo's condition; None if none does."""
    share = 1.0
    while share >= shortest:
        moved = step(layout, state, share * reduced, share * points)
        reached = total(layout, weighted, moved, weight)
        if np.isfinite(reached) and reached <= vPv - 2 * ARMIJO * share * predicted:
            return moved, reached
        share /= 2
    return None, vPv
