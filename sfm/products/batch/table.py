"""Table of a batch: on the terminal while it runs, and then as batch.csv, batch.json and index.html."""

from __future__ import annotations

import os
import signal
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

from rich.console import Console, RenderableType
from rich.live import Live
from rich.table import Table as RichTable
from rich.text import Text

from sfm.files.open_folders import MANIFEST, read_manifest, refuse_foreign_files
from sfm.files.plain_text import as_plain, is_plain
from sfm.files.whole_files import whole_files
from sfm.model.display import counted
from sfm.model.errors import OutputError
from sfm.model.remarks.remark import Remark, remark
from sfm.model.remarks.verdict import judge
from sfm.products.batch.job import LOGS, SurveyRow
from sfm.report.page import Column, Link, Mark, Note, Page, Section, Table, Tile
from sfm.report.pages import texts_of
from sfm.report.phrases import fixed
from sfm.runtime.compiling import COMPILING
from sfm.runtime.forecast import BatchCountdown, RunHistory, Work
from sfm.runtime.progress_bar import clock_time
from sfm.runtime.threads import cores

PAGES = ("batch.json", "batch.csv", "index.html")  # the first identifies them
PRINTED = "index.pdf"  # where it was asked for
COLOURS = {"good": "green", "fair": "yellow", "bad": "red", "": "red"}
RECENT = 8  # finished surveys that remain visible
REFRESHES_PER_SECOND = 4


@dataclass
class _Line:
    """A survey in progress."""

    begun: float | None = None  # when a worker began it, time.monotonic()
    stage: str = "waiting"
    photographs: int = 0  # number of measured photographs
    total: int = 0  # number of photographs to measure


class BatchTable:
    """Observer of a batch: a live table on a terminal, else a line for every finished survey."""

    def __init__(self, console: Console, *, verbose: bool = False) -> None:
        self._console = console
        self._verbose = verbose
        self._lines: dict[str, _Line] = {}
        self._recent: list[SurveyRow] = []
        self._left = self._done = self._failed = 0
        self._compiling = False
        self._countdown: BatchCountdown | None = None
        self._live = Live(
            console=console, get_renderable=self._render, refresh_per_second=REFRESHES_PER_SECOND
        )

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def planned(self, works: Mapping[str, Work | None], workers: int) -> None:
        """Begin with the surveys to run."""
        self._left = len(works)
        runs = RunHistory.of_user().read()
        self._countdown = BatchCountdown(works, runs, workers=workers, threads=cores())

    def received(self, name: str, message: dict[str, Any]) -> None:
        """Note a message of a survey."""
        line = self._lines.setdefault(name, _Line())
        if "photographs" in message:
            line.total = int(message["photographs"])
        elif line.begun is None:
            line.begun = time.monotonic()
        if "photograph" in message:
            line.stage = "targets"
            line.photographs += 1
            if self._countdown is not None:
                self._countdown.measured(
                    name, float(message["seconds"]), line.total, stored=bool(message["stored"])
                )
        if "compiling" in message and not self._compiling:
            self._compiling = True
            self.remark(f"kolinear: the {COMPILING}")
        if "stage" in message:
            line.stage = str(message["stage"])
            if self._countdown is not None and "before" in message:
                self._countdown.begin(name, line.stage, time.monotonic(), float(message["before"]))
        if self._verbose:
            what = ", ".join(f"{key} {value}" for key, value in message.items())
            self._console.print(Text(f"  {name}: {what}"), soft_wrap=True)

    def finished(self, name: str, row: SurveyRow, *, kept: bool) -> None:
        """Note the end of a survey."""
        self._lines.pop(name, None)
        if self._countdown is not None:
            self._countdown.finish(name, row.seconds, dependable=row.succeeded and not kept)
        self._left -= 1
        self._done += row.succeeded
        self._failed += not row.succeeded
        self._recent = [*self._recent, row][-RECENT:]
        if (not self._console.is_terminal or self._verbose) and not kept:
            self._console.print(
                Text(f"{name}: {outcome_of(row)}", style=COLOURS[row.verdict]), soft_wrap=True
            )

    def remark(self, text: str) -> None:
        """Print a remark above the table."""
        self._console.print(Text(text), soft_wrap=True)

    def _render(self) -> RenderableType:
        """Return the present table."""
        now = time.monotonic()
        text = f"{self._done + self._failed} of {self._done + self._failed + self._left} surveys"
        if self._failed:
            text += f", {self._failed} failed"
        left = self._countdown.left(now) if self._countdown is not None else None
        if left is not None and self._left:
            text += f", {clock_time(left)} to the end"
        table = RichTable(box=None, padding=(0, 2, 0, 0), caption=text, caption_justify="left")
        for name in ("survey", "stage", "photographs", "seconds"):
            table.add_column(name, justify="right" if name in ("photographs", "seconds") else "left")
        for row in self._recent:
            style = COLOURS[row.verdict]
            table.add_row(
                Text(row.folder, style=style), Text(outcome_of(row), style=style), "", f"{row.seconds:.1f}"
            )
        for name, line in list(self._lines.items()):
            count = f"{line.photographs} of {line.total}" if line.total else ""
            seconds = "" if line.begun is None else f"{now - line.begun:.0f}"
            table.add_row(Text(name), Text(line.stage), count, seconds)
        return table


