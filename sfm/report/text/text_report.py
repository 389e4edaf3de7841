"""report.txt: the bundle report on one page of plain text, as surveyors read it in a terminal.

Rank and datum, sigma0 and redundancy, tests, reliability, variance components, unknowns with their
standard deviations, correlations, worst residuals. No dates and hosts, so that two reports can be compared.
What it says stands in the template `report.txt`.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from sfm.adjustment.quality.statistics import STRONG
from sfm.report.findings.findings import Findings
from sfm.report.numbers import FILTERS, finer_unit, finer_unit_of
from sfm.report.phrases import NORMAL_95, PHRASES
from sfm.report.template_cache import template_cache
from sfm.report.text import filters as lines

MAX_ROWS = 12  # of a list; the rest is in the tables of the result
WORST = 5  # residuals and photographs


def text_report(findings: Findings) -> str:
    """Return the report as plain text of at most `lines.WIDTH` columns."""
    result = findings.result
    photographs = findings.statistics.photographs
    text = (
        _environment()
        .get_template("report.txt")
        .render(
            f=findings,
            r=result,
            a=result.adjustment,
            worst_photographs=np.argsort(-np.nan_to_num(photographs.sigma0), kind="stable")[:WORST],
            most=MAX_ROWS,
            worst=WORST,
        )
    )
    return lines.with_bars(text)


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("sfm.report.text"),
        autoescape=False,  # plain text
        undefined=StrictUndefined,
        finalize=lines.as_value,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        extensions=["jinja2.ext.do"],
        bytecode_cache=template_cache(__name__),
    )
    made.filters |= FILTERS
    made.filters |= {one.__name__: one for one in (lines.columns, lines.facts, lines.wrap)}
    made.globals |= PHRASES | {
        "NORMAL_95": NORMAL_95,
        "finer_unit": finer_unit,
        "finer_unit_of": finer_unit_of,
        "heading": lines.heading,
        "rule": "=" * lines.WIDTH,
        "strong": STRONG,
        "isnan": np.isnan,
    }
    return made
