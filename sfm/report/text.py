"""A declared page as plain text: tables in columns, facts and sentences in lines, the first rows of each.

Figures, notes, and what a click unfolds on the page are left out, unless it is declared to be in texts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from sfm.display import NO_BREAK, bound
from sfm.report.figures.plot_data import Plot
from sfm.report.page import (
    Cards,
    FoldedParts,
    Heading,
    Note,
    Page,
    Paragraph,
    Part,
    Subheading,
    Table,
    one_line,
)

WIDTH = 100
MAX_ROWS = 10  # of a table
NAME_WIDTH = 36  # of what a fact is about, at most
MARGIN = "  "


def text(page: Page) -> str:
    """Return a page as text of at most `WIDTH` columns."""
    lines = [f"KOLINEAR  {one_line(page.title)}"[:WIDTH], "=" * WIDTH]
    lines += wrapped(one_line(page.verdict.headline), behind=0)
    for one in page.verdict.lines:
        lines += wrapped(one_line(f"- {one.severity}: {one.text} {one.remedy}"), behind=2)
    for section in page.sections:
        found = list(_lines(section.parts)) if section.in_text else []
        if found:
            lines += ["", f"{section.title} ".ljust(WIDTH, "="), *found]
    return "\n".join(lines) + "\n"


def _lines(parts: Iterable[Part]) -> Iterator[str]:
    heading: list[str] = []  # written before what is below it
    for part in parts:
        found: list[str] = []
        match part:
            case Plot() | Note() | Cards():
                continue
            case Heading():
                heading = ["", f"{one_line(part.text)} ".ljust(WIDTH, "-")]
            case Subheading():
                heading += ["", *wrapped(MARGIN + one_line(part.text), behind=4)]
            case FoldedParts():
                found = list(_lines(part.parts)) if part.in_text else []
            case Paragraph():
                found = wrapped(MARGIN + one_line(part.text), behind=4)
            case Table():
                found = _facts(part) if part.facts else _table(part)
        if found:
            yield from (*heading, *found)
            heading = []


def _facts(table: Table) -> list[str]:
    rows = [[one_line(str(cell)) for cell in row] for row in table.cells]
    width = min(max((len(name) for name, _ in rows), default=0), NAME_WIDTH)
    return [
        line
        for name, words in rows
        for line in wrapped(f"{MARGIN}{name:<{width}}  {words}", behind=width + 4)
    ]


def _table(table: Table) -> list[str]:
    """Return the first rows in columns; each as a sentence where the columns are too wide."""
    lines = [MARGIN + line for line in table.lines(MAX_ROWS)]
    if max(map(len, lines)) > WIDTH:
        before = ["" if one.format is None else f"{one.heading} " for _, one in table.shown]
        rows = ([one_line(str(cell)) for cell in row] for row in table.first(MAX_ROWS))
        named = ([b + cell for b, cell in zip(before, row, strict=True) if cell] for row in rows)
        sentences = (f"{MARGIN}{name}: {'; '.join(cells)}" for name, *cells in named)
        lines = [line for one in sentences for line in wrapped(one, behind=4)]
    if len(table.rows) > MAX_ROWS:
        where = f", in {table.source}" if table.source else ""
        lines.append(f"{MARGIN}and {len(table.rows) - MAX_ROWS} more{where}")
    return lines


def wrapped(line: str, *, behind: int) -> list[str]:
    """Return a line broken between words, not before a unit; the others begin behind so many spaces."""
    lines, rest = [], bound(line.rstrip())
    while len(rest) > WIDTH:
        cut = rest.rfind(" ", behind + 1, WIDTH)
        cut = WIDTH if cut < 0 else cut
        lines.append(rest[:cut])
        rest = " " * behind + rest[cut:].strip()
    return [one.replace(NO_BREAK, " ") for one in (*lines, rest)]
