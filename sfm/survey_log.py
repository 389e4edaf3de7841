"""The log of a survey for machines: one JSON object per line, written as things happen.

Every line has `time` (UTC) and `event`:

    start       survey, file, inputs (fingerprint of all it reads), version
    photograph  image, targets, rejected, stored (measured in an earlier run), seconds; or failed, a reason
    stage       stage, seconds, steps
    warning     text
    result      photographs, points, observations, sigma0_px, rms_px, verdict, seconds, ...
    failed      reason
"""

from __future__ import annotations

import json
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from sfm.errors import OutputError

MAX_LOG_BYTES = 50_000_000  # of a log that is read back


class SurveyLog:
    """Progress that is written down; with a path every line goes to the file at once.

    Steps are counted from several threads, hence the lock.
    """

    def __init__(self, path: Path | None = None, *, append: bool = False) -> None:
        self._lines: list[str] = []
        self._lock = threading.Lock()
        self._path = path
        self._file = None
        self._stage: str | None = None
        self._begun = 0.0
        self._steps = 0
        if path is not None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._file = path.open("a" if append else "w", encoding="utf-8")
            except OSError as error:
                raise OutputError(f"{path}: the log cannot be written: {error.strerror}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()

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
        """Write down the stage that ends with this one; a second call for a stage tells its total."""
        if name == self._stage:
            return
        self.end_stage()
        self._stage, self._begun, self._steps = name, time.perf_counter(), 0

    def advance(self, step: str = "") -> None:
        """Count one step of the stage."""
        with self._lock:
            self._steps += 1

    def end_stage(self) -> None:
        """Write down the stage that is under way, if there is one."""
        if self._stage is not None:
            seconds = round(time.perf_counter() - self._begun, 4)
            steps = {"steps": self._steps} if self._steps else {}
            self.note("stage", stage=self._stage, seconds=seconds, **steps)
            self._stage = None

    def text(self) -> str:
        """Return all lines so far."""
        with self._lock:
            return "\n".join(self._lines) + "\n"


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
