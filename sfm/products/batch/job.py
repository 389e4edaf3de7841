"""One survey of a batch, run by a worker, and the check whether `--resume` may keep an earlier result.

A result in the folder of a batch may come from a stranger, together with a matching log and manifest.
Therefore every finished result is noted in the user's cache folder, by its path and the hash of its manifest,
which contains the hashes of its files.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sfm.files.open_folders import MANIFEST, Owner, locked, owner_of, sha256_of
from sfm.files.plain_text import as_plain
from sfm.files.user_cache import make_user_folder, remove_unused, user_folder
from sfm.files.whole_files import whole_file
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import AnyArray
from sfm.model.errors import FolderInUseError, OutputError
from sfm.pipeline import run_survey
from sfm.report.findings import Findings, findings_of
from sfm.report.output import (
    LOG,
    SurveyLog,
    read_log,
    remove_log,
    result_entries,
    write_result,
    write_unfinished,
)
from sfm.report.viewer.pictures import BUDGET_MB
from sfm.runtime.compiling import when_compiling
from sfm.runtime.executor import Send
from sfm.runtime.faults import error_in_words, is_fault
from sfm.runtime.progress import Silent
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.sources import reads_photographs
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.inputs.survey_file import SurveyFile
from sfm.survey.measuring.measured_store import Measured, MeasuredStore
from sfm.survey.sources.joined import measure_photograph_once
from sfm.survey.unfinished import UnfinishedSurvey, UnfinishedSurveyError

LOCK = ".lock"  # of the batch
VERDICTS = ("good", "fair", "bad")
LOGS = "logs"  # folder of the logs of surveys without a result


@dataclass(frozen=True)
class SurveyJob:
    """Job of a worker: a survey to run."""

    file: Path  # the survey file
    out: Path  # folder of the batch
    folder: str  # name of the survey's folder in the batch
    inputs: str  # fingerprint of everything that the survey reads
    allow_outside: bool  # whether the survey file may name files outside its folder
    owner: Owner | None  # owner of the batch folder, who started this run
    images: Path | None = None  # folder that a person named for its photographs
    pictures_mb: float = BUDGET_MB  # largest size of the pictures inside a report, 10^6 bytes


@dataclass(frozen=True)
class Comparers:
    """Programs to compare surveys with, as functions of a module, which can be sent to workers."""

    others_of: Callable[[Survey], OtherPrograms]  # returns the programs that a survey requests
    # returns the writer of its model, which receives a folder and the colours of the points
    writer_of: Callable[[SurveyResult], Callable[[Path, AnyArray | None], None] | None]


@dataclass(frozen=True)
class PhotographNote:
    """Outcome of a photograph, for the log."""

    image: str
    counts: dict[str, int] = field(default_factory=dict)  # of targets, rejected candidates, features
    stored: bool = False  # measured in an earlier run
    seconds: float = 0.0
    failed: str = ""  # why it could not be read

    def entry(self) -> dict[str, Any]:
        """Return the line of the log."""
        entry = asdict(self)
        counts: dict[str, Any] = entry.pop("counts")
        return entry | counts


@dataclass(frozen=True)
class MeasuredPhotograph:
    """A measured photograph, passed from the worker that measured it to the worker that runs the survey."""

    note: PhotographNote
    held: dict[str, tuple[Measured, bool]]  # as in `MeasuredStore`; computers may not share a store


@dataclass(frozen=True)
class SurveyRow:
    """A survey in the tables of a batch; values are None without a result."""

    survey: str  # name of the survey
    file: str  # survey file
    folder: str  # folder of the result or the log
    status: str  # done | failed | set aside
    verdict: str = ""  # good | fair | bad
    sigma0_px: float | None = None
    rms_px: float | None = None
    photographs: int | None = None  # oriented
    photographs_total: int | None = None
    points: int | None = None
    comparison: str = ""  # agrees | differs | none
    seconds: float = 0.0  # computing time, including photographs
    reason: str = ""  # why there is no result, or why a stage could not go on, one line
    fault: bool = False  # whether the reason is an error of the program, not of the survey

    @property
    def succeeded(self) -> bool:
        """Whether there is a dependable result."""
        return self.status == "done" and self.verdict != "bad"


def lock_of(out: Path, folder: str) -> Path:
    """Return the lock of a survey's folder, the same as for a single run into it."""
    return out / f".{folder}.lock"


