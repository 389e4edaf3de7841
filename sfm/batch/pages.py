"""The tables of a batch: batch.csv, batch.json and index.html, one row per survey."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, fields
from html import escape
from pathlib import Path

from sfm.batch.survey import LOGS, SurveyRow
from sfm.errors import OutputError
from sfm.files.plain_text import as_plain, csv_text, is_plain
from sfm.files.whole_files import MANIFEST, read_manifest, refuse_links, sha256_of, whole_file, write_manifest
from sfm.report.markup import Cell, file_url, table
from sfm.report.pages import page

PAGES = ("batch.json", "batch.csv", "index.html")
HEADER = ("survey", "file", "result", "photographs", "points", "sigma0, px", "RMS, px", "COLMAP", "seconds")
LEVELS = {"good": "good", "fair": "fair", "bad": "bad", "": "bad"}
"""colour of a verdict; without a result there is none, which is bad"""


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
    texts = {name: text.encode() for name, text in zip(PAGES, pages, strict=True)}
    there = {name: [sha256_of(out / name)] for name in PAGES if (out / name).exists()}
    # Listed before they are written, beside those that are there: whatever ends the run, they are known.
    new = {name: hashlib.sha256(text).hexdigest() for name, text in texts.items()}
    write_manifest(out, {name: [*there.get(name, ()), new[name]] for name in PAGES})
    for name, text in texts.items():
        with whole_file(out / name) as part:
            part.write_bytes(text)


def refuse_foreign_pages(out: Path) -> None:
    """Raise OutputError where a folder has files of these names that no batch has written, or a changed one.

    So it does where the path is no text that can stand in them, or leads through a link.
    """
    if not is_plain(str(out)):
        raise OutputError(f"{as_plain(str(out))}: the path is no plain text; needed another --out")
    for name in (MANIFEST, *PAGES):
        refuse_links(out / name)
    known = read_manifest(out)
    try:
        there = {name: sha256_of(out / name) for name in (MANIFEST, *PAGES) if (out / name).exists()}
    except OSError as error:
        raise OutputError(f"{out}: the folder cannot be read: {error.strerror}") from error
    foreign = [name for name, digest in there.items() if digest not in known.get(name, ())]
    foreign += [] if known.keys() <= {MANIFEST, *PAGES} else [MANIFEST]
    if foreign:
        raise OutputError(
            f"{out}: the folder holds '{foreign[-1]}', which no batch has written, or not as it is "
            "now; needed another --out"
        )


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


def render_index(rows: Sequence[SurveyRow], name: str) -> str:
    """Return the page with a line for every survey; whatever came from files is escaped.

    Args:
        rows: one per survey.
        name: of the batch.
    """
    count = totals(rows)
    good = sum(row.succeeded for row in rows)
    remarked = sum(row.verdict == "fair" for row in rows)
    differs = sum(row.comparison == "differs" for row in rows)
    remarks = [f"{count[word]} {word}" for word in ("failed", "set aside", "not dependable") if count[word]]
    remarks += [f"{remarked} with remarks, told in the report"] if remarked else []
    remarks += [f"{differs} where COLMAP's adjustment differs"] if differs else []
    level = "bad" if good < len(rows) else "fair" if remarked or differs else "good"
    above = _common_folder(rows)
    where = f"<p class=note>Files are below {escape(above)}</p>" if above else ""
    sections = [("Surveys", table(HEADER, [_cells(row, above) for row in rows]) + where)]
    without = [row for row in rows if row.status != "done"]
    if without:
        told = [
            (row.survey, _below(row.file, above), Cell(row.status, level="bad"), row.reason, _log(row))
            for row in without
        ]
        sections.append(("Without a result", table(("survey", "file", "", "reason", "log"), told)))
    seconds = sum(row.seconds for row in rows)
    tiles = (
        ("Surveys", str(len(rows)), f"{good} with a dependable result"),
        ("Photographs oriented", _oriented(rows), "of surveys with a result"),
        ("Object points", str(sum(row.points or 0 for row in rows)), ""),
        ("Computing", f"{seconds:.1f} s", "of all workers together"),
    )
    verdict = f"{good} of {len(rows)} surveys {'has' if good == 1 else 'have'} a dependable result."
    return page("Batch of surveys", name, verdict, level, sections, remarks=remarks, tiles=tiles)


def _cells(row: SurveyRow, above: str) -> tuple[str | Cell, ...]:
    """Return the line of a survey in the table."""
    done = row.status == "done"
    return (
        Cell(row.survey, url=f"{file_url(row.folder)}/report.html" if done else ""),
        _below(row.file, above),
        Cell(row.verdict if done else row.status, level=LEVELS.get(row.verdict, "bad")),
        f"{row.photographs} / {row.photographs_total}" if done else "",
        "" if row.points is None else str(row.points),
        _fixed(row.sigma0_px),
        _fixed(row.rms_px),
        Cell(row.comparison, level="bad") if row.comparison == "differs" else row.comparison,
        f"{row.seconds:.1f}",
    )


def _log(row: SurveyRow) -> Cell:
    return Cell(f"{row.folder}.jsonl", url=f"{LOGS}/{file_url(row.folder)}.jsonl")


def _oriented(rows: Sequence[SurveyRow]) -> str:
    return f"{sum(r.photographs or 0 for r in rows)} of {sum(r.photographs_total or 0 for r in rows)}"


def _common_folder(rows: Sequence[SurveyRow]) -> str:
    """Return the folder that all survey files are below, empty if there is none but the root."""
    try:
        common = os.path.commonpath([Path(row.file).parent for row in rows])
    except ValueError:  # none at all, or several drives
        return ""
    return "" if common == Path(common).anchor else common


def _below(file: str, above: str) -> str:
    return os.path.relpath(file, above) if above else file


def _fixed(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"
