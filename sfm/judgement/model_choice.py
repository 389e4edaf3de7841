"""Choices of model: what else is solved where a solution suggests it, and which of the solutions is taken.

A stage has a table of choices, each a row: the models that a solution suggests, the gain of ln likelihood by
the solution of another model, the parameters that it adds, and what is reported if it is taken. `choose`
solves the models and takes the solution with the most evidence, which is the gain minus the price. A choice
that a test has decided before has evidence without limit.

The price is that of the further parameters (`sfm.model.likelihood.price_of`), and ln of the number of
alternatives over the level. Chance makes a wrong model likelier than the right one by the factor 1 / level
in a share of at most `level` of all cases. Another solution with no further parameters has no price.

Source: Kass and Raftery (1995), J. Am. Stat. Assoc. 90 (parameters); Ville (1939), Etude critique de la
notion de collectif (bound on a ratio of likelihoods).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from sfm.model.distributions import FALSE_ALARM, Levels
from sfm.model.errors import GeometryError
from sfm.model.likelihood import price_of

Solution = TypeVar("Solution")
Model = TypeVar("Model")


def decided(_: Any, __: Any) -> float:
    """Return the evidence for a solution whose model a test has decided before."""
    return float("inf")


@dataclass(frozen=True)
class Choice(Generic[Model, Solution]):
    """A choice between the model of a solution and others.

    Example:
        The mean of a sample, or none:

        >>> from sfm.judgement.model_choice import Choice, choose
        >>> row = Choice(lambda _: [0.0, 2.0], lambda before, after: after - before)
        >>> choose(1.0, [row], solve=float)
        2.0
    """

    models: Callable[[Solution], Iterable[Model]]  # that a solution suggests, the usual ones first
    gain: Callable[[Solution, Solution], float] = decided  # of ln likelihood, from the present to another one
    # further parameters of another solution in groups, each with the number of image points that it moves
    further: Callable[[Solution, Solution], Iterable[tuple[int, int]]] = lambda _, __: ()
    # the solution that is taken, with its remarks, from the present one and the chosen one
    report: Callable[[Solution, Solution], Solution] = lambda _, chosen: chosen
    suffices: Callable[[Solution], bool] = lambda _: False  # whether no further model is tried
    onward: bool = False  # whether a solution that is not taken suggests models too
    behind: int = 1  # alternatives behind each model: start values, and photographs that are asked the same


def choose(
    present: Solution,
    choices: Sequence[Choice[Model, Solution]],
    solve: Callable[[Model], Solution],
    *,
    false_alarm: float = FALSE_ALARM,
) -> Solution:
    """Return the solution of the likeliest model.

    Args:
        present: solution of the usual model.
        choices: what else may be tried, one choice after another, each on the solution taken before.
        solve: returns the solution of a model; a GeometryError means that there is none.
        false_alarm: probability that a right result is called wrong, as the user states it.

    Raises:
        GeometryError: a model on which a test has decided has no solution.
    """
    for choice in choices:
        models, best, most = deque(choice.models(present)), None, 0.0
        search = float(np.log(max(len(models), 1) * choice.behind / Levels(false_alarm).family))
        while models:
            model = models.popleft()
            try:
                solution = solve(model)
            except GeometryError:
                if choice.gain is decided:
                    raise
                continue
            prices = [price_of(*group) for group in choice.further(present, solution)]
            evidence = choice.gain(present, solution) - (sum(prices) + search if prices else 0.0)
            if evidence > most:
                best, most = solution, evidence
                if choice.suffices(solution):
                    break
            elif choice.onward:
                models.extend(choice.models(solution))
        if best is not None:
            present = choice.report(present, best)
    return present


def solve_likeliest(
    usual: Model,
    choices: Sequence[Choice[Model, Solution | None]],
    solve: Callable[[Model], Solution],
    *,
    false_alarm: float = FALSE_ALARM,
) -> Solution:
    """Return the solution of the likeliest model, of which the usual one need have none.

    Without its solution, the rows are given None in its place. The other arguments are those of `choose`.

    Raises:
        GeometryError: no model has a solution; the reason is that of the usual one.
    """
    try:
        present: Solution | None = solve(usual)
    except GeometryError:
        present = choose(None, choices, solve, false_alarm=false_alarm)
        if present is None:
            raise
        return present
    chosen = choose(present, choices, solve, false_alarm=false_alarm)
    assert chosen is not None
    return chosen
