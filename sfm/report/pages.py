"""The pages of the program: a row for each, and how one is written with its files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from sfm.files.folder_lock import locked
from sfm.files.whole_files import remove_leftovers, whole_folder
from sfm.report.html import html
from sfm.report.page import Page

PAGES: Mapping[str, str] = {
    "Acceptance": "sfm.report.acceptance",
    "EpochSeries": "sfm.report.epochs",
    "Findings": "sfm.report.survey_report",
    "Further": "sfm.report.further",
    "Measurement": "sfm.report.measurement",
    "Plan": "sfm.report.planning",
    "Refinement": "sfm.report.refinement",
    "ResultComparison": "sfm.report.differences",
    "Validation": "sfm.report.validation",
    "ViewerScene": "sfm.report.view_page",
}
"""The type of a result, and the module, imported when needed, whose function `page` declares its page."""


def page_of(found: Any, **beside: Any) -> Page:
    """Return the declared page of a result.

    Args:
        found: a result of a type of `PAGES`.
        beside: what its declaration needs besides.
    """
    return cast(Page, import_module(PAGES[type(found).__name__]).page(found, **beside))


def html_of(found: Any, **beside: Any) -> str:
    """Return the page of a result as HTML; arguments as for `page_of`."""
    return html(page_of(found, **beside))


def texts_of(page: Page) -> dict[str, str]:
    """Return the page as HTML and the text files beside it, by name."""
    return page.texts | {page.path: html(page)}


def write_page(found: Any, out: Path, *, also: Callable[[Path], None] | None = None, **beside: Any) -> Path:
    """Write the page of a result and its files into a folder, whole or not at all.

    Args:
        found: a result of a type of `PAGES`.
        out: the folder: new, empty or an unchanged earlier one.
        also: is given the folder to write further files into.
        beside: what the declaration of the page needs besides.

    Returns:
        Path of the page.

    Raises:
        OutputError: the folder contains something else or cannot be written, or another run is writing it.
    """
    return write_declared(page_of(found, **beside), out, also=also)


def write_declared(page: Page, out: Path, *, also: Callable[[Path], None] | None = None) -> Path:
    """Write a declared page and its files as `write_page` does."""
    with locked(out.parent / f".{out.name}.lock", out):
        remove_leftovers(out)
        with whole_folder(out, "the result", replaceable=True) as folder:
            for name, text in texts_of(page).items():
                (folder / name).write_text(text, encoding="utf-8", newline="")
            if also is not None:
                also(folder)
    return out / page.path
