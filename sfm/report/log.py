"""The log of a survey for machines: one JSON object per line, written as things happen.

Every line has `time` (UTC) and `event`:

    start       survey, file, version; survey_at, images_at (paths from the folder of the result);
                in a batch: inputs (fingerprint of all it reads)
    photograph  image, targets, rejected, features, stored (measured in an earlier run), seconds; or failed
    stage       stage, seconds, steps
    warning     text
    result      verdict, sigma0_px, rms_px, photographs, points, observations, stored_photographs, ...
    failed      reason
"""

from __future__ import annotations

import json
import math
import os
import threading
import time
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from sfm.errors import OutputError
from sfm.files.open_folders import make_folder, open_regular_file
from sfm.report.findings.findings import Findings
from sfm.runtime.progress import SILENT, Progress

LOG = "log.jsonl"  # in the folder of a result
MAX_LOG_BYTES = 50_000_000  # of a log that is read back


class SurveyLog:
    """Progress that is written down; with a path every line goes to the file at once.

    Steps are counted from several threads, hence the lock.
    """

    def __init__(self, path: Path | None = None, *, append: bool = False, watch: Progress = SILENT) -> None:
        """Begin a log.

        Args:
            path: its file, if it is to have one; an earlier log there is replaced or appended to.
            append: whether it is appended to.
            watch: receives the same.

        Raises:
            OutputError: the file cannot be written, or is something else than a log.
        """
        self._lines: list[str] = []
        self._lock = threading.Lock()
        self._path = path
        self._watch = watch
        self._file = None
        self._stage: str | None = None
        self._begun = 0.0
        self._steps = 0
        if path is not None:
            try:
                make_folder(path.parent)
                if append:
                    refuse_other_log(path)
                else:
                    remove_log(path)  # another run may have it open still
                flags = os.O_WRONLY | os.O_CREAT | (os.O_APPEND if append else os.O_EXCL)
                self._file = os.fdopen(open_regular_file(path, flags), "a", encoding="utf-8")
            except OSError as error:
                raise OutputError(f"{path}: the log cannot be written: {error.strerror}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            with suppress(OSError):  # said when the line was written
                self._file.close()

    def start(self, survey: str, file: Path, **more: Any) -> None:
        """Write the first line of a survey.

        Raises:
            OutputError: the file cannot be written.
        """
        self.note("start", survey=survey, file=str(file), version=version("kolinear"), **more)

    def note(self, event: str, **what: Any) -> None:
        """Write one line.

        Raises:
            OutputError: the file cannot be written.
        """
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = json.dumps({"time": now, "event": event, **what}, ensure_ascii=False)
        with self._lock:
            self._lines.append(line)
            if self._file is None:
                return
            try:
                self._file.write(line + "\n")
                self._file.flush()
            except OSError as error:
                raise OutputError(f"{self._path}: the log cannot be written: {error.strerror}") from error

    def stage(self, name: str, total: int | None = None) -> None:
        """Write down the stage that ends with this one; a second call for a stage gives its total."""
        self._watch.stage(name, total)
        if name == self._stage:
            return
        self.end_stage()
        self._stage, self._begun, self._steps = name, time.perf_counter(), 0

    def advance(self, step: str = "") -> None:
        """Count one step of the stage."""
        self._watch.advance(step)
        with self._lock:
            self._steps += 1

    def step(self, name: str, done: int | None = None, total: int | None = None) -> None:
        """Pass on what the stage does; the log has the stages only."""
        self._watch.step(name, done, total)

    def end_stage(self) -> None:
        """Write down the stage that is under way, if there is one."""
        if self._stage is not None:
            seconds = round(time.perf_counter() - self._begun, 4)
            steps = {"steps": self._steps} if self._steps else {}
            self.note("stage", stage=self._stage, seconds=seconds, **steps)
            self._stage = None

    def close_into(self, folder: Path, findings: Findings, **more: Any) -> None:
        """Write the end of a survey that worked, and all lines into the folder of the result.

        Args:
            folder: the folder, before it appears in its place.
            findings: what the survey ended with.
            more: further entries of the last line.
        """
        self.end_stage()
        for one in findings.verdict.remarks:
            self.note("remark", **one.as_dict())
        self.note("result", **result_entries(findings), **more)
        (folder / LOG).write_text("\n".join(self._lines) + "\n", encoding="utf-8")


def result_entries(findings: Findings) -> dict[str, Any]:
    """Return the figures of a result in a log or a table of surveys; None where unknown."""
    result = findings.result
    a, both = result.adjustment, result.comparison
    return {
        "survey": result.survey,
        "verdict": findings.verdict.level,
        "sigma0_px": float(a.sigma0_px) if math.isfinite(a.sigma0_px) else None,
        "rms_px": float(a.rms_px) if math.isfinite(a.rms_px) else None,
        "photographs": len(a.network.images),
        "photographs_total": result.images_total,
        "points": len(a.network.points),
        "observations": int((~a.rejected).sum()),
        "rejected": int(a.rejected.sum()),
        "iterations": a.iterations,
        "converged": a.converged,
        "comparison": "none" if both is None else both.outcome,
        "stored_photographs": [p.image for p in result.photographs if p.stored],
        "failed_photographs": [{"image": f.image, "reason": f.reason.as_dict()} for f in result.failed],
    }


def refuse_other_log(path: Path) -> None:
    """Raise OutputError where something stands that is no log, or a link on the way to it."""
    try:
        os.close(open_regular_file(path, os.O_RDONLY))
        if path.stat().st_size and not any({"time", "event"} <= entry.keys() for entry in read_log(path)):
            raise OutputError(f"{path}: is no log of Kolinear, and is left alone; needed another --out")
    except FileNotFoundError:
        return
    except OSError as error:
        raise OutputError(f"{path}: the log cannot be written: {error.strerror}") from error


def remove_log(path: Path) -> None:
    """Remove a log, if it is there.

    Raises:
        OutputError: something else stands there, or it cannot be removed.
    """
    refuse_other_log(path)
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: the log cannot be removed: {error.strerror}") from error


def read_log(path: Path) -> tuple[dict[str, Any], ...]:
    """Return the lines of a log; lines that are not whole, as a killed run leaves them, are passed over.

    Raises:
        OSError: the file cannot be read.
    """
    if path.stat().st_size > MAX_LOG_BYTES:
        return ()
    found = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(entry, dict):
            found.append(entry)
    return tuple(found)
