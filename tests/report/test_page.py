"""Declared pages: tables on the page, in files and on the terminal; a new page in one file and one row."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
from rich.console import Console

from sfm.cli.console import print_remarks
from sfm.files.result_tables import GIVEN
from sfm.model.conventions import FloatArray
from sfm.model.remarks.remark import remark
from sfm.model.remarks.verdict import Line, judge
from sfm.report.page import (
    MAX_ROWS,
    YES,
    Banner,
    Card,
    Cards,
    Column,
    FoldedParts,
    Heading,
    Link,
    Mark,
    Note,
    Page,
    Paragraph,
    Section,
    Statement,
    Subheading,
    Table,
    Tile,
    axes,
    columns_of,
    facts,
)
from sfm.report.pages import MAX_ROWS as MAX_TEXT_ROWS
from sfm.report.pages import PAGES, WIDTH, html, page_of, write_page
from sfm.report.pages import text as text_of
from sfm.report.phrases import significant

EVIL = "<img src=x onerror=alert(1)>"


@dataclass(frozen=True)
class Levelling:
    """Heights of points over those of a levelling: what the exercise shows on a page of its own."""

    names: tuple[str, ...]
    difference: FloatArray  # m, (n,)
    sigma: float  # m


def page(found: Levelling) -> Page:
    """Return the page of a levelling; with its row in PAGES all that a new page needs."""
    level, sigma = found.difference, found.sigma
    columns = (
        Column("point", "id"),
        Column("difference", "dZ", "mm", "+.2f", 1000.0, unknown="not levelled"),
        Column("within 3 sigma", "agrees", flag=YES),
    )
    rows = list(zip(found.names, level, np.abs(level) <= 3 * sigma, strict=True))
    worst = f"{significant(1000 * np.nanmax(np.abs(level)))} mm at most"
    return Page(
        "levelling",
        "Levelling",
        "Heights",
        judge((), {"good": worst, "fair": worst, "bad": worst}),
        (
            Section("Heights", facts([("Sigma", f"{significant(1000 * sigma)} mm")]), Note("Levelled.")),
            Section("Points", FoldedParts("all", Table(columns, rows, "heights"))),
        ),
        summary={"sigma": sigma, "largest": np.nanmax(np.abs(level)), "differences": level},
    )


@pytest.fixture
def levelling(monkeypatch: pytest.MonkeyPatch) -> Levelling:
    monkeypatch.setitem(PAGES, "Levelling", f"{__name__}:page")  # the row
    return Levelling((EVIL, "=B", "C"), np.array([0.0012345, -0.02, np.nan]), 0.001)


def test_a_new_page_is_one_file_and_one_row(levelling: Levelling, tmp_path: Path) -> None:
    path = write_page(levelling, tmp_path / "out")
    files = ("heights.csv", "levelling.html", "levelling.json", "manifest.json")
    assert sorted(one.name for one in path.parent.iterdir()) == list(files)
    with (path.parent / "heights.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [["id", "dZ", "agrees"], [EVIL, "0.0012345", "1"], ["'=B", "-0.02", "0"], ["C", "", "0"]]
    assert json.loads((path.parent / "levelling.json").read_text()) == {
        "sigma": 0.001,
        "largest": 0.02,
        "differences": [0.0012345, -0.02, None],
    }
    text = path.read_text()
    assert EVIL not in text and "&lt;img src=x" in text
    assert "<strong>20.0 mm at most</strong>" in text and "<h2>Points</h2>" in text
    assert "<th class=n>difference [mm]</th>" in text and "<td class=n>+1.23</td>" in text
    assert "<td>not levelled</td><td></td>" in text and "<td>yes</td>" in text
    assert page_of(levelling).text.splitlines() == ["Heights", "  Sigma  1.00 mm"]  # points are folded
    assert page_of(levelling).tables[0].text.splitlines()[1:] == [
        f"{EVIL}            +1.23  yes",
        f"=B{'-20.00':>43}",
        f"C{'not levelled':>44}",
    ]


@pytest.mark.parametrize("shown", PAGES)
def test_every_row_leads_to_a_declaration_of_its_type(shown: str) -> None:
    module, function = PAGES[shown].split(":")
    hints = get_type_hints(getattr(import_module(module), function))
    assert next(iter(hints.values())).__name__ == shown and hints["return"] is Page


def small(*parts: object, **options: object) -> Page:
    sections = (Section("S", *parts), Section("Empty", None))  # type: ignore[arg-type]
    return Page("x", "Kind", "Title", Banner("good", "Fine."), sections, **options)  # type: ignore[arg-type]


def test_every_kind_of_part_is_rendered_and_escaped() -> None:
    cells = (Mark(EVIL, "bad"), Link(EVIL, 'a b"/x.html'))
    table = Table((Column(EVIL), Column(EVIL)), [cells], total=("sum", None))
    words = (Heading(EVIL), Subheading(EVIL), Paragraph(EVIL), Note(EVIL), Statement(EVIL, "bad"))
    parts = (
        *words,
        FoldedParts(EVIL, table, open=True),
        Cards([Card('a b"/x.jpg', b"jpeg", EVIL, EVIL)]),
        None,
    )
    text = html(small(*parts, tiles=(Tile(EVIL, EVIL, EVIL, wide=True),)))
    assert EVIL not in text and text.count("&lt;img src=x") == 16
    assert "<h4>&lt;img" in text and '<p class="verdict bad">&lt;img' in text and "<div class=wide>" in text
    assert '<a href="a%20b%22/x.jpg"><img loading=lazy' in text and "data:image/jpeg;base64,anBlZw==" in text
    assert '<span class="mark bad">&lt;img' in text and 'href="a%20b%22/x.html"' in text
    assert "Empty" not in text and "<details open>" in text
    assert "<tr class=sum><th scope=row>sum</th><td></td></tr>" in text


def test_sections_with_a_key_are_linked_at_the_head() -> None:
    sections = (Section("A", Note("a"), key="a"), Section("B", Note("b")), Section("C", key="c"))
    text = html(Page("x", "Kind", "Title", Banner("good", "Fine."), sections))
    assert '<nav><a href="#a">A</a></nav>' in text and '<section id="a">' in text and "#c" not in text
    assert text.startswith("<!DOCTYPE html>") and "<nav>" not in html(small(Note("a")))


def test_a_page_as_text_has_tables_facts_and_words() -> None:
    long = Column("a column of words"), Column("value", "", "mm", ".1f")
    parts = (
        *(Heading("Empty"), Note("a note"), Heading("Rows"), Paragraph("Words of 10 mm. " * 10)),
        facts([("name", "value " * 20), ("other", "b")]),
        Table(long, [("a|b", 1.0), ("c\nd", 10.0)] + [("e", 2.0)] * MAX_TEXT_ROWS, all_in="all.csv"),
        FoldedParts("left out", Paragraph("hidden")),
        FoldedParts("shown", Table(long, [("x" * 95, 1.0)], total=("sum", 3.0)), in_text=True),
    )
    sections = (Section("First", *parts), Section("Not here", Paragraph("gone"), in_text=False))
    verdict = judge(
        (remark("photographs_not_drawn", photographs=[EVIL]),), {"good": "g", "fair": "f", "bad": "b"}
    )
    lines = text_of(Page("x", "Kind", "Title", verdict, sections)).splitlines()
    words = "\n".join(lines)
    assert max(map(len, lines)) <= WIDTH and lines[0].endswith("Title") and EVIL in words
    for absent in ("Empty", "a note", "hidden", "Not here", "gone"):
        assert absent not in words
    assert "\n  a|b                       1.0\n  c d                      10.0\n" in words
    assert (
        "\n  and 2 more, in all.csv\n" in words
        and f"\n  {'x' * 95}:\n    value [mm] 1.0\n  sum: value" in words
    )
    assert "\n  name   value value" in words and "\n         value" in words and "10\n" not in words


def test_columns_of_a_page_are_named_by_the_table_of_results() -> None:
    columns = columns_of(GIVEN, {"name": Column("bar"), "w": Column("w", format="+.2f")})
    assert tuple(one.name for one in columns) == GIVEN.names_of()
    row = ("kind", "a - b", "length", "m", 1.0, 0.1, 0.1, 0.5, 1.234)
    table = Table(columns, [row])
    assert table.header == ("bar", ">w") and list(table.cells) == [("a - b", "+1.23")]
    assert table.csv.splitlines()[0] == ",".join(GIVEN.names_of())


def test_remarks_of_a_verdict_stand_in_the_banner() -> None:
    said = remark("photographs_not_drawn", photographs=[EVIL])
    verdict = judge((said,), {"good": "g", "fair": "f", "bad": "b"})
    text = html(Page("x", "Kind", "Title", verdict, ()))
    assert f'<li class="{said.severity}">' in text and EVIL not in text


def test_a_page_shows_the_first_rows_and_the_file_has_all() -> None:
    rows = [(str(k), float(k)) for k in range(MAX_ROWS + 1)]
    table = Table((Column("point", "id"), Column("X", "X", format=".1f")), rows, "points")
    text = html(small(table))
    assert text.count("<th scope=row>") == MAX_ROWS and f"The first {MAX_ROWS} of {MAX_ROWS + 1} rows" in text
    assert len(table.csv.splitlines()) == len(table.text.splitlines()) == MAX_ROWS + 2
    assert len(table.records) == MAX_ROWS + 1
    assert Table(table.columns, rows[1:], "points").cut == ""


def test_columns_of_the_page_and_of_files_are_apart() -> None:
    columns = (Column(None, "id"), Column("shown"), *axes("d", "mm", ".1f", factor=1000.0, parts="XY"))
    table = Table(columns, [("a", "b", 0.001, np.float64(np.inf))])
    assert table.header == ("shown", ">dX [mm]", ">dY [mm]")
    assert list(table.cells) == [("b", "1.0", "inf")]
    assert table.csv == "id,dX,dY\na,0.001,\n"
    assert table.records == [{"id": "a", "dX": 0.001, "dY": None}]


def test_figures_stand_before_notes_and_few_notes_are_shown() -> None:
    """Errors and warnings are read first and all shown; of the notes of a good survey few are."""
    notes = tuple(Line("note", f"note {k}") for k in range(9))
    warnings = tuple(Line("warning", f"warning {k}") for k in range(7))
    for lines, shown in ((notes, 5), ((*warnings[:2], *notes), 3), ((*warnings, *notes), 0)):
        page = html(Page("x", "Kind", "Title", Banner("good", "g", lines), (), (Tile("Points", 5),)))
        figures, folded = page.index("class=tiles"), page.index("more notes</summary>")
        items = [match.start() for match in re.finditer('<li class="note"', page)]
        assert len(items) == 9 and min(items) > figures
        assert sum(place < folded for place in items) == shown
        serious = [match.start() for match in re.finditer('<li class="warning"', page)]
        assert len(serious) == len(lines) - 9 and max(serious, default=0) < figures
    few = html(Page("x", "Kind", "Title", Banner("good", "g", notes[:5]), (), (Tile("Points", 5),)))
    assert "more note" not in few and few.count('<li class="note"') == 5


def test_the_terminal_counts_further_notes(capsys: pytest.CaptureFixture[str]) -> None:
    lines = (*(Line("warning", f"warning {k}", "Act.") for k in range(7)), Line("note", "last"))
    for folded, count in ((True, 7), (False, 8)):
        print_remarks(Console(), lines, folded=folded)
        told = capsys.readouterr().out.splitlines()
        assert len(told) == 8 and sum(line.startswith("!") for line in told) == 7
        assert ("1 more note: in the report" in told[-1]) == (count == 7)
