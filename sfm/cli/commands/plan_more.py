"""The command `plan more`: photographs to add to a survey."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import Pdf, PlanOut, ResultFolder
from sfm.cli.process import loading
from sfm.model.errors import GeometryError
from sfm.runtime.faults import working_on


def plan_more(
    result: ResultFolder,
    count: Annotated[
        int, typer.Option("--photographs", metavar="N", min=1, max=50, help="Number of new photographs.")
    ] = 3,
    incidence: Annotated[
        float,
        typer.Option(
            "--max-incidence-deg",
            metavar="DEG",
            help="Largest angle between a new ray and the mean ray of a point, degrees.",
        ),
    ] = 60.0,
    out: PlanOut = Path("out/more"),
    pdf: Pdf = False,
) -> None:
    """Propose further photographs that improve the weakest points.

    The proposed stations are about as far from the object as those of the survey. Obstacles that hide points
    from there are not known.
    """
    with loading():
        from adapters.formats.control_tables import read_given
        from adapters.formats.result_tables import read_result
        from sfm.cli.console import exit_by, print_page, print_verdict
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.products.planning.plan import further_photographs, image_sigma, with_image_sigma
        from sfm.report.pages import page_of, write_declared
        from sfm.runtime.progress import StageClock
        from sfm.runtime.progress_bar import drawn_progress

    refuse_foreign_folder(out)
    with working_on(str(result)), drawn_progress() as drawn, StageClock(drawn).stage("plan"):
        stored = read_result(result)
        given = read_given(result, stored.network)
        sigma = given.sigma0_px or image_sigma(stored.network)
        if not sigma > 0:
            raise GeometryError("the standard deviation of its image points is not known")
        network = with_image_sigma(stored.network, sigma).with_given(given.bars)
        further = further_photographs(
            network, stored.estimate, sigma_px=sigma, count=count, max_incidence_deg=incidence
        )
    page = page_of(further, result=stored)
    path = write_declared(page, out)
    print_verdict(page.verdict)
    print(page.text)
    print_page("Report", path, pdf=pdf)
    exit_by(page.verdict)
