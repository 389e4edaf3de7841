"""The tables of a batch: batch.csv, batch.json and index.html, one row per survey."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import astuple, fields
from pathlib import Path

from sfm.batch.job import LOGS, SurveyRow
from sfm.errors import OutputError
from sfm.files.manifest import MANIFEST, read_manifest, refuse_foreign_files
from sfm.files.plain_text import as_plain, is_plain
from sfm.files.whole_files import whole_files
from sfm.remarks.remark import Remark, remark
from sfm.remarks.verdict import judge
from sfm.report.numbers import fixed
from sfm.report.page import Column, Link, Mark, Note, Page, Section, Table, Tile
from sfm.report.pages import texts_of

PAGES = ("batch.json", "batch.csv", "index.html")  # the first states whose they are


def write_batch_pages(rows: Sequence[SurveyRow], out: Path) -> None:
    """Write batch.json, batch.csv and index.html, each whole or not at all.

    Args:
        rows: one per survey.
        out: folder of the batch.

    Raises:
        OutputError: they cannot be written.
    """
    texts = texts_of(batch_page(rows, out.name))
    with whole_files(out) as part:
        for name in PAGES:
            (part / name).write_bytes(texts[name].encode())


def refuse_foreign_pages(out: Path) -> None:
    """Raise OutputError where a folder has files of these names that no batch has written, or a changed one.

    So it does where the path is no text that they can contain, or leads through a link.
    """
    if not is_plain(str(out)):
        raise OutputError(
            f"{as_plain(str(out))}: the path has control or invisible characters; needed another --out"
        )
    if not read_manifest(out).keys() <= {MANIFEST, *PAGES}:
        raise OutputError(
            f"{out}: the folder contains '{MANIFEST}' of a result, no batch; needed another --out"
        )
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


def batch_page(rows: Sequence[SurveyRow], name: str) -> Page:
    """Return the page with a line for every survey.

    Args:
        rows: one per survey.
        name: of the batch.
    """
    good = sum(row.succeeded for row in rows)
    headline = f"{good} of {len(rows)} surveys {'has' if good == 1 else 'have'} a dependable result."
    above = _common_folder(rows)
    oriented, photographs, points = (
        sum(getattr(row, of) or 0 for row in rows) for of in ("photographs", "photographs_total", "points")
    )
    every = Table(
        tuple(Column(name=field.name) for field in fields(SurveyRow)), [astuple(row) for row in rows], "batch"
    )
    without = [row for row in rows if row.status != "done"]
    return Page(
        "batch",
        "Batch of surveys",
        name,
        judge(batch_remarks(rows), {"good": headline, "fair": headline, "bad": headline}),
        (
            Section("Surveys", _surveys(rows, above), Note(f"Files are below {above}") if above else None),
            Section("Without a result", _without(without, above) if without else None),
        ),
        tiles=(
            Tile("Surveys", len(rows), f"{good} with a dependable result"),
            Tile("Photographs oriented", f"{oriented} of {photographs}", "of surveys with a result"),
            Tile("Object points", points),
            Tile("Computing", f"{fixed(sum(row.seconds for row in rows), 1)} s", "of all workers together"),
        ),
        summary={"surveys": every.records, "totals": totals(rows)},
        files=(every,),
        file="index",
    )


def _surveys(rows: Sequence[SurveyRow], above: str) -> Table:
    """Return the surveys with what came of them."""
    columns = (
        *(Column("survey"), Column("file"), Column("result"), Column("photographs", format=str)),
        *(Column("points", format="z.0f"), Column("sigma0, px", format="z.4f")),
        *(Column("RMS, px", format="z.4f"), Column("COLMAP"), Column("seconds", format="z.1f")),
    )
    cells = []
    for row in rows:
        done = row.status == "done"
        compared = Mark("differs", "bad") if row.comparison == "differs" else row.comparison
        cells.append(
            (
                Link(row.survey, f"{row.folder}/report.html") if done else row.survey,
                _below(row.file, above),
                Mark(row.verdict if done else row.status, row.verdict or "bad"),
                f"{row.photographs} / {row.photographs_total}" if done else None,
                *(row.points, row.sigma0_px, row.rms_px, compared, row.seconds),
            )
        )
    return Table(columns, cells)


def _without(rows: Sequence[SurveyRow], above: str) -> Table:
    """Return the surveys that have no result, and why."""
    cells = [
        (
            *(row.survey, _below(row.file, above), Mark(row.status, "bad"), row.reason),
            Link(f"{row.folder}.jsonl", f"{LOGS}/{row.folder}.jsonl"),
        )
        for row in rows
    ]
    return Table(tuple(Column(one) for one in ("survey", "file", "", "reason", "log")), cells)


def _below(file: str, above: str) -> str:
    return os.path.relpath(file, above) if above else file


def _common_folder(rows: Sequence[SurveyRow]) -> str:
    """Return the folder that all survey files are below, empty if there is none but the root."""
    try:
        common = os.path.commonpath([Path(row.file).parent for row in rows])
    except ValueError:  # none at all, or several drives
        return ""
    return "" if common == Path(common).anchor else common
