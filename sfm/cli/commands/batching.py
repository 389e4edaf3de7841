"""Command about many surveys: batch."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.commands.starting import FAILED, loading
from sfm.cli.commands.surveying import AllowOutside, PicturesMb, Verbose
from sfm.cli.first_use import compile_first
from sfm.errors import KolinearError
from sfm.runtime.faults import FAULT

if TYPE_CHECKING:
    from sfm.survey.inputs.survey import Survey
    from sfm.survey.other_programs import OtherPrograms


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
    """Run many surveys side by side, each to its own report.

    One table lists them all.  Exit code 0 if every survey has a dependable result, else 1; 70 if one met
    a fault of the program; 2 where a person must put something right.
    """
    if cluster is not None and jobs is not None:
        raise KolinearError("--jobs is for processes on this computer, --cluster brings its own workers")
    with loading():
        from rich.console import Console

        from sfm.api import colmap_writer
        from sfm.batch.job import Comparers
        from sfm.batch.run import calls_of, find_surveys, run_batch
        from sfm.batch.table import BatchTable, print_batch, stopping_at_terminate
        from sfm.cli.commands.batch_engine import batch_engine

    files = find_surveys(surveys)
    compile_first()
    engine = batch_engine(
        partial(calls_of, files, allow_outside=allow_outside),
        jobs=jobs,
        cluster=cluster,
        tell=partial(print, file=sys.stderr),
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
