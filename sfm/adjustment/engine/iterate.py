"""Iteration of the normal equations to the least sum of squares.

The method is Gauss-Newton with an Armijo line search, or Levenberg-Marquardt to approach the optimum and
Gauss-Newton to finish. The last steps are undamped in either case. A bent valley allows only short straight
steps; there a longer step is corrected back to the bottom of the valley. If only the values are wanted, the
last step may use the current gradient with the reduced matrix of the step before (simplified Newton). A step
that would bring a point behind a camera has an infinite sum of squares and is shortened or damped.

The iteration has converged when the predicted change of the adjusted observations, |A dx| weighted, is at
most `tolerance` times the residuals |v|, or at most MIN_SHIFT. With MIN_SHIFT no unknown would move by more
than that fraction of its a priori standard deviation.

Source: Boerlin and Grussenmeyer (2013), Photogrammetric Record 28(144), for criterion, line search and
veto; Nielsen (1999), IMM-REP-1999-05, for the damping; Deuflhard (2011), Newton Methods for Nonlinear
Problems, sec. 2.1.2, for the simplified step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NoReturn, Protocol

import numpy as np

from sfm.adjustment.datum import Motions, ResolvedDatum, motions_of, on_sound_points, with_further
from sfm.adjustment.engine.collinearity import State, sum_of_squares
from sfm.adjustment.engine.normals import NormalEquations, Space, new_space, normal_equations
from sfm.adjustment.engine.observed import ObservedKind, coupled_poses, vPv_of
from sfm.adjustment.engine.solvers.choice import blocks_of, choose_solver
from sfm.adjustment.engine.solvers.dense import DenseSolver
from sfm.adjustment.engine.solvers.protocol import Factor, Solver
from sfm.adjustment.engine.unknowns import Unknowns, step
from sfm.model.conventions import FloatArray
from sfm.model.errors import DivergedError, GeometryError
from sfm.runtime.progress import keep_freed_memory

TOLERANCE = 1e-6
MIN_SHIFT = 1e-6
ARMIJO = 1e-4  # share of the predicted decrease that a step must achieve (Nocedal and Wright, sec. 3.1)
MIN_STEP_SHARE = 2.0**-12  # smallest share of a Gauss-Newton step that is tried
BENT_STEP_SHARE = 0.25  # share of a Gauss-Newton step below which a valley counts as bent
CORRECTIONS = 3  # steps back to the bottom of a valley
START_DAMPING = 1e-3  # share of the diagonal
UNDAMPED_TOLERANCE = 1e-2  # |A dx| / |v| below which Levenberg-Marquardt hands over to Gauss-Newton
MAX_DAMPING = 1e10
ROUNDING = 1e-12  # relative difference between sums of the same squares in different orders
FAR_TOLERANCE = 0.9  # |A dx| / |v| above which the step after the next is not expected to be the last
# |A dx| / |v| of a step below which its reduced matrix may be used to test whether the next step is the last.
SIMPLIFIED_TOLERANCE = 0.8
SINGLE_TOLERANCE = 1e-2  # |A dx| / |v| above which steps may come from a product in single precision
METHODS = ("gauss-newton", "levenberg-marquardt", "undamped")


@dataclass(frozen=True)
class Optimum:
    """Result of an iteration, with the undamped normal equations of its last step."""

    state: State
    equations: NormalEquations
    factor: Factor
    motions: Motions
    converged: bool
    iterations: int
    vPv: float
    start_vPv: float  # v'Pv at the start values


class Former(Protocol):
    """Forms the normal equations of one network."""

    def normal_equations(self, state: State, weight: FloatArray, damping: float) -> NormalEquations:
        """Return the normal equations at a state with object points eliminated.

        Args:
            state: values of all parameters.
            weight: factor on the weight of each image point, (k,).
            damping: share of its diagonal added to the whole normal matrix.
        """

    def vPv(self, state: State, weight: FloatArray) -> float:
        """Return v'Pv of all observations; infinite if a point is behind a camera."""


@dataclass(frozen=True)
class InOnePiece:
    """Forms the normal equations in this process."""

    layout: Unknowns
    observed: tuple[ObservedKind, ...]
    space: Space  # memory of the normal equations, reused in every step

    def normal_equations(self, state: State, weight: FloatArray, damping: float) -> NormalEquations:
        """Return the normal equations at a state, see `Former.normal_equations`."""
        return normal_equations(self.layout, self.observed, state, weight, damping=damping, space=self.space)

    def vPv(self, state: State, weight: FloatArray) -> float:
        """Return v'Pv of all observations; infinite if a point is behind a camera."""
        return sum_of_squares(self.layout.observations, state, weight) + vPv_of(self.observed, state)


