"""The distributions of test statistics are those of scipy.stats, far into their tails."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sfm.adjustment.quality.statistics import non_centrality
from sfm.model import distributions
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
    delta0 = non_centrality()
    assert delta0 == pytest.approx(4.13, abs=0.005)
    found = distributions.normal_sf(critical - delta0)
    assert found == pytest.approx(distributions.POWER, abs=1e-6)


def test_levels_have_one_home() -> None:
    """Other modules import them, or have a number of another kind."""
    theirs = [
        ("model/distributions.py", "FALSE_ALARM"),
        ("model/distributions.py", "LEVEL"),
        ("model/distributions.py", "POWER"),
        ("orientation/resection/ransac.py", "CHANCE"),  # an expected number
    ]
    found = [
        (path.relative_to(ROOT / "sfm").as_posix(), named.group(1))
        for path in sorted((ROOT / "sfm").rglob("*.py"))
        for line in path.read_text(encoding="utf-8").splitlines()
        if (named := re.match(LEVELS, line))
    ]
    assert found == theirs


def test_the_tests_of_a_survey_have_its_levels() -> None:
    """`Levels` of the adjustment or of the survey file; others have no survey, or are asked before it."""
    without = {
        "targets/fits/": "targets are measured",
        "survey/sources/repeated.py": "tables of image points are read",
        "products/drafting/": "there is no survey file yet",
        "survey/diagnosis/photograph_cameras.py": "a number of trials",
        "products/planning/": "a plan",
        "comparison/": "two results",
        "cli/commands/epochs.py": "several results",
        "products/epochs/": "several results",
        "products/geometry/": "a shape",
    }
    users = set()
    for path in sorted((ROOT / "sfm").rglob("*.py")):
        name = path.relative_to(ROOT / "sfm").as_posix()
        code = re.sub(r"#.*", "", path.read_text(encoding="utf-8"))
        code = re.sub(
            r'""".*?"""|^(?:from|import) [^(\n]*\n|^from [^\n]*\([^)]*\)\n', "", code, flags=re.S | re.M
        )
        if re.search(r"(?<!: float = )\b(?:LEVEL|FAMILY|FALSE_ALARM)\b", code):
            users.add(next((prefix for prefix in without if name.startswith(prefix)), name))
    assert users - {"model/distributions.py", "survey/inputs/settings.py"} == set(without)


def test_all_levels_have_the_share_of_the_user() -> None:
    usual, strict = distributions.Levels(), distributions.Levels(distributions.FALSE_ALARM / 10)
    assert usual.false_alarm == distributions.FALSE_ALARM and usual.family == distributions.FAMILY
    assert usual == distributions.Levels(distributions.FALSE_ALARM)
    assert distributions.Levels(0.05).question == distributions.LEVEL  # whatever the default is
    assert strict.question == pytest.approx(usual.question / 10)
    assert strict.family == pytest.approx(usual.family / 10)
    assert strict.of_each(1000) == pytest.approx(usual.of_each(1000) / 10, rel=0.03)
