"""docs/reading-the-report.md names every figure that the templates of the report print."""

from __future__ import annotations

import re
from pathlib import Path

from tests.places import ROOT

TEMPLATES = ROOT / "sfm" / "report"
PAGE = re.sub(r"\s+", " ", (ROOT / "docs" / "reading-the-report.md").read_text(encoding="utf-8")).lower()


def html_labels(path: Path) -> set[str]:
    text = path.read_text(encoding="utf-8")
    found = set(re.findall(r't\.row\(\s*"([^"]{3,})"', text)) | set(
        re.findall(r"<h[34]>([^<{]+)</h[34]>", text)
    )
    return found | set(re.findall(r'^\s+\("([^"]{3,})", f\.\w+', text, re.M))


def text_labels(path: Path) -> set[str]:
    text = path.read_text(encoding="utf-8")
    facts = re.findall(
        r"^([A-Za-z0-9][\w ,.()]+?) \| ",
        "\n".join(re.findall(r"filter facts %}(.*?)endfilter", text, re.S)),
        re.M,
    )
    return set(facts) | set(re.findall(r'^\s+\("([^"]{3,})", [\w.]+ \*', text, re.M))


def test_every_figure_of_the_report_is_explained() -> None:
    labels: set[str] = set()
    for path in sorted((TEMPLATES / "html" / "templates" / "report").glob("*.html")):
        labels |= html_labels(path)
    labels |= text_labels(TEMPLATES / "text" / "templates" / "report.txt")
    assert len(labels) > 60
    missing = sorted(one for one in labels if one.lower() not in PAGE)
    assert not missing, missing