@dataclass(frozen=True)
class Problem:
    """Constants of all steps and rounds of an adjustment."""

    layout: Unknowns  # order of the unknowns
    observed: tuple[ObservedKind, ...]  # observations other than image points
    datum: ResolvedDatum
    former: Former  # forms the normal equations
    solver: Solver  # solver of the reduced normal equations


@dataclass(frozen=True)
class Move:
    """A step in the datum."""

    reduced: FloatArray  # step of the reduced unknowns, (reduced,)
    points: FloatArray  # step of the object points, (n, 3)
    predicted: float  # g'N^-1 g = |A dx|^2 without damping
    vPv: float  # v'Pv at its start


@dataclass(frozen=True)
class Step(Move):
    """A step with the normal equations that it comes from."""

    equations: NormalEquations
    factor: Factor
    motions: Motions

    def move(self) -> Move:
        """Return the step without the normal equations, which take much memory."""
        return Move(self.reduced, self.points, self.predicted, self.vPv)

    def within(self, share: float) -> bool:
        """Return whether |A dx| is at most this share of |v|, or at most MIN_SHIFT."""
        return bool(np.sqrt(self.predicted) <= max(share * np.sqrt(self.vPv), MIN_SHIFT))


def problem_of(layout: Unknowns, observed: tuple[ObservedKind, ...], datum: ResolvedDatum) -> Problem:
    """Return the constants of an adjustment, including the solver chosen for its normal equations.

    Args:
        layout: order of the unknowns.
        observed: observations other than image points.
        datum: kind and points.
    """
    keep_freed_memory()
    blocks = blocks_of(layout, observed)
    if blocks is not None:
        return Problem(layout, observed, datum, blocks, blocks)
    solver = DenseSolver(layout) if len(coupled_poses(observed, layout)) else choose_solver(layout)
    return Problem(layout, observed, datum, InOnePiece(layout, observed, new_space(layout)), solver)


def iterate(
    problem: Problem,
    state: State,
    weight: FloatArray,
    *,
    method: str = "gauss-newton",
    max_iterations: int = 50,
    tolerance: float = TOLERANCE,
    near: bool = False,
    exact: bool = True,
) -> Optimum:
    """Return the state with the least weighted sum of squares.

    Args:
        problem: constants of the adjustment.
        state: start values.
        weight: factor on the weight of each image point, shape (k,).
        method: gauss-newton, levenberg-marquardt, or undamped (Gauss-Newton with full steps, for comparison).
        max_iterations: largest number of steps.
        tolerance: |A dx| / |v| at which the iteration has converged.
        near: whether the start is near the optimum; then no step is computed in single precision.
        exact: whether the factor must belong to the normal equations of the last step, as a covariance
            requires; if not, it may belong to the step before.

    Raises:
        GeometryError: unknown method, or start values with normal equations that cannot be solved.
    """
    if method not in METHODS:
        raise GeometryError(f"adjustment: method '{method}', expected one of {', '.join(METHODS)}")
    layout = problem.layout
    single = problem.solver.has_coarse and not near
    taken, first = 0, state
    start_vPv: float | None = None
    if method == "levenberg-marquardt":
        state, taken, start_vPv = _approach(problem, state, weight, max_iterations, single)
        single = False
    share = 1.0
    before: tuple[State, Move] | None = None
    limit = np.inf
    shortest = 1.0 if method == "undamped" else MIN_STEP_SHARE
    last: Factor | None = None
    while True:
        move = _solve(problem, state, weight, single=single, limit=limit, last=last, tolerance=tolerance)
        if move is None:
            if before is None:
                if state is first:
                    _refuse(problem, state)
                state = first  # the damped steps have led to equations that cannot be solved
                continue
            shorter = _shorter_step(problem, before, weight, share, shortest)
            if shorter is None:
                state, move = before[0], _solve(problem, before[0], weight)
                break
            (state, share), limit = shorter, np.inf
            continue
        start_vPv = move.equations.vPv if start_vPv is None else start_vPv
        if move.within(tolerance) or taken >= max_iterations:
            break
        taken += 1
        single = single and not move.within(FAR_TOLERANCE)
        before, share = (state, move.move()), 1.0
        state = step(layout, state, move.reduced, move.points)  # tested by the next normal equations
        limit = _most_allowed(before[1], share, shortest)
        last = None if exact or not move.within(SIMPLIFIED_TOLERANCE) else move.factor
        del move  # its memory is needed for the next step
    if move is None:
        _refuse(problem, state)
    converged, vPv = move.within(tolerance), move.equations.vPv
    if converged:
        moved = step(layout, state, move.reduced, move.points)
        reached = total(problem, moved, weight)
        if reached <= vPv * (1 + ROUNDING):
            state, vPv = moved, reached
    start_vPv = vPv if start_vPv is None else start_vPv
    return Optimum(state, move.equations, move.factor, move.motions, converged, taken, vPv, start_vPv)


