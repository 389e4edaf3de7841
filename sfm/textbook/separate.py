"""Separate adjustment: object points and orientations in turn, in place of all unknowns together.

Each round first moves every object point with the orientations held (3 x 3 systems), then all
orientations with the points held (one system of the exterior orientations and the interior parameters).
It ends at the same optimum as the simultaneous adjustment, but converges only linearly and knows no
covariance between points and orientations: what it would call the precision of a point is the limiting
precision.

Source: document 000 of the project's sources, sec. 2.4; block coordinate descent in Nocedal and Wright,
Numerical Optimization (2006), sec. 9.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sfm.adjustment.engine.accumulate import Blocks
from sfm.adjustment.engine.collinearity import State, sum_of_squares
from sfm.adjustment.engine.normals import new_space, normal_equations
from sfm.adjustment.engine.observed import observed_of
from sfm.adjustment.engine.unknowns import Unknowns, estimate_of, start_weights, step, unknowns_of
from sfm.arguments import checked_arguments
from sfm.conventions import FloatArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network

TOLERANCE = 1e-13  # relative decrease of v'Pv in a round at which the rounds end
MIN_STEP_SHARE = 2.0**-12  # shortest share of a step that is tried


@dataclass(frozen=True)
class SeparateAdjustment:
    """Where the rounds ended."""

    estimate: Estimate  # adjusted interior and exterior orientation and points
    vPv: float  # weighted sum of squared residuals of the image points
    rounds: int  # that were computed
    converged: bool  # whether the last round decreased v'Pv by no more than the tolerance


@checked_arguments()
def adjust_separately(
    network: Network, estimate: Estimate, *, max_rounds: int = 2000, tolerance: float = TOLERANCE
) -> SeparateAdjustment:
    """Return the adjustment of points and orientations in turn.

    Each round moves every object point by itself, the orientations held, then all orientations, the points
    held. It ends at the optimum of `sfm.adjustment.solve.adjust`, but takes hundreds of rounds where that
    takes a few steps, and gives no covariance. The control points of the network, fixed, are the datum if
    there are any; else it stays where the start values put it.

    Args:
        network: image points, and control points if any.
        estimate: start values; photographs and points without (NaN) are held out.
        max_rounds: rounds at most.
        tolerance: relative decrease of v'Pv in a round at which the rounds end.

    Returns:
        Adjusted values, v'Pv, and whether it converged.

    Raises:
        GeometryError: scale bars or other observations, which join points to one another.

    Example:
        >>> adjust_separately(network, start).estimate.points  # doctest: +SKIP

    Source: Nocedal and Wright, Numerical Optimization (2006), sec. 9.3 (block coordinate descent).
    """
    layout, state = unknowns_of(network, estimate, use_control=True)
    observed = observed_of(network, layout, state, use_control=True)
    if observed:
        raise GeometryError(
            "separate adjustment: the network has scale bars or other observations, expected image points "
            "and fixed control only (adjust takes the others)"
        )
    weight = start_weights(layout, state)
    vPv = float(sum_of_squares(layout.observations, state, weight))
    space = new_space(layout)
    for number in range(1, max_rounds + 1):
        before = vPv
        for move in (_points, _orientations):
            normals = normal_equations(layout, observed, state, weight, space=space)
            reduced, points = move(normals.blocks, layout)
            state, vPv = _shorten(layout, state, weight, reduced, points, vPv)
        if before - vPv <= tolerance * before:
            return SeparateAdjustment(estimate_of(state, estimate), vPv, number, True)
    return SeparateAdjustment(estimate_of(state, estimate), vPv, max_rounds, False)


def _points(blocks: Blocks, layout: Unknowns) -> tuple[FloatArray, FloatArray]:
    """Step of the points, -V^-1 g, with the orientations held."""
    dX = -np.linalg.solve(blocks.V, blocks.gp[:, :, None])[:, :, 0]
    return np.zeros(layout.reduced), np.where(layout.point_free, dX, 0.0)


def _orientations(blocks: Blocks, layout: Unknowns) -> tuple[FloatArray, FloatArray]:
    """Step of exterior and interior orientation, -U^-1 g, with the points held."""
    m = len(layout.pose_free)
    U = np.zeros((layout.reduced, layout.reduced))
    g = np.zeros(layout.reduced)
    g[: 6 * m] = blocks.g.ravel()
    for i in range(m):
        U[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = np.triu(blocks.U[i])
        column = layout.interior_column[layout.observations.camera[i]]
        U[6 * i : 6 * i + 6, column] = blocks.C[i, :, : len(column)]
    for a, column in enumerate(layout.interior_column):
        f = len(column)
        U[np.ix_(column, column)] += blocks.D[a, :f, :f]
        g[column] += blocks.gi[a, :f]
    on = layout.reduced_free()
    scale = 1 / np.sqrt(np.diagonal(U)[on])
    factored = cho_factor(U[np.ix_(on, on)] * scale[:, None] * scale, lower=False)
    dx = np.zeros(layout.reduced)
    dx[on] = -scale * cho_solve(factored, scale * g[on])
    return dx, np.zeros(layout.point_free.shape)


def _shorten(
    layout: Unknowns, state: State, weight: FloatArray, reduced: FloatArray, points: FloatArray, vPv: float
) -> tuple[State, float]:
    """Return the state after the longest share of the step, by halves, that does not raise v'Pv."""
    share = 1.0
    while share >= MIN_STEP_SHARE:
        moved = step(layout, state, share * reduced, share * points)
        reached = float(sum_of_squares(layout.observations, moved, weight))
        if reached <= vPv:
            return moved, reached
        share /= 2
    return state, vPv
