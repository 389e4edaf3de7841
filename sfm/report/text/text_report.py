"""report.txt: the bundle report on one page of plain text, as surveyors read it in a terminal.

Rank and datum, sigma0 and redundancy, tests, reliability, variance components, unknowns with their
standard deviations, correlations, worst residuals. No dates and hosts, so that two reports can be compared.
Its text is in the template `report.txt`.

Lines, headings and columns of the reports in plain text, as filters of templates.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from sfm.adjustment.quality.statistics import STRONG
from sfm.display import NO_BREAK, aligned, bound
from sfm.report.findings.findings import Findings
from sfm.report.numbers import FILTERS, finer_unit, finer_unit_of
from sfm.report.phrases import NORMAL_95, PHRASES
from sfm.report.template_cache import template_cache
from sfm.report.text import text_report as lines

WIDTH = 100
MAX_CHARACTERS = 40  # of a cell in columns
NAME_WIDTH = 21  # of what a fact is about
KEPT_BAR = "\x1f"  # stands for a bar in a name until the columns are set

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


def heading(title: str) -> str:
    """Return a heading with a rule behind it."""
    return f"{title} ".ljust(WIDTH, "-")


def as_value(value: object) -> str:
    """Return a value as it may stand in a template: in one line, no bar of its own taken for a column's."""
    return " ".join(str(value).splitlines()).replace("|", KEPT_BAR)


def with_bars(text: str) -> str:
    """Return a finished text with the bars that stood in its values."""
    return text.replace(KEPT_BAR, "|")


def facts(text: str) -> str:
    """Set lines `name | what is told of it`, each on as many lines as it needs, one below the other."""
    told = (cells for cells in map(_cells, text.splitlines()) if any(cells))
    lines = (f"  {name:<{NAME_WIDTH}} {' | '.join(words)}" for name, *words in told)
    return "".join(f"{wrapped(line, behind=NAME_WIDTH + 3)}\n" for line in lines)


def columns(text: str, left: int) -> str:
    """Set lines of cells between bars in columns; the first `left` ones to the left, numbers to the right."""
    rows = [_cells(line) for line in text.splitlines() if line.strip()]
    rows = [[cell[:MAX_CHARACTERS] if c < left else cell for c, cell in enumerate(row)] for row in rows]
    lines = aligned(rows, [c < left for c in range(len(rows[0]))])
    return "".join(f"  {line}".rstrip() + "\n" for line in lines)


def wrap(text: str) -> str:
    """Break long lines between words; what follows stands two spaces behind the beginning of the first."""
    lines = (line.rstrip() for line in text.splitlines())
    return "".join(f"{wrapped(line, behind=len(line) - len(line.lstrip()) + 2)}\n" for line in lines if line)


def wrapped(line: str, *, behind: int) -> str:
    """Break a line between words, not before a unit; what follows stands behind so many spaces."""
    lines, rest = [], bound(line.rstrip())
    while len(rest) > WIDTH:
        cut = rest.rfind(" ", behind + 1, WIDTH)
        cut = WIDTH if cut < 0 else cut
        lines.append(rest[:cut])
        rest = " " * behind + rest[cut:].strip()
    return "\n".join([*lines, rest]).replace(NO_BREAK, " ")


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split("|")]
