"""The command `batch`, which runs many surveys, and the choice of the engine that does the work.

The engine is Dask, with worker processes on this computer or on a cluster. Where Dask is not installed,
`InProcess` runs the surveys one after the other in this process.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from threadpoolctl import threadpool_limits

from sfm.cli.options import AllowOutside, Pdf, PicturesMb, Verbose
from sfm.cli.process import FAILED, compile_first, loading
from sfm.cli.survey_runs import drafted_beside
from sfm.model.errors import (
    INSTALL_DASK,
    GeometryError,
    KolinearError,
    MissingLibraryError,
    PhotographError,
    SurveyFileError,
    one_line,
)
from sfm.runtime.executor import Call, Done, Engine, Event, Lost, Sent, Work
from sfm.runtime.faults import FAULT
from sfm.runtime.memory import within_bytes

if TYPE_CHECKING:
    from sfm.survey.assembly import OtherPrograms
    from sfm.survey.inputs.survey import Survey


def batch(
    surveys: Annotated[
        list[str],
        typer.Argument(
            metavar="SURVEYS...",
            help="Survey files, glob patterns, or folders (every survey.toml in or below the folder; "
            "without any, the *.toml files in it, or a survey file that is drafted for its photographs).",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder of the batch, with one folder per survey.")
    ] = Path("out/batch"),
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            metavar="N",
            min=1,
            help="Number of worker processes.  [default: one per core and 1.5 GiB of memory, "
            "or what the largest survey needs]",
        ),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            "--cluster",
            metavar="ADDRESS",
            help="Dask scheduler, such as tcp://192.168.1.5:8786, used instead of processes on this "
            "computer. Its workers need Kolinear and access to the same folders.",
        ),
    ] = None,
    pictures_mb: PicturesMb = 15.0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep finished results of an earlier run with the same inputs.")
    ] = False,
    allow_outside: AllowOutside = False,
    verbose: Verbose = False,
    pdf: Pdf = False,
) -> None:
    """Run many surveys in parallel, each with a report.

    One table lists all surveys.  Folders of photographs without a survey file get one in the folder of the
    batch.  Exit code 0 if every survey has a dependable result, 1 if not, 70 if a
    survey failed by an error of the program, 2 if the input must be corrected.
    """
    if cluster is not None and jobs is not None:
        raise KolinearError("--jobs counts processes on this computer; --cluster has other workers")
    with loading():
        from rich.console import Console

        from sfm.library.surveys import colmap_writer
        from sfm.products.batch.job import Comparers
        from sfm.products.batch.run import calls_of, find_surveys, memory_of, run_batch
        from sfm.products.batch.table import (
            BatchTable,
            print_batch,
            refuse_foreign_pages,
            stopping_at_terminate,
        )

    refuse_foreign_pages(out)  # before anything is drafted there
    without_draft: dict[Path, Exception] = {}

    def draft(photographs: Path) -> Path:
        """Return the survey file of a folder of photographs, or the folder if it has no draft."""
        try:
            return drafted_beside(photographs, None, None, within=out)[0]
        except (SurveyFileError, GeometryError, PhotographError) as error:  # fails only this survey
            without_draft[photographs.resolve()] = error
            return photographs

    files = find_surveys(surveys, draft)
    compile_first()
    engine = batch_engine(
        partial(calls_of, files, allow_outside=allow_outside),
        partial(memory_of, files, allow_outside=allow_outside),
        jobs=jobs,
        cluster=cluster,
        send=partial(print, file=sys.stderr),
    )
    with stopping_at_terminate(), BatchTable(Console(stderr=True), verbose=verbose) as table:
        rows = run_batch(
            files,
            out,
            engine,
            Comparers(_programs_of_worker, colmap_writer),
            table,
            resume=resume,
            allow_outside=allow_outside,
            pictures_mb=pictures_mb,
            without_draft=without_draft,
        )
    print_batch(Console(highlight=False), rows, out / "index.html")
    if pdf:
        from sfm.cli.console import print_page
        from sfm.products.batch.job import note_finished, was_finished

        for folder in (out / row.folder for row in rows if row.folder):
            noted = was_finished(folder)
            if (folder / "report.html").is_file():
                print_page("Report", folder / "report.html", pdf=True)
            if noted:
                note_finished(folder)  # with its PDF
        print_page("Index", out / "index.html", pdf=True)
    if any(row.fault for row in rows):
        raise SystemExit(FAULT)
    if not all(row.succeeded for row in rows):
        raise SystemExit(FAILED)


def _programs_of_worker(survey: Survey) -> OtherPrograms:
    """Return the programs to compare a survey with, on one thread each, as every core has a worker."""
    from sfm.library.surveys import programs_of

    return programs_of(survey.compare.backend, survey.compare.baseline, threads=1)


def batch_engine(
    busy: Callable[[], int],
    needed_bytes: Callable[[], float],
    *,
    jobs: int | None,
    cluster: str | None,
    send: Callable[[str], None],
) -> AbstractContextManager[Engine]:
    """Return the engine of a batch.

    Args:
        busy: returns the largest number of calls that can run at a time; more workers would be idle.
        needed_bytes: returns the memory of the largest call that fits this computer, bytes.
        jobs: number of workers on this computer; if None, as many as its cores and memory allow.
        cluster: address of a Dask scheduler to use instead.
        send: receives one line with the reason if surveys run one after the other.

    Raises:
        MissingLibraryError: `cluster` is given but Dask is not installed.
        BackendError: no scheduler answers at the address.
    """
    try:
        from adapters import dask_cluster as dask
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("dask", "distributed"):
            raise
        if cluster is not None:
            raise MissingLibraryError(f"--cluster {cluster}: Dask is not installed: {INSTALL_DASK}") from None
        send(f"Dask is not installed: surveys run one after the other in this process; {INSTALL_DASK}")
        return nullcontext(InProcess())
    engine: AbstractContextManager[Engine]
    if cluster is not None:
        engine = dask.remote_engine(cluster, "--cluster")
    else:
        engine = dask.local_engine(min(jobs or dask.fitting_workers(needed_bytes()), busy()))
    return engine


class InProcess:
    """Engine that runs one piece of work after the other in this process (`sfm.runtime.executor.Engine`).

    Messages of a call are passed on after it has returned.
    """

    workers = 1

    @property
    def call_bytes(self) -> float:
        """Memory that this process may take, bytes."""
        return within_bytes()

    def run(self, works: Iterable[Work], *, at_a_time: int) -> Iterator[Event]:
        """Run all work one call at a time, regardless of `at_a_time`, and yield events.

        Args:
            works: pieces of work, in order.
            at_a_time: ignored.

        Raises:
            KolinearError: raised by a called function.
        """
        for work in works:
            try:
                parts = []
                for part in work.parts:
                    value, said = _run_call(part)
                    yield from (Sent(work.key, message) for message in said)
                    parts.append(value)
                value, said = _run_call(work.whole, parts)
            except KolinearError:
                raise
            except Exception as error:
                yield Lost(work.key, f"it failed: {type(error).__name__}: {one_line(error)}")
                continue
            yield from (Sent(work.key, message) for message in said)
            yield Done(work.key, value)


def _run_call(call: Call, *more: Any) -> tuple[Any, list[dict[str, Any]]]:
    """Return the value of a call and the messages that it sent.

    BLAS is limited to one thread, as in a worker: sums over several threads differ in the last bit.
    """
    said: list[dict[str, Any]] = []
    with threadpool_limits(limits=1):
        return call.function(*call.arguments, *more, send=said.append), said
