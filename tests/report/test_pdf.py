"""Pages as PDF: printed by a real browser, read back as text; what is said where nothing prints."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from sfm.cli import main
from sfm.files.open_folders import refuse_foreign_folder
from sfm.judgement.verdict import judge
from sfm.model.errors import MissingLibraryError, OutputError
from sfm.report import pdf as printing
from sfm.report.page import Column, FoldedParts, Note, Page, Section, Table
from sfm.report.pages import html, write_declared
from sfm.report.pdf import BROWSERS, pdf_printer, write_pdf
from tests.pdf_text import pages_of

IN_BROWSER = pytest.mark.skipif(not any(map(shutil.which, BROWSERS)), reason="no browser prints here")
TITLE = 'Br"ücke\\9 </style> } body { display: none } <b>'
ROWS = 300
A4_POINTS = (595.28, 841.89)


def long_page(title: str = TITLE) -> Page:
    columns = (Column("name", "id"), Column("height", "Z", "mm", ".1f"))
    table = Table(columns, [(f"row{k}", float(k)) for k in range(ROWS)], "heights")
    well = judge((), {"good": "All well.", "fair": "", "bad": ""})
    return Page(
        "levels", "Levelling", title, well, (Section("Points", FoldedParts("all", table), Note("End.")),)
    )


@pytest.fixture
def page(tmp_path: Path) -> Path:
    return write_declared(long_page(), tmp_path / "out")


@IN_BROWSER
def test_a_page_is_printed_on_a4_with_header_numbers_and_a_place_to_sign(page: Path) -> None:
    printed = write_pdf(page)
    assert printed == page.with_suffix(".pdf")
    content = printed.read_bytes()
    boxes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", content)
    assert boxes and all([float(v) for v in box] == pytest.approx(A4_POINTS, abs=0.5) for box in boxes)
    pages = pages_of(content)
    assert len(pages) > 3
    for k, text in enumerate(pages, 1):
        lines = text.splitlines()
        assert lines[0] == f"Levelling: {TITLE}" and lines[1] == "Kolinear"
        assert "".join(lines[2:5]).replace(" ", "") == f"{k}/{len(pages)}"
    words = [word for text in pages for word in text.split()]
    assert [word for word in words if word.startswith("row")] == [f"row{k}" for k in range(ROWS)]  # unfolded
    with_rows = [text for text in pages if re.search(r"^row\d+$", text, re.M)]
    assert all("height [mm]" in text for text in with_rows)  # the head of the table on each page
    assert pages[-1].splitlines()[-3:] == ["Name", "Date", "Signature"]
    assert not any("Signature" in text for text in pages[:-1])


@IN_BROWSER
def test_the_pdf_belongs_to_its_folder(page: Path) -> None:
    write_pdf(page)
    write_pdf(page)  # an earlier one is replaced
    refuse_foreign_folder(page.parent)
    write_declared(long_page(), page.parent)
    assert not page.with_suffix(".pdf").exists()  # it showed the earlier result
    page.with_suffix(".pdf").write_bytes(b"a letter")
    with pytest.raises(OutputError, match=r"levels\.pdf"):
        write_pdf(page)
    assert page.with_suffix(".pdf").read_bytes() == b"a letter"


@pytest.mark.parametrize("title", [TITLE, "x" * 200, "日本 \n\x07"])
def test_a_title_cannot_leave_the_header(title: str) -> None:
    rule = re.search(r'@top-left \{ content: "([^"]*)"; \}', html(long_page(title)))
    assert rule and re.fullmatch(r"(\\[0-9a-f]+ )*", rule[1])
    shown = "".join(chr(int(code, 16)) for code in rule[1].replace("\\", "").split())
    whole = f"Levelling: {title}"
    assert shown == (whole if len(whole) <= 80 else f"{whole[:77]}...")


def test_without_a_printer_one_line_says_what_to_install(
    page: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(page.parent))
    monkeypatch.setattr(printing, "find_spec", lambda name: None)
    with pytest.raises(MissingLibraryError, match="--pdf needs Chromium, Chrome or Edge on the path"):
        pdf_printer()
    monkeypatch.setattr(printing, "find_spec", lambda name: name)
    monkeypatch.setitem(sys.modules, "weasyprint", None)  # as without Pango
    with pytest.raises(MissingLibraryError, match="--pdf needs Pango, without which WeasyPrint cannot be"):
        pdf_printer()
    monkeypatch.setattr(printing, "find_spec", lambda name: None)
    monkeypatch.setattr(sys, "argv", ["kolinear", "run", "none.toml", "--pdf"])
    with pytest.raises(SystemExit) as ended:
        main()  # before the survey is looked at
    said = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2 and len(said) == 1 and "kolinear[pdf]" in said[0]


@pytest.mark.parametrize(
    ("script", "told"),
    [
        ("exit 3", "chromium ended with code 3"),
        ("exit 0", "no PDF was made"),
        ("exec sleep 30", "took more than 1 s"),
    ],
)
def test_a_browser_that_fails_leaves_the_page(
    page: Path, monkeypatch: pytest.MonkeyPatch, script: str, told: str
) -> None:
    tools = page.parent.parent / "tools"
    tools.mkdir()
    (tools / "chromium").write_text(f"#!/bin/sh\n{script}\n")
    (tools / "chromium").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:/bin:/usr/bin")
    monkeypatch.setattr(printing, "SECONDS", 1)
    before = sorted(page.parent.iterdir())
    with pytest.raises(OutputError, match=f"levels.html: was not printed, .*{told}"):
        write_pdf(page)
    assert sorted(page.parent.iterdir()) == before


def test_weasyprint_prints_where_there_is_no_browser(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def print_to(source: str, target: str) -> None:
        assert Path(source) == page.resolve()
        Path(target).write_bytes(b"%PDF-1.7 by the library")

    def fail(target: str) -> None:
        raise AssertionError("no such\nlayout")

    monkeypatch.setenv("PATH", str(page.parent))
    monkeypatch.setattr(printing, "find_spec", lambda name: name)

    class Html:
        def __init__(self, filename: str) -> None:
            self.write_pdf = lambda target: print_to(filename, target)

    monkeypatch.setitem(sys.modules, "weasyprint", SimpleNamespace(HTML=Html))
    assert write_pdf(page).read_bytes().startswith(b"%PDF-1.7")
    broken = SimpleNamespace(HTML=lambda filename: SimpleNamespace(write_pdf=fail))
    monkeypatch.setitem(sys.modules, "weasyprint", broken)
    with pytest.raises(OutputError, match="WeasyPrint: no such layout"):
        write_pdf(page)
