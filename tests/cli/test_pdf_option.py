"""`--pdf` of the commands: each that writes a page has it, and the PDF is beside the page."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from sfm.files.open_folders import MANIFEST, refuse_foreign_folder
from tests.commands import command_of, kolinear
from tests.places import ROOT
from tests.surveys import write_observed_survey

WRITES_A_PAGE = ("page_of", "write_page", "write_declared", "run_survey_file", "run_batch", "result.write(")
COMMANDS = (
    *("run", "adjust", "calibrate", "batch", "refine", "audit", "measure", "compare", "epochs", "accept"),
    *("plan network", "plan more", "plan simulate"),
)
BROWSER = """#!/bin/sh
for word in "$@"; do
  case $word in --print-to-pdf=*) printf '%%PDF-1.4' > "${word#*=}" ;; esac
done
"""


@pytest.fixture
def browser(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A browser that prints at once; tests/report/test_pdf.py prints with a real one."""
    tools = tmp_path / "tools"
    tools.mkdir()
    (tools / "chromium").write_text(BROWSER)
    (tools / "chromium").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:/bin:/usr/bin")
    monkeypatch.chdir(tmp_path)


def test_every_command_with_a_page_prints_it() -> None:
    sources = {
        path.stem: path.read_text(encoding="utf-8") for path in (ROOT / "sfm/cli/commands").glob("*.py")
    }
    writing = {name for name, text in sources.items() if any(word in text for word in WRITES_A_PAGE)}
    assert writing == {words.replace(" ", "_") for words in COMMANDS}
    for words in COMMANDS:
        assert "--pdf" in [option for one in command_of(words).params for option in one.opts], words


def shown_pages(told: str) -> list[tuple[Path, Path]]:
    """Return the pages that a command names, each with the PDF that it names after it."""
    lines = told.splitlines()
    return [
        (Path(page.split(": ")[1]), Path(pdf.removeprefix("PDF: ")))
        for page, pdf in itertools.pairwise(lines)
        if pdf.startswith("PDF: ")
    ]


@pytest.mark.usefixtures("browser", "plots")
def test_pages_of_several_commands_are_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("first", "second"):
        survey = write_observed_survey(tmp_path / name, name)
        assert kolinear("adjust", survey, "--out", tmp_path / "out" / name, "--pdf") in (0, 1)
    results = [tmp_path / "out" / name for name in ("first", "second")]
    kolinear("compare", *results, "--out", tmp_path / "comparison", "--pdf")
    kolinear("measure", results[0], "--out", tmp_path / "measurement", "--pdf")
    kolinear("plan", "more", results[0], "--out", tmp_path / "more", "--pdf")
    pages = shown_pages(capsys.readouterr().out)
    assert [page.name for page, _ in pages] == [
        *("report.html", "report.html", "comparison.html", "measurement.html", "more.html")
    ]
    for page, pdf in pages:
        assert page.is_file() and pdf == page.with_suffix(".pdf") and pdf.read_bytes() == b"%PDF-1.4"
        assert (page.parent / MANIFEST).is_file()
        refuse_foreign_folder(page.parent)
    assert kolinear("adjust", tmp_path / "first" / "survey.toml", "--out", results[0]) in (0, 1)
    assert not (results[0] / "report.pdf").exists()  # it showed the earlier result


@pytest.mark.usefixtures("browser", "plots", "in_process")
def test_a_batch_prints_its_reports_and_its_index(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("first", "second"):
        write_observed_survey(tmp_path / name, name)
    arguments = ("batch", tmp_path / "first", tmp_path / "second", "--out", tmp_path / "out", "--jobs", 1)
    assert kolinear(*arguments, "--pdf") in (0, 1)
    pages = shown_pages(capsys.readouterr().out)
    assert sorted(page.name for page, _ in pages) == ["index.html", "report.html", "report.html"]
    assert all(pdf.is_file() for _, pdf in pages)
    assert kolinear(*arguments, "--resume") in (0, 1)
    assert (
        not (tmp_path / "out" / "index.pdf").exists() and len(list((tmp_path / "out").glob("*/*.pdf"))) == 2
    )
