"""The pages of the program: a row for each, rendered as HTML or as plain text.

The HTML of a page contains everything that it shows, and a Content-Security-Policy. Names, reasons and
remarks come from untrusted files. The template escapes them. Should that ever fail, a browser still
refuses any script, style or address that is not in the policy.

The plain text of a page contains the first rows of its tables in columns, and facts and sentences in lines.
It omits figures, notes, and folded parts unless these are declared to be in texts.

Source: W3C, Content Security Policy Level 3 (https://www.w3.org/TR/CSP3/), sections 2.3.1 and 6.7.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from sfm.files.open_folders import locked
from sfm.files.whole_files import remove_leftovers, whole_folder
from sfm.model.display import NO_BREAK, bound
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
from sfm.report.phrases import is_number

PAGES: Mapping[str, str] = {
    "Acceptance": "sfm.products.inspection.page:acceptance_page",
    "Audit": "sfm.products.auditing.page:page",
    "Calibration": "sfm.products.calibration.page:page",
    "CameraDifference": "sfm.report.camera_differences:page",
    "EpochSeries": "sfm.products.epochs.page:page",
    "Findings": "sfm.report.survey_report:page",
    "Further": "sfm.products.planning.further_page:page",
    "Measurement": "sfm.products.inspection.page:page",
    "Plan": "sfm.products.planning.page:page",
    "Refinement": "sfm.products.refining.page:page",
    "ResultComparison": "sfm.report.differences:page",
    "UnfinishedSurvey": "sfm.report.unfinished:page",
    "ViewerScene": "sfm.report.view_page:page",
}
"""For each type of result, the module (imported when needed) and the function that declares its page."""
NO_SOURCE = "'none'"  # of a Content-Security-Policy
WIDTH = 100  # of the text, columns
MARGIN = "  "  # before a line of text
MAX_ROWS = 10  # rows of a table in the text
HEADER_LETTERS = 80  # of the line above each printed page
NAME_WIDTH = 36  # maximum width of the name of a fact


def page_of(subject: Any, **beside: Any) -> Page:
    """Return the declared page of a result.

    Args:
        subject: a result of a type in `PAGES`.
        beside: further arguments of the function that declares its page.
    """
    module, function = PAGES[type(subject).__name__].split(":")
    return cast(Page, getattr(import_module(module), function)(subject, **beside))


def html_of(subject: Any, **beside: Any) -> str:
    """Return the page of a result as HTML; arguments as for `page_of`."""
    return html(page_of(subject, **beside))


def texts_of(page: Page) -> dict[str, str]:
    """Return the page as HTML and the text files beside it, by name."""
    return page.texts | {page.path: html(page)}


def write_page(subject: Any, out: Path, *, also: Callable[[Path], None] | None = None, **beside: Any) -> Path:
    """Write the page of a result and its files into a folder, whole or not at all.

    Args:
        subject: a result of a type in `PAGES`.
        out: the folder: new, empty or an unchanged earlier one.
        also: receives the folder, to write further files into it.
        beside: further arguments of the function that declares the page.

    Returns:
        Path of the page.

    Raises:
        OutputError: the folder contains something else or cannot be written, or another run is writing it.
    """
    return write_declared(page_of(subject, **beside), out, also=also)


def write_declared(page: Page, out: Path, *, also: Callable[[Path], None] | None = None) -> Path:
    """Write a declared page and its files, like `write_page`."""
    with locked(out.parent / f".{out.name}.lock", out):
        remove_leftovers(out)
        with whole_folder(out, "the result", replaceable=True) as folder:
            for name, text in texts_of(page).items():
                (folder / name).write_text(text, encoding="utf-8", newline="")
            if also is not None:
                also(folder)
    return out / page.path


def html(page: Page) -> str:
    """Return a page as HTML."""
    style = source("base.css") + source("report.css") + _running_header(f"{page.kind}: {page.title}")
    script = source("tables.js")
    policy = content_policy(
        [style, page.viewer.style] if page.viewer else [style],
        [page.viewer.script, script] if page.viewer else [script],
        pictures_beside=page.pictures_beside,
    )
    parts = {"style": Markup(style), "tables_script": Markup(script), "policy": policy}
    return _template().render(page=page, **parts)


def _running_header(text: str) -> str:
    """Return a style rule that prints a text above each page; any character is escaped, as CSS allows."""
    shown = text if len(text) <= HEADER_LETTERS else f"{text[: HEADER_LETTERS - 3]}..."
    escaped = "".join(f"\\{ord(letter):x} " for letter in shown)
    return f'@page {{ @top-left {{ content: "{escaped}"; }} @top-right {{ content: "Kolinear"; }} }}\n'


def data_url(data: bytes, kind: str) -> str:
    """Return a picture as a data URL."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


