"""docs/reading-the-report.md names every figure of the report."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from sfm.pipeline import run_survey
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.page import FoldedParts, Heading, Part, Table
from sfm.report.pages import page_of
from sfm.survey.inputs.survey import read_survey
from tests.places import ROOT
from tests.surveys import write_photograph_survey

PAGE = re.sub(r"\s+", " ", (ROOT / "docs" / "reading-the-report.md").read_text(encoding="utf-8")).lower()
OF_FIGURES = ("", "observations", "standard deviation", "reliability")  # first columns that name figures


def labels(parts: tuple[Part, ...]) -> Iterator[str]:
    for part in parts:
        if isinstance(part, FoldedParts):
            yield from labels(part.parts)
        elif isinstance(part, Heading):
            yield re.sub(r"^The \d+ ", "", part.text)
        elif isinstance(part, Table) and (part.facts or part.header[0] in OF_FIGURES):
            yield from (str(row[0]).removesuffix(" small") for row in part.rows)  # the name of the camera
        elif isinstance(part, Table):
            reasons = (
                part.header[1:] if "accepted in the result" not in str(part.header) else part.header[1:3]
            )
            yield from (one.removeprefix(">").partition(" [")[0] for one in reasons)


def test_every_figure_of_the_report_is_explained(tmp_path: Path) -> None:
    found = findings_of(run_survey(read_survey(write_photograph_survey(tmp_path / "survey", "page"))))
    sections = {one.key: one for one in page_of(found).sections}
    names = {
        one for key in ("worked", "quality", "rejected", "comparison") for one in labels(sections[key].parts)
    }
    assert len(names) > 60
    missing = sorted(one for one in names if one.lower() not in PAGE)
    assert not missing, missing
