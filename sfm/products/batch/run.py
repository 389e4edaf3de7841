"""Batch of surveys, run by an engine in other processes, which can be resumed after any interruption.

A survey's folder appears complete or not at all, and contains the fingerprint of its input. The folders alone
therefore show which surveys are finished, however an earlier run ended.
"""

from __future__ import annotations

import glob
import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

from sfm.files.globs import BELOW, find_files
from sfm.files.open_folders import MANIFEST, locked, owner_of, refuse_foreign_folder
from sfm.files.plain_text import as_plain
from sfm.files.whole_files import remove_leftovers
from sfm.model.errors import BackendError, FolderInUseError, SurveyFileError
from sfm.photographs.video_files import is_video
from sfm.products.batch.job import (
    LOCK,
    LOGS,
    Comparers,
    SurveyJob,
    SurveyRow,
    failed_row,
    fingerprint,
    finished_row,
    lock_of,
    measure_one,
    note_finished,
    reconstruct,
    remove_old_notes,
    was_finished,
)
from sfm.products.batch.table import PAGES, refuse_foreign_pages, write_batch_pages
from sfm.products.drafting.draft import has_photographs
from sfm.products.drafting.frames_folder import videos_of
from sfm.report.output import SurveyLog, folder_name, refuse_other_log, remove_log
from sfm.report.viewer.pictures import BUDGET_MB
from sfm.runtime.executor import Call, Done, Engine, Lost, Sent, Work, WorkerLost
from sfm.runtime.forecast import Forecast, RunHistory, forecast
from sfm.runtime.forecast import Work as Extent
from sfm.runtime.memory import limit_bytes
from sfm.survey.inputs.measurements import NO_PHOTOGRAPHS, find_photographs, masks_of, work_of
from sfm.survey.inputs.named_folders import named_folder
from sfm.survey.inputs.sources import reads_photographs
from sfm.survey.inputs.start import refuse_unknown_photographs
from sfm.survey.inputs.survey import read_survey, survey_of_file
from sfm.survey.inputs.survey_file import SurveyFile, read_survey_file
from sfm.survey.measuring.measured_store import MeasuredStore

SURVEY_NAME = "survey.toml"  # searched for in folders
MEMORY_REMEDY = "run fewer --jobs, use workers with more memory, or take fewer photographs or smaller ones"
NONE: Mapping[Path, Exception] = MappingProxyType({})


class Watch(Protocol):
    """Observer of a running batch."""

    def planned(self, works: Mapping[str, Extent | None], workers: int) -> None:
        """Receive what the time of each survey depends on, by the names of their folders.

        The number of workers is that of the calls that run at a time.
        """

    def received(self, name: str, message: dict[str, Any]) -> None:
        """Receive a message of a survey.

        The survey has {"photographs": count}, begins {"stage": name, "before": s of the one before}, or has
        measured {"photograph": name, "seconds": s, "stored": whether an earlier run did}. With
        {"compiling": True} its worker compiles kernels first.
        """

    def finished(self, name: str, row: SurveyRow, *, kept: bool) -> None:
        """Receive the end of a survey; `kept` if an earlier run finished it."""

    def remark(self, text: str) -> None:
        """Receive a remark for people."""


@dataclass(frozen=True)
class _Plan:
    """A survey of the batch before it runs."""

    file: Path
    folder: str
    survey: SurveyFile | Exception  # or why its file cannot be read


