"""The command `audit`: a model of any program, judged by its own image points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import Overwrite
from sfm.cli.process import compile_first, loading
from sfm.runtime.faults import working_on

SHOWN = 4  # sections of the page whose tables are printed


def audit(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="File or folder of another program.")],
    from_format: Annotated[
        str | None,
        typer.Option("--from", metavar="F", help="Format of the model.  [default: by its content]"),
    ] = None,
    survey: Annotated[
        Path | None,
        typer.Option(
            "--survey",
            metavar="FILE",
            help="Survey file with control, scale bars and tables of the model's points.",
        ),
    ] = None,
    fix: Annotated[
        str,
        typer.Option("--fix", metavar="NAMES", help="Interior parameters to hold fixed, such as cx,cy,k1."),
    ] = "",
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder of the result.  [default: out/NAME_audit]"),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Judge a model of another program by its own image points.

    The model is adjusted from its image points, without photographs, and held against what it states: whether
    its cameras are determined, how precise its points are, gross errors, what the datum does. The folder has
    a page, audit.html, and the full report of the adjustment.

    Exit code 0 with a dependable result, with or without remarks; 1 if the result is not dependable, for the
    reasons on the page, or a stage cannot go on; 2 if the input must be corrected.
    """
    with loading():
        from adapters.formats.registry import read_content
        from sfm.cli.console import exit_by, print_verdict
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.pipeline import run_survey
        from sfm.products.auditing.audit import audit_of, stated_of, survey_of_model
        from sfm.report.findings import findings_of
        from sfm.report.output import folder_name, write_result
        from sfm.report.pages import page_of, texts_of
        from sfm.runtime.progress_bar import drawn_progress
        from sfm.runtime.threads import cores, one_blas_thread
        from sfm.survey.inputs.survey import read_survey

    with working_on(str(model)):
        content = read_content(model, from_format)
        stated = stated_of(content.result)
        held = tuple(name.strip() for name in fix.split(",") if name.strip())
        given = None if survey is None else read_survey(survey)
        audited = survey_of_model(content.result, stated, fixed=held, given=given)
    folder = out or Path("out") / f"{folder_name(model.resolve().name)}_audit"
    refuse_foreign_folder(folder)
    compile_first()
    with working_on(str(model)), drawn_progress() as progress, one_blas_thread():
        result = run_survey(audited, jobs=cores(), progress=progress)
        findings = findings_of(result)
        page = page_of(audit_of(content.result, stated, findings.result), report="report.html")

        def add_page(part: Path) -> None:
            for name, text in texts_of(page).items():
                (part / name).write_text(text, encoding="utf-8", newline="")

        write_result(findings, folder, finish=add_page, progress=progress)
    print_verdict(page.verdict)
    print(replace(page, sections=page.sections[:SHOWN]).text)
    print(f"Report: {folder / 'report.html'}")
    print(f"Audit: {folder / page.path}")
    exit_by(page.verdict)
