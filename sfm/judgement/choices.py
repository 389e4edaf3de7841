"""Choices of model: what else is solved where a solution suggests it, and which of the solutions is taken.

A stage has a table of choices, each a row: the models that a solution suggests, the evidence for the solution
of another model, and what is reported if it is taken. `choose` solves the models and takes the solution with
the most evidence. Evidence is the gain of ln likelihood minus the price, see `sfm.likelihood`. A choice that
a test has decided before has evidence without limit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from sfm.errors import GeometryError

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

        >>> from sfm.judgement.choices import Choice, choose
        >>> row = Choice(lambda _: [0.0, 2.0], lambda before, after: after - before)
        >>> choose(1.0, [row], solve=float)
        2.0
    """

    models: Callable[[Solution], Iterable[Model]]  # that a solution suggests, the usual ones first
    evidence: Callable[[Solution, Solution], float] = decided  # of another solution over the present one
    # the solution that is taken, with its remarks, from the present one and the chosen one
    report: Callable[[Solution, Solution], Solution] = lambda _, chosen: chosen
    suffices: Callable[[Solution], bool] = lambda _: False  # whether no further model is tried


def choose(
    present: Solution,
    choices: Sequence[Choice[Model, Solution]],
    solve: Callable[[Model], Solution],
) -> Solution:
    """Return the solution of the likeliest model.

    Args:
        present: solution of the usual model.
        choices: what else may be tried, one choice after another, each on the solution taken before.
        solve: returns the solution of a model; a GeometryError means that there is none.

    Raises:
        GeometryError: a model on which a test has decided has no solution.
    """
    for choice in choices:
        best, most = None, 0.0
        for model in choice.models(present):
            try:
                solution = solve(model)
            except GeometryError:
                if choice.evidence is decided:
                    raise
                continue
            evidence = choice.evidence(present, solution)
            if evidence > most:
                best, most = solution, evidence
                if choice.suffices(solution):
                    break
        if best is not None:
            present = choice.report(present, best)
    return present
