"""The tutorial: its commands print what the page shows."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.places import ROOT, load_page_code

PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
HEADLINE = "The survey worked: 12 of 12 photographs oriented, 96 object points."


def without_figures(text: str) -> str:
    return re.sub(r"\d+(?:\.\d+)?", "0", " ".join(text.split()))


@pytest.mark.slow
def test_the_tutorial_prints_what_its_page_shows(tmp_path: Path) -> None:
    """Headlines, rows and remarks as they are, further figures without their digits."""
    printed = load_page_code("tutorial_outputs").outputs(PAGE, tmp_path)
    assert len(printed) == 2
    for shown, now in printed.items():
        assert shown.startswith(HEADLINE) and now.startswith(HEADLINE)
        assert without_figures(now) == without_figures(shown), "python docs/tutorial_outputs.py"
    assert "`c_assumed`" in PAGE and "`sigma_px = 0.02`" in PAGE
    text = (tmp_path / "out" / "photos.toml").read_text(encoding="utf-8")
    assert "c_mm = 14.0" in text and "c_assumed = true" not in text and text.count("[[scale_bar]]\nfrom") == 2