def outcome_of(row: SurveyRow) -> str:
    """Return a short text on how a survey ended."""
    if row.status != "done":
        return f"{row.status}: {row.reason}"
    if row.reason:
        return f"{row.verdict}: {row.reason}"
    sigma0 = "" if row.sigma0_px is None else f", sigma0 {row.sigma0_px:.4f} px"
    return f"{row.verdict}, {row.photographs} of {row.photographs_total} photographs{sigma0}"


def print_batch(console: Console, rows: Sequence[SurveyRow], page: Path) -> None:
    """Print the outcome of a batch: the number of results, failed surveys with reasons, and its page."""
    count = [(name, n) for name, n in totals(rows).items() if name != "surveys"]
    parts = [counted(len(rows), "survey")]
    parts += [f"{n} {name}" for name, n in count if n or name == "done"]
    console.print(Text(", ".join(parts), "bold"))
    for row in rows:
        if not row.succeeded:
            outcome = outcome_of(row) if row.status != "done" else f"{outcome_of(row)}: see its report"
            where = (
                "" if row.reason.startswith(row.file) else f" ({row.file})"
            )  # the reason may already state the file
            console.print(Text(f"  {row.survey}{where}: {outcome}", style="red"), soft_wrap=True)
    console.print(Text(f"Index: {page}", style="bold"), soft_wrap=True)


@contextmanager
def stopping_at_terminate() -> Iterator[None]:
    """Treat a request to terminate, as before a shutdown of the computer, like Ctrl-C."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def write_batch_pages(rows: Sequence[SurveyRow], out: Path) -> None:
    """Write batch.json, batch.csv and index.html, each completely or not at all.

    Args:
        rows: one row per survey.
        out: folder of the batch.

    Raises:
        OutputError: they cannot be written.
    """
    texts = texts_of(batch_page(rows, out.name))
    if PRINTED in read_manifest(out):
        (out / PRINTED).unlink(missing_ok=True)  # it shows an earlier batch
    with whole_files(out) as part:
        for name in PAGES:
            (part / name).write_bytes(texts[name].encode())


def refuse_foreign_pages(out: Path) -> None:
    """Raise OutputError if a folder has files of these names that no batch wrote, or that were changed.

    It is also raised if the path contains invisible characters, or leads through a link.
    """
    if not is_plain(str(out)):
        raise OutputError(
            f"{as_plain(str(out))}: the path has control or invisible characters; needed another --out"
        )
    if not read_manifest(out).keys() <= {MANIFEST, PRINTED, *PAGES}:
        raise OutputError(
            f"{out}: the folder contains '{MANIFEST}' of a result, not of a batch; needed another --out"
        )
    refuse_foreign_files(out, PAGES)


def totals(rows: Sequence[SurveyRow]) -> dict[str, int]:
    """Return the number of surveys by their outcome."""
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
    """Return the remarks on the outcomes of the surveys of a batch."""
    kinds = {
        "surveys_not_dependable": [row.survey for row in rows if row.status == "done" and not row.succeeded],
        "surveys_with_warnings": [row.survey for row in rows if row.verdict == "fair"],
    }
    ended = {how: [row.survey for row in rows if row.status == how] for how in ("failed", "set aside")}
    remarks = [remark("surveys_failed", how=how, surveys=names) for how, names in ended.items() if names]
    remarks += [remark(kind, surveys=names) for kind, names in kinds.items() if names]
    return tuple(remarks)


def batch_page(rows: Sequence[SurveyRow], name: str) -> Page:
    """Return the page with a line for every survey.

    Args:
        rows: one row per survey.
        name: name of the batch.
    """
    good = sum(row.succeeded for row in rows)
    headline = f"{good} of {len(rows)} surveys {'has' if good == 1 else 'have'} a dependable result."
    try:
        above = os.path.commonpath([Path(row.file).parent for row in rows])
    except ValueError:  # no files, or several drives
        above = ""
    if above == Path(above).anchor:
        above = ""
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
            Section(
                "Surveys", _table_of_results(rows, above), Note(f"Files are below {above}") if above else None
            ),
            Section("Without a result", _table_of_failures(without, above) if without else None),
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


def _table_of_results(rows: Sequence[SurveyRow], above: str) -> Table:
    """Return the table of surveys with their results."""
    columns = (
        Column("survey"),
        Column("file"),
        Column("result"),
        Column("photographs", format=str),
        Column("points", format="z.0f"),
        Column("sigma0, px", format="z.4f"),
        Column("RMS, px", format="z.4f"),
        Column("COLMAP"),
        Column("seconds", format="z.1f"),
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
                row.points,
                row.sigma0_px,
                row.rms_px,
                compared,
                row.seconds,
            )
        )
    return Table(columns, cells)


def _table_of_failures(rows: Sequence[SurveyRow], above: str) -> Table:
    """Return the table of surveys without a result, with the reasons."""
    cells = [
        (
            row.survey,
            _below(row.file, above),
            Mark(row.status, "bad"),
            row.reason,
            Link(f"{row.folder}.jsonl", f"{LOGS}/{row.folder}.jsonl"),
        )
        for row in rows
    ]
    return Table(tuple(Column(title) for title in ("survey", "file", "", "reason", "log")), cells)


def _below(file: str, above: str) -> str:
    return os.path.relpath(file, above) if above else file
