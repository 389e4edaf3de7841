"""The distributions of test statistics are those of scipy.stats, far into their tails."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sfm import distributions
from sfm.judgement.given.values import NONCENTRALITY
from tests.places import ROOT

LEVELS = (
    r"((?:[A-Z]+_)?(?:ALPHA|LEVEL|FALSE_ALARM|ALARM|FAMILY|CHANCE)|POWER)\b(?:: float)? = (?:0?\.\d|\d+e-)"
)
X = np.array([-2.0, -1e-9, 0.0, 1e-6, 0.01, 0.5, 1.0, 4.0, 30.0, 250.0])
P = np.array([1e-12, 1e-6, 1e-3, 0.05, 0.5, 0.95, 1 - 1e-6])


@pytest.mark.parametrize(
    ("ours", "theirs", "at", "redundancies"),
    [
        (distributions.chi2_sf, stats.chi2.sf, X, [(1,), (3,), (250,), (100_000,)]),
        (distributions.chi2_isf, stats.chi2.isf, P, [(1,), (3,), (250,), (100_000,)]),
        (distributions.chi2_ppf, stats.chi2.ppf, P, [(1,), (3,), (250,), (100_000,)]),
        (distributions.f_sf, stats.f.sf, X, [(1, 2), (3, 40), (200, 100_000)]),
        (distributions.t_sf, stats.t.sf, X, [(1,), (8,), (100_000,)]),
        (distributions.t_ppf, stats.t.ppf, P, [(1,), (8,), (100_000,)]),
        (distributions.normal_sf, stats.norm.sf, X, [()]),
        (distributions.normal_ppf, stats.norm.ppf, P, [()]),
    ],
)
def test_distributions_are_those_of_scipy(
    ours: Callable[..., Any], theirs: Callable[..., Any], at: Any, redundancies: list[tuple[int, ...]]
) -> None:
    for r in redundancies:
        np.testing.assert_allclose(ours(at, *r), theirs(at, *r), rtol=1e-9, atol=1e-300)


def test_poisson() -> None:
    np.testing.assert_allclose(
        distributions.poisson_sf(np.arange(-2, 9), 2.5), stats.poisson.sf(np.arange(-2, 9), 2.5), rtol=1e-12
    )


def test_f_is_exceeded_with_the_probability_asked_for() -> None:
    """scipy's own isf is the quantile of 1 - p, which loses five digits in the tail."""
    for r in ((1, 2), (3, 40), (200, 100_000)):
        np.testing.assert_allclose(stats.f.sf(distributions.f_isf(P, *r), *r), P, rtol=1e-9)


def test_an_error_that_is_called_detectable_is_found_with_the_stated_power() -> None:
    """Baarda (1968): 4.13 standard deviations at 0.1 % with 80 %."""
    critical = -distributions.normal_ppf(distributions.LEVEL / 2)
    assert pytest.approx(4.13, abs=0.005) == NONCENTRALITY
    found = distributions.normal_sf(critical - NONCENTRALITY)
    assert found == pytest.approx(distributions.POWER, abs=1e-6)


def test_levels_have_one_home() -> None:
    """Other modules import them, or have a number of another kind."""
    theirs = [
        ("distributions.py", "FALSE_ALARM"),
        ("distributions.py", "LEVEL"),
        ("distributions.py", "POWER"),
        ("orientation/resection/ransac.py", "CHANCE"),  # an expected number
    ]
    found = [
        (path.relative_to(ROOT / "sfm").as_posix(), named.group(1))
        for path in sorted((ROOT / "sfm").rglob("*.py"))
        for line in path.read_text(encoding="utf-8").splitlines()
        if (named := re.match(LEVELS, line))
    ]
    assert found == theirs
