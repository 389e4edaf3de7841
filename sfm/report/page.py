"""Declared pages: what a page shows, and its tables as text, CSV and JSON. `html` renders it as HTML.

A page is sections of tables, figures and words below a verdict. Its tables hold plain values; columns state
how a value is named and written, so that the page, the terminal and the files beside the page share one
table.
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

from sfm.display import aligned, counted
from sfm.files.plain_text import csv_text, or_none
from sfm.files.result_tables import ResultTable
from sfm.remarks.verdict import Line, Verdict
from sfm.report.figures.plot_data import Plot
from sfm.report.phrases import significant
from sfm.report.viewer.embedded import Viewer

MAX_ROWS = 2000  # of a table of a page; files have all

YES = ("", "yes")  # words of a flag

Format = str | Callable[[Any], str]


@dataclass(frozen=True)
class Mark:
    """A word of a table with the colour of a level."""

    text: str
    level: str  # good, fair or bad

    def __str__(self) -> str:
        return self.text

    def __html__(self) -> str:
        """Return it for a template."""
        return Markup('<span class="mark {}">{}</span>').format(self.level, self.text)


@dataclass(frozen=True)
class Link:
    """A word of a table that leads to a file beside the page."""

    text: str
    path: str  # from the folder of the page, as the disk knows it

    def __str__(self) -> str:
        return self.text

    def __html__(self) -> str:
        """Return it for a template."""
        return Markup('<a href="{}">{}</a>').format(quote(self.path), self.text)


@dataclass(frozen=True)
class Column:
    """A column of a table: how its values are named and written."""

    title: str | None = ""  # heading on the page; None: only in files
    name: str = ""  # heading in files; empty: only on the page
    unit: str = ""  # on the page, in brackets behind the title
    format: Format | None = None  # of numbers: a format specification or a function; None: a text
    factor: float = 1.0  # from the unit of files to that of the page
    flag: tuple[str, str] | None = None  # on the page for what is not true and what is, 0 and 1 in files
    unknown: str | None = None  # in place of NaN on the page; None: what the format makes of it

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
    """Return columns of a vector, with the same names on the page and in files."""
    return tuple(Column(prefix + one, prefix + one, unit, format, factor) for one in parts)


def columns(*titles: str) -> tuple[Column, ...]:
    """Return columns of the page by their titles, those of numbers with ">" before them."""
    return tuple(Column(one.removeprefix(">"), format=str if one[:1] == ">" else None) for one in titles)


def columns_of(table: ResultTable, shown: Mapping[str, Column]) -> tuple[Column, ...]:
    """Return the columns of a table of results, and how a page shows some of them, by their names there."""
    return tuple(replace(shown.get(name, Column(None)), name=name) for name in table.names_of())


@dataclass(frozen=True)
class Table:
    """Rows of plain values below columns; a page shows the first ones."""

    columns: tuple[Column, ...]
    rows: Sequence[Sequence[Any]]
    file: str = ""  # name of the CSV file without its ending; empty: it has none
    facts: bool = False  # names and words without a header
    total: Sequence[Any] | None = None  # a last row, of sums or means, on the page
    most: int = MAX_ROWS  # rows on the page
    all_in: str = ""  # the file with all rows, where that is another one than `file`
    kind: ClassVar[str] = "table"

    @property
    def shown(self) -> tuple[tuple[int, Column], ...]:
        """The columns on the page, with their places in the rows."""
        return tuple((k, one) for k, one in enumerate(self.columns) if one.title is not None)

    @property
    def header(self) -> tuple[str, ...]:
        """The headings on the page, those of numbers with ">" before them."""
        return tuple(("" if one.format is None else ">") + one.heading for _, one in self.shown)

    @property
    def cells(self) -> Iterable[tuple[str | Mark | Link, ...]]:
        """The rows as the page shows them."""
        return self._cells(self.rows[: self.most])

    def first(self, count: int | None) -> Iterable[tuple[str | Mark | Link, ...]]:
        """Return the first rows and the last one, of sums, as the page shows them."""
        return (*self._cells(self.rows[:count]), *self.sums)

    @property
    def sums(self) -> Iterable[tuple[str | Mark | Link, ...]]:
        """The last row as the page shows it, nothing without one."""
        return self._cells([] if self.total is None else [self.total])

    def _cells(self, rows: Iterable[Sequence[Any]]) -> Iterable[tuple[str | Mark | Link, ...]]:
        shown = self.shown
        return (tuple(one.cell(row[k]) for k, one in shown) for row in rows)

    @property
    def cut(self) -> str:
        """How many of the rows the page shows; empty where all."""
        if len(self.rows) <= self.most:
            return ""
        where = f"; all are in {self.source}" if self.source else ""
        return f"The first {self.most} of {counted(len(self.rows), 'row')}{where}."

    @property
    def source(self) -> str:
        """The file with all rows; empty without one."""
        return self.all_in or (f"{self.file}.csv" if self.file else "")

    @property
    def csv(self) -> str:
        """The table as CSV, with all digits."""
        named = self._named
        flags = [one.flag is not None for _, one in named]
        rows = (
            [int(row[k]) if flag else row[k] for (k, _), flag in zip(named, flags, strict=True)]
            for row in self.rows
        )
        return csv_text([one.name for _, one in named], rows)

    @property
    def records(self) -> list[dict[str, Any]]:
        """The rows for JSON, by the names of the columns in files."""
        return [{one.name: plain(row[k]) for k, one in self._named} for row in self.rows]

    @property
    def _named(self) -> list[tuple[int, Column]]:
        """The columns in files, with their places in the rows."""
        return [(k, one) for k, one in enumerate(self.columns) if one.name]

    @property
    def text(self) -> str:
        """All rows in columns of plain text, numbers at the right."""
        return "\n".join((*self.lines(), ""))

    def lines(self, most: int | None = None) -> list[str]:
        """Return the first rows in columns of plain text, numbers at the right; all without a number."""
        shown = [one for _, one in self.shown]
        rows = [[one_line(str(cell)) for cell in row] for row in self.first(most)]
        if not self.facts:
            rows.insert(0, [one.heading for one in shown])
        return aligned(rows, [one.format is None for one in shown])


def one_line(words: str) -> str:
    """Return a text without breaks of lines."""
    return " ".join(words.splitlines())


def facts(rows: Sequence[tuple[str | Link, str]]) -> Table:
    """Return names and what is stated of each."""
    return Table((Column(), Column()), rows, facts=True)


@dataclass(frozen=True)
class Paragraph:
    """Sentences."""

    text: str
    kind: ClassVar[str] = "paragraph"


class Note(Paragraph):
    """Sentences that explain what is beside them."""

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
    """A small picture that leads to a large one beside the page."""

    path: str  # of the large one, from the folder of the page
    jpeg: bytes
    title: str
    words: str
    kind: ClassVar[str] = "card"


class FoldedParts:
    """Parts that a click unfolds; a text has them where that is stated."""

    kind: ClassVar[str] = "folded"

    def __init__(self, summary: str, *parts: Part, open: bool = False, in_text: bool = False) -> None:
        self.summary, self.parts, self.open, self.in_text = summary, parts, open, in_text


class Cards:
    """Cards beside one another."""

    kind: ClassVar[str] = "cards"

    def __init__(self, cards: Iterable[Card]) -> None:
        self.cards = tuple(cards)


Part = Table | Plot | Paragraph | FoldedParts | Cards


class Section:
    """A part of a page with a title; parts that are None are left out, and a section without any.

    Args:
        title: of the section.
        parts: of the section.
        key: by which addresses name the section; with one it is among the links at the head of the page.
        in_text: whether a text has it.
    """

    def __init__(self, title: str, *parts: Part | None, key: str = "", in_text: bool = True) -> None:
        self.title, self.key, self.in_text = title, key, in_text
        self.parts = tuple(part for part in parts if part is not None)


@dataclass(frozen=True)
class Tile:
    """A figure that a reader sees first."""

    name: str
    value: object
    note: str = ""
    wide: bool = False


@dataclass(frozen=True)
class Banner:
    """A verdict on what is not judged by remarks."""

    level: str
    headline: str
    lines: tuple[Line, ...] = ()


@dataclass(frozen=True)
class Page:
    """The content of a page, and the files beside it."""

    name: str  # of its files, without their endings
    kind: str  # line above the title
    title: str
    verdict: Verdict | Banner
    sections: tuple[Section, ...]
    tiles: tuple[Tile, ...] = ()
    viewer: Viewer | None = None
    pictures_beside: bool = False  # whether the scene shows pictures that lie beside the page
    summary: Mapping[str, Any] | None = None  # for NAME.json; values that are not finite become null
    files: tuple[Table, ...] = ()  # tables that are written beside those of the sections
    file: str = ""  # of the page itself, without its ending; empty: its name

    @property
    def path(self) -> str:
        """Name of the file of the page."""
        return f"{self.file or self.name}.html"

    @property
    def links(self) -> tuple[Section, ...]:
        """The sections that the head of the page leads to."""
        return tuple(one for one in self.sections if one.key and one.parts)

    @property
    def tables(self) -> tuple[Table, ...]:
        """The tables with a file."""
        parts = [part for section in self.sections for part in _unfolded(section.parts)]
        found = (*self.files, *(part for part in parts if isinstance(part, Table)))
        return tuple(one for one in found if one.file)

    @property
    def text(self) -> str:
        """The tables of the sections for the terminal, those left out that a click unfolds."""
        lines: list[str] = []
        for section in self.sections:
            tables = [part for part in section.parts if isinstance(part, Table)]
            lines += [section.title] if tables else []
            lines += [f"  {line}" for table in tables for line in table.text.splitlines()]
        return "\n".join(lines)

    @property
    def texts(self) -> dict[str, str]:
        """The text files beside the page, by their names."""
        found = {f"{one.file}.csv": one.csv for one in self.tables}
        if self.summary is not None:
            text = json.dumps(plain(self.summary), indent=2, ensure_ascii=False, allow_nan=False)
            found[f"{self.name}.json"] = text + "\n"
        return found


def plain(value: Any) -> Any:
    """Return a value for JSON: numbers that are not finite as None, arrays and tuples as lists."""
    if isinstance(value, Mapping):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    return or_none(float(value)) if isinstance(value, float | np.floating) else value


def values_of(one: object, names: str) -> dict[str, Any]:
    """Return attributes by their names, for JSON."""
    return {name: plain(getattr(one, name)) for name in names.split()}


def _unfolded(parts: Iterable[Part]) -> Iterable[Part]:
    for part in parts:
        yield from _unfolded(part.parts) if isinstance(part, FoldedParts) else (part,)