def measure_one(survey: SurveyFile, image: str, path: Path, *, send: Send) -> MeasuredPhotograph:
    """Measure one photograph; if it cannot be read, the result states why."""
    begun = time.perf_counter()
    store = MeasuredStore.of_user()
    try:
        with when_compiling(lambda: send({"compiling": True})):
            counts, stored = measure_photograph_once(survey, image, path, store)
            note = PhotographNote(image, counts, stored=stored)
    except Exception as error:  # an unforeseen error recurs when the survey runs, and fails it there
        note = PhotographNote(image, failed=as_plain(error_in_words(error)))
    note = replace(note, seconds=round(time.perf_counter() - begun, 4))
    send({"photograph": image, "seconds": note.seconds, "stored": note.stored})
    return MeasuredPhotograph(note, store.held)


def reconstruct(
    job: SurveyJob, comparers: Comparers, photographs: list[MeasuredPhotograph], *, send: Send
) -> SurveyRow:
    """Run a survey with measured photographs, and write its result.

    Args:
        job: the survey to run.
        comparers: programs to compare it with.
        photographs: its measured photographs.
        send: receives the stages.

    Returns:
        The row of the survey, with a reason if there is no result or a stage could not go on.

    Raises:
        OutputError: the result or the log cannot be written.
    """
    begun = time.perf_counter()
    _refuse_ended(job)
    name = job.folder
    live = job.out / LOGS / f"{job.folder}.jsonl"
    with SurveyLog(live, watch=_Sending(send)) as log, when_compiling(lambda: send({"compiling": True})):
        log.start(name, job.file, inputs=job.inputs)
        for photograph in photographs:
            log.note("photograph", **photograph.note.entry())
        before = sum(photograph.note.seconds for photograph in photographs)
        held = {key: measured for photograph in photographs for key, measured in photograph.held.items()}
        try:
            survey = read_survey(job.file, allow_outside=job.allow_outside)
            name = survey.name
            row = _run(job, survey, comparers, held, log, lambda: before + time.perf_counter() - begun)
        except Exception as error:
            if isinstance(error, OutputError) and not isinstance(error, FolderInUseError):
                log.note("failed", reason=str(error))  # other surveys cannot be written either
                raise
            seconds = round(before + time.perf_counter() - begun, 3)
            row = SurveyRow(name, str(job.file), job.folder, "failed", seconds=seconds)
            return failed_row(log, error, row)
    remove_log(live)  # the result contains it
    return row


def failed_row(log: SurveyLog, error: Exception, row: SurveyRow) -> SurveyRow:
    """Return the row of a survey that an error ended, and write the error into its log.

    Raises:
        OutputError: the log cannot be written.
    """
    reason, fault = as_plain(error_in_words(error)), is_fault(error)
    trace = {"trace": traceback.format_exception(error)} if fault else {}
    log.note("failed", survey=row.survey, file=as_plain(row.file), reason=reason, **trace)
    if fault:
        reason += f"; its traceback is in {LOGS}/{row.folder}.jsonl"
    return replace(row, reason=reason, fault=fault)


