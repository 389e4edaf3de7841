"""Commands about surveys: run, adjust and batch."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.starting import loading
from sfm.errors import KolinearError
from sfm.faults import FAULT, working_on

if TYPE_CHECKING:
    from sfm.result import SurveyResult
    from sfm.survey.comparison import OtherPrograms
    from sfm.survey.inputs.survey_file import Survey

FAILED = 1  # exit code where a survey, or one of a batch, has no dependable result

SurveyFile = Annotated[
    Path, typer.Argument(metavar="SURVEY.toml", help="The survey file; its paths are relative to it.")
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="DIR",
        help="Folder of the result, written whole or not at all; an earlier result is replaced.  "
        "[default: out/NAME OF THE SURVEY]",
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option("--jobs", metavar="N", min=1, help="Photographs worked on at a time.  [default: all cores]"),
]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Tell more: every photograph and warning.")]
AllowOutside = Annotated[
    bool,
    typer.Option(
        "--allow-outside",
        help="Let the survey file name files outside its own folder; only for survey files that you trust.",
    ),
]


def run(
    survey_file: SurveyFile,
    images: Annotated[
        Path | None,
        typer.Option(
            "--images", metavar="DIR", help="Folder of the photographs, in place of that of the survey file."
        ),
    ] = None,
    out: Out = None,
    jobs: Jobs = None,
    allow_outside: AllowOutside = False,
    verbose: Verbose = False,
) -> None:
    """Run a survey from its photographs to the report.

    Exit code 0 with a result, remarks or none; 1 if the result cannot be depended on, the report says
    why; 2 where a person must put something right.
    """
    begun = time.perf_counter()
    with loading():
        from sfm.cli.console import drawn_progress, tell_result
        from sfm.pipeline import run_survey
        from sfm.report.findings.findings import findings_of
        from sfm.report.log import SurveyLog
        from sfm.report.output import write_result
        from sfm.survey.inputs.survey_file import read_survey
        from sfm.survey.target_store import TargetStore

    with working_on(str(survey_file)):
        survey = read_survey(survey_file, allow_outside=allow_outside)
    if survey.observations is not None:
        raise KolinearError(
            f"{survey_file}: it has [observations] in place of photographs: kolinear adjust {survey_file}"
        )
    others = _others(survey)
    folder = _folder(survey, out)
    workers = jobs or _cores()
    store = TargetStore.of_user()
    store.remove_old()
    with drawn_progress() as drawn, _threads(), _written(folder), SurveyLog(watch=drawn) as log:
        log.start(survey.name, survey_file)
        result = run_survey(survey, images_dir=images, jobs=workers, others=others, store=store, progress=log)
        findings = findings_of(result)
        page = write_result(
            findings,
            folder,
            write_colmap=_colmap_writer(result),
            finish=lambda part: log.close_into(part, findings),
            jobs=workers,
            progress=log,
        )
    if not tell_result(findings, page, seconds=time.perf_counter() - begun, verbose=verbose):
        raise SystemExit(FAILED)


def adjust(
    survey_file: SurveyFile, out: Out = None, allow_outside: AllowOutside = False, verbose: Verbose = False
) -> None:
    """Run a survey from measured image points to the report.

    They are those of [observations] in the survey file, in place of photographs.  Exit code 0 with a
    result, remarks or none; 1 if the result cannot be depended on, the report says why; 2 where a person
    must put something right.
    """
    begun = time.perf_counter()
    with loading():
        from sfm.cli.console import drawn_progress, tell_result
        from sfm.pipeline import adjust_survey
        from sfm.report.findings.findings import findings_of
        from sfm.report.log import SurveyLog
        from sfm.report.output import write_result
        from sfm.survey.inputs.survey_file import read_survey

    with working_on(str(survey_file)):
        survey = read_survey(survey_file, allow_outside=allow_outside)
    if survey.observations is None:
        raise KolinearError(
            f"{survey_file}: it has no [observations]; with photographs: kolinear run {survey_file}"
        )
    others = _others(survey)
    folder = _folder(survey, out)
    with drawn_progress() as drawn, _threads(), _written(folder), SurveyLog(watch=drawn) as log:
        log.start(survey.name, survey_file)
        result = adjust_survey(survey, others=others, progress=log)
        findings = findings_of(result)
        page = write_result(
            findings,
            folder,
            write_colmap=_colmap_writer(result),
            finish=lambda part: log.close_into(part, findings),
            progress=log,
        )
    if not tell_result(findings, page, seconds=time.perf_counter() - begun, verbose=verbose):
        raise SystemExit(FAILED)


def batch(
    surveys: Annotated[
        list[str],
        typer.Argument(
            metavar="SURVEYS...",
            help="Survey files; folders (every survey.toml in and below, else the *.toml in them); globs.",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder of the batch, with a folder per survey.")
    ] = Path("out/batch"),
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            metavar="N",
            min=1,
            help="Worker processes.  [default: as many as there are cores and 1.5 GiB of memory]",
        ),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            "--cluster",
            metavar="ADDRESS",
            help="A Dask scheduler, such as tcp://192.168.1.5:8786, in place of processes on this computer; "
            "its workers need Kolinear and see the same folders.",
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep what an earlier run finished, if its inputs are the same.")
    ] = False,
    allow_outside: AllowOutside = False,
    verbose: Verbose = False,
) -> None:
    """Run many surveys side by side, each to its own report.

    One table tells them all.  Exit code 0 if every survey has a dependable result, else 1; 70 if one came
    upon a fault of the program; 2 where a person must put something right.
    """
    if cluster is not None and jobs is not None:
        raise KolinearError("--jobs is for processes on this computer, --cluster brings its own workers")
    with loading():
        from rich.console import Console

        from adapters.dask_cluster import fitting_workers, local_engine, remote_engine
        from sfm.batch.run import calls_of, find_surveys, run_batch
        from sfm.batch.survey import Comparers
        from sfm.batch.table import BatchTable, print_batch, stopping_at_terminate

    files = find_surveys(surveys)
    if cluster is not None:
        engine = remote_engine(cluster)
    else:
        busy = calls_of(files, allow_outside=allow_outside)  # more would wait for nothing
        engine = local_engine(min(jobs or fitting_workers(), busy))
    with stopping_at_terminate(), BatchTable(Console(stderr=True), verbose=verbose) as table:
        rows = run_batch(
            files,
            out,
            engine,
            Comparers(_others_of_worker, _colmap_writer),
            table,
            resume=resume,
            allow_outside=allow_outside,
        )
    print_batch(Console(highlight=False), rows, out / "index.html")
    if any(row.fault for row in rows):
        raise SystemExit(FAULT)
    if not all(row.succeeded for row in rows):
        raise SystemExit(FAILED)


def _others(survey: Survey, *, threads: int = -1) -> OtherPrograms:
    """Return the programs that the survey wants to be compared with; their library is imported only then."""
    from sfm.survey.comparison import OtherPrograms

    others = OtherPrograms()
    if survey.compare.backend == "colmap":
        from adapters.colmap.covariance import adjust_with_covariance

        others = replace(others, adjuster=adjust_with_covariance)
    if survey.compare.baseline == "mapper":
        from adapters.colmap.mapper import map_photographs

        others = replace(others, mapper=partial(map_photographs, threads=threads))
    return others


def _others_of_worker(survey: Survey) -> OtherPrograms:
    """Return the same for a worker of a batch, one of as many as there are cores."""
    return _others(survey, threads=1)


def _colmap_writer(result: SurveyResult) -> Callable[[Path], None] | None:
    """Return what writes the result in COLMAP's model, the solution that was compared; None without one."""
    both = result.comparison
    if both is None:
        return None
    from adapters.colmap.camera_models import write_model

    return lambda folder: write_model(folder, both.network, both.adjustment.estimate)


def _folder(survey: Survey, out: Path | None) -> Path:
    """Return the folder of the result, before any work is done for one that cannot be used."""
    from sfm.files.whole_files import refuse_foreign_folder
    from sfm.report.output import folder_name

    out = Path("out") / folder_name(survey.name) if out is None else out
    refuse_foreign_folder(out)
    return out


def _cores() -> int:
    """Return how many processor cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _written(folder: Path) -> Iterator[None]:
    """Keep other runs from writing the same folder, and clear away what killed ones have left there."""
    from sfm.files.folder_lock import locked
    from sfm.files.whole_files import remove_leftovers

    with locked(folder.parent / f".{folder.name}.lock", folder):
        remove_leftovers(folder)
        yield


@contextmanager
def _threads() -> Iterator[None]:
    """Hold BLAS to one thread: photographs are worked on side by side, and two BLAS pools in turn fight."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
