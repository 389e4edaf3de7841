"""One survey of a batch, as a worker runs it, and which results `--resume` may keep.

A result that lies in the folder of a batch may have come with the survey, with a log and a manifest that fit.
So whoever finishes a result notes it in the user's cache folder, by its path and the hash of its manifest,
which has the hashes of its files.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sfm.errors import FolderInUseError, OutputError
from sfm.files.open_folders import MANIFEST, Owner, locked, owner_of, sha256_of
from sfm.files.plain_text import as_plain
from sfm.files.user_cache import make_user_folder, remove_unused, user_folder
from sfm.files.whole_files import whole_file
from sfm.kernels.compiling import when_compiling
from sfm.pipeline import run_survey
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.output import LOG, SurveyLog, read_log, remove_log, result_entries, write_result
from sfm.report.viewer.pictures import BUDGET_MB
from sfm.result import SurveyResult
from sfm.runtime.executor import Send
from sfm.runtime.faults import error_in_words, is_fault
from sfm.runtime.progress import Silent
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.survey import Survey, read_survey, survey_family
from sfm.survey.inputs.survey_file import SurveyFile
from sfm.survey.measuring.measured_store import Measured, MeasuredStore
from sfm.survey.measuring.targets import measure_photograph
from sfm.survey.measuring.tie_points import natural_points_of

LOCK = ".lock"  # of the batch
VERDICTS = ("good", "fair", "bad")
LOGS = "logs"  # folder of the logs of surveys that have no result


@dataclass(frozen=True)
class SurveyJob:
    """Input of a worker that runs a survey."""

    file: Path  # the survey file
    out: Path  # folder of the batch
    folder: str  # name of the survey's folder in it
    inputs: str  # fingerprint of everything that the survey reads
    allow_outside: bool  # whether the survey file may name files outside its folder
    owner: Owner | None  # of the folder of the batch, who asked for this
    pictures_mb: float = BUDGET_MB  # what the pictures inside a report may take, 10^6 bytes


@dataclass(frozen=True)
class Comparers:
    """Programs that surveys are compared with: functions of a module, so that they travel to workers."""

    others_of: Callable[[Survey], OtherPrograms]  # those that a survey asks for
    writer_of: Callable[[SurveyResult], Callable[[Path], None] | None]  # writes its model


@dataclass(frozen=True)
class PhotographNote:
    """Outcome of a photograph, for the log."""

    image: str
    targets: int = 0
    rejected: int = 0  # candidates
    features: int = 0  # of natural texture
    stored: bool = False  # measured in an earlier run
    seconds: float = 0.0
    failed: str = ""  # why it could not be read


@dataclass(frozen=True)
class MeasuredPhotograph:
    """A photograph as the worker that measured it hands it to the one that goes on."""

    note: PhotographNote
    held: dict[str, tuple[Measured, bool]]  # as of a MeasuredStore; computers may have no common one


@dataclass(frozen=True)
class SurveyRow:
    """A survey in the tables of a batch; None where there is no result."""

    survey: str  # its name
    file: str  # survey file
    folder: str  # folder of the result or of the log
    status: str  # done | failed | set aside
    verdict: str = ""  # good | fair | bad
    sigma0_px: float | None = None
    rms_px: float | None = None
    photographs: int | None = None  # oriented
    photographs_total: int | None = None
    points: int | None = None
    comparison: str = ""  # agrees | differs | none
    seconds: float = 0.0  # of computing, photographs included
    reason: str = ""  # why there is no result, one line
    fault: bool = False  # whether that is an error of the program, not of the survey

    @property
    def succeeded(self) -> bool:
        """Whether there is a result that can be depended on."""
        return self.status == "done" and self.verdict != "bad"


def lock_of(out: Path, folder: str) -> Path:
    """Return the lock of a survey's folder, the same as that of a single run into it."""
    return out / f".{folder}.lock"


def measure_one(
    job: SurveyJob, survey: SurveyFile, image: str, path: Path, *, send: Send
) -> MeasuredPhotograph:
    """Measure one photograph; why it cannot be read is part of what is returned."""
    begun = time.perf_counter()
    store = MeasuredStore.of_user()
    try:
        with when_compiling(lambda: send({"compiling": True})):
            note = _measure(survey, image, path, store)
    except Exception as error:  # an unforeseen one fails the survey, which comes upon it again
        note = PhotographNote(image, failed=as_plain(error_in_words(error)))
    send({"photograph": image})
    return MeasuredPhotograph(replace(note, seconds=round(time.perf_counter() - begun, 4)), store.held)


def _measure(survey: SurveyFile, image: str, path: Path, store: MeasuredStore) -> PhotographNote:
    """Measure what a survey asks for in a photograph, and keep it in the store."""
    if survey.tie_points is not None:
        natural, stored = natural_points_of(path, survey.tie_points, store)
        return PhotographNote(image, features=len(natural), stored=stored)
    family = survey_family(survey.targets, survey.codes)
    targets, stored = measure_photograph(path, survey.targets, family, store)
    return PhotographNote(image, len(targets), len(targets.rejected_xy), stored=stored)