def run_batch(
    files: Sequence[Path],
    out: Path,
    engine: AbstractContextManager[Engine],
    comparers: Comparers,
    watch: Watch,
    *,
    resume: bool = False,
    allow_outside: bool = False,
    pictures_mb: float = BUDGET_MB,
    without_draft: Mapping[Path, Exception] = NONE,
) -> tuple[SurveyRow, ...]:
    """Run surveys and write batch.csv, batch.json and index.html beside their results.

    Args:
        files: survey files.
        out: folder of the batch; every survey gets a folder in it.
        engine: runs the work; it is entered here, so that leftovers of workers are removed after they ended.
        comparers: programs to compare the surveys with.
        watch: receives the events.
        resume: whether results that an earlier run finished from the same inputs are kept; else every survey
            is run, and only measurements in photographs are taken from an earlier run.
        allow_outside: whether survey files may name files outside their folders.
        pictures_mb: largest size of the pictures inside a report, 10^6 bytes; the others are files beside it.
        without_draft: why no survey file could be drafted, by the folders of photographs among the files.

    Returns:
        One row per survey in the order of the files.

    Raises:
        OutputError: the folder cannot be written, or another run is writing into it.
        BackendError: no worker is left.
    """
    refuse_foreign_pages(Path(out))
    out = Path(os.path.abspath(out))  # it contains no links
    plans = _plan(files, without_draft, allow_outside=allow_outside)
    for plan in plans:
        refuse_other_log(out / LOGS / f"{plan.folder}.jsonl")
    MeasuredStore.of_user().remove_old()
    remove_old_notes()
    with _no_empty_folders(out), locked(out / LOCK, out) as before:
        if before is not None:
            watch.remark(f"an earlier run was cut off ({before}); what it had finished is safe")
        _remove_half_written(out, plans)
        try:
            with engine as running:
                extents = {plan.folder: _extent_of(plan) for plan in plans}
                watch.planned(extents, running.workers)
                rows = _run(
                    plans,
                    out,
                    running,
                    comparers,
                    watch,
                    expected=_forecasts(extents),
                    call_bytes=running.call_bytes,
                    resume=resume,
                    allow_outside=allow_outside,
                    pictures_mb=pictures_mb,
                )
        finally:
            _remove_half_written(out, plans)
        ordered = tuple(rows[plan.folder] for plan in plans)
        write_batch_pages(ordered, out)
    return ordered


@contextmanager
def _no_empty_folders(out: Path) -> Iterator[None]:
    """Remove folders made for a batch that produced nothing."""
    missing = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        yield
    finally:
        for folder in (out / LOGS, *missing):
            with suppress(OSError):  # it is in use
                folder.rmdir()


def find_surveys(names: Sequence[str], draft: Callable[[Path], Path] | None = None) -> tuple[Path, ...]:
    """Return the survey files for the names on the command line, each once.

    Args:
        names: files, folders or globs. A folder stands for every survey.toml in and below it, or if there is
            none, for the *.toml files in it, or for its photographs. Globs are for shells that do not expand
            them.
        draft: returns the survey file of a folder of photographs; None if folders need one.

    Raises:
        SurveyFileError: a name matches nothing.
    """
    files: dict[Path, None] = {}
    for name in names:
        if not name:  # such as an unset variable of the shell; for Path it means the current folder
            raise SurveyFileError("an empty name stands for no survey")
        path = Path(name)
        if path.exists() or not glob.has_magic(name):
            files.update(dict.fromkeys(_survey_files_in(path, draft)))
            continue
        matches = _matches(path)
        for match in matches:
            files.update(dict.fromkeys(_survey_files_in(match, draft)))
    return tuple(files)


def _matches(path: Path) -> list[Path]:
    """Return the matches of a glob on the command line; with `**`, links out of its folder are refused."""
    first = next(k for k, part in enumerate(path.parts) if glob.has_magic(part))
    folder, pattern = Path(*path.parts[:first]), Path(*path.parts[first:])

    def refuse_leaving(link: Path) -> None:
        if BELOW in pattern.parts and not link.resolve().is_relative_to(folder.resolve()):
            raise SurveyFileError(f"{path}: {link} leads out of {folder}, which is not searched with {BELOW}")

    try:
        paths = find_files(folder, str(pattern), enter=refuse_leaving, folders=True, hidden=False)
    except ValueError as error:
        raise SurveyFileError(f"{path}: {BELOW} stands for whole folders only") from error
    if not paths:
        raise SurveyFileError(f"{path}: no file matches")
    return paths


def calls_of(files: Sequence[Path], *, allow_outside: bool = False) -> int:
    """Return how many workers can be busy at a time: one per photograph or survey without any, at least 1.

    Args:
        files: survey files.
        allow_outside: whether survey files may name files outside their folders.
    """
    calls = 0
    for file in files:
        with suppress(Exception):  # the run reports errors
            survey = read_survey_file(file, allow_outside=allow_outside)
            images = named_folder(survey)
            calls += len(find_photographs(survey, images_dir=images)) if reads_photographs(survey) else 1
    return max(1, calls)