def _refuse(problem: Problem, state: State) -> NoReturn:
    """Raise the reason why the normal equations of the start values cannot be solved."""
    motions_of(problem.layout, problem.observed, state, problem.datum)  # raises if the datum is the reason
    raise GeometryError("adjustment: the normal equations cannot be solved from these start values")


def optimum_at(problem: Problem, state: State, weight: FloatArray) -> Optimum | None:
    """Return the normal equations at a state taken as the optimum; None if they cannot be solved.

    Args:
        problem: constants of the adjustment.
        state: values of all parameters.
        weight: factor on the weight of each image point, (k,).
    """
    move = _solve(problem, state, weight)
    if move is None:
        return None
    vPv = move.equations.vPv
    return Optimum(state, move.equations, move.factor, move.motions, True, 0, vPv, vPv)


def _solve(
    problem: Problem,
    state: State,
    weight: FloatArray,
    *,
    damping: float = 0.0,
    single: bool = False,
    limit: float = np.inf,
    last: Factor | None = None,
    tolerance: float = 0.0,
) -> Step | None:
    """Return the step from a state; None if the normal equations cannot be solved or v'Pv is too large.

    Args:
        problem: constants of the adjustment.
        state: start of the step.
        weight: factor on the weight of each image point, shape (k,).
        damping: share of its diagonal added to the normal matrix.
        single: whether single precision suffices while the step is far from convergence.
        limit: largest v'Pv accepted.
        last: factor of the step before, used if it shows convergence.
        tolerance: |A dx| / |v| of convergence.
    """
    p, layout = problem, problem.layout
    equations = p.former.normal_equations(state, weight, damping)
    if equations.vPv > limit or not (np.isfinite(equations.vPv) and np.isfinite(equations.g).all()):
        return None
    try:
        motions = motions_of(layout, p.observed, state, on_sound_points(p.datum, equations.held))
    except GeometryError:  # the datum points have moved together during the iteration
        return None
    try:
        if last is not None:
            tried = _step(p, equations, last, motions)
            if tried.within(tolerance):
                return tried
        for coarse in (True, False) if single else (False,):
            factored = p.solver.factor(equations, motions, damped=damping > 0, coarse=coarse)
            if factored is None:
                continue
            tried = _step(p, equations, factored, motions)
            if not (coarse and tried.within(SINGLE_TOLERANCE)):
                return tried
    except DivergedError:
        return None
    return None


def _step(problem: Problem, equations: NormalEquations, factor: Factor, motions: Motions) -> Step:
    layout = problem.layout
    datum = on_sound_points(problem.datum, equations.held)
    motions = with_further(motions, factor.further, equations, layout, datum)
    with np.errstate(over="ignore", invalid="ignore"):  # an infinite step is refused by its sum of squares
        reduced = -factor.solve(equations.g)
        points = equations.point_step(reduced)
        predicted = max(equations.y_squared - float(equations.g @ reduced), 0.0)
        dx, dX = motions.transform(reduced, points)
    return Step(dx, dX, predicted, equations.vPv, equations, factor, motions)