def reconstruct(
    job: SurveyJob, comparers: Comparers, photographs: list[MeasuredPhotograph], *, send: Send
) -> SurveyRow:
    """Run a survey whose photographs are measured, and write its result.

    Args:
        job: the survey.
        comparers: what to compare it with.
        photographs: what came of its photographs.
        send: receives the stages.

    Returns:
        Its row, with a reason if there is no result.

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
            log.note("photograph", **asdict(photograph.note))
        before = sum(photograph.note.seconds for photograph in photographs)
        held = {key: found for photograph in photographs for key, found in photograph.held.items()}
        try:
            survey = read_survey(job.file, allow_outside=job.allow_outside)
            name = survey.name
            row = _run(job, survey, comparers, held, log, lambda: before + time.perf_counter() - begun)
        except Exception as error:
            if isinstance(error, OutputError) and not isinstance(error, FolderInUseError):
                log.note("failed", reason=str(error))  # others will not be written, either
                raise
            seconds = round(before + time.perf_counter() - begun, 3)
            row = SurveyRow(name, str(job.file), job.folder, "failed", seconds=seconds)
            return failed_row(log, error, row)
    remove_log(live)  # the result has it
    return row


def failed_row(log: SurveyLog, error: Exception, row: SurveyRow) -> SurveyRow:
    """Return the row of a survey that an error has ended, and write the error into its log.

    Raises:
        OutputError: the log cannot be written.
    """
    reason, fault = as_plain(error_in_words(error)), is_fault(error)
    trace = {"trace": traceback.format_exception(error)} if fault else {}
    log.note("failed", survey=row.survey, file=as_plain(row.file), reason=reason, **trace)
    if fault:
        reason += f"; its traceback is in {LOGS}/{row.folder}.jsonl"
    return replace(row, reason=reason, fault=fault)


def fingerprint(survey: SurveyFile) -> str:
    """Return a SHA-256 of what a survey reads: tables by content, photographs by name, size and date.

    Raises:
        KolinearError: photographs are missing.
        OSError: a file cannot be read.
    """
    digest = hashlib.sha256(survey.path.read_bytes())
    for table in survey.tables():
        if table.is_file():  # its reader reports what cannot be read; a pipe would never end
            with table.open("rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
    if survey.observations is None:
        found = find_photographs(survey)
        for name, path in zip(found.names, found.paths, strict=True):
            status = path.stat() if path.exists() else path.lstat()  # a link that leads nowhere
            digest.update(f"{name}\0{status.st_size}\0{status.st_mtime_ns}\0".encode())
    return digest.hexdigest()


def finished_row(job: SurveyJob) -> SurveyRow | None:
    """Return the row of a result that this version has written from the same inputs, None without one."""
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
    return row if _is_sound(row) else None


def _is_sound(row: SurveyRow) -> bool:
    """Whether the values of a row that was read are such as this program writes."""
    numbers = (row.sigma0_px, row.rms_px, row.photographs, row.photographs_total, row.points, row.seconds)
    return (
        row.verdict in VERDICTS
        and all(isinstance(text, str) for text in (row.survey, row.comparison, row.reason))
        and all(n is None or (isinstance(n, int | float) and math.isfinite(n)) for n in numbers)
    )


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
    result = run_survey(survey, others=others, store=store, progress=log)
    log.stage("report")
    findings = findings_of(result)
    row: list[SurveyRow] = []

    def close_log(folder: Path) -> None:
        _refuse_ended(job)
        row.append(_row(job, result_entries(findings), round(seconds(), 3)))
        log.close_into(folder, findings, seconds=row[0].seconds)

    with locked(lock_of(job.out, job.folder), job.out / job.folder):
        write_result(
            findings,
            job.out / job.folder,
            write_colmap=comparers.writer_of(result),
            finish=close_log,
            budget_mb=job.pictures_mb,
        )
        note_finished(job.out / job.folder)  # at once, in case the batch is killed now
    return row[0]


def _refuse_ended(job: SurveyJob) -> None:
    """Raise OutputError where the run that asked for a survey is over.

    Workers of a cluster work on when it was killed, and another run may have the folder by now.
    """
    if owner_of(job.out / LOCK) != job.owner:
        raise OutputError(f"{job.out}: the run that asked for survey {job.folder} is over")


def _row(job: SurveyJob, entries: dict[str, Any], seconds: float) -> SurveyRow:
    """Return the row of a survey from the last line of its log; TypeError if that is something else."""
    names = {field.name for field in fields(SurveyRow)} - {"file", "folder", "status", "seconds", "fault"}
    known = {key: value for key, value in entries.items() if key in names}
    return SurveyRow(file=str(job.file), folder=job.folder, status="done", seconds=seconds, **known)


@dataclass(frozen=True)
class _Sending(Silent):
    """Progress that reports to the watched batch which stage begins, and nothing else."""

    send: Send

    def stage(self, name: str, total: int | None = None) -> None:
        self.send({"stage": name})


def note_finished(folder: Path) -> None:
    """Note that a result is by this user; where there is no room it is computed again at `--resume`."""
    with suppress(OSError, OutputError):
        entry = _entry(folder)
        make_user_folder(entry.parents[1])
        with whole_file(entry, replaces=True) as part:
            part.touch()


def was_finished(folder: Path) -> bool:
    """Whether a result was noted, and has the same manifest as then.

    Raises:
        OutputError: others can write where results are noted.
    """
    try:
        os.utime(_entry(folder))  # asked for now
    except OSError:
        return False
    return True


def remove_old_notes() -> None:
    """Remove notes not asked for in months.

    Raises:
        OutputError: others can write where results are noted.
    """
    remove_unused(_notes())


def _notes() -> Path:
    return user_folder("finished", "notes on finished results")


def _entry(folder: Path) -> Path:
    """Return the file that notes a result as it is now."""
    key = hashlib.sha256(os.fsencode(f"{folder.absolute()}\0{sha256_of(folder / MANIFEST)}")).hexdigest()
    return _notes() / key[:2] / key