def _survey_files_in(path: Path, draft: Callable[[Path], Path] | None) -> list[Path]:
    """Return the survey files of a folder or the one drafted for its photographs, or a file itself."""
    if not path.is_dir():
        return [draft(path).resolve() if draft is not None and is_video(path) else path.resolve()]
    below = find_files(path, f"**/{SURVEY_NAME}") or find_files(path, "*.toml")
    if not below and draft is not None and (has_photographs(path) or videos_of(path)):
        below = [draft(path)]
    if not below:
        raise SurveyFileError(
            f"{path}: no {SURVEY_NAME} in or below this folder, nor any *.toml in it, nor photographs "
            "or videos"
        )
    return [file.resolve() for file in below]


def _plan(
    files: Sequence[Path], without_draft: Mapping[Path, Exception], *, allow_outside: bool
) -> tuple[_Plan, ...]:
    """Read all survey files and give each a separate folder."""
    read: list[tuple[Path, SurveyFile | Exception]] = []
    for file in files:
        if file in without_draft:
            read.append((file, without_draft[file]))
            continue
        try:
            read.append((file, read_survey_file(file, allow_outside=allow_outside)))
        except Exception as error:  # an unforeseen error only fails this survey
            read.append((file, error))
    names = []
    for file, survey in read:
        name = file.parent.name if file.name == SURVEY_NAME else file.stem
        names.append(folder_name(survey.name if isinstance(survey, SurveyFile) else name))
    often = Counter(name.casefold() for name in names)
    plans = []
    for (file, survey), name in zip(read, names, strict=True):
        reserved = name.casefold() in (LOGS, MANIFEST, *PAGES)
        if often[name.casefold()] > 1 or reserved:  # a suffix that is the same in every run
            name = f"{name}-{hashlib.sha256(str(file).encode()).hexdigest()[:8]}"
        plans.append(_Plan(file, name, survey))
    return tuple(plans)


def _run(
    plans: Sequence[_Plan],
    out: Path,
    engine: Engine,
    comparers: Comparers,
    watch: Watch,
    *,
    expected: Mapping[str, Forecast],
    call_bytes: float,
    resume: bool,
    allow_outside: bool,
    pictures_mb: float,
) -> dict[str, SurveyRow]:
    """Run the unfinished surveys; those with workers that died run again, alone, to find the one at fault."""
    rows: dict[str, SurveyRow] = {}
    works: dict[str, Work] = {}

    def finish(name: str, row: SurveyRow, *, kept: bool = False) -> None:
        if row.status == "done" and not kept:
            note_finished(out / name)  # also here: workers on other computers have another cache folder
        rows[name] = row
        works.pop(name, None)
        watch.finished(name, row, kept=kept)

    def begin() -> Iterator[Work]:
        for plan in plans:
            try:
                if isinstance(plan.survey, Exception):
                    raise plan.survey
                refuse_foreign_folder(out / plan.folder)
                images = named_folder(plan.survey)
                job = SurveyJob(
                    plan.file,
                    out,
                    plan.folder,
                    fingerprint(plan.survey, images),
                    allow_outside,
                    owner_of(out / LOCK),
                    images,
                    pictures_mb,
                )
                earlier = finished_row(job) if resume else None
                if earlier is not None and not was_finished(out / plan.folder):
                    watch.remark(
                        f"{out / plan.folder}: no run of yours is known to have finished this result, it is "
                        "computed again"
                    )
                    earlier = None
                if earlier is None:
                    if plan.folder in expected:
                        expected[plan.folder].refuse(there_bytes=call_bytes, remedy=MEMORY_REMEDY)
                    works[plan.folder] = _work(job, plan.survey, comparers)
            except Exception as error:
                finish(plan.folder, _row_without_result(plan, out, "failed", error))
                continue
            if earlier is not None:  # a run killed at the last moment may have left its log
                remove_log(out / LOGS / f"{plan.folder}.jsonl")
                finish(plan.folder, earlier, kept=True)
                continue
            work = works[plan.folder]
            watch.received(plan.folder, {"photographs": len(work.parts)})
            yield work

    def lost(works: Iterable[Work], at_a_time: int) -> Iterator[Lost]:
        for event in engine.run(works, at_a_time=at_a_time):
            if isinstance(event, Sent):
                watch.received(event.key, event.message)
            elif isinstance(event, Done):
                finish(event.key, event.value)
            elif isinstance(event, WorkerLost):
                watch.remark(f"worker {event.worker} was lost; the others do its work again")
            else:
                yield event

    suspects = []
    for event in lost(begin(), engine.workers + 1):
        watch.received(event.key, {"stage": "waiting for a second try, alone"})
        suspects.append(event.key)
    by_name = {plan.folder: plan for plan in plans}
    for suspect in suspects:
        for event in lost([works[suspect]], 1):
            died = BackendError(f"set aside: {event.reason}, alone as well as beside others")
            row = _row_without_result(by_name[event.key], out, "set aside", died)
            finish(event.key, replace(row, fault=True))
    return rows


