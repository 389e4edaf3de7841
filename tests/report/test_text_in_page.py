"""With no script at all, the page says every number that the report in plain text says."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from sfm.pipeline import run_survey
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.pages import html_of
from sfm.report.survey_report import text_report
from sfm.survey.inputs.survey import read_survey
from tests.surveys import write_observed_survey, write_photograph_survey

NUMBER = re.compile(r"(?<![\w.^-])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\w)")


class Words(HTMLParser):
    """The text of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.text = ""
        self.hidden = False

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.hidden = tag in ("style", "script")

    def handle_endtag(self, tag: str) -> None:
        self.hidden = False

    def handle_data(self, data: str) -> None:
        self.text += "" if self.hidden else f" {data}"


def said(text: str) -> set[float]:
    return {float(number) for number in NUMBER.findall(text)}


@pytest.mark.parametrize("write", [write_photograph_survey, write_observed_survey])
def test_the_page_says_what_the_text_says(write: object, tmp_path: Path) -> None:
    findings = findings_of(run_survey(read_survey(write(tmp_path / "survey", "text in page"))))  # type: ignore[operator]
    words = Words()
    words.feed(html_of(findings))
    text = text_report(findings)
    missing = sorted(said(text) - said(words.text))
    lines = [line for line in text.splitlines() if said(line) & set(missing)]
    assert missing == [], "\n".join(lines)
    assert len(said(text)) > 60