def fingerprint(survey: SurveyFile, images: Path | None = None) -> str:
    """Return a SHA-256 of the input of a survey: tables by content, photographs by name, size and date.

    Args:
        survey: the survey file.
        images: folder that a person named for its photographs.

    Raises:
        KolinearError: photographs are missing.
        OSError: a file cannot be read.
    """
    digest = hashlib.sha256(survey.path.read_bytes())
    for table in survey.tables():
        if table.is_file():  # an unreadable table is reported by its reader; a pipe would never end
            with table.open("rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
    if reads_photographs(survey):
        photographs = find_photographs(survey, images_dir=images)
        for name, path in zip(photographs.names, photographs.paths, strict=True):
            status = path.stat() if path.exists() else path.lstat()  # a link that leads nowhere
            digest.update(f"{name}\0{status.st_size}\0{status.st_mtime_ns}\0".encode())
    return digest.hexdigest()


def finished_row(job: SurveyJob) -> SurveyRow | None:
    """Return the row of a result that this version wrote from the same inputs, or None."""
    try:
        entries = read_log(job.out / job.folder / LOG)
    except OSError:
        return None
    begun = {"event": "start", "inputs": job.inputs, "version": version("kolinear")}
    same = [entry for entry in entries if begun.items() <= entry.items()]
    results = [entry for entry in entries if entry.get("event") == "result"]
    if not same or not results:
        return None
    try:
        row = _row(job, results[-1], float(results[-1].get("seconds", 0.0)))
    except (TypeError, ValueError):
        return None
    # The values of a row from a file must be possible values of this program.
    numbers = (row.sigma0_px, row.rms_px, row.photographs, row.photographs_total, row.points, row.seconds)
    sound = (
        row.verdict in VERDICTS
        and all(isinstance(text, str) for text in (row.survey, row.comparison, row.reason))
        and all(n is None or (isinstance(n, int | float) and math.isfinite(n)) for n in numbers)
    )
    return row if sound else None


def _run(
    job: SurveyJob,
    survey: Survey,
    comparers: Comparers,
    held: dict[str, tuple[Measured, bool]],
    log: SurveyLog,
    seconds: Callable[[], float],
) -> SurveyRow:
    others = comparers.others_of(survey)
    store = replace(MeasuredStore.of_user(), held=held)
    ended: Findings | UnfinishedSurvey
    try:
        ended = findings_of(
            run_survey(survey, images_dir=job.images, others=others, store=store, progress=log)
        )
    except UnfinishedSurveyError as error:
        ended = error.reached
    log.stage("report")
    row: list[SurveyRow] = []

    def close_log(folder: Path) -> None:
        _refuse_ended(job)
        row.append(_row(job, result_entries(ended), round(seconds(), 3)))
        log.close_into(folder, ended, seconds=row[0].seconds)

    out = job.out / job.folder
    with locked(lock_of(job.out, job.folder), out):
        if isinstance(ended, UnfinishedSurvey):
            write_unfinished(ended, out, finish=close_log)
        else:
            write_result(
                ended,
                out,
                write_colmap=comparers.writer_of(ended.result),
                finish=close_log,
                budget_mb=job.pictures_mb,
            )
        note_finished(out)  # at once, in case the batch is killed now
    return row[0]


def _refuse_ended(job: SurveyJob) -> None:
    """Raise OutputError if the run that started a survey has ended.

    Workers of a cluster continue after their run was killed, and another run may own the folder by then.
    """
    if owner_of(job.out / LOCK) != job.owner:
        raise OutputError(f"{job.out}: the run that asked for survey {job.folder} is over")


def _row(job: SurveyJob, entries: dict[str, Any], seconds: float) -> SurveyRow:
    """Return the row of a survey from the last line of its log; raises TypeError if a value is missing."""
    names = {field.name for field in fields(SurveyRow)} - {"file", "folder", "status", "seconds", "fault"}
    known = {key: value for key, value in entries.items() if key in names}
    return SurveyRow(file=str(job.file), folder=job.folder, status="done", seconds=seconds, **known)


@dataclass
class _Sending(Silent):
    """Progress that only reports the beginning of stages to the batch, and the time of the one before."""

    send: Send
    begun: float = field(default_factory=time.perf_counter)

    def stage(self, name: str, total: int | None = None) -> None:
        before, self.begun = self.begun, time.perf_counter()
        self.send({"stage": name, "before": round(self.begun - before, 4)})


def note_finished(folder: Path) -> None:
    """Note that this user computed a result; if that fails, `--resume` computes it again."""
    with suppress(OSError, OutputError):
        entry = _entry(folder)
        make_user_folder(entry.parents[1])
        with whole_file(entry, replaces=True) as part:
            part.touch()


def was_finished(folder: Path) -> bool:
    """Return whether a result was noted, with the same manifest as now.

    Raises:
        OutputError: other users can write into the folder of the notes.
    """
    try:
        os.utime(_entry(folder))  # marks the note as used now
    except OSError:
        return False
    return True


def remove_old_notes() -> None:
    """Remove notes not used for months.

    Raises:
        OutputError: other users can write into the folder of the notes.
    """
    remove_unused(_notes())


def _notes() -> Path:
    return user_folder("finished", "notes on finished results")


def _entry(folder: Path) -> Path:
    """Return the file that notes the present state of a result."""
    key = hashlib.sha256(os.fsencode(f"{folder.absolute()}\0{sha256_of(folder / MANIFEST)}")).hexdigest()
    return _notes() / key[:2] / key