@cache
def source(name: str) -> str:
    """Return a style sheet or the script shared by all pages."""
    return files("sfm.report").joinpath(f"templates/{name}").read_text(encoding="utf-8")


@cache
def _template() -> Template:
    """Return the template of all pages, which escapes texts and rejects undefined names."""
    made = Environment(
        loader=PackageLoader("sfm.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"bound": bound, "data_url": data_url, "quoted": quote}
    made.tests["numeric"] = lambda cell: is_number(str(cell))
    return made.get_template("page.html")


def content_policy(
    styles: Sequence[str], scripts: Sequence[str] = (), *, pictures_beside: bool = False
) -> str:
    """Return the policy of a page with inline style sheets and scripts, and pictures as data URLs.

    Attributes `style` and `on...` are allowed nowhere: they would need 'unsafe-inline'.

    Args:
        styles: exact content of each style element.
        scripts: exact content of each script element that is run.
        pictures_beside: whether the page shows pictures from files beside it, which the policy calls 'self'.
    """
    allowed = {
        "default-src": [NO_SOURCE],
        "img-src": ["data:", "'self'"] if pictures_beside else ["data:"],
        "style-src": [_hash(text) for text in styles],
        "script-src": [_hash(text) for text in scripts],
        "base-uri": [NO_SOURCE],
        "form-action": [NO_SOURCE],
    }
    return "; ".join(" ".join((name, *(sources or [NO_SOURCE]))) for name, sources in allowed.items())


def _hash(text: str) -> str:
    """Return the source expression that allows one element by its content."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def text(page: Page) -> str:
    """Return a page as text of at most `WIDTH` columns."""
    lines = [f"KOLINEAR  {one_line(page.title)}"[:WIDTH], "=" * WIDTH]
    lines += wrapped(one_line(page.verdict.headline), behind=0)
    for line in page.verdict.lines:
        lines += wrapped(one_line(f"- {line.severity}: {line.text} {line.remedy}"), behind=2)
    for section in page.sections:
        body = list(_lines(section.parts)) if section.in_text else []
        if body:
            lines += ["", f"{section.title} ".ljust(WIDTH, "="), *body]
    return "\n".join(lines) + "\n"


def _lines(parts: Iterable[Part]) -> Iterator[str]:
    heading: list[str] = []  # written once a part below it has content
    for part in parts:
        lines: list[str] = []
        match part:
            case Plot() | Note() | Cards():
                continue
            case Heading():
                heading = ["", f"{one_line(part.text)} ".ljust(WIDTH, "-")]
            case Subheading():
                heading += ["", *wrapped(MARGIN + one_line(part.text), behind=4)]
            case FoldedParts():
                lines = list(_lines(part.parts)) if part.in_text else []
            case Paragraph():
                lines = wrapped(MARGIN + one_line(part.text), behind=4)
            case Table() if part.facts:
                rows = [[one_line(str(cell)) for cell in row] for row in part.cells]
                width = min(max((len(name) for name, _ in rows), default=0), NAME_WIDTH)
                for name, words in rows:
                    lines += wrapped(f"{MARGIN}{name:<{width}}  {words}", behind=width + 4)
            case Table():
                lines = _table(part)
        if lines:
            yield from (*heading, *lines)
            heading = []


def _table(table: Table) -> list[str]:
    """Return the first rows in columns, or each as a sentence if the columns are too wide."""
    lines = [MARGIN + line for line in table.lines(MAX_ROWS)]
    if max(map(len, lines)) > WIDTH:
        before = ["" if column.format is None else f"{column.heading} " for _, column in table.shown]
        rows = ([one_line(str(cell)) for cell in row] for row in table.first(MAX_ROWS))
        named = ([b + cell for b, cell in zip(before, row, strict=True) if cell] for row in rows)
        sentences = (f"{MARGIN}{name}: {'; '.join(cells)}" for name, *cells in named)
        lines = [line for sentence in sentences for line in wrapped(sentence, behind=4)]
    if len(table.rows) > MAX_ROWS:
        where = f", in {table.source}" if table.source else ""
        lines.append(f"{MARGIN}and {len(table.rows) - MAX_ROWS} more{where}")
    return lines


def wrapped(line: str, *, behind: int) -> list[str]:
    """Return a line broken between words, but not before a unit; later lines are indented by `behind`."""
    lines, rest = [], bound(line.rstrip())
    while len(rest) > WIDTH:
        cut = rest.rfind(" ", behind + 1, WIDTH)
        cut = WIDTH if cut < 0 else cut
        lines.append(rest[:cut])
        rest = " " * behind + rest[cut:].strip()
    return [part.replace(NO_BREAK, " ") for part in (*lines, rest)]
