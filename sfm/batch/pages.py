"""The tables of a batch: batch.csv, batch.json and index.html, one row per survey."""

from __future__ import annotations

import csv
import io
import json
import os
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, fields
from html import escape
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from sfm.batch.survey import LOGS, SurveyRow
from sfm.errors import OutputError

HEADER = (
    "survey",
    "status",
    "verdict",
    "sigma0, px",
    "RMS, px",
    "photographs",
    "points",
    "COLMAP",
    "seconds",
    "remark",
)


def write_batch_pages(rows: Sequence[SurveyRow], out: Path) -> None:
    """Write batch.csv, batch.json and index.html, each whole or not at all.

    Args:
        rows: one per survey.
        out: folder of the batch.

    Raises:
        OutputError: they cannot be written.
    """
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    names = [field.name for field in fields(SurveyRow)]
    writer.writerow(names)
    writer.writerows(["" if v is None else v for v in asdict(row).values()] for row in rows)
    data = {"surveys": [asdict(row) for row in rows], "totals": totals(rows)}
    _write(out / "batch.csv", table.getvalue())
    _write(out / "batch.json", json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n")
    _write(out / "index.html", render_index(rows))


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


def render_index(rows: Sequence[SurveyRow]) -> str:
    """Return the page with a line for every survey; whatever came from files is escaped."""
    style = files("sfm.report").joinpath("report.css").read_text(encoding="utf-8")
    told = ", ".join(f"{count} {name}" for name, count in totals(rows).items() if count or name == "done")
    head = "".join(f"<th>{escape(name)}</th>" for name in HEADER)
    body = "\n".join(_line(row) for row in rows)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Batch</title><style>{style}</style></head><body><main><h1>Batch</h1><p>{escape(told)}</p>"
        f"<div class=scroll><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>"
        "</main></body></html>\n"
    )


def _line(row: SurveyRow) -> str:
    done = row.status == "done"
    link = f"{quote(row.folder)}/report.html" if done else f"{LOGS}/{quote(row.folder)}.jsonl"
    cells = (
        row.status,
        row.verdict,
        _number(row.sigma0_px, 4),
        _number(row.rms_px, 4),
        f"{row.photographs} of {row.photographs_total}" if done else "",
        "" if row.points is None else str(row.points),
        row.comparison,
        f"{row.seconds:.1f}",
        row.reason,
    )
    name = f'<th scope=row><a href="{escape(link)}">{escape(row.survey)}</a></th>'
    return f"<tr>{name}{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>"


def _number(value: float | None, decimals: int) -> str:
    return "" if value is None else f"{value:.{decimals}f}"


def _write(path: Path, text: str) -> None:
    """Write a file beside its place, have it on the disk, and put it there."""
    try:
        handle, part = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            Path(part).chmod(0o644)  # mkstemp makes it for the owner alone
            Path(part).replace(path)
        finally:
            Path(part).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
