"""The folder of a result: written beside its place, then put there by one rename, or not at all."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from sfm.files.whole_files import MANIFEST, refuse_foreign_folder, whole_folder
from sfm.progress import SILENT, Progress
from sfm.report.html import render_html
from sfm.report.overlays import draw_overlays
from sfm.report.plots import all_plots
from sfm.report.summary import write_summary
from sfm.report.tables import write_tables
from sfm.report.text import text_report
from sfm.result import StageTime, SurveyResult

MAX_FOLDER_BYTES = 100  # of the name of a survey's folder; disks take 255, endings included

WRITTEN = (
    "summary.json",
    "points.csv",
    "images.csv",
    "cameras.csv",
    "image_points.csv",
    "given.csv",
    "reliability.csv",
    "variance_components.csv",
    "report.txt",
    "points.ply",
    "report.html",
    "colmap",
    "overlays",
    "plots",
    "log.jsonl",
    MANIFEST,
)


def write_result(
    result: SurveyResult,
    out: Path,
    *,
    write_colmap: Callable[[Path], None] | None = None,
    finish: Callable[[Path], None] | None = None,
    jobs: int = 1,
    progress: Progress = SILENT,
) -> Path:
    """Write everything that a survey gives into one folder, whole or not at all.

    Args:
        result: the result.
        out: the folder; an unchanged earlier result in it is replaced, anything else in it is an error.
        write_colmap: fills the folder `colmap`, which it is given; None leaves it out.
        finish: is given the folder when all else is in it, and may add log.jsonl.
        jobs: photographs drawn at the same time.
        progress: is told of every photograph.

    Returns:
        The path of report.html.

    Raises:
        OutputError: the folder cannot be written, or holds something else than an earlier result.
    """
    out = Path(out)
    refuse_foreign_folder(out)
    started = time.perf_counter()
    progress.stage("report", len(result.photographs))
    with whole_folder(out, "the result", replaceable=True) as folder:
        if write_colmap is not None:
            (folder / "colmap").mkdir()
            write_colmap(folder / "colmap")
        overlays = draw_overlays(result, jobs=jobs, progress=progress)
        if overlays:
            (folder / "overlays").mkdir()
        for overlay in overlays:
            (folder / "overlays" / overlay.file_name).write_bytes(overlay.jpeg)
        plots = all_plots(result.adjustment, result.length_unit)
        (folder / "plots").mkdir()
        for stem, _, data in plots:
            (folder / "plots" / f"{stem}.png").write_bytes(data)
        timed = replace(result, seconds=(*result.seconds, StageTime("report", time.perf_counter() - started)))
        write_tables(timed, folder)
        write_summary(timed, folder)
        (folder / "report.txt").write_text(text_report(timed), encoding="utf-8")
        page = render_html(timed, plots, overlays, has_model=write_colmap is not None)
        (folder / "report.html").write_text(page, encoding="utf-8")
        if finish is not None:
            finish(folder)
    return out / "report.html"


def folder_name(name: str) -> str:
    """Return the name of the folder of a survey's result: its own, as far as all disks take it."""
    kept = re.sub(r"[^\w.\-]+", "_", name).encode()[:MAX_FOLDER_BYTES].decode(errors="ignore")
    return kept.strip("._-") or "survey"
