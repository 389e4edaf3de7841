"""The command `plan simulate`, which renders a plan, runs it and compares."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import Pdf
from sfm.cli.process import loading
from sfm.runtime.faults import working_on


def plan_simulate(
    folder: Annotated[Path, typer.Argument(metavar="PLAN", help="Folder written by `plan network`.")],
    codes: Annotated[str, typer.Option("--family", help="Code family of the targets.")] = "ring14",
    image_points: Annotated[
        bool, typer.Option("--image-points", help="Simulate image points instead of photographs.")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", metavar="S", min=0, help="Seed of the noise.")] = 0,
    out: Annotated[
        Path,
        typer.Option("--out", metavar="DIR", help="Folder for the photographs, survey file and result."),
    ] = Path("out/simulation"),
    pdf: Pdf = False,
) -> None:
    """Render the photographs of a plan, run the survey, and compare it with the prediction.

    The points become targets; the rig, scale bars and observations have errors as planned. Predicted standard
    deviations are compared with the achieved ones and with the true errors.
    """
    with loading():
        from sfm.cli.console import print_page
        from sfm.files.open_folders import locked, refuse_foreign_folder
        from sfm.files.whole_files import remove_leftovers, whole_folder
        from sfm.library.surveys import run_survey
        from sfm.products.inspection.planned_survey import compare_with_plan, read_plan, write_simulation

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
                achieved = compare_with_plan(planned, family, result, seed=seed)
                text = json.dumps(asdict(achieved), indent=2, allow_nan=False)
                (part / "simulation.json").write_text(f"{text}\n", encoding="utf-8")
    print(f"{achieved.points} of {achieved.planned} planned points measured")
    print(f"sigma of points: {achieved.ratio:.3f} times the predicted (median)")
    print(f"true errors: {achieved.error_ratio_squared**0.5:.3f} times the predicted, RMS")
    print(
        f"sigma of an image coordinate: {achieved.sigma_px:.4f} px, predicted {achieved.predicted_px:.4f} px"
    )
    if achieved.mount_ratio_squared is not None:
        rms = achieved.mount_ratio_squared**0.5
        print(f"true errors of mounts: {rms:.3f} times their standard deviations, RMS")
    print_page("Report", out / "result" / "report.html", pdf=pdf)
