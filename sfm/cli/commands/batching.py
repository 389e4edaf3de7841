"""Command about many surveys: batch.

Who does the work of a batch: Dask on this computer or elsewhere, or this process where it is missing.

An engine without processes: one call after the other, here, where no library for more is installed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

import typer
from threadpoolctl import threadpool_limits

from sfm.cli.commands.starting import FAILED, compile_first, loading
from sfm.cli.commands.surveying import AllowOutside, PicturesMb, Verbose
from sfm.errors import KolinearError, MissingLibraryError, one_line
from sfm.runtime.executor import Call, Done, Engine, Event, Lost, Sent, Work
from sfm.runtime.faults import FAULT

if TYPE_CHECKING:
    from sfm.survey.assembly import OtherPrograms
    from sfm.survey.inputs.survey import Survey

INSTALL_DASK = "pip install 'dask[distributed]' cryptography, the extra kolinear[cluster]"


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
    pictures_mb: PicturesMb = 15.0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep what an earlier run finished, if its inputs are the same.")
    ] = False,
    allow_outside: AllowOutside = False,
    verbose: Verbose = False,
) -> None:
    """Run many surveys side by side, each with its report.

    One table lists them all.  Exit code 0 if every survey has a dependable result, else 1; 70 if one met
    a fault of the program; 2 where a person must put something right.
    """
    if cluster is not None and jobs is not None:
        raise KolinearError("--jobs is for processes on this computer, --cluster brings its workers")
    with loading():
        from rich.console import Console

        from sfm.api import colmap_writer
        from sfm.batch.job import Comparers
        from sfm.batch.run import calls_of, find_surveys, run_batch
        from sfm.batch.table import BatchTable, print_batch, stopping_at_terminate

    files = find_surveys(surveys)
    compile_first()
    engine = batch_engine(
        partial(calls_of, files, allow_outside=allow_outside),
        jobs=jobs,
        cluster=cluster,
        send=partial(print, file=sys.stderr),
    )
    with stopping_at_terminate(), BatchTable(Console(stderr=True), verbose=verbose) as table:
        rows = run_batch(
            files,
            out,
            engine,
            Comparers(_others_of_worker, colmap_writer),
            table,
            resume=resume,
            allow_outside=allow_outside,
            pictures_mb=pictures_mb,
        )
    print_batch(Console(highlight=False), rows, out / "index.html")
    if any(row.fault for row in rows):
        raise SystemExit(FAULT)
    if not all(row.succeeded for row in rows):
        raise SystemExit(FAILED)


def _others_of_worker(survey: Survey) -> OtherPrograms:
    """Return what a survey is compared with in a worker of a batch, one of as many as there are cores."""
    from sfm.api import programs_of

    return programs_of(survey.compare.backend, survey.compare.baseline, threads=1)


def batch_engine(
    busy: Callable[[], int], *, jobs: int | None, cluster: str | None, send: Callable[[str], None]
) -> AbstractContextManager[Engine]:
    """Return the engine of a batch.

    Args:
        busy: returns how many calls can run at a time at most; more workers would wait for nothing.
        jobs: workers on this computer; as many as its cores and memory allow if not given.
        cluster: address of a Dask scheduler in place of them.
        send: receives one line where surveys run one after the other, and why.

    Raises:
        MissingLibraryError: a scheduler is asked for, and Dask is not installed.
        BackendError: no scheduler answers at the address.
    """
    dask = _dask_cluster()
    if dask is None:
        if cluster is not None:
            raise MissingLibraryError(f"--cluster {cluster}: Dask is not installed: {INSTALL_DASK}")
        send(f"Dask is not installed: surveys run one after the other in this process; {INSTALL_DASK}")
        return nullcontext(InProcess())
    engine: AbstractContextManager[Engine]
    if cluster is not None:
        engine = dask.remote_engine(cluster)
    else:
        engine = dask.local_engine(min(jobs or dask.fitting_workers(), busy()))
    return engine


def _dask_cluster() -> ModuleType | None:
    """Return the module that uses Dask, None where Dask is not installed."""
    try:
        from adapters import dask_cluster
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("dask", "distributed"):
            raise
        return None
    return dask_cluster


class InProcess:
    """Runs one piece of work after the other in this process, see sfm.kernels.threads.Engine.

    Messages of a call are passed on when it has returned.
    """

    workers = 1

    def run(self, works: Iterable[Work], *, at_a_time: int) -> Iterator[Event]:
        """Run all work and yield what happens; one call at a time, whatever is asked for.

        Raises:
            KolinearError: what a called function raised.
        """
        for work in works:
            try:
                parts = []
                for part in work.parts:
                    value, said = _called(part)
                    yield from (Sent(work.key, message) for message in said)
                    parts.append(value)
                value, said = _called(work.whole, parts)
            except KolinearError:
                raise
            except Exception as error:
                yield Lost(work.key, f"it failed: {type(error).__name__}: {one_line(error)}")
                continue
            yield from (Sent(work.key, message) for message in said)
            yield Done(work.key, value)


def _called(call: Call, *more: Any) -> tuple[Any, list[dict[str, Any]]]:
    """Return what a call returns and what it has reported.

    BLAS is held to one thread as in a worker: sums of several threads differ in the last bit.
    """
    said: list[dict[str, Any]] = []
    with threadpool_limits(limits=1):
        return call.function(*call.arguments, *more, send=said.append), said
