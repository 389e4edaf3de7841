"""Compiled templates that are kept: used again, compiled anew where damaged, never a reason to fail."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from jinja2 import DictLoader, Environment

from sfm.report import template_cache
from sfm.report.template_cache import TemplateCache

TEMPLATE = {"page.html": "{{ name }} and {{ 2 | twice }}"}


def made_environment(cache: TemplateCache | None) -> Environment:
    """Return an environment as those of the reports, with a filter that a template is compiled with."""
    environment = Environment(loader=DictLoader(TEMPLATE), autoescape=True, bytecode_cache=cache)
    environment.filters["twice"] = lambda value: 2 * value
    return environment


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder in the place of that beside the sources."""
    monkeypatch.setattr(template_cache, "KEPT", tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    return tmp_path


def rendered(cache: TemplateCache | None) -> str:
    """Return the page of a new environment."""
    return made_environment(cache).get_template("page.html").render(name="a & b")


def test_a_kept_template_is_not_compiled_again(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second environment renders the same without the compiler; other modules have other templates."""
    first = rendered(template_cache.template_cache("sfm.report.html.page"))
    (file,) = kept.iterdir()
    template_cache.template_cache("sfm.report.text.text_report")
    monkeypatch.setattr(Environment, "_generate", lambda *_, **__: pytest.fail("compiled again"))
    assert rendered(template_cache.template_cache("sfm.report.html.page")) == first == "a &amp; b and 4"
    assert list(kept.iterdir()) == [file]


def test_templates_of_other_sources_are_removed(kept: Path) -> None:
    """What an earlier version of the filters has left is neither used nor kept."""
    (kept / "sfm.report.html.page-3.1.0-0123456789abcdef-page.template").write_bytes(b"old")
    template_cache.template_cache("sfm.report.html.page")
    assert not list(kept.iterdir())


@pytest.mark.parametrize("length", [0, 3, 40, 60, 120])
def test_a_damaged_file_is_compiled_again(kept: Path, length: int) -> None:
    """A file cut off anywhere, as a full disk leaves it, changes nothing."""
    page = rendered(template_cache.template_cache("sfm.report.html.page"))
    (file,) = kept.iterdir()
    file.write_bytes(file.read_bytes()[:length])
    assert rendered(template_cache.template_cache("sfm.report.html.page")) == page


def test_a_folder_that_vanishes_is_no_reason_to_fail(kept: Path) -> None:
    """A template that cannot be written is rendered all the same."""
    cache = template_cache.template_cache("sfm.report.html.page")
    assert cache is not None
    kept.rmdir()
    assert rendered(cache) == "a &amp; b and 4"


def test_nothing_is_kept_where_python_keeps_nothing(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Python's own switch counts for templates, too (-B, PYTHONDONTWRITEBYTECODE)."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    assert template_cache.template_cache("sfm.report.html.page") is None
