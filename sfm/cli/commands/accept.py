"""The command `accept`: calibrated lengths, VDI/VDE 2634 part 1."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import Pdf, ResultFolder
from sfm.cli.process import loading
from sfm.runtime.faults import working_on


def accept(
    source: ResultFolder,
    lengths: Annotated[
        Path, typer.Argument(metavar="LENGTHS.csv", help="Calibrated lengths: line,from,to,length[,sigma].")
    ],
    a: Annotated[
        float, typer.Option("--limit-a", metavar="A", help="A of the error limit A + K L, object unit.")
    ],
    k: Annotated[
        float, typer.Option("--limit-k", metavar="K", help="K of the error limit, such as 2e-5.")
    ] = 0.0,
    b: Annotated[
        float | None, typer.Option("--limit-b", metavar="B", help="Largest error limit, object unit.")
    ] = None,
    coverage: Annotated[
        float,
        typer.Option(
            "--coverage", metavar="k", min=1.0, help="Coverage factor k of U = k sigma of the calibration."
        ),
    ] = 2.0,
    diagonal: Annotated[
        float | None,
        typer.Option(
            "--diagonal",
            metavar="D",
            help="Body diagonal of the measuring volume, object unit.  [default: of the box around all "
            "points]",
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the table and the page.")
    ] = Path("out/acceptance"),
    pdf: Pdf = False,
) -> None:
    """Test a result against calibrated lengths (VDI/VDE 2634).

    The scale must come from other bars than the tested ones. Exit code 1 if an error of a length provably
    exceeds the limit, or simply exceeds it where the calibration has no standard deviation.
    """
    with loading():
        from adapters.formats.result_tables import read_result, read_scale_sources
        from sfm.cli.console import exit_by, print_page, print_verdict
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.products.inspection.acceptance import LengthLimit, accept_result, read_lengths
        from sfm.report.pages import write_page

    refuse_foreign_folder(out)
    with working_on(str(source)):
        result = read_result(source)
        bars, control = read_scale_sources(source)
    acceptance = accept_result(
        result,
        read_lengths(lengths),
        LengthLimit(a, k, float("inf") if b is None else b),
        bars=bars,
        control=control,
        coverage=coverage,
        diagonal=diagonal,
    )
    page = write_page(acceptance, out)
    print_verdict(acceptance.verdict)
    print(f"largest error of a length: {acceptance.largest:.4g} {acceptance.unit}")
    print_page("Report", page, pdf=pdf)
    exit_by(acceptance.verdict)
