"""Comparisons in the report of a survey: with the other adjuster, and with another pipeline."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.comparison.two_adjusters.adjusters import compare_adjusters
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.page import Paragraph, Statement, Table
from sfm.report.survey_comparison import adjuster_parts, pipeline_parts
from sfm.result import BaselineComparison, SurveyResult
from tests.other_adjuster import in_house_adjuster
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def result() -> SurveyResult:
    network, truth = make_network(seed_of("compared"), images=5, points=20, noise_px=0.1)
    a = adjust(network, truth, datum=Datum("free"))
    both = compare_adjusters(a, in_house_adjuster)
    return SurveyResult("compared", "m", 5, (), a, np.full(20, -1), both)


@pytest.mark.parametrize(
    ("changed", "level", "reasons"),
    [
        ({}, "good", 0),
        ({"stopped_early": True}, "good", 0),
        ({"backend_converged": False}, "good", 0),  # fits alike
        ({"backend_converged": False, "cost": (1.0, 2.0)}, "bad", 1),
    ],
)
def test_the_outcome_comes_first_with_its_reasons(
    result: SurveyResult, changed: dict[str, Any], level: str, reasons: int
) -> None:
    both = result.comparison
    assert both is not None
    cost = changed.pop("cost", both.comparison.cost)
    both = replace(both, comparison=replace(both.comparison, cost=cost), **changed)
    first, second, *_ = adjuster_parts(findings_of(replace(result, comparison=both)))
    assert isinstance(first, Statement) and first.level == level and first.text
    assert (isinstance(second, Table) and len(second.rows)) == (reasons or False)
    (none,) = adjuster_parts(findings_of(replace(result, comparison=None)))
    assert type(none) is Paragraph


def test_the_other_pipeline_is_compared_in_a_unit_that_reads_well(result: SurveyResult) -> None:
    found = BaselineComparison(
        "mapper", (5, 4), 5, (0.1, 0.5), 18, 0.25,
        np.full((18, 3), 1e-3), np.full((4, 3), 2e-3), np.full(4, 0.01), (2.0, 30.0),
    )  # fmt: skip
    _, both, apart, _ = pipeline_parts(findings_of(replace(result, baseline=found)))
    assert isinstance(both, Table) and isinstance(apart, Table)
    assert both.rows[0] == ("photographs oriented", "5 of 5", "4 of 5", "")
    assert both.rows[2][1:] == ("0.100", "0.250", "px")
    (_, point, _, unit), (_, centre, _, same), rotation = apart.rows
    assert float(centre) == 2 * float(point) and unit == same and rotation[-1] == "deg"
    assert list(pipeline_parts(findings_of(result))) == []
