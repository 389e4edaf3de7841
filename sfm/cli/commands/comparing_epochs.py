"""The command `epochs`: what moved between two or more surveys of one object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.commands.starting import loading
from sfm.errors import SurveyFileError
from sfm.runtime.faults import working_on

if TYPE_CHECKING:
    from sfm.epochs.differences import Epoch


def epochs(
    results: Annotated[
        list[Path],
        typer.Argument(
            metavar="FIRST SECOND ...",
            help="Result folders in their order; a survey file is run first, its result goes to out/NAME.",
        ),
    ],
    reference: Annotated[
        str,
        typer.Option(
            "--reference",
            metavar="P,Q,...",
            help="Points taken as stable until a test shows otherwise: names, patterns such as R*, ranges "
            "such as 501-520.  [default: all]",
        ),
    ] = "",
    group: Annotated[
        list[str] | None,
        typer.Option(
            "--group",
            metavar="NAME=P,Q,...",
            help="Points whose motion as a block is asked for; may be given several times.",
        ),
    ] = None,
    model: Annotated[
        str, typer.Option("--model", help="How groups move: rigid, similarity or affine.")
    ] = "rigid",
    alpha: Annotated[
        float,
        typer.Option(
            "--alpha", min=1e-6, max=0.5, help="Probability of reporting a movement where nothing moved."
        ),
    ] = 0.05,
    together: Annotated[
        bool,
        typer.Option(
            "--together",
            help="Adjust all epochs as one, with one interior orientation of each camera that took several "
            "of them; one that changed is refused.",
        ),
    ] = False,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder of tables, JSON and page.")
    ] = Path("out/epochs"),
) -> None:
    """Find what moved between surveys of one object.

    Congruency test, the points that are stable, displacements with their tests, and motion of groups.
    """
    with loading():
        from sfm.cli.console import print_verdict
        from sfm.epochs.series import analyse_epochs, verdict_of_epochs
        from sfm.files.manifest import refuse_foreign_folder
        from sfm.report.epochs import describe_block, describe_stable
        from sfm.report.pages import write_page

    refuse_foreign_folder(out)
    if len(results) < 2:
        raise SurveyFileError(f"epochs: {len(results)} given, expected 2 or more")
    groups: dict[str, list[str]] = {}
    for name, points in map(_named, group or ()):
        if name in groups:
            raise SurveyFileError(f"--group {name} is given twice")
        groups[name] = _listed(points)
    for k, path in enumerate(results):
        if path.resolve() in [one.resolve() for one in results[:k]]:
            raise SurveyFileError(f"epochs: {path} is given twice")
    given = [_epoch(path) for path in results]
    if len({epoch.name for epoch in given}) < len(given):  # folders of one name in different places
        given = [replace(epoch, name=str(path)) for epoch, path in zip(given, results, strict=True)]
    with working_on(" ".join(map(str, results))):
        found = analyse_epochs(
            given,
            reference=_listed(reference),
            groups=groups,
            model=model,
            alpha=alpha,
            together=together,
        )
    page = write_page(found, out)
    print_verdict(verdict_of_epochs(found))
    for pair in found.pairs:
        print(" to ".join(pair.displacements.differences.names))
        print(f"  {describe_stable(pair.displacements)}")
        for block in pair.blocks:
            print(f"  {describe_block(block)}")
    print(f"Report: {page}")


def _epoch(path: Path) -> Epoch:
    """Return an epoch of a result folder, or of a survey file, which is run."""
    from adapters.formats.given_table import read_given
    from adapters.formats.result_tables import read_result
    from sfm.cli.commands.surveying import run_file
    from sfm.epochs.differences import Epoch

    folder = run_file(path) if path.is_file() else path
    with working_on(str(folder)):
        result = read_result(folder)
        given = read_given(folder, result.network)
    name = folder.resolve().name
    return Epoch(name, result, given.bars, given.control, given.interior, given.sigma0, given.sigma0_px)


def _named(text: str) -> tuple[str, str]:
    name, equals, points = text.partition("=")
    if not (name.strip() and equals and points.strip()):
        raise SurveyFileError(f"--group {text}: expected a name and its points, such as pier=P*,17")
    return name.strip(), points


def _listed(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]
