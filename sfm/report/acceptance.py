"""An acceptance test as table, JSON and page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from sfm.files.plain_text import csv_text, or_none
from sfm.geometry.tolerance import DECISIONS
from sfm.inspection.acceptance import Acceptance
from sfm.report.figures.measurements import length_error_figure
from sfm.report.figures.plots import plot
from sfm.report.html.page import render
from sfm.report.page_files import write_files

COLUMNS = (
    "line",
    "from",
    "to",
    "length",
    "sigma",
    "measured",
    "sigma_measured",
    "error",
    "limit",
    "decision",
)
FILES = ("lengths.csv", "acceptance.json", "acceptance.html")
PICTURE = (
    "Error of length measurement over length: bars are the expanded uncertainty of the calibration, lines "
    "the limit A + K L, at most B."
)


def write_acceptance(found: Acceptance, out: Path) -> Path:
    """Write an acceptance test into a folder and return the path of its page.

    Args:
        found: the test.
        out: the folder.

    Raises:
        OutputError: the folder holds something else or cannot be written.
    """
    text = json.dumps(acceptance_summary(found), indent=2, ensure_ascii=False, allow_nan=False)
    verdict = found.verdict
    page = render(
        "acceptance.html",
        t=found,
        title=found.name,
        headline=verdict.headline,
        level=verdict.level,
        remarks=verdict.lines,
        rows=acceptance_rows(found),
        decisions=DECISIONS,
        picture=plot("errors", PICTURE, length_error_figure(found)),
    )
    texts = (csv_text(COLUMNS, acceptance_rows(found)), text + "\n", page)
    return write_files(out, tuple(zip(FILES, texts, strict=True)), main=FILES[-1])


def acceptance_rows(found: Acceptance) -> list[tuple[object, ...]]:
    """Return the rows of lengths.csv."""
    one = found.lengths
    measured = one.length + found.error
    return list(
        zip(
            *(one.line, one.start, one.end, one.length, one.sigma, measured, found.sigma, found.error),
            *(found.limit, found.decision),
            strict=True,
        )
    )


def acceptance_summary(found: Acceptance) -> dict[str, Any]:
    """Return what acceptance.json holds: plain values only, None for what is not known."""
    verdict = found.verdict
    return {
        "test": "VDI/VDE 2634 part 1",
        "result": found.name,
        "length_unit": found.unit,
        **verdict.as_dict(),
        "limit": {"A": found.a, "K": found.k, "B": or_none(found.b)},
        "coverage": found.coverage,
        "lines": len(set(found.lengths.line)),
        "lengths": len(found.error),
        **{one.replace(" ", "_"): found.count(one) for one in DECISIONS},
        "largest_error": found.largest,
        "rms_error": float(np.sqrt((found.error**2).mean())),
        "body_diagonal": found.diagonal,
    }