def _approach(
    problem: Problem, state: State, weight: FloatArray, max_iterations: int, single: bool
) -> tuple[State, int, float | None]:
    """Return a state near the optimum by Levenberg-Marquardt, the number of steps and v'Pv at the start."""
    damping, growth = START_DAMPING, 2.0
    start_vPv: float | None = None
    for taken in range(max_iterations):
        move = _solve(problem, state, weight, damping=damping, single=single)
        gain = -1.0
        if move is not None:
            start_vPv = move.equations.vPv if start_vPv is None else start_vPv
            if move.within(UNDAMPED_TOLERANCE):
                return state, taken, start_vPv
            moved = step(problem.layout, state, move.reduced, move.points)
            gain = (move.equations.vPv - total(problem, moved, weight)) / move.predicted
        if gain > ARMIJO:
            state = moved
            damping *= max(1 / 10, 1 - (2 * gain - 1) ** 3)
            growth = 2.0
        else:
            damping *= growth
            growth *= 2
        move = None  # its memory is needed for the next step
        if damping > MAX_DAMPING:
            break
    return state, max_iterations, start_vPv


def total(problem: Problem, state: State, weight: FloatArray) -> float:
    """Return v'Pv of all observations; infinite if a point is behind a camera.

    Args:
        problem: constants of the adjustment.
        state: values of all parameters.
        weight: factor on the weight of each image point, (k,).
    """
    return problem.former.vPv(state, weight)


def _shorter_step(
    problem: Problem, before: tuple[State, Move], weight: FloatArray, share: float, shortest: float
) -> tuple[State, float] | None:
    """Return the state after less of the step before, and the share; None if no share can be taken.

    Args:
        problem: constants of the adjustment.
        before: start of the step, and the step.
        weight: factor on the weight of each image point, shape (k,).
        share: share of the step that led to equations that cannot be solved, or to a larger sum of squares.
        shortest: last share to try.
    """
    start, move = before
    better = _line_search(problem, start, weight, move, share / 2, shortest)
    if share == 1.0 and better is not None and better[1] < BENT_STEP_SHARE:
        better = _along_valley(problem, start, weight, move, better[1]) or better
    return better


def _line_search(
    problem: Problem, state: State, weight: FloatArray, move: Move, share: float, shortest: float
) -> tuple[State, float] | None:
    """Halve a share of a step until it meets Armijo's condition; return the new state and the share.

    Args:
        problem: constants of the adjustment.
        state: start of the step.
        weight: factor on the weight of each image point, shape (k,).
        move: the step.
        share: first share to try.
        shortest: last share to try; 1 accepts the full step without a condition, if it can be computed.
    """
    while share >= shortest:
        moved = step(problem.layout, state, share * move.reduced, share * move.points)
        reached = total(problem, moved, weight)
        if np.isfinite(reached) and reached <= _most_allowed(move, share, shortest):
            return moved, share
        share /= 2
    return None


def _along_valley(
    problem: Problem, start: State, weight: FloatArray, move: Move, straight: float
) -> tuple[State, float] | None:
    """Follow a bent valley along a share of a step; return the new state and the share.

    A straight step soon leaves such a valley, and small shares of it make little progress. So a longer share
    is taken and then corrected back to the bottom. A correction is the next step with the condition that the
    reduced unknowns do not move along the first step. A straight share s leaves the bottom by an amount
    proportional to s^2, and its correction misses by the square of that. So the root of the straight share is
    possible.

    Args:
        problem: constants of the adjustment.
        start: start of the step.
        weight: factor on the weight of each image point, shape (k,).
        move: the step.
        straight: share of the step that can be taken straight.
    """
    along, share = move.reduced, float(np.sqrt(straight))
    allowed, height = _most_allowed(move, share, MIN_STEP_SHARE), np.inf
    moved = step(problem.layout, start, share * move.reduced, share * move.points)
    for _ in range(CORRECTIONS):
        back = _solve(problem, moved, weight)
        if back is None or back.vPv > height / 2:  # the correction does not lead back
            return None
        height = back.vPv
        with np.errstate(over="ignore", invalid="ignore"):  # as in `_step`
            z = back.factor.solve(along)
            nothing = back.equations.point_step(np.zeros_like(z))
            z, Z = back.motions.transform(z, back.equations.point_step(z) - nothing)
            part = float(along @ back.reduced) / float(along @ z)
            moved = step(problem.layout, moved, back.reduced - part * z, back.points - part * Z)
        if total(problem, moved, weight) <= allowed:
            return moved, share
    return None


def _most_allowed(move: Move, share: float, shortest: float) -> float:
    """Return the largest v'Pv at which a share of a step meets Armijo's condition."""
    if shortest == 1.0:
        return np.inf
    return move.vPv * (1 + ROUNDING) - share * 2 * ARMIJO * move.predicted
