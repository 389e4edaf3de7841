"""The tables of a batch: batch.csv, batch.json and index.html, one row per survey."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

from sfm.batch.job import LOGS, SurveyRow
from sfm.errors import OutputError
from sfm.files.manifest import MANIFEST, read_manifest, refuse_foreign_files
from sfm.files.plain_text import as_plain, csv_text, is_plain
from sfm.files.whole_files import whole_files
from sfm.remarks.remark import Remark, remark
from sfm.remarks.verdict import judge
from sfm.report.html.page import render

PAGES = ("batch.json", "batch.csv", "index.html")  # the first states whose they are


def write_batch_pages(rows: Sequence[SurveyRow], out: Path) -> None:
    """Write batch.json, batch.csv and index.html, each whole or not at all.

    Args:
        rows: one per survey.
        out: folder of the batch.

    Raises:
        OutputError: they cannot be written.
    """
    names = [field.name for field in fields(SurveyRow)]
    data = {"surveys": [asdict(row) for row in rows], "totals": totals(rows)}
    pages = (
        json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n",
        csv_text(names, [tuple(asdict(row).values()) for row in rows]),
        render_index(rows, out.name),
    )
    with whole_files(out) as part:
        for name, text in zip(PAGES, pages, strict=True):
            (part / name).write_bytes(text.encode())


def refuse_foreign_pages(out: Path) -> None:
    """Raise OutputError where a folder has files of these names that no batch has written, or a changed one.

    So it does where the path is no text that can stand in them, or leads through a link.
    """
    if not is_plain(str(out)):
        raise OutputError(
            f"{as_plain(str(out))}: the path has control or invisible characters; needed another --out"
        )
    if not read_manifest(out).keys() <= {MANIFEST, *PAGES}:
        raise OutputError(f"{out}: the folder holds '{MANIFEST}' of a result, no batch; needed another --out")
    refuse_foreign_files(out, PAGES)


def totals(rows: Sequence[SurveyRow]) -> dict[str, int]:
    """Return how many surveys ended in which way."""
    count = Counter(row.status for row in rows)
    bad = sum(row.status == "done" and not row.succeeded for row in rows)
    return {
        "surveys": len(rows),
        "done": count["done"],
        "failed": count["failed"],
        "set aside": count["set aside"],
        "not dependable": bad,
    }


def batch_remarks(rows: Sequence[SurveyRow]) -> tuple[Remark, ...]:
    """Return how the surveys of a batch ended, by name."""
    kinds = {
        "surveys_failed": [row.survey for row in rows if row.status == "failed"],
        "surveys_set_aside": [row.survey for row in rows if row.status == "set aside"],
        "surveys_not_dependable": [row.survey for row in rows if row.status == "done" and not row.succeeded],
        "surveys_with_warnings": [row.survey for row in rows if row.verdict == "fair"],
        "adjuster_differs_in_surveys": [row.survey for row in rows if row.comparison == "differs"],
    }
    return tuple(remark(kind, surveys=names) for kind, names in kinds.items() if names)


def render_index(rows: Sequence[SurveyRow], name: str) -> str:
    """Return the page with a line for every survey.

    Args:
        rows: one per survey.
        name: of the batch.
    """
    good = sum(row.succeeded for row in rows)
    headline = f"{good} of {len(rows)} surveys {'has' if good == 1 else 'have'} a dependable result."
    verdict = judge(batch_remarks(rows), {"good": headline, "fair": headline, "bad": headline})
    above = _common_folder(rows)
    return render(
        "batch.html",
        title=name,
        headline=verdict.headline,
        level=verdict.level,
        remarks=verdict.lines,
        rows=rows,
        good=good,
        oriented=sum(row.photographs or 0 for row in rows),
        photographs=sum(row.photographs_total or 0 for row in rows),
        points=sum(row.points or 0 for row in rows),
        above=above,
        below=lambda file: os.path.relpath(file, above) if above else file,
        logs=LOGS,
    )


def _common_folder(rows: Sequence[SurveyRow]) -> str:
    """Return the folder that all survey files are below, empty if there is none but the root."""
    try:
        common = os.path.commonpath([Path(row.file).parent for row in rows])
    except ValueError:  # none at all, or several drives
        return ""
    return "" if common == Path(common).anchor else common
