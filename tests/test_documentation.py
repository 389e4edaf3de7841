"""Pages of docs/: on the site, their commands run, what they name exists."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest

from sfm import cli
from sfm.survey.inputs.survey_file import SurveyFile
from tests.places import ROOT, load_page_code


def test_every_page_is_on_the_site() -> None:
    docs = ROOT / "docs"
    listed = {
        name[1:] if name.startswith("/") else str((page.parent / name).relative_to(docs))
        for page in docs.rglob("index.md")
        for tree in re.findall(r"^```{toctree}\n(.*?)^```", page.read_text(encoding="utf-8"), re.S | re.M)
        for name in re.findall(r"^(?:[\w ]+ <)?([\w/-]+)>?$", tree, re.M)
    }
    pages = {str(page.relative_to(docs).with_suffix("")) for page in docs.rglob("*.md")} - {"index"}
    assert pages == listed


@pytest.mark.parametrize("page", ["validation.md", "sources.md", "planning.md"])
def test_commands_of_the_page_name_what_is_there(page: str) -> None:
    """Files and folders exist, and what `pytest -k` asks for is part of the name of a test in them."""
    spans = re.findall(r"`([^`\n]+)`", (ROOT / "docs" / page).read_text(encoding="utf-8"))
    named = [span for span in spans if re.search(r"(?:tests|benchmarks|datasets)[/.]\w", span)]
    assert named
    for span in named:
        for path in re.findall(r"(?:tests|benchmarks|datasets)(?:[/.][\w.-]+)+", span):
            found = ROOT / (path if "/" in path else path.replace(".", "/") + ".py")
            assert found.exists(), f"{page}: {span}"
            for word in re.findall(r" -k (\w+)", span):
                assert re.search(rf"def test_\w*{word}", found.read_text(encoding="utf-8")), f"{page}: {span}"


def test_every_key_of_the_survey_file_has_a_meaning_and_bounds() -> None:
    keys = load_page_code("survey_keys")
    rows = {}
    for name, field in SurveyFile.model_fields.items():
        for row in keys.rows_of(keys.section_of(field.annotation)):
            rows[f"{field.alias or name}.{row[0]}"] = row
    assert len(rows) > 50
    assert not [key for key, row in rows.items() if len(row[3]) < 5], "keys without a comment in settings.py"
    assert rows["tie_points.window_px"][1] == "integer, from 7 to 101"
    assert rows["tie_points.max_features"][1] == "integer, from 100 to 20000"
    assert rows["camera.c_mm"][1] == "number, from 1e-09 to 1e+12"
    assert rows["camera.size_px"][1] == "[integer, integer], above 0 to 1e+06"
    assert rows["camera.weighted"][1] == "table { parameter = [value, sigma] }, from 1e-30 to 1e+12"
    assert rows["camera.correlations"][1].endswith("correlation], from -1 to 1, at most 200")
    assert rows["targets.rows"][1] == "integer, from 2 to 500"
    assert rows["targets.marks"][1] == "list of [row, column], at most 1000"
    assert rows["adjust.reject"][1] == "tau | huber | tukey | none"


def test_faults_of_a_site_are_found(tmp_path: Path) -> None:
    links = load_page_code("links")
    (tmp_path / "a.html").write_text(
        '<h1 id="top">A</h1><a href="b.html#there">b</a><a href="#top">up</a>'
        '<a href="https://elsewhere.org">x</a><a href="b.html#gone">b</a><a href="c.html">c</a>'
        '<img src="missing.png"><img src="data:image/png;base64,">'
        '<script src="https://elsewhere.org/x.js"></script><link rel="next" href="b.html">'
    )
    (tmp_path / "b.html").write_text('<p id="there">b</p>')
    assert links.faults_of(tmp_path) == [
        "a.html: missing.png is not there",
        "a.html: loads https://elsewhere.org/x.js from elsewhere",
        "a.html: link to b.html#gone, which has no such place",
        "a.html: link to c.html, which is not there",
    ]


TICKED = r"`((?:sfm|adapters)(?:\.\w+)+)`"
PAGES = {
    page.name: page.read_text(encoding="utf-8")
    for page in sorted((ROOT / "docs/theory").glob("*.md"))
    if page.name != "index.md"
}
NAMED = set(re.findall(TICKED, "\n".join(PAGES.values())))
METHODS = (ROOT / "docs/methods.md").read_text(encoding="utf-8").partition("## The modules of these rooms")[0]


def module_of(name: str) -> str:
    """Return the longest part of a name that is a module."""
    module, _, _ = name.rpartition(".")
    try:
        return name if importlib.util.find_spec(name) else module_of(module)
    except ModuleNotFoundError:  # the part before the last is a module, the last one of its functions
        return module_of(module)


@pytest.mark.parametrize("page", PAGES)
def test_every_function_of_the_pages_exists(page: str) -> None:
    names = re.findall(TICKED, PAGES[page])
    assert len(names) > 10
    for name in names:
        module = module_of(name)
        rest = name.removeprefix(module).strip(".")
        assert not rest or hasattr(importlib.import_module(module), rest), f"{page}: there is no {name}"


def source_of(name: str) -> str:
    """Return the module in which a function of a room is written."""
    module = module_of(name)
    value = getattr(importlib.import_module(module), name.removeprefix(module).strip("."), None)
    return getattr(value, "__module__", module)


def test_every_method_is_reached_from_the_theory() -> None:
    """Its function is named there, or another one of its module."""
    reached = {source_of(name) for name in NAMED}
    missing = sorted({name for name in re.findall(TICKED, METHODS) if source_of(name) not in reached})
    assert not missing, missing


PAGE = (ROOT / "docs" / "how-to" / "reproduce-the-sources.md").read_text(encoding="utf-8")
STEPS = re.findall(r"^## (Document \d+).*?\n```(sh|python)\n(.*?)```\n+```text\n(.*?)```", PAGE, re.S | re.M)


def test_every_document_is_reproduced() -> None:
    assert [title for title, *_ in STEPS] == [f"Document {number:03}" for number in range(5)]


@pytest.mark.parametrize(("title", "language", "code", "told"), STEPS, ids=[step[0] for step in STEPS])
def test_the_numbers_of_a_document_come_out(
    title: str, language: str, code: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(ROOT / "datasets", tmp_path / "datasets", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.chdir(tmp_path)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        if language == "python":
            exec(compile(code, title, "exec"), {})
        else:
            for line in code.splitlines():
                monkeypatch.setattr(sys, "argv", shlex.split(line))
                with contextlib.suppress(SystemExit):
                    cli.main()
    words = " ".join(printed.getvalue().split())
    for number in told.splitlines():
        assert number in words, f"{number} is not in: {words}"