def _extent_of(plan: _Plan) -> Extent | None:
    """Return what the time of a survey depends on; None where it cannot run."""
    if isinstance(plan.survey, Exception):
        return None
    try:
        survey, files = survey_of_file(plan.survey), NO_PHOTOGRAPHS
        if reads_photographs(plan.survey):
            files = find_photographs(survey, images_dir=named_folder(plan.survey))
        return work_of(survey, files)
    except Exception:  # its run states the reason
        return None


def _forecasts(extents: Mapping[str, Extent | None]) -> dict[str, Forecast]:
    """Return the expected time and memory of surveys, by the names of their folders."""
    runs = RunHistory.of_user().read()
    return {name: forecast(extent, runs) for name, extent in extents.items() if extent is not None}


def memory_of(files: Sequence[Path], *, allow_outside: bool = False) -> float:
    """Return the expected memory of the largest survey that may fit this computer, bytes; 0 without any.

    Args:
        files: survey files.
        allow_outside: whether survey files may name files outside their folders.
    """
    plans = _plan(files, NONE, allow_outside=allow_outside)
    expected = _forecasts({plan.folder: _extent_of(plan) for plan in plans}).values()
    fitting = [each.memory_mb * 1e6 for each in expected if each.least_memory_mb * 1e6 <= limit_bytes()]
    return max(fitting, default=0.0)


def _work(job: SurveyJob, survey: SurveyFile, comparers: Comparers) -> Work:
    """Return a survey as work for the engine: a part for each photograph, and the whole."""
    parts: tuple[Call, ...] = ()
    if reads_photographs(survey):
        given = read_survey(job.file, allow_outside=job.allow_outside)
        photographs = find_photographs(survey, images_dir=job.images)
        survey = survey.with_masks(masks_of(survey, images_dir=job.images).folder)
        refuse_unknown_photographs(given, photographs.names)  # before the photographs are measured
        parts = tuple(
            Call(measure_one, (survey, name, path))
            for name, path in zip(photographs.names, photographs.paths, strict=True)
        )
    return Work(job.folder, parts, Call(reconstruct, (job, comparers)))


def _row_without_result(plan: _Plan, out: Path, status: str, error: Exception) -> SurveyRow:
    """Return the row of a survey that no worker finished, and write its log."""
    name = plan.survey.name if isinstance(plan.survey, SurveyFile) else plan.folder
    with SurveyLog(out / LOGS / f"{plan.folder}.jsonl", append=True) as log:
        return failed_row(log, error, SurveyRow(name, as_plain(str(plan.file)), plan.folder, status))


def _remove_half_written(out: Path, plans: Sequence[_Plan]) -> None:
    """Remove half-written files of killed workers, but not files that others write beside this batch."""
    for plan in plans:
        if any(out.glob(f".{glob.escape(plan.folder)}.*")):
            with suppress(FolderInUseError), locked(lock_of(out, plan.folder)):
                remove_leftovers(out / plan.folder)
    for page in (MANIFEST, *PAGES):
        remove_leftovers(out / page)
