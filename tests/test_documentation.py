"""Every page of docs/ is on the site."""

from __future__ import annotations

import re

import pytest

from tests.places import ROOT


def test_every_page_is_on_the_site() -> None:
    docs = ROOT / "docs"
    listed = set(re.findall(r"^([\w/-]+)$", (docs / "index.md").read_text(encoding="utf-8"), re.M))
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
