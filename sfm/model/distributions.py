"""Distributions of test statistics, from special functions because `scipy.stats` takes a second to import.

The names follow `scipy.stats`: sf is the probability of exceeding x, isf its inverse, ppf the quantile. All
functions accept numbers or arrays, and return NaN for invalid arguments.

Source: Abramowitz, Stegun (1964), Handbook of Mathematical Functions, 26.4, 26.6, 26.7.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

# Probabilities of tests. All tests of image coordinates of a survey share the first.
FALSE_ALARM = 0.05  # that the tests of one kind, together, report anything in a result without errors
LEVEL = 0.001  # that one question is answered wrongly where there is no survey; Baarda (1968)
POWER = 0.8  # that an error of the size that is called detectable is found; Baarda (1968)
# Questions that share a false alarm. About a whole survey: alternatives, choices of model, points,
# photographs, divisions of these, cameras; more are asked, but not all are open in one survey. About single
# values of it: as many as give Baarda's 0.001 for a false alarm of 0.05.
WHOLE, SINGLE = 5, 50
FAMILY = FALSE_ALARM / WHOLE
MARGIN = 2 * np.log(1 / LEVEL)  # lead in -2 ln likelihood that distinguishes an explanation from others
MIN_LEAD = np.log(100)  # difference of ln likelihood below which two alternatives cannot be separated


@dataclass(frozen=True)
class Levels:
    """Levels of the tests of a survey or an adjustment, `levels` of its settings and of `Adjustment`.

    All have the same share of the probability that the user states.
    """

    false_alarm: float = FALSE_ALARM  # that a right result is called wrong; tests of one kind share it

    @property
    def question(self) -> float:
        """Level of one question about single values of the survey."""
        return self.false_alarm / SINGLE

    @property
    def family(self) -> float:
        """Level of a question about the whole survey."""
        return self.false_alarm / WHOLE

    def of_each(self, tests: int) -> float:
        """Level of each of several tests that share the false alarm, see `level_of_single`."""
        return level_of_single(self.false_alarm, tests)


def level_of_single(family: float, tests: int) -> float:
    """Return the level of each single test for a given probability that any of several tests rejects wrongly.

    Args:
        family: probability of a wrong rejection in all tests together.
        tests: number of tests.

    Source: Sidak (1967), J. Am. Stat. Assoc. 62.
    """
    return float(-np.expm1(np.log1p(-family) / max(tests, 1)))


def chi2_sf(x: Any, r: Any) -> Any:
    """Probability that chi-square of redundancy r is larger than x."""
    return special.chdtrc(r, np.maximum(x, 0.0))  # rounding can make a difference of squares negative


def chi2_isf(probability: Any, r: Any) -> Any:
    """Value that chi-square of redundancy r exceeds with a probability."""
    return special.chdtri(r, probability)


def chi2_ppf(probability: Any, r: Any) -> Any:
    """Value that chi-square of redundancy r stays below with a probability."""
    return 2 * special.gammaincinv(r / 2, probability)


def f_sf(x: Any, r1: Any, r2: Any) -> Any:
    """Probability that F of redundancies r1 and r2 is larger than x."""
    return special.fdtrc(r1, r2, np.maximum(x, 0.0))


def f_isf(probability: Any, r1: Any, r2: Any) -> Any:
    """Value that F of redundancies r1 and r2 exceeds with a probability.

    It is the reciprocal of the value that F of r2 and r1 stays below.
    """
    return 1 / special.fdtri(r2, r1, probability)


def t_sf(x: Any, r: Any) -> Any:
    """Probability that Student's t of redundancy r is larger than x."""
    return special.stdtr(r, -x)


def t_ppf(probability: Any, r: Any) -> Any:
    """Value that Student's t of redundancy r stays below with a probability."""
    return special.stdtrit(r, probability)


def nct_parameter(x: float, r: int, power: float) -> float:
    """Non-centrality at which Student's t of redundancy r exceeds x with the probability `power`."""
    return float(special.nctdtrinc(r, 1 - power, x))


def normal_sf(x: Any) -> Any:
    """Probability that a standard normal variable is larger than x."""
    return special.ndtr(-x)


def normal_ppf(probability: Any) -> Any:
    """Value that a standard normal variable stays below with a probability."""
    return special.ndtri(probability)


def poisson_sf(k: Any, expected: Any) -> Any:
    """Probability of more than k events, given their expected number."""
    return np.where(np.asarray(k) < 0, 1.0, special.pdtrc(np.maximum(k, 0), expected))[()]


def binomial_sf(k: Any, n: Any, p: Any) -> Any:
    """Probability of more than k events in n trials with probability p each."""
    return np.where(np.asarray(k) < 0, 1.0, special.bdtrc(np.maximum(k, 0), n, p))[()]
