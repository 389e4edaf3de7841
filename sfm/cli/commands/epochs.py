"""The command `epochs`: what moved between surveys of one object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.options import Pdf, names_in
from sfm.cli.process import loading
from sfm.model.errors import SurveyFileError
from sfm.runtime.faults import working_on

if TYPE_CHECKING:
    from sfm.products.epochs.differences import Epoch


def epochs(
    results: Annotated[
        list[Path],
        typer.Argument(
            metavar="FIRST SECOND ...",
            help="Result folders in chronological order. A survey file is run first, with its result in "
            "out/NAME.",
        ),
    ],
    reference: Annotated[
        str,
        typer.Option(
            "--reference",
            metavar="P,Q,...",
            help="Points assumed stable until a test shows otherwise: names, patterns such as R*, ranges "
            "such as 501-520.  [default: all]",
        ),
    ] = "",
    group: Annotated[
        list[str] | None,
        typer.Option(
            "--group",
            metavar="NAME=P,Q,...",
            help="Points whose motion as one block is estimated; may be given several times.",
        ),
    ] = None,
    model: Annotated[
        str, typer.Option("--model", help="Motion of a group: rigid, similarity or affine.")
    ] = "rigid",
    alpha: Annotated[
        float | None,
        typer.Option(
            "--alpha",
            min=1e-6,
            max=0.5,
            help="Probability of reporting a motion where nothing moved; as for a survey if left out.",
        ),
    ] = None,
    together: Annotated[
        bool,
        typer.Option(
            "--together",
            help="Adjust all epochs together, with one interior orientation for each camera that took "
            "several of them; a camera that changed between epochs is refused.",
        ),
    ] = False,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the tables, JSON and page.")
    ] = Path("out/epochs"),
    pdf: Pdf = False,
) -> None:
    """Find what moved between surveys of one object.

    Reports the congruency test, the stable points, displacements with their tests, and motions of groups.
    """
    with loading():
        from sfm.cli.console import exit_by, print_page, print_verdict
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.model.distributions import FALSE_ALARM
        from sfm.products.epochs.page import describe_block, describe_stable
        from sfm.products.epochs.series import analyse_epochs, verdict_of_epochs
        from sfm.report.pages import write_page

    refuse_foreign_folder(out)
    if len(results) < 2:
        raise SurveyFileError(f"epochs: {len(results)} given, expected 2 or more")
    groups: dict[str, tuple[str, ...]] = {}
    for text in group or ():
        name, equals, points = (part.strip() for part in text.partition("="))
        if not (name and equals and points):
            raise SurveyFileError(f"--group {text}: expected a name and its points, such as pier=P*,17")
        if name in groups:
            raise SurveyFileError(f"--group {name} is given twice")
        groups[name] = names_in(points)
    for k, path in enumerate(results):
        if path.resolve() in [earlier.resolve() for earlier in results[:k]]:
            raise SurveyFileError(f"epochs: {path} is given twice")
    given = [_read_epoch(path) for path in results]
    if len({epoch.name for epoch in given}) < len(given):  # folders of the same name in different folders
        given = [replace(epoch, name=str(path)) for epoch, path in zip(given, results, strict=True)]
    with working_on(" ".join(map(str, results))):
        series = analyse_epochs(
            given,
            reference=names_in(reference),
            groups=groups,
            model=model,
            alpha=FALSE_ALARM if alpha is None else alpha,
            together=together,
        )
    page = write_page(series, out)
    verdict = verdict_of_epochs(series)
    print_verdict(verdict)
    for pair in series.pairs:
        print(" to ".join(pair.displacements.differences.names))
        print(f"  {describe_stable(pair.displacements)}")
        for block in pair.blocks:
            print(f"  {describe_block(block)}")
    print_page("Report", page, pdf=pdf)
    exit_by(verdict)


def _read_epoch(path: Path) -> Epoch:
    """Return the epoch of a result folder, or of a survey file, which is run first."""
    from adapters.formats.control_tables import read_given
    from adapters.formats.result_tables import read_result
    from sfm.cli.survey_runs import run_file
    from sfm.products.epochs.differences import Epoch

    folder = run_file(path) if path.is_file() else path
    with working_on(str(folder)):
        result = read_result(folder)
        given = read_given(folder, result.network)
    name = folder.resolve().name
    return Epoch(name, result, given.bars, given.control, given.interior, given.sigma0, given.sigma0_px)
