"""Every page of docs/ is on the site."""

from __future__ import annotations

import re

from tests.places import ROOT


def test_every_page_is_on_the_site() -> None:
    docs = ROOT / "docs"
    listed = set(re.findall(r"^([\w/-]+)$", (docs / "index.md").read_text(encoding="utf-8"), re.M))
    pages = {str(page.relative_to(docs).with_suffix("")) for page in docs.rglob("*.md")} - {"index"}
    assert pages == listed
