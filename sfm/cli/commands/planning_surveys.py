"""Commands between a plan and its survey: the plan simulated, and photographs to add to a result."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.commands.starting import loading
from sfm.runtime.faults import working_on


def simulate_command(
    folder: Annotated[Path, typer.Argument(metavar="PLAN", help="Folder that `plan network` has written.")],
    codes: Annotated[str, typer.Option("--family", help="Rings of the coded targets.")] = "ring14",
    image_points: Annotated[
        bool, typer.Option("--image-points", help="Simulate image points in place of photographs.")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", metavar="S", min=0, help="Of the noise.")] = 0,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder of photographs, survey file and result.")
    ] = Path("out/simulation"),
) -> None:
    """Photograph a plan by rendering, run the survey, and compare it.

    Its points become targets, its rig, scale bars and observations have errors as planned; predicted standard
    deviations are beside those achieved and the true errors.
    """
    with loading():
        from sfm.api import run_survey
        from sfm.files.folder_lock import locked
        from sfm.files.manifest import refuse_foreign_folder
        from sfm.files.whole_files import remove_leftovers, whole_folder
        from sfm.inspection.planned_survey import achieved, read_plan, write_simulation

    refuse_foreign_folder(out)
    with working_on(str(folder)):
        planned = read_plan(folder)
        family = None if image_points else codes
        with locked(out.parent / f".{out.name}.lock", out):
            remove_leftovers(out)
            with whole_folder(out, "the simulation", replaceable=True) as part:
                survey = write_simulation(planned, part, codes=family, seed=seed)
                result = run_survey(survey, compare_with="none", progress=True)
                result.write(part / "result")
                (part / ".result.lock").unlink(missing_ok=True)
                found = achieved(planned, family, result, seed=seed)
                text = json.dumps(asdict(found), indent=2, allow_nan=False)
                (part / "simulation.json").write_text(f"{text}\n", encoding="utf-8")
    print(f"{found.points} of {found.planned} planned points measured")
    print(f"sigma of points: {found.ratio:.3f} times the predicted (median)")
    print(f"true errors: {found.error:.3f} times the predicted, RMS")
    print(f"sigma of an image coordinate: {found.sigma_px:.4f} px, predicted {found.predicted_px:.4f} px")
    if found.mounts is not None:
        print(f"true errors of mounts: {found.mounts:.3f} times their standard deviations, RMS")
    print(f"Report: {out / 'result' / 'report.html'}")


def more_command(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder of a survey.")],
    count: Annotated[
        int, typer.Option("--photographs", metavar="N", min=1, max=50, help="Number of new ones.")
    ] = 3,
    incidence: Annotated[
        float,
        typer.Option("--max-incidence-deg", metavar="DEG", help="Largest angle to the mean ray."),
    ] = 60.0,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of page and tables.")] = Path(
        "out/more"
    ),
) -> None:
    """Propose further photographs that help the weakest points.

    They are taken from about as far as those of the survey; what hides points there is not known.
    """
    with loading():
        import numpy as np

        from adapters.formats.given_table import read_given
        from adapters.formats.result_tables import read_result
        from sfm.cli.console import print_verdict
        from sfm.errors import GeometryError
        from sfm.files.manifest import refuse_foreign_folder
        from sfm.planning.further import further_photographs
        from sfm.report.pages import page_of, write_declared
        from sfm.runtime.progress import StageClock
        from sfm.runtime.progress_bar import drawn_progress

    refuse_foreign_folder(out)
    with working_on(str(result)), drawn_progress() as drawn, StageClock(drawn).stage("plan"):
        stored = read_result(result)
        given = read_given(result, stored.network)
        seen = stored.network.image_points
        stated = float(np.median(np.sqrt(np.trace(seen.covariance, axis1=1, axis2=2) / 2)))
        sigma = given.sigma0_px or stated
        if not sigma > 0:
            raise GeometryError("the standard deviation of its image points is not known")
        network = replace(
            stored.network,
            image_points=replace(seen, covariance=seen.covariance * (sigma / stated) ** 2),
            scale_bars=given.bars,
        )
        found = further_photographs(
            network, stored.estimate, sigma_px=sigma, count=count, max_incidence_deg=incidence
        )
    page = page_of(found, result=stored)
    path = write_declared(page, out)
    print_verdict(page.verdict)
    print(page.text)
    print(f"Report: {path}")
