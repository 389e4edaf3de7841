"""Declared pages: the content of a page, and its tables as text, CSV and JSON.

A page consists of a verdict and sections of tables, figures and text. Its tables contain plain values.
Columns define how a value is named and formatted, so the page, the terminal and the files beside the page
share one table. `pages` renders a page as HTML.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from sfm.files.plain_text import csv_text, or_none
from sfm.files.result_tables import ResultTable
from sfm.model.display import aligned, counted
from sfm.model.remarks.verdict import Line, Verdict, split_lines
from sfm.report.figures.plot_data import Plot
from sfm.report.phrases import significant
from sfm.report.viewer.embedded import Viewer

MAX_ROWS = 2000  # rows of a table on a page; files contain all

YES = ("", "yes")  # words for a flag

Format = str | Callable[[Any], str]


@dataclass(frozen=True)
class Mark:
    """A word in a table, coloured by a level."""

    text: str
    level: str  # good, fair or bad

    def __str__(self) -> str:
        return self.text

    def __html__(self) -> str:
        """Return it for a template."""
        return Markup('<span class="mark {}">{}</span>').format(self.level, self.text)


@dataclass(frozen=True)
class Link:
    """A word in a table that links to a file beside the page."""

    text: str
    path: str  # from the folder of the page, as in the file system

    def __str__(self) -> str:
        return self.text

    def __html__(self) -> str:
        """Return it for a template."""
        return Markup('<a href="{}">{}</a>').format(quote(self.path), self.text)


@dataclass(frozen=True)
class Column:
    """A column of a table: how its values are named and formatted."""

    title: str | None = ""  # heading on the page; None: only in files
    name: str = ""  # heading in files; empty: only on the page
    unit: str = ""  # on the page, in brackets after the title
    format: Format | None = None  # of numbers: a format specification or a function; None: text
    factor: float = 1.0  # from the unit in files to the unit on the page
    flag: tuple[str, str] | None = None  # words on the page for false and true, which are 0 and 1 in files
    unknown: str | None = None  # replaces NaN on the page; None: the format writes NaN

    @property
    def heading(self) -> str:
        """Title and unit."""
        return f"{self.title} [{self.unit}]" if self.unit else f"{self.title}"

    def cell(self, value: Any) -> str | Mark | Link:
        """Return a value as the page shows it."""
        if value is None:
            return ""
        if isinstance(value, str | Mark | Link):
            return value
        if self.flag is not None:
            return self.flag[int(value)]
        if self.unknown is not None and math.isnan(value):
            return self.unknown
        if self.format is None or self.format is str:
            return str(value)
        number = value if self.factor == 1 else value * self.factor
        return format(number, self.format) if isinstance(self.format, str) else self.format(number)


def axes(
    prefix: str, unit: str = "", format: Format = significant, *, factor: float = 1.0, parts: str = "XYZ"
) -> tuple[Column, ...]:
    """Return the columns of a vector, with the same names on the page and in files."""
    return tuple(Column(prefix + part, prefix + part, unit, format, factor) for part in parts)


def columns(*titles: str) -> tuple[Column, ...]:
    """Return columns that are only on the page; ">" before a title marks numbers."""
    return tuple(
        Column(title.removeprefix(">"), format=str if title[:1] == ">" else None) for title in titles
    )


def file_columns(*names: str) -> tuple[Column, ...]:
    """Return columns that are only in files."""
    return tuple(Column(None, name) for name in names)


def columns_of(table: ResultTable, shown: Mapping[str, Column]) -> tuple[Column, ...]:
    """Return the columns of a result table; `shown` states, by name, those that a page shows."""
    return tuple(replace(shown.get(name, Column(None)), name=name) for name in table.names_of())


@dataclass(frozen=True)
class Table:
    """Rows of plain values under columns; a page shows the first rows."""

    columns: tuple[Column, ...]
    rows: Sequence[Sequence[Any]]
    file: str = ""  # name of the CSV file without suffix; empty: no file
    facts: bool = False  # names and words without a header
    total: Sequence[Any] | None = None  # last row with sums or means, only on the page
    most: int = MAX_ROWS  # maximum number of rows on the page
    all_in: str = ""  # file with all rows, if it is not `file`
    kind: ClassVar[str] = "table"

    @property
    def shown(self) -> tuple[tuple[int, Column], ...]:
        """The columns on the page, with their indices in the rows."""
        return tuple((k, column) for k, column in enumerate(self.columns) if column.title is not None)

    @property
    def header(self) -> tuple[str, ...]:
        """The headings on the page; ">" before a heading marks numbers."""
        return tuple(("" if column.format is None else ">") + column.heading for _, column in self.shown)

    @property
    def cells(self) -> Iterable[tuple[str | Mark | Link, ...]]:
        """The rows as the page shows them."""
        return self._cells(self.rows[: self.most])

    def first(self, count: int | None) -> Iterable[tuple[str | Mark | Link, ...]]:
        """Return the first rows and the row of sums, as the page shows them."""
        return (*self._cells(self.rows[:count]), *self.sums)

    @property
    def sums(self) -> Iterable[tuple[str | Mark | Link, ...]]:
        """The row of sums as the page shows it; empty without one."""
        return self._cells([] if self.total is None else [self.total])

    def _cells(self, rows: Iterable[Sequence[Any]]) -> Iterable[tuple[str | Mark | Link, ...]]:
        shown = self.shown
        return (tuple(column.cell(row[k]) for k, column in shown) for row in rows)

    @property
    def cut(self) -> str:
        """A sentence on how many rows the page shows; empty if all."""
        if len(self.rows) <= self.most:
            return ""
        where = f"; all are in {self.source}" if self.source else ""
        return f"The first {self.most} of {counted(len(self.rows), 'row')}{where}."

    @property
    def source(self) -> str:
        """The file with all rows; empty if there is none."""
        return self.all_in or (f"{self.file}.csv" if self.file else "")

    @property
    def csv(self) -> str:
        """The table as CSV, with all digits."""
        named = self._named
        flags = [column.flag is not None for _, column in named]
        rows = (
            [int(row[k]) if flag else row[k] for (k, _), flag in zip(named, flags, strict=True)]
            for row in self.rows
        )
        return csv_text([column.name for _, column in named], rows)

    @property
    def records(self) -> list[dict[str, Any]]:
        """The rows for JSON, by the names of the columns in files."""
        return [{column.name: plain(row[k]) for k, column in self._named} for row in self.rows]

    @property
    def _named(self) -> list[tuple[int, Column]]:
        """The columns in files, with their indices in the rows."""
        return [(k, column) for k, column in enumerate(self.columns) if column.name]

    @property
    def text(self) -> str:
        """All rows as plain text in columns, numbers right-aligned."""
        return "\n".join((*self.lines(), ""))

    def lines(self, most: int | None = None) -> list[str]:
        """Return the first rows as plain text in columns, numbers right-aligned; None returns all rows."""
        shown = [column for _, column in self.shown]
        rows = [[one_line(str(cell)) for cell in row] for row in self.first(most)]
        if not self.facts:
            rows.insert(0, [column.heading for column in shown])
        return aligned(rows, [column.format is None for column in shown])


def one_line(words: str) -> str:
    """Return a text without line breaks."""
    return " ".join(words.splitlines())


def facts(rows: Sequence[tuple[str | Link, str]]) -> Table:
    """Return a table of names, each with a statement."""
    return Table((Column(), Column()), rows, facts=True)


@dataclass(frozen=True)
class Paragraph:
    """Sentences."""

    text: str
    kind: ClassVar[str] = "paragraph"


class Note(Paragraph):
    """Sentences that explain the part beside them."""

    kind = "note"


class Heading(Paragraph):
    """A heading within a section."""

    kind = "heading"


class Subheading(Paragraph):
    """A heading below a heading."""

    kind = "subheading"


@dataclass(frozen=True)
class Statement(Paragraph):
    """Sentences with the colour of a level."""

    level: str  # good, fair or bad
    kind = "statement"


@dataclass(frozen=True)
class Card:
    """A thumbnail that links to a large picture beside the page."""

    path: str  # of the large picture, from the folder of the page
    jpeg: bytes
    title: str
    words: str
    kind: ClassVar[str] = "card"


class FoldedParts:
    """Parts that unfold at a click; plain text contains them only if `in_text`."""

    kind: ClassVar[str] = "folded"

    def __init__(self, summary: str, *parts: Part, open: bool = False, in_text: bool = False) -> None:
        self.summary, self.parts, self.open, self.in_text = summary, parts, open, in_text


class Cards:
    """Cards side by side."""

    kind: ClassVar[str] = "cards"

    def __init__(self, cards: Iterable[Card]) -> None:
        self.cards = tuple(cards)


Part = Table | Plot | Paragraph | FoldedParts | Cards


class Section:
    """A part of a page with a title; parts that are None are dropped, and so is a section without parts.

    Args:
        title: title of the section.
        parts: parts of the section.
        key: anchor of the section; a section with a key is linked at the head of the page.
        in_text: whether plain text contains the section.
    """

    def __init__(self, title: str, *parts: Part | None, key: str = "", in_text: bool = True) -> None:
        self.title, self.key, self.in_text = title, key, in_text
        self.parts = tuple(part for part in parts if part is not None)


def tested_section(verdict: Verdict) -> Section:
    """Return the section on what was tested, on what, and with which result; empty if nothing was."""
    rows = [test.tested for test in verdict.tests]
    table = Table(columns("test", "tested on", "result or why not"), rows) if rows else None
    return Section("What was tested?", table, key="tested")


@dataclass(frozen=True)
class Tile:
    """A key figure at the top of a page."""

    name: str
    value: object
    note: str = ""
    wide: bool = False


@dataclass(frozen=True)
class Banner:
    """A verdict that is not based on remarks."""

    level: str
    headline: str
    lines: tuple[Line, ...] = ()


@dataclass(frozen=True)
class Page:
    """The content of a page, and the files beside it."""

    name: str  # of its files, without suffix
    kind: str  # line above the title
    title: str
    verdict: Verdict | Banner
    sections: tuple[Section, ...]
    tiles: tuple[Tile, ...] = ()
    viewer: Viewer | None = None
    pictures_beside: bool = False  # whether the scene shows pictures that are files beside the page
    summary: Mapping[str, Any] | None = None  # for NAME.json; values that are not finite become null
    files: tuple[Table, ...] = ()  # further tables written to files
    file: str = ""  # name of the page's file, without suffix; empty: `name`

    @property
    def path(self) -> str:
        """File name of the page."""
        return f"{self.file or self.name}.html"

    @property
    def warnings(self) -> tuple[Line, ...]:
        """The errors and warnings, which are read before the figures."""
        return tuple(line for line in self.verdict.lines if line.severity != "note")

    @property
    def notes(self) -> tuple[tuple[Line, ...], tuple[Line, ...]]:
        """The notes below the figures: those that are shown, and those that are folded."""
        shown, folded = split_lines(self.verdict.lines)
        return tuple(line for line in shown if line.severity == "note"), folded

    @property
    def links(self) -> tuple[Section, ...]:
        """The sections that the head of the page links to."""
        return tuple(section for section in self.sections if section.key and section.parts)

    @property
    def tables(self) -> tuple[Table, ...]:
        """The tables with a file."""
        parts = [part for section in self.sections for part in _unfolded(section.parts)]
        tables = (*self.files, *(part for part in parts if isinstance(part, Table)))
        return tuple(table for table in tables if table.file)

    @property
    def text(self) -> str:
        """The tables of the sections for the terminal, without folded ones."""
        lines: list[str] = []
        for section in self.sections:
            tables = [part for part in section.parts if isinstance(part, Table)]
            lines += [section.title] if tables else []
            lines += [f"  {line}" for table in tables for line in table.text.splitlines()]
        return "\n".join(lines)

    @property
    def texts(self) -> dict[str, str]:
        """The text files beside the page, by their names."""
        texts = {f"{table.file}.csv": table.csv for table in self.tables}
        if self.summary is not None:
            text = json.dumps(plain(self.summary), indent=2, ensure_ascii=False, allow_nan=False)
            texts[f"{self.name}.json"] = text + "\n"
        return texts


def plain(value: Any) -> Any:
    """Return a value for JSON: numbers that are not finite as None, arrays and tuples as lists."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    return or_none(float(value)) if isinstance(value, float | np.floating) else value


def values_of(record: object, names: str) -> dict[str, Any]:
    """Return attributes of an object by name, for JSON."""
    return {name: plain(getattr(record, name)) for name in names.split()}


def _unfolded(parts: Iterable[Part]) -> Iterable[Part]:
    for part in parts:
        yield from _unfolded(part.parts) if isinstance(part, FoldedParts) else (part,)
