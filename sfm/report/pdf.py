"""A page of the program as PDF on A4, by a browser without window or by WeasyPrint.

The style sheet of the pages arranges the print: a header with the title, page numbers, folded parts opened, a
still of the viewer, and at the end a place for name, date and signature.

Source: W3C, CSS Paged Media Module Level 3 (page margin boxes); Chromium, headless mode.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from sfm.files.whole_files import whole_files
from sfm.model.errors import MissingLibraryError, OutputError, one_line

BROWSERS = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"),
    *("msedge", "microsoft-edge", "microsoft-edge-stable"),
)
SECONDS = 300  # for a page; of 2,000 photographs it takes a tenth
DRAWN_MS = 10_000  # of the page's own time, in which its viewer unpacks and draws

Printer = Callable[[Path, Path], None]  # prints a page, an HTML file, into a PDF file


def pdf_printer() -> Printer:
    """Return what prints pages here: a browser on the path, else WeasyPrint.

    Raises:
        MissingLibraryError: there is neither, or WeasyPrint cannot be loaded.
    """
    for name in BROWSERS:
        browser = shutil.which(name)
        if browser is not None:
            return lambda page, pdf: _print_by_browser(browser, page, pdf)
    if find_spec("weasyprint") is not None:
        try:
            import weasyprint  # noqa: F401 - it loads Pango, which pip does not install
        except (ImportError, OSError) as error:
            raise MissingLibraryError(
                "--pdf needs Pango, without which WeasyPrint cannot be loaded, or Chromium, Chrome or Edge "
                f"on the path: {one_line(error)[:100]}"
            ) from error
        return _print_by_weasyprint
    raise MissingLibraryError(
        "--pdf needs Chromium, Chrome or Edge on the path, or WeasyPrint; install one of them, the last "
        "with: pip install 'kolinear[pdf]'"
    )


def write_pdf(page: Path) -> Path:
    """Print a page into a PDF beside it, which belongs to its folder as the page does.

    Args:
        page: an HTML file that the program wrote.

    Returns:
        Path of the PDF.

    Raises:
        MissingLibraryError: nothing here prints pages.
        OutputError: the page cannot be printed, or another file has the name of the PDF.
    """
    printer = pdf_printer()
    with whole_files(page.parent, "the PDF") as folder:
        printed = folder / f"{page.stem}.pdf"
        printer(page.resolve(), printed)
        begins = b""
        if printed.is_file():
            with printed.open("rb") as file:
                begins = file.read(5)
        if begins != b"%PDF-":
            raise OutputError(f"{page}: was not printed, no PDF was made")
    return page.with_suffix(".pdf")


def _print_by_browser(browser: str, page: Path, pdf: Path) -> None:
    # processes of a browser that was stopped may still write into its profile
    with tempfile.TemporaryDirectory(prefix="kolinear-print-", ignore_cleanup_errors=True) as profile:
        command = [
            browser,
            "--headless",
            "--disable-gpu",  # the viewer is drawn by the processor
            "--enable-unsafe-swiftshader",
            "--disable-extensions",
            "--disable-background-networking",
            "--no-first-run",
            f"--user-data-dir={profile}",
            "--no-pdf-header-footer",
            f"--virtual-time-budget={DRAWN_MS}",
            f"--print-to-pdf={pdf}",
            page.as_uri(),
        ]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            command.insert(1, "--no-sandbox")  # which Chromium does not offer to root
        try:
            ended = subprocess.run(command, capture_output=True, timeout=SECONDS, check=False)
        except subprocess.TimeoutExpired as error:
            raise OutputError(f"{page}: was not printed, {browser} took more than {SECONDS} s") from error
        except OSError as error:
            raise OutputError(f"{page}: was not printed, {browser}: {error.strerror}") from error
    if ended.returncode:
        raise OutputError(f"{page}: was not printed, {browser} ended with code {ended.returncode}")


def _print_by_weasyprint(page: Path, pdf: Path) -> None:
    from weasyprint import HTML

    try:
        HTML(filename=str(page)).write_pdf(str(pdf))
    except Exception as error:  # the library documents no set of errors for a page that it cannot arrange
        reason = one_line(error)[:100]
        raise OutputError(f"{page}: was not printed, WeasyPrint: {reason}") from error
